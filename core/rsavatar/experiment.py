"""The only door into the core for the CLI and the worker: ``run(spec) -> Result``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsavatar.events import Report, silent
from rsavatar.spec import JobSpec


@dataclass(frozen=True)
class Score:
    """Metrics of one held-out image; a metric that could not be computed is None (protocol says why)."""

    camera: str
    frame: int
    values: Mapping[str, float | None]


@dataclass(frozen=True)
class Result:
    """What a job found. ``to_json`` is the content of ``OUT/metrics.json``.

    ``means`` is over frames, then cameras (paper, section 4.1); it also holds ``joint_mm``, ``joint_deg`` and
    ``sub_frame_joint_mm`` where the subject has a true motion.
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
        }


def run(
    spec: JobSpec,
    out: Path,
    subject_dir: Path | None = None,
    report: Report = silent,
    should_stop: Callable[[], bool] = lambda: False,
) -> Result:
    """Load the subject, train, evaluate, and write ``OUT/{checkpoint.safetensors, metrics.json, motion.npz, predictions}``.

    Resumes from ``OUT/checkpoint.safetensors`` where that is of the same spec, data and code; the result is bit-identical
    to that of an undisturbed run. ``subject_dir`` None means a subject that the core makes itself (``studio``).
    ``should_stop`` is asked once a step: when true, a checkpoint is written and ``Interrupted`` raised.

    Raises:
        DataError, BodyError, CheckpointError, KernelError, DivergedError: as their names say.
        Interrupted: when ``should_stop`` asked for it.
    """
    raise NotImplementedError
