"""When the rows of a rolling-shutter benchmark are exposed: groups, windows, instants, the seam (paper, section 4.1).

Times are in source frames. Nothing here reads a picture.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rsavatar.data.base import Array
from rsavatar.errors import DataError, expected

SEAM_LIMIT_PX = 0.5  # the paper's bound on the step between neighbouring bands
_LARGEST_RECURSION = 8


@dataclass(frozen=True)
class Clock:
    """K source frames make one output frame, of which the readout takes the part gamma.

    Raises:
        DataError: unless K is at least 1 and gamma within 0 and 1.
    """

    period: int = 11  # K
    gamma: float = 1.0

    def __post_init__(self) -> None:
        if self.period < 1 or not 0 <= self.gamma <= 1:
            raise DataError(expected("K and gamma", "K >= 1 and 0 <= gamma <= 1", (self.period, self.gamma)))

    @property
    def readout(self) -> float:
        """How long the rows take: gamma K."""
        return self.gamma * self.period

    def mids(self, source_frames: int, triggers: Iterable[float] = (0.0,)) -> list[int]:
        """Mid frames ``n K + K // 2`` of the output frames that a sequence holds.

        The first group is dropped: a centred window with gamma = 1 reaches half an interval beyond its group. So is a
        group whose window, moved by any of ``triggers``, leaves the sequence.
        """
        early, late = min(triggers, default=0.0), max(triggers, default=0.0)
        centres = [n * self.period + self.period // 2 for n in range(1, source_frames // self.period + 1)]
        half = self.readout / 2
        return [mid for mid in centres if mid + early - half >= 0 and mid + late + half <= source_frames - 1]

    def row_times(self, mid: float, height: int, steps: int | None = None) -> Array:
        """Times [H] of the rows: ``mid + readout (v / H - 1/2)``, to the nearest of ``steps`` a source frame.

        ``mid`` is the camera's: its trigger offset is in it. None takes every row at its own time.
        """
        times: Array = mid + self.readout * (np.arange(height) / height - 0.5)
        return times if steps is None else np.round(times * steps) / steps

    def instants(self, recursion: int) -> int:
        """Instants in one window, both ends included, with ``2**recursion`` intervals a source frame."""
        steps: int = 2**recursion
        return round(self.readout * steps) + 1

    def seam(self, displacement: float, recursion: int) -> float:
        """D / (K 2**e): pixels between neighbouring instants of a point that moves D pixels in one window.

        0 for a global shutter.
        """
        return displacement / (self.readout * 2**recursion) if self.readout else 0.0

    def recursion(self, displacement: float) -> int:
        """The smallest e whose seam is below half a pixel.

        Raises:
            DataError: if ``displacement`` is not a finite number of pixels, or too large for any e.
        """
        if not np.isfinite(displacement) or displacement < 0:
            raise DataError(expected("displacement D", "pixels, at least 0", displacement))
        for recursion in range(_LARGEST_RECURSION + 1):
            if self.seam(displacement, recursion) < SEAM_LIMIT_PX:
                return recursion
        raise DataError(expected("displacement D", f"a motion that e = {_LARGEST_RECURSION} resolves", displacement))


def trigger_offsets(wanted: str | dict[str, float], cameras: Iterable[str], period: int, seed: int) -> dict[str, float]:
    """delta_c of the training cameras, source frames: "0", "random" (uniform within a quarter of a period), or a table.

    Raises:
        DataError: for another word, or a table without one of the cameras or with a number that is not finite.
    """
    names = list(cameras)
    if isinstance(wanted, dict):
        missing = [name for name in names if not np.isfinite(wanted.get(name, np.nan))]
        if missing:
            raise DataError(
                expected("trigger offsets", f"a number for cameras {', '.join(names)}", f"none for {missing}")
            )
        return {name: float(wanted[name]) for name in names}
    if wanted == "random":
        drawn = np.random.default_rng([seed, 17]).uniform(-period / 4, period / 4, len(names))
        return dict(zip(names, drawn.round(4).tolist(), strict=True))
    if wanted == "0":
        return dict.fromkeys(names, 0.0)
    raise DataError(expected("trigger offsets", "0, random or a table by camera", repr(wanted)))
