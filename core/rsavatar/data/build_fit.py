"""The first body fit: the source's own at the mid frame, or what a fitter sees of a rolling shutter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from rsavatar.body.base import JOINTS, BodyModel
from rsavatar.data.base import Array, BodyFit
from rsavatar.data.build_plan import Clock
from rsavatar.data.studio_motion import bones
from rsavatar.geometry.cameras import Camera


def mid_fit(fit: BodyFit, mids: Sequence[int]) -> BodyFit:
    """The source's fits [N] at the mid frames: what "biased towards the middle band" means without error."""
    chosen = list(mids)
    return BodyFit(fit.poses[chosen], fit.Rh[chosen], fit.Th[chosen], fit.shapes)


def seen_fit(fit: BodyFit, mids: Sequence[int], clock: Clock, cameras: Sequence[Camera], body: BodyModel) -> BodyFit:
    """Fits [N] to rolling-shutter frames: every joint as it was when its own row was read, rows averaged over cameras.

    Between source frames rotations turn steadily and places move straight.

    Args:
        fit: F states of the source.
        mids: mid frames, N of them.
        clock: K and gamma.
        cameras: those that are trained on.
        body: whose joints are projected.
    """
    middle = mid_fit(fit, mids)
    joints = bones(body, middle)[1]
    rows = np.mean([np.clip(view.project(joints)[0][..., 1] / view.height, 0, 1) for view in cameras], axis=0)
    times = np.asarray(mids, np.float64)[:, None] + clock.readout * (rows - 0.5)
    times = np.clip(times, 0, len(fit.poses) - 1)
    turns = fit.poses.reshape(-1, JOINTS, 3)
    poses = np.stack([_turned(turns[:, j], times[:, j]) for j in range(JOINTS)], 1)
    return BodyFit(poses.reshape(-1, 3 * JOINTS), _turned(fit.Rh, times[:, 0]), _moved(fit.Th, times[:, 0]), fit.shapes)


def _turned(vectors: Array, times: Array) -> Array:
    """Axis-angle [N, 3] at ``times`` between axis-angles [F, 3] at 0, 1, 2, .."""
    before, part = _split(times, len(vectors))
    start = Rotation.from_rotvec(vectors[before])
    step = (start.inv() * Rotation.from_rotvec(vectors[before + 1])).as_rotvec()
    out: Array = (start * Rotation.from_rotvec(part[:, None] * step)).as_rotvec()
    return out


def _moved(places: Array, times: Array) -> Array:
    before, part = _split(times, len(places))
    return places[before] + part[:, None] * (places[before + 1] - places[before])


def _split(times: Array, length: int) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], Array]:
    before = np.minimum(np.floor(times).astype(np.int64), length - 2)
    return before, times - before
