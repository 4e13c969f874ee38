"""Stress cases of training: bad steps, bad rates, bad data, long runs, and the same bits whatever happens around it."""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import resource
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rsavatar import kernels
from rsavatar.bench.stability_case import Case, Measured
from rsavatar.bench.stability_subject import case as small
from rsavatar.checkpoint import Owner, read
from rsavatar.data.base import Image
from rsavatar.errors import DataError, DivergedError, Interrupted
from rsavatar.events import Event, Note, Progress
from rsavatar.imaging import Actor
from rsavatar.methods.base import Case as Job
from rsavatar.methods.base import build_actor, observations, settings
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.optimization import Rates, Saver, Settings
from rsavatar.train import Observation, fit

OWNER = Owner("stability", "stability", "stability", "stability")
LONG_RUN = "RSAVATAR_STABILITY_STEPS"  # environment variable: steps of the long run
Poison = Callable[[list[Observation]], list[Observation]]
Tune = Callable[[Settings], Settings]


@dataclass
class Run:
    """What a training run said and left behind."""

    actor: Actor
    folder: Path
    events: list[Event] = field(default_factory=list)
    rejected: int = 0

    @property
    def losses(self) -> list[float]:
        """Reported losses, in order."""
        return [e.loss for e in self.events if isinstance(e, Progress) and e.loss is not None]

    @property
    def finite(self) -> bool:
        """Whether every parameter is."""
        return all(bool(torch.isfinite(p).all()) for p in self.actor.parameters())

    @property
    def digest(self) -> str:
        """Of all tensors in the checkpoint, but for the run's duration."""
        tensors, _, _ = read(self.folder / "checkpoint.safetensors")
        total = hashlib.sha256()
        for name in sorted(set(tensors) - {"progress"}):
            total.update(name.encode() + tensors[name].numpy().tobytes())
        return total.hexdigest()[:12]


def train(job: Job, folder: Path, tune: Tune = lambda s: s, poison: Poison = lambda o: o, stop_at: int = 0) -> Run:
    """Train a job in ``folder``, going on from a checkpoint that is there; asked to stop after ``stop_at`` steps."""
    method = RollingShutterAvatar()
    run = Run(build_actor(method, job), folder)
    saver = Saver(folder / "checkpoint.safetensors", OWNER)

    def should_stop() -> bool:
        steps = [e.step for e in run.events if isinstance(e, Progress)]
        return bool(stop_at and steps and steps[-1] >= stop_at)

    seen = poison(observations(method, job))
    with suppress(Interrupted):
        run.rejected = fit(run.actor, seen, tune(settings(job)), saver, run.events.append, should_stop).rejected
    return run


def cases() -> list[Case]:
    """All of them."""
    steps = int(os.environ.get(LONG_RUN, "3000"))
    survive = "finishes with finite parameters"
    drift = "last losses within 1.5x of the best, parameters finite, memory within 64 MiB of that after a tenth"
    same = "every tensor of the checkpoint equal, bit for bit"
    end = "finishes finite, or 'diverged at step n' with the last good checkpoint kept, readable and finite"
    plain = [Case(f"training with P = {P}", survive, _survives(motion="frame-spline", P=P)) for P in (2, 8)]
    return [
        *plain,
        Case("one frame", survive, _survives(frames=1)),
        Case("one camera", survive, _survives(training=("00",))),
        Case("T > H", survive, _survives(T=200)),
        Case("readout 0", survive, _still),
        Case("one empty mask", "left out, the rest trains", _masked(1)),
        Case("every mask empty", "DataError", _masked(2)),
        Case("NaN in one frame's clock", "its steps are rejected, counted and reported; the run survives", _poisoned),
        Case("NaN in the Gaussians", "'diverged at step n' names the parameter", _broken_parameter),
        Case("step sizes x 100", end, _rated(100.0)),
        Case("step sizes x 1e4", end, _rated(1e4)),
        Case("step sizes infinite", end, _rated(math.inf)),
        Case("one and two threads", same, _threads),
        Case("stopped twice and resumed, in other processes", same, _restarts),
        Case(f"{steps} steps", drift, lambda: _long(steps)),
    ]


def _survives(**words: Any) -> Callable[[], Measured]:
    def run() -> Measured:
        with tempfile.TemporaryDirectory() as folder:
            done = train(small(iterations=150, **words), Path(folder))
            losses = f"loss {done.losses[0]:.3f} to {done.losses[-1]:.3f}"
            return f"{losses}, {done.rejected} rejected", done.finite and math.isfinite(done.losses[-1])

    return run


def _still() -> Measured:
    job = small(iterations=150)
    timing = replace(job.subject.timing, readout_frames=0.0)
    with tempfile.TemporaryDirectory() as folder:
        done = train(replace(job, subject=replace(job.subject, timing=timing)), Path(folder))
        return f"loss {done.losses[0]:.3f} to {done.losses[-1]:.3f}", done.finite


def _masked(cameras: int) -> Callable[[], Measured]:
    def run() -> Measured:
        job = small(iterations=100)
        observe, empty = job.subject.observe, job.subject.training[:cameras]

        def blind(name: str, frame: int) -> Image:
            rgb, mask = observe(name, frame)
            return (rgb, mask) if name not in empty else (np.zeros_like(rgb), np.zeros_like(mask))

        with tempfile.TemporaryDirectory() as folder:
            try:
                done = train(replace(job, subject=replace(job.subject, observe=blind)), Path(folder))
            except DataError as error:
                return f"DataError: {error}", cameras == 2
            return f"loss {done.losses[0]:.3f} to {done.losses[-1]:.3f}", cameras == 1 and done.finite

    return run


def _poisoned() -> Measured:
    def poison(seen: list[Observation]) -> list[Observation]:
        return [
            replace(seen[0], schedule=replace(seen[0].schedule, offsets=seen[0].schedule.offsets * math.nan)),
            *seen[1:],
        ]

    with tempfile.TemporaryDirectory() as folder:
        done = train(small(iterations=120, motion="frame-spline"), Path(folder), poison=poison)
        told = [e.text for e in done.events if isinstance(e, Note) and "rejected" in e.text]
        return f"{done.rejected} of 120 rejected, {len(told)} reports", done.finite and done.rejected == 30 and bool(
            told
        )


def _broken_parameter() -> Measured:
    method = RollingShutterAvatar()
    job = small(iterations=100)
    actor = build_actor(method, job)
    actor.avatar.log_scales.data[0, 5] = math.nan
    with tempfile.TemporaryDirectory() as folder:
        saver = Saver(Path(folder) / "checkpoint.safetensors", OWNER)
        try:
            fit(actor, observations(method, job), settings(job), saver, lambda _: None, lambda: False)
        except DivergedError as error:
            return f"DivergedError: {error}", "log_scales" in str(error) and not saver.path.exists()
    return "no error", False


def _rated(factor: float) -> Callable[[], Measured]:
    rates = Rates(**{name: rate * factor for name, rate in asdict(Rates()).items()})

    def run() -> Measured:
        with tempfile.TemporaryDirectory() as folder:
            job = small(iterations=1500, checkpoint_every=50)
            try:
                done = train(job, Path(folder), lambda s: replace(s, rates=rates, sh_from=100))
            except DivergedError as error:
                kept = Path(folder) / "checkpoint.safetensors"
                if not kept.exists():
                    return f"{error}; before the first checkpoint", "diverged at step" in str(error)
                tensors, _, step = read(kept)
                finite = all(bool(torch.isfinite(t).all()) for name, t in tensors.items() if name != "progress")
                return f"{error}; checkpoint of step {step} kept", finite
            return f"loss {done.losses[0]:.3f} to {done.losses[-1]:.3f}", done.finite and math.isfinite(done.losses[-1])

    return run


def _threads() -> Measured:
    before, digests = kernels.threads(), []
    try:
        for threads in (1, 2):
            kernels.use_threads(threads)
            with tempfile.TemporaryDirectory() as folder:
                digests.append(train(small(iterations=200), Path(folder)).digest)
    finally:
        kernels.use_threads(before)
    return f"{digests[0]} and {digests[1]}", digests[0] == digests[1]


def _part(folder: str, stop_at: int) -> None:
    torch.set_num_threads(1)
    kernels.use_threads(2)
    train(small(iterations=200), Path(folder), stop_at=stop_at)


def _restarts() -> Measured:
    with tempfile.TemporaryDirectory() as whole, tempfile.TemporaryDirectory() as parts:
        undisturbed = train(small(iterations=200), Path(whole))
        for stop_at in (25, 125, 0):
            process = multiprocessing.get_context("spawn").Process(target=_part, args=(parts, stop_at))
            process.start()
            process.join()
        digests = undisturbed.digest, replace(undisturbed, folder=Path(parts)).digest
    return f"{digests[0]} and {digests[1]}", digests[0] == digests[1]


def _long(steps: int) -> Measured:
    peaks: list[float] = []

    def settle(how: Settings) -> Settings:
        return replace(how, density=None)

    with tempfile.TemporaryDirectory() as folder:
        train(small(iterations=max(steps // 10, 1)), Path(folder), settle)
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    with tempfile.TemporaryDirectory() as folder:
        done = train(small(iterations=steps), Path(folder), settle)
        peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    windows = [float(np.mean(done.losses[i : i + 10])) for i in range(0, len(done.losses) - 9, 10)]
    grown = peaks[1] - peaks[0]
    text = f"loss {windows[0]:.4f}, best {min(windows):.4f}, last {windows[-1]:.4f}; {grown:.0f} MiB more"
    return text, done.finite and windows[-1] < 1.5 * min(windows) and grown < 64
