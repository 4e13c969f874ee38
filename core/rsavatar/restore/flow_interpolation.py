"""Interpolation by dense optical flow: bidirectional, occlusion-aware, with acceleration; no weights.

Every point of either picture moves on a parabola through its places in three consecutive pictures. The flows, not the
colours, are splatted to the wanted instant (softmax splatting), and the colours are then fetched from both pictures by
windowed sinc: a colour that is splatted is blurred. A point that only one picture shows is fetched from that one alone;
where several points meet, the person and those whose flow leads there and back are in front.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from rsavatar.restore.flow import Flow, dense_flow
from rsavatar.restore.interpolate import AbstractInterpolator, Array, Bytes, Floats, Indices, Shots
from rsavatar.restore.warp import splat

_TRUSTED_PX, _TRUSTED_PART = 0.5, 0.05  # a flow that misses by this much on its way back is half believed
_IN_FRONT = 8.0  # logarithm of the weight of the person over the background
_DOUBT = 10.0  # logarithm of the weight that is lost with all trust
_SMALLEST = 24  # pixels a side: pictures are enlarged to this by their border, so that they have a flow


@dataclass(frozen=True)
class _Paths:
    """Where the points of one picture go: ``velocity * t + bend * t**2`` at t towards the other picture, pixels."""

    velocity: Floats  # [H, W, 2]
    bend: Floats  # [H, W, 2]
    trust: Floats  # [H, W] 0..1: whether the other picture shows the point, too
    weight: Floats  # [H, W] in splatting
    reach: int  # how many rows a point gets away from its own at most


class FlowInterpolator(AbstractInterpolator):
    """Dense flow both ways, splatted to the row's instant."""

    name, settings = "flow", "dis 1, quadratic, lanczos"

    def rows(self, shots: Shots, rows: Indices, times: Array) -> Floats:
        """See ``AbstractInterpolator``."""
        if np.array_equal(shots.first, shots.second):
            return shots.first[rows].astype(np.float32)
        there, back = _flow(shots.first, shots.second), _flow(shots.second, shots.first)
        ahead = _paths(shots.first, there, back, None if shots.before is None else _flow(shots.first, shots.before))
        behind = _paths(shots.second, back, there, None if shots.after is None else _flow(shots.second, shots.after))
        out = np.empty((len(rows), *shots.first.shape[1:]), np.float32)
        for time in np.unique(times):
            asked = np.flatnonzero(times == time)
            out[asked] = _rows_at(shots, ahead, behind, float(time), rows[asked])
        return out


def _flow(here: Bytes, there: Bytes) -> Flow:
    """``dense_flow`` of the colours, of pictures of any size."""
    height, width = here.shape[:2]
    more = ((0, max(_SMALLEST - height, 0)), (0, max(_SMALLEST - width, 0)), (0, 0))
    a, b = (np.ascontiguousarray(np.pad(picture[..., :3], more, "edge")) for picture in (here, there))
    return dense_flow(a, b)[:height, :width]


def _paths(here: Bytes, to: Flow, back: Flow, opposite: Flow | None) -> _Paths:
    """Paths of the points of ``here`` along ``to``, bent by their flow to the picture on the opposite side."""
    trust = _trust(to, back)
    bend: Floats = np.zeros_like(to)
    if opposite is not None:
        bend = np.asarray((to + opposite) / 2, np.float32)
        # A body's velocity changes little between two pictures; where it seems to, one of the flows is wrong.
        sudden = np.linalg.norm(bend, axis=-1) / (_TRUSTED_PX + 0.25 * np.linalg.norm(to, axis=-1))
        bend *= (trust * np.exp2(-(sudden**2)))[..., None].astype(np.float32)
    weight = np.exp(_IN_FRONT * (here[..., 3] > 0) - _DOUBT * (1 - trust) - _IN_FRONT).astype(np.float32)
    reach = int(np.ceil((np.abs(to[..., 1] - bend[..., 1]) + np.abs(bend[..., 1])).max())) + 1
    return _Paths(to - bend, bend, trust, weight, reach)


def _trust(to: Flow, back: Flow) -> Floats:
    """1 where following ``to`` and then ``back`` leads home, falling to 0 where it does not."""
    x, y = _grid(range(to.shape[0]), to.shape[1])
    home = to + cv2.remap(back, x + to[..., 0], y + to[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    miss = np.linalg.norm(home, axis=-1) / (_TRUSTED_PX + _TRUSTED_PART * np.linalg.norm(to, axis=-1))
    trust: Floats = np.exp2(-(miss**2)).astype(np.float32)
    return trust


def _rows_at(shots: Shots, ahead: _Paths, behind: _Paths, time: float, rows: Indices) -> Floats:
    if time in (0.0, 1.0):
        return (shots.second if time else shots.first)[rows].astype(np.float32)
    height = len(ahead.trust)
    reach = max(ahead.reach, behind.reach)
    near = slice(max(int(rows.min()) - reach, 0), min(int(rows.max()) + reach + 1, height))
    (to_first, moved_first), (to_second, moved_second) = _thrown(ahead, time, near), _thrown(behind, 1 - time, near)
    thrown = splat(_tensors(to_first, to_second), _tensors(moved_first, moved_second)).numpy()[:, :, rows - near.start]
    # Behind's channels speak of its own picture first: exchanged, both say the same of ``first`` and ``second``.
    joint = (1 - time) * thrown[0] + time * thrown[1][[2, 3, 0, 1, 5, 4, 6]]
    total = joint[-1]
    mean = joint[:-1] / np.maximum(total, 1e-9)
    mean[:4, total < 1e-9] = 0.0
    mean[4:, total < 1e-9] = 1.0
    x, y = _grid(rows, shots.first.shape[1])
    a = _fetch(shots.first, x + mean[0], y + mean[1])
    b = _fetch(shots.second, x + mean[2], y + mean[3])
    seen_a, seen_b = (1 - time) * mean[4] + 1e-4, time * mean[5] + 1e-4
    share = (seen_b / (seen_a + seen_b))[..., None]
    blended: Floats = np.clip((1 - share) * a + share * b, 0, 255)
    return blended


def _thrown(paths: _Paths, time: float, near: slice) -> tuple[Floats, Floats]:
    """What the points in some rows carry [7, R, W], and how far they have moved at ``time`` [2, R, W].

    They carry, times their weight: the flow to their own picture (2) and to the other (2), whether their own and the
    other show them, and 1.
    """
    velocity, bend, trust = paths.velocity[near], paths.bend[near], paths.trust[near]
    moved = velocity * time + bend * time**2
    left = velocity + bend - moved
    ones = np.ones_like(trust)
    values = np.stack([-moved[..., 0], -moved[..., 1], left[..., 0], left[..., 1], ones, trust, ones])
    return values * paths.weight[near], moved.transpose(2, 0, 1)


def _tensors(*values: Floats) -> Tensor:
    return torch.from_numpy(np.stack(values).astype(np.float32))


def _grid(rows: Indices | range, width: int) -> tuple[Floats, Floats]:
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.asarray(rows, np.float32))
    return x, y


def _fetch(picture: Bytes, x: Floats, y: Floats) -> Floats:
    fetched = cv2.remap(picture.astype(np.float32), x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(fetched, np.float32)
