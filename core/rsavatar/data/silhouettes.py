"""How well a projected body covers a mask."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rsavatar.data.base import Array, Bytes
from rsavatar.data.images import Lens
from rsavatar.geometry.cameras import Camera

LONGEST_SIDE = 256  # pixels: silhouettes are compared at this size, enough to tell centimetres on a person
DILATION = 0.02  # of the longest side: hair, loose clothes and the motion within a readout stay inside
_NEAR = 0.05  # metres


@dataclass(frozen=True)
class Score:
    """``inside``: fraction of projected vertices in the dilated mask; ``iou``: overlap of the two silhouettes."""

    inside: float
    iou: float


@dataclass(frozen=True)
class Target:
    """A mask at the size of comparison, with the camera of that size and the factor that took it there."""

    camera: Camera
    mask: npt.NDArray[np.bool_]  # [H, W]
    dilated: npt.NDArray[np.bool_]  # [H, W]
    factor: float


def target_of(camera: Camera, coverage: Bytes) -> Target:
    """The mask [H, W] (0..255) of ``camera``, shrunk to at most ``LONGEST_SIDE``."""
    factor = min(1.0, LONGEST_SIDE / max(coverage.shape))
    small = camera.scaled(factor)
    shrunk = cv2.resize((coverage != 0).astype(np.float32), (small.width, small.height), interpolation=cv2.INTER_AREA)
    mask = shrunk >= 0.5
    radius = max(1, round(DILATION * max(mask.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return Target(small, mask, cv2.dilate(mask.astype(np.uint8), disc) != 0, factor)


def score(
    target: Target, camera: Camera, vertices: Array, faces: npt.NDArray[np.int64], lens: Lens | None = None
) -> Score:
    """Vertices [V, 3] (metres, world) seen by ``camera``, which has the target's size, against the target's mask.

    With a ``lens``, its undistortion is applied to the silhouette first.
    """
    pixels, depth = camera.project(vertices)
    front = depth > _NEAR
    shape = silhouette(camera, pixels, front, faces)
    if lens is not None:
        shape = lens.undistorted(shape.astype(np.uint8) * 255) >= 128
    return Score(_inside(target, pixels, front), _iou(target.mask, shape))


def silhouette(
    camera: Camera, pixels: Array, front: npt.NDArray[np.bool_], faces: npt.NDArray[np.int64]
) -> npt.NDArray[np.bool_]:
    """The filled triangles [F, 3] of projected vertices [V, 2] whose corners all lie in ``front`` of the camera."""
    canvas = np.zeros((camera.height, camera.width), np.uint8)
    # OpenCV's pixel centres are whole integers; 4 fractional bits.
    corners = np.clip(np.nan_to_num(pixels) - 0.5, -4096, 4096) * 16
    for triangle in np.rint(corners).astype(np.int32)[faces[front[faces].all(1)]]:
        cv2.fillConvexPoly(canvas, triangle, 1, shift=4)
    return canvas.astype(np.bool_)


def _inside(target: Target, pixels: Array, front: npt.NDArray[np.bool_]) -> float:
    height, width = target.mask.shape
    whole = np.floor(np.clip(np.nan_to_num(pixels, nan=-1), -1, 1e6)).astype(np.int64)
    seen = front & (whole >= 0).all(1) & (whole[:, 0] < width) & (whole[:, 1] < height)
    return float(np.sum(target.dilated[whole[seen, 1], whole[seen, 0]]) / len(pixels))


def _iou(one: npt.NDArray[np.bool_], other: npt.NDArray[np.bool_]) -> float:
    union = np.sum(one | other)
    return float(np.sum(one & other) / union) if union else 0.0
