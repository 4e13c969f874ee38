"""The only door into the core for the CLI and the worker: ``run(spec) -> Result``."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from rsavatar import __version__, catalog, kernels
from rsavatar.body.find import find_body
from rsavatar.calibration import found_schedule, schedule_errors
from rsavatar.checkpoint import Owner, settle
from rsavatar.data.catalogue import open_subject
from rsavatar.data.disturb import disturb
from rsavatar.errors import SpecError, expected
from rsavatar.evaluate import Score, evaluate, write_preview
from rsavatar.events import Note, Preview, Report, silent
from rsavatar.methods.base import AbstractMethod, Case, build_actor, check_case, observations, settings
from rsavatar.optimization import Saver
from rsavatar.pictures import Shown, work_of, write_pictures
from rsavatar.spec import JobSpec
from rsavatar.train import Trained, fit


@dataclass(frozen=True)
class Result:
    """What a job found. ``to_json`` is the content of ``OUT/metrics.json``.

    ``means`` is over frames, then cameras (paper, section 4.1); it also holds ``joint_mm``, ``joint_deg`` and
    ``sub_frame_joint_mm`` where the subject has a true motion, and ``readout_error_*`` and ``trigger_error_*`` where
    the schedule was disturbed or calibrated.
    """

    spec: JobSpec
    means: Mapping[str, float | None]
    scores: tuple[Score, ...]
    protocol: Mapping[str, Any]  # mask dilation, perceptual metric states, cameras, frames
    gaussians: int
    train_seconds: float
    evaluate_seconds: float
    provenance: Mapping[str, Any]  # code version, commit, data and spec sha256, machine, threads
    artifacts: Mapping[str, Path]  # name -> file: checkpoint, metrics, motion, previews
    schedule: Mapping[str, Any] = field(default_factory=dict)  # readouts and triggers found; empty if not calibrated

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        per_camera: dict[str, dict[str, list[float]]] = {}
        for score in self.scores:
            for name, value in score.values.items():
                if value is not None:
                    per_camera.setdefault(score.camera, {}).setdefault(name, []).append(value)
        return {
            "spec": self.spec.model_dump(mode="json", by_alias=True),
            "means": dict(self.means),
            "per_camera": {c: {k: sum(v) / len(v) for k, v in m.items()} for c, m in per_camera.items()},
            "scores": [{"camera": s.camera, "frame": s.frame, **s.values} for s in self.scores],
            "protocol": dict(self.protocol),
            "gaussians": self.gaussians,
            "train_seconds": self.train_seconds,
            "evaluate_seconds": self.evaluate_seconds,
            "provenance": dict(self.provenance),
            "schedule": dict(self.schedule),
        }


def run(
    spec: JobSpec,
    out: Path,
    subject_dir: Path | None = None,
    report: Report = silent,
    should_stop: Callable[[], bool] = lambda: False,
) -> Result:
    """Load the subject, train, evaluate; ``out`` gets checkpoint.safetensors, metrics.json, motion.npz, predictions/.

    Resumes from the checkpoint there if it is of the same spec, data and code; the result is bit-identical to that of
    an undisturbed run. ``subject_dir`` None means a subject that the core makes itself (``studio``).
    ``should_stop`` is asked between blocks of steps: when true, a checkpoint is written and ``Interrupted`` raised.

    Raises:
        DataError, BodyError, SpecError, CheckpointError, KernelError, DivergedError: as their names say.
        Interrupted: when ``should_stop`` asked for it.
    """
    kernels.keep_memory()
    _use_threads()
    out = out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    subject = open_subject(spec.subject, subject_dir)
    body, which = find_body(spec.body, subject)
    report(Note(which))
    if not kernels.available():
        report(Note("No native kernels: rendering with the torch twin, several hundred times slower."))
    case = Case(spec, disturb(subject, spec.disturb, spec.seed), body)
    check_case(case)
    method: AbstractMethod = catalog.load(catalog.METHODS, spec.method)()
    prepared = method.prepare(case, report, should_stop)
    case = prepared.case
    actor = build_actor(method, case)
    code = f"{__version__}; {prepared.restorer}" if prepared.restorer else __version__
    owner = Owner(spec.sha256(), subject.fingerprint, body.sha256, code)
    saver = Saver(_checkpoint_file(out, owner, report), owner)
    shown, seen = Shown(method, case, actor), observations(method, case)
    work = work_of(shown, seen)
    trained = fit(actor, seen, settings(case), saver, report, should_stop)
    scored = evaluate(actor, subject, spec.sh_degree, out, report)
    artifacts = {"checkpoint": trained.checkpoint, "metrics": out / "metrics.json", "motion": out / "motion.npz"}
    artifacts |= write_pictures(shown, out)
    if preview := write_preview(scored.scores, subject, out):
        artifacts["preview"] = preview[0]
        report(Preview(spec.iterations, str(preview[0]), preview[1]))
    found = found_schedule(case.subject.timing, subject.training, actor.clock)
    uncertain = bool(spec.calibrate or spec.disturb.readout or spec.disturb.trigger)
    result = Result(
        spec=spec,
        means={**scored.means, **prepared.means, **(schedule_errors(found, subject) if uncertain else {})},
        scores=scored.scores,
        protocol=scored.protocol,
        gaussians=actor.avatar.count,
        train_seconds=trained.seconds,
        evaluate_seconds=scored.seconds,
        provenance=_provenance(owner, trained) | {"work": work, "restorer": prepared.restorer or None},
        artifacts=artifacts,
        schedule=found.to_json(subject.timing) if uncertain else {},
    )
    artifacts["metrics"].write_text(json.dumps(result.to_json(), indent=1) + "\n")
    return result


def _use_threads() -> None:
    """RSAVATAR_THREADS for the kernels, or all cores that this process may use; the result does not depend on it.

    Torch itself gets one: its sums depend on the number of threads, and its tensors here are small.
    """
    wanted = os.environ.get("RSAVATAR_THREADS") or str(len(os.sched_getaffinity(0)))
    if not wanted.isdecimal() or int(wanted) < 1:
        raise SpecError(expected("RSAVATAR_THREADS", "a whole number of at least 1", repr(wanted)))
    kernels.use_threads(int(wanted))
    torch.set_num_threads(1)


def _checkpoint_file(out: Path, owner: Owner, report: Report) -> Path:
    """Where the checkpoint is or will be. One that is damaged or another job's is set aside, not overwritten."""
    path = out / "checkpoint.safetensors"
    for sentence in settle(path, owner)[1]:
        report(Note(sentence))
    return path


def _provenance(owner: Owner, trained: Trained) -> dict[str, Any]:
    """What produced the numbers."""
    return {
        "version": __version__,
        "commit": commit(),
        "spec_sha256": owner.spec,
        "data_sha256": owner.data,
        "body_sha256": owner.body,
        "torch": torch.__version__,
        "kernels": kernels.targets()[0] if kernels.available() else "torch twin",
        "threads": kernels.threads(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}",
        "rejected_steps": trained.rejected,
        "doubted_images": list(trained.doubted),
    }


def commit() -> str:
    """Commit of the checkout that this package runs from; "unknown" outside of one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
