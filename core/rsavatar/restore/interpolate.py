"""Pictures between two consecutive pictures: one interface, and the two ways that look at no motion.

A rolling-shutter frame needs of every instant a few rows only, so an interpolator is asked for rows, not for pictures.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rsavatar.errors import DataError, expected

Array = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]

RECURSION = 4  # e where nobody says: 2**e intervals between two pictures


@dataclass(frozen=True)
class Shots:
    """Four consecutive pictures of a still camera at times -1, 0, 1, 2; the outer two may be missing.

    Each is [H, W, 4]: red, green, blue and the coverage of the person, 0..255.
    """

    before: Bytes | None
    first: Bytes
    second: Bytes
    after: Bytes | None

    def __post_init__(self) -> None:
        for name in ("before", "second", "after"):
            picture: Bytes | None = getattr(self, name)
            if picture is not None and picture.shape != self.first.shape:
                raise DataError(expected(f"picture {name!r} of an interpolation", self.first.shape, picture.shape))
        if self.first.ndim != 3 or self.first.shape[-1] != 4:
            raise DataError(expected("pictures of an interpolation", "shape (H, W, 4)", self.first.shape))


class AbstractInterpolator(ABC):
    """Rows of the pictures between ``first`` (time 0) and ``second`` (time 1).

    **Contract**: at time 0 the rows of ``first`` come back unchanged, at time 1 those of ``second``; where the two
    agree and nothing moves, so does the result.
    """

    name: str
    settings: str  # what else decides the result: part of what identifies a build
    whole_body = False  # whether it must see the whole body, not only the surroundings of the wanted rows

    @abstractmethod
    def rows(self, shots: Shots, rows: Indices, times: Array) -> Floats:
        """Row ``rows[k]`` of the picture at ``times[k]`` in [0, 1].

        Returns:
            [R, W, 4], 0..255.
        """


class RowCopy(AbstractInterpolator):
    """No interpolation: each row from the nearest picture."""

    name, settings = "copy", ""

    def rows(self, shots: Shots, rows: Indices, times: Array) -> Floats:
        """The row of ``first`` before the middle, else of ``second``."""
        late = (times >= 0.5)[:, None, None]
        return np.where(late, shots.second[rows], shots.first[rows]).astype(np.float32)


class LinearBlend(AbstractInterpolator):
    """Cross-fade: what moves is seen twice."""

    name, settings = "linear", ""

    def rows(self, shots: Shots, rows: Indices, times: Array) -> Floats:
        """The mean of both pictures, weighted by nearness in time."""
        share = times[:, None, None].astype(np.float32)
        blended: Floats = (1 - share) * shots.first[rows] + share * shots.second[rows]
        return blended


def pick_rows(at: Callable[[float], Floats], rows: Indices, times: Array) -> Floats:
    """Rows out of whole pictures ``at(time)`` [H, W, 4]; every distinct time is asked for once."""
    out: list[Floats] = [np.empty(0, np.float32)] * len(rows)
    for time in np.unique(times):
        picture = at(float(time))
        for k in np.flatnonzero(times == time):
            out[k] = picture[rows[k]]
    return np.stack(out)


def interpolator(name: str, weights: Path | None = None, recursion: int = RECURSION) -> AbstractInterpolator:
    """The interpolator of a name: flow, rife, rife-v4, linear or copy.

    Args:
        name: which.
        weights: for rife and rife-v4, the authors' file ``flownet.pkl``.
        recursion: e, for rife, which halves intervals e times.

    Raises:
        DataError: for an unknown name, or weights that are missing, not wanted or not of that network.
    """
    from rsavatar.restore import flow_interpolation, rife

    if name in ("rife", "rife-v4"):
        if weights is None:
            raise DataError(expected(f"weights of {name}", "the authors' file flownet.pkl", "none"))
        return rife.Rife(weights, recursion) if name == "rife" else rife.RifeV4(weights)
    plain: dict[str, type[AbstractInterpolator]] = {
        "flow": flow_interpolation.FlowInterpolator,
        "linear": LinearBlend,
        "copy": RowCopy,
    }
    if name not in plain:
        raise DataError(expected("interpolator", f"one of {', '.join([*plain, 'rife', 'rife-v4'])}", repr(name)))
    if weights is not None:
        raise DataError(expected(f"weights of {name}", "none: it has no weights", str(weights)))
    return plain[name]()
