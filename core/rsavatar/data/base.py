"""The words that every dataset speaks: ``Subject``, ``BodyFit``, ``Timing``, ``TrueMotion``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from rsavatar.errors import DataError, expected
from rsavatar.geometry.cameras import Camera

Array = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]
Image = tuple[Bytes, Bytes]  # RGB [H, W, 3] and coverage [H, W], 0..255; black where coverage is 0
ReadImage = Callable[[str, int], Image]  # (camera name, frame index) -> image


@dataclass(frozen=True)
class BodyFit:
    """SMPL parameters of N states. **Convention** (EasyMocap): x_world = R(Rh) smpl(poses, shapes) + Th.

    Raises:
        DataError: on wrong shapes or non-finite values.
    """

    poses: Array  # [N, 72] axis-angle, radians; the first three are zero
    Rh: Array  # [N, 3] axis-angle, radians
    Th: Array  # [N, 3] metres
    shapes: Array  # [10]

    def __post_init__(self) -> None:
        n = len(self.poses)
        for name, shape in {"poses": (n, 72), "Rh": (n, 3), "Th": (n, 3), "shapes": (10,)}.items():
            value: Array = getattr(self, name)
            if value.shape != shape:
                raise DataError(expected(f"body fit {name}", f"shape {shape}", value.shape))
            if not np.isfinite(value).all():
                raise DataError(expected(f"body fit {name}", "finite numbers", "NaN or infinity"))


Direction = Literal["down", "up", "right", "left"]


@dataclass(frozen=True)
class Timing:
    """When rows are exposed, in source frames. Row v of H of frame n in camera c is exposed at
    ``mid[n] + trigger[c] + readout * (v / H - 1/2)`` (paper, eq. rowtime, window centred on ``mid``).
    """

    mid_frames: Array  # [N]
    readout_frames: float  # gamma * K
    period_frames: float  # K
    trigger_frames: Mapping[str, float] = field(default_factory=dict)  # delta_c by camera name; absent = 0
    exposure_frames: float = 0.0  # of every row, centred on the row's time
    fps: float | None = None  # source frames a second, where they are known
    direction: Direction = "down"  # in which the sensor is read; of a sideways one v and H count columns

    def trigger(self, camera: str) -> float:
        """delta_c in source frames."""
        return float(self.trigger_frames.get(camera, 0.0))


@dataclass(frozen=True)
class TrueMotion:
    """Exact motion, for scoring and for the oracle only. S instants evenly spread over each readout, ends included."""

    mid: BodyFit
    mid_joints: Array  # [N, 24, 3] metres, world
    sub_poses: Array  # [N, S, 72]
    sub_Rh: Array  # [N, S, 3]
    sub_Th: Array  # [N, S, 3]
    sub_joints: Array  # [N, S, 24, 3]


@dataclass(frozen=True)
class Subject:
    """One person in front of a calibrated rolling-shutter rig: N frames, cameras by two-digit name ("04").

    ``observe`` reads a rolling-shutter frame of a training camera; ``truth`` a sharp frame at the mid-row time of any
    listed camera. Both return full images, undistorted. ``root`` is where it came from, ``fingerprint`` a sha256 of
    what was read.
    """

    name: str
    root: Path
    cameras: Mapping[str, Camera]
    training: tuple[str, ...]
    held_out: tuple[str, ...]
    fit: BodyFit
    timing: Timing
    observe: ReadImage
    truth: ReadImage
    fingerprint: str
    body: Path | None = None  # body model that lies with the data
    motion: TrueMotion | None = None
    missing: frozenset[tuple[str, int]] = frozenset()  # training images (camera, frame) that were never taken

    @property
    def frames(self) -> int:
        """N, the number of output frames."""
        return len(self.fit.poses)
