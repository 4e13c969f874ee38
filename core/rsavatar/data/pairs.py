"""Where training pairs of rolling-shutter correction come from: studio seeds, or a subject that has sharp frames."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rsavatar.data.base import Array, Bytes, Subject
from rsavatar.data.studio_stage import Stage, row_times, set_stage
from rsavatar.errors import DataError, expected
from rsavatar.events import Progress, Report, silent
from rsavatar.restore.pairs import Take

PERIOD = 11  # source frames; a seed's tempo scales it
TEMPO = (0.7, 1.7)  # from slow to fast: 5 to 80 pixels of motion in a readout at 256 pixels


@dataclass(frozen=True)
class StudioPairs:
    """Which pairs to draw: every seed is another person, another motion, and other clocks and tempo."""

    seeds: tuple[int, ...]
    size: int = 256  # pixels a side
    frames: int = 5  # of a take
    cameras: int = 8  # of the ring, from the first

    def __post_init__(self) -> None:
        if not self.seeds or self.size < 64 or self.frames < 2 or self.cameras < 1:
            got = (len(self.seeds), self.size, self.frames, self.cameras)
            raise DataError(expected("seeds, size, frames and cameras", "at least 1, 64, 2 and 1", got))


def studio_takes(wanted: StudioPairs, report: Report = silent) -> list[Take]:
    """One take for each seed and camera, every row of a rolling frame drawn at its own instant."""
    begun, takes = time.monotonic(), []
    for done, seed in enumerate(wanted.seeds, 1):
        takes += _takes_of(set_stage(seed, wanted.size), wanted, np.random.default_rng([seed, 23]))
        report(Progress("pairs", done, len(wanted.seeds), time.monotonic() - begun))
    return takes


def _takes_of(stage: Stage, wanted: StudioPairs, rng: np.random.Generator) -> list[Take]:
    period = PERIOD * rng.uniform(*TEMPO)
    mids = rng.uniform(0, 40) + period * (1 + np.arange(wanted.frames))
    views = list(stage.cameras[: wanted.cameras])
    size = wanted.size

    def drawn(times: Iterable[Array]) -> list[list[Bytes]]:
        return [[rgb for rgb, _ in stage.pictures(views, clock)] for clock in times]

    rolling = drawn(row_times(mid, period, size) for mid in mids)
    middle = drawn(np.full(size, mid) for mid in mids)
    first = drawn(np.full(size, mid - period / 2) for mid in mids)
    return [
        Take(*(np.stack([images[c] for images in stack]) for stack in (rolling, middle, first)))
        for c in range(len(views))
    ]


def subject_takes(subject: Subject) -> list[Take]:
    """One take for each training camera of a subject that knows its cameras' sharp frames.

    Raises:
        DataError: if it has fewer than two frames, or a sharp frame is missing.
    """
    if subject.frames < 2 or not subject.training:
        raise DataError(expected(f"subject {subject.name}", "a training camera with two frames", "none"))
    frames = range(subject.frames)
    return [
        Take(
            np.stack([subject.observe(camera, n)[0] for n in frames]),
            np.stack([subject.truth(camera, n)[0] for n in frames]),
            None,
        )
        for camera in subject.training
    ]
