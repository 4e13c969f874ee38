"""One rolling-shutter picture out of sharp ones: each row from its own instant."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from rsavatar.data.base import Array, Bytes
from rsavatar.restore.interpolate import AbstractInterpolator, Shots

_KEPT = 6  # sharp pictures in memory
_Box = tuple[slice, slice]


class Reel:
    """The sharp pictures of one camera, F of them; a few of the last are kept."""

    def __init__(self, read: Callable[[int], Bytes], length: int) -> None:
        self.length = length
        self.at = lru_cache(_KEPT)(read)

    def around(self, frame: int) -> list[Bytes | None]:
        """The pictures ``frame`` - 1 to ``frame`` + 2; None beyond the ends of the sequence."""
        return [self.at(k) if 0 <= k < self.length else None for k in range(frame - 1, frame + 3)]


def expose(reel: Reel, times: Array, interpolator: AbstractInterpolator) -> Bytes:
    """The picture [H, W, 4] whose row v is the scene at ``times[v]``, source frames, increasing.

    Interpolated is only the body and its surroundings; elsewhere each row is that of the nearest sharp picture.
    """
    out = np.stack([reel.at(min(int(np.floor(t + 0.5)), reel.length - 1))[v] for v, t in enumerate(times)])
    first = np.floor(times).astype(np.int64)
    for frame in np.unique(first):
        rows = np.flatnonzero(first == frame)
        rows = rows[times[rows] > frame]  # at a sharp picture's own time, that picture it is
        box = _surroundings(reel.around(int(frame)), rows, interpolator.whole_body) if len(rows) else None
        if box is None:
            continue
        shots = Shots(*(None if p is None else np.ascontiguousarray(p[box]) for p in reel.around(int(frame))))  # type: ignore[arg-type] # the middle two are there
        inside = rows[(rows >= box[0].start) & (rows < box[0].stop)]
        found = interpolator.rows(shots, inside - box[0].start, times[inside] - frame)
        out[inside, box[1]] = np.floor(np.clip(found, 0, 255) + 0.5).astype(np.uint8)
    return out


def _surroundings(
    pictures: list[Bytes | None], rows: np.ndarray[tuple[int], np.dtype[np.int64]], whole: bool
) -> _Box | None:
    """The part of the pictures that an interpolator must see of the body around ``rows``; None where nobody is near."""
    coverage = np.max([picture[..., 3] for picture in pictures if picture is not None], axis=0)
    height, width = coverage.shape
    margin = max(height // 8, 24)
    on_rows = np.flatnonzero(coverage.any(1))
    if not len(on_rows) or rows[-1] < on_rows[0] - margin or rows[0] > on_rows[-1] + margin:
        return None
    top, bottom = (on_rows[0], on_rows[-1]) if whole else (rows[0], rows[-1])
    down = slice(max(int(top) - margin, 0), min(int(bottom) + 1 + margin, height))
    on_columns = np.flatnonzero(coverage[down].any(0))
    if not len(on_columns):
        return None
    side = margin // 2
    return down, slice(max(int(on_columns[0]) - side, 0), min(int(on_columns[-1]) + 1 + side, width))
