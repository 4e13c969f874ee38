"""A subject made worse than it is, to measure what that costs: schedule, fits, missing images, wrong masks.

Only what a method is given changes; the truth stays as it was. Which images are hit is a function of the seed.
"""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256

import numpy as np
import torch

from rsavatar.data.base import Array, BodyFit, Bytes, Image, ReadImage, Subject, Timing
from rsavatar.errors import DataError, expected
from rsavatar.geometry.rotations import compose, exp_so3, log_so3
from rsavatar.spec import Disturbance

CUT = 0.4  # of the person's height or width that a wrong mask loses
BLOB = 0.5  # of the person's height: side of what a wrong mask takes for a part of the person
LATE = 3  # frames by which a wrong mask is late
Views = frozenset[tuple[str, int]]


def disturb(subject: Subject, how: Disturbance, seed: int) -> Subject:
    """``subject`` as a method gets to see it.

    Raises:
        DataError: if the fit's error is to be scaled and the subject has no true motion. Sharp frames that do not
            exist are missed when they are read.
    """
    if not how.any():
        return subject
    rng = np.random.default_rng([seed, 19])
    views = [(camera, frame) for camera in subject.training for frame in range(subject.frames)]
    observe, timing = subject.observe, subject.timing
    if how.capture == "global shutter":
        observe, timing = subject.truth, replace(timing, readout_frames=0.0, exposure_frames=0.0)
    absent, wrong = _chosen(views, how.missing, rng), _chosen(views, how.masks, rng)
    return replace(
        subject,
        timing=mistimed(timing, subject.training, how),
        fit=subject.fit if how.fit == 1 else _worse_fit(subject, how.fit),
        missing=subject.missing | absent,
        fingerprint=sha256(f"{subject.fingerprint} {how.model_dump_json()} {seed}".encode()).hexdigest(),
        observe=_with_wrong_masks(replace(subject, observe=observe), wrong) if wrong else observe,
    )


def mistimed(timing: Timing, cameras: tuple[str, ...], how: Disturbance) -> Timing:
    """The schedule as it is taken to be: triggers late and early by turns, on the mean of ``cameras`` right."""
    late = how.trigger * timing.period_frames * np.array([(-1.0) ** k for k in range(len(cameras))])
    late -= late.mean()
    triggers = dict(timing.trigger_frames)
    for camera, by in zip(cameras, late.tolist(), strict=True):
        triggers[camera] = timing.trigger(camera) + by
    return replace(timing, readout_frames=timing.readout_frames * (1 + how.readout), trigger_frames=triggers)


def _chosen(views: list[tuple[str, int]], share: float, rng: np.random.Generator) -> Views:
    order = rng.permutation(len(views))
    return frozenset(views[i] for i in order[: round(share * len(views))])


def _worse_fit(subject: Subject, factor: float) -> BodyFit:
    """The fit with its error, as it is at the mid rows, times ``factor``."""
    if subject.motion is None:
        raise DataError(expected(f"subject {subject.name}", "a true motion, for disturb.fit", "none"))
    given, true = subject.fit, subject.motion.mid
    return BodyFit(
        _beyond(true.poses.reshape(-1, 24, 3), given.poses.reshape(-1, 24, 3), factor).reshape(-1, 72),
        _beyond(true.Rh, given.Rh, factor),
        true.Th + factor * (given.Th - true.Th),
        true.shapes + factor * (given.shapes - true.shapes),
    )


def _beyond(true: Array, given: Array, factor: float) -> Array:
    """Rotations [..., 3] ``factor`` times as far from the true ones as the given ones are, in the same direction."""
    a, b = torch.from_numpy(true), torch.from_numpy(given)
    error = log_so3(exp_so3(a).transpose(-1, -2) @ exp_so3(b))
    result: Array = compose(a, factor * error).numpy()
    return result


def _with_wrong_masks(subject: Subject, wrong: Views) -> ReadImage:
    kinds = {view: k % 3 for k, view in enumerate(sorted(wrong))}

    def observe(camera: str, frame: int) -> Image:
        rgb, mask = subject.observe(camera, frame)
        if (camera, frame) not in wrong or not mask.any():
            return rgb, mask
        kind = kinds[camera, frame]
        if kind == 0:
            return _cut(rgb, mask)
        if kind == 1:
            return _grown(rgb, mask)
        other = frame - LATE if frame >= LATE else frame + LATE
        known = 0 <= other < subject.frames and (camera, other) not in subject.missing
        foreign = subject.observe(camera, other)[1] if known else np.zeros_like(mask)
        return np.where(foreign[..., None] > 0, rgb, 0).astype(np.uint8), foreign

    return observe


def _cut(rgb: Bytes, mask: Bytes) -> Image:
    """Without the lower part of the person."""
    rows = np.flatnonzero(mask.any(1))
    kept = mask.copy()
    kept[rows[-1] - round(CUT * (rows[-1] - rows[0])) :] = 0
    return np.where(kept[..., None] > 0, rgb, 0).astype(np.uint8), kept


def _grown(rgb: Bytes, mask: Bytes) -> Image:
    """With a grey thing at the person's side taken for a part of the person."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    side = max(round(BLOB * (rows[-1] - rows[0])), 2)
    top, left = int(rows[0] + rows[-1]) // 2 - side // 2, int(columns[-1]) - side // 4
    added = np.zeros(mask.shape, bool)
    added[max(top, 0) : top + side, max(left, 0) : left + side] = True
    added &= mask == 0
    return np.where(added[..., None], np.uint8(110), rgb), np.where(added, np.uint8(255), mask)
