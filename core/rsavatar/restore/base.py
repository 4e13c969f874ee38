"""What every corrector of rolling-shutter frames keeps: the words of a shot, and the contract."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rsavatar.errors import DataError, expected

Bytes = npt.NDArray[np.uint8]
Picture = tuple[Bytes, Bytes]  # RGB [H, W, 3] and coverage [H, W], 0..255; black where coverage is 0


@dataclass(frozen=True, eq=False)
class Shot:
    """A rolling-shutter frame between its neighbours of the same camera; the first and last of a sequence lack one.

    Raises:
        DataError: if pictures differ in size, or the frame has no neighbour at all.
    """

    before: Picture | None
    frame: Picture
    after: Picture | None
    gamma: float = 1.0  # readout as a part of the frame period

    def __post_init__(self) -> None:
        others = [picture for picture in (self.before, self.after) if picture is not None]
        if not others:
            raise DataError(expected("frame to restore", "a neighbour in time", "none"))
        shapes = {part.shape[:2] for picture in (self.frame, *others) for part in picture}
        if len(shapes) != 1:
            raise DataError(expected("frames of a camera", "one size", sorted(shapes)))


class AbstractCorrector(ABC):
    """Rolling-shutter frame to the sharp frame at its middle row's instant.

    **Contract**: a function of the shot alone; equal shots give equal pictures; the coverage moves as the picture does,
    and the picture is black where it is 0; a shutter without readout leaves the frame as it is.
    """

    @abstractmethod
    def restore(self, shot: Shot) -> Picture:
        """The restored frame, of the same size."""

    @property
    @abstractmethod
    def identity(self) -> str:
        """What it is, for people and for cache keys: its name, weights and settings."""


def on_black(rgb: Bytes, coverage: Bytes) -> Picture:
    """The picture with nothing outside its coverage."""
    return np.where(coverage[..., None] != 0, rgb, 0).astype(np.uint8), coverage
