"""How far the body moves on the image while it is read out: D, by dense optical flow (paper, section 4.1).

Points on the body are followed from picture to picture through every readout window. D is the length of the longest
path; a seam of D / (K 2**e) pixels follows from it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from rsavatar.data.base import Array, Bytes
from rsavatar.data.build_plan import Clock
from rsavatar.restore.flow import Flow, dense_flow

LARGEST_SIDE = 512  # pixels: larger pictures are measured at a reduced size
_SPACING = 2  # pixels between followed points
_RANK = 3  # the third longest path: where the flow leaps and not the body, it is a point or two
_MARGIN = 16

Read = Callable[[int], Bytes]  # frame -> [H, W, 4]


def displacements(read: Read, mids: Sequence[float], clock: Clock, height: int) -> Array:
    """Path lengths [N], in pixels, of each window's fastest body point in one camera; 0 where nobody is seen.

    Args:
        read: the camera's sharp pictures.
        mids: the windows' centres in this camera, source frames.
        clock: K and gamma.
        height: of the pictures, pixels.
    """
    factor = min(1.0, LARGEST_SIDE / height)
    window = _Window(read, factor)
    lengths = [window.longest(mid - clock.readout / 2, mid + clock.readout / 2) for mid in mids]
    return np.array(lengths) / factor


class _Window:
    """Flows between consecutive pictures of one camera; the last is kept, because windows share their ends."""

    def __init__(self, read: Read, factor: float) -> None:
        self._read, self._factor = read, factor
        self._pictures: dict[int, Bytes] = {}
        self._flow: tuple[int, Flow] | None = None

    def longest(self, start: float, end: float) -> float:
        """Length of the longest path from ``start`` to ``end``."""
        first, last = int(np.floor(start)), int(np.ceil(end))
        points = _points(self._picture(first)[..., 3])
        lengths = np.zeros(len(points))
        for frame in range(first, last):
            part = min(end, frame + 1) - max(start, frame)
            step = _sampled(self._between(frame), points)
            lengths += part * np.linalg.norm(step, axis=1)
            points = points + step
            kept = _sampled(self._picture(frame + 1)[..., 3].astype(np.float32), points) > 127  # still on the body
            points, lengths = points[kept], lengths[kept]
        return float(np.sort(lengths)[-min(_RANK, len(lengths))]) if len(lengths) else 0.0

    def _between(self, frame: int) -> Flow:
        if self._flow is None or self._flow[0] != frame:
            self._flow = frame, _body_flow(self._picture(frame), self._picture(frame + 1))
        return self._flow[1]

    def _picture(self, frame: int) -> Bytes:
        if frame not in self._pictures:
            picture = self._read(frame)
            if self._factor < 1:
                picture = cv2.resize(picture, None, fx=self._factor, fy=self._factor, interpolation=cv2.INTER_AREA)
            self._pictures = {k: v for k, v in self._pictures.items() if abs(k - frame) < 3} | {frame: picture}
        return self._pictures[frame]


def _points(coverage: Bytes) -> Array:
    """Places (x, y) [M, 2] on the body, pixel indices."""
    rows, columns = np.nonzero(coverage[::_SPACING, ::_SPACING] > 127)
    return np.stack([columns, rows], 1).astype(np.float64) * _SPACING


def _body_flow(a: Bytes, b: Bytes) -> Flow:
    """Flow [H, W, 2] from ``a`` to ``b`` within the box that holds the body in both; 0 elsewhere."""
    flow = np.zeros((*a.shape[:2], 2), np.float32)
    x, y, width, height = cv2.boundingRect(np.maximum(a[..., 3], b[..., 3]))
    if not width:
        return flow
    box = (slice(max(y - _MARGIN, 0), y + height + _MARGIN), slice(max(x - _MARGIN, 0), x + width + _MARGIN))
    if min(a[box].shape[:2]) >= _MARGIN:
        flow[box] = dense_flow(np.ascontiguousarray(a[box][..., :3]), np.ascontiguousarray(b[box][..., :3]))
    return flow


def _sampled(values: np.ndarray[tuple[int, ...], np.dtype[np.float32]], points: Array) -> Array:
    if not len(points):
        return np.zeros((0, *values.shape[2:]))
    x, y = points.T.astype(np.float32)[:, :, None]
    taken = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(taken[:, 0], np.float64)
