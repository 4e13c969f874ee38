"""Draws triangle meshes row by row: a z-buffer scanline renderer in numpy for the studio subject.

It shares no code and no approximation with the Gaussian renderer. **Convention**: pixel centres at half integers; with
``samples`` per axis, sample k of a pixel lies at (k + 1/2) / samples. All samples of a row see the row's own mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rsavatar.geometry.cameras import Camera

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]
Paint = Callable[[Indices, Array], Array]  # triangles [M] and barycentric weights [M, 3] -> RGB [M, 3] in 0..1

SAMPLES = 3  # per axis and pixel


@dataclass(frozen=True)
class Strip:
    """Rows [lo, hi) that see one posed mesh."""

    lo: int
    hi: int
    vertices: Array  # [V, 3] metres, world


@dataclass(frozen=True, eq=False)
class _Scans:
    """Pieces of sample rows inside triangles: L of them, with the triangle's corners on the image."""

    triangle: Indices  # [L]
    row: Indices  # [L] sample row
    corners: Array  # [L, 3, 3]: x and y in samples, 1 / depth


def draw(
    strips: list[Strip], faces: Indices, camera: Camera, paint: Paint, samples: int = SAMPLES
) -> tuple[Bytes, Bytes]:
    """One picture of a surface that faces outward (counter-clockwise from outside); the back is not drawn.

    Visibility is exact at every sample: the nearest triangle by perspective-correct depth. Colours are averaged as
    they are, without gamma.

    Args:
        strips: which rows see which mesh; rows in no strip stay empty.
        faces: [F, 3].
        camera: where from; its size is the picture's.
        paint: colour of points of the surface.
        samples: per axis and pixel.

    Returns:
        RGB [H, W, 3] on black, multiplied by coverage, and coverage [H, W], both 0..255.
    """
    parts = [_scan(strip, faces, camera, samples) for strip in strips]
    scans = _Scans(
        np.concatenate([part.triangle for part in parts]),
        np.concatenate([part.row for part in parts]),
        np.concatenate([part.corners for part in parts]),
    )
    piece, column = _columns_inside(scans, camera.width * samples)
    weights, nearness = _perspective_weights(scans.corners[piece], column, scans.row[piece])
    width = camera.width * samples
    place = scans.row[piece] * width + column
    seen = _nearest(place, nearness, camera.height * samples * width)
    colour = np.ones((len(seen), 4))
    colour[:, :3] = paint(scans.triangle[piece[seen]], weights[seen])
    pixel = scans.row[piece[seen]] // samples * camera.width + column[seen] // samples
    count = camera.height * camera.width
    sums = np.stack([np.bincount(pixel, channel, count) for channel in colour.T], -1) / samples**2
    out = np.floor(np.clip(sums, 0, 1) * 255 + 0.5).astype(np.uint8).reshape(camera.height, camera.width, 4)
    return out[..., :3], out[..., 3]


def _scan(strip: Strip, faces: Indices, camera: Camera, samples: int) -> _Scans:
    """Every (triangle, sample row) of a strip whose triangle faces the camera and crosses the row."""
    pixels, depth = camera.project(strip.vertices)
    on_image = np.column_stack([pixels * samples, 1 / depth])
    y0, y1, y2 = (on_image[:, 1][faces[:, k]] for k in range(3))
    low, high = np.minimum(np.minimum(y0, y1), y2), np.maximum(np.maximum(y0, y1), y2)
    near = np.flatnonzero((high > strip.lo * samples) & (low < strip.hi * samples))
    first = np.maximum(np.ceil(low[near] - 0.5), strip.lo * samples).astype(np.int64)
    last = np.minimum(np.floor(high[near] - 0.5), strip.hi * samples - 1).astype(np.int64)
    corners = on_image[faces[near]]
    drawn = (last >= first) & (_signed_area(corners) < 0)
    near, first, last, corners = near[drawn], first[drawn], last[drawn], corners[drawn]
    index, step = _unrolled(last - first + 1)
    return _Scans(near[index], first[index] + step, corners[index])


def _signed_area(corners: Array) -> Array:
    """Twice the area of triangles [L, 3, 3] on the image; negative where they face the camera (y points down)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _unrolled(counts: Indices) -> tuple[Indices, Indices]:
    """For counts (2, 0, 3): which (0, 0, 2, 2, 2) and the step within each (0, 1, 0, 1, 2)."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)


def _columns_inside(scans: _Scans, width: int) -> tuple[Indices, Indices]:
    """Sample columns between the two edges that a sample row crosses: piece and column of each."""
    y = (scans.row + 0.5)[:, None]
    here, there = scans.corners, np.roll(scans.corners, -1, axis=1)
    rise = there[..., 1] - here[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (y - here[..., 1]) / rise
        x = here[..., 0] + along * (there[..., 0] - here[..., 0])
    crossed = (along >= 0) & (along <= 1)
    left = np.where(crossed, x, np.inf).min(1)
    right = np.where(crossed, x, -np.inf).max(1)
    first = np.clip(np.ceil(left - 0.5), 0, width)
    last = np.clip(np.floor(right - 0.5), -1, width - 1)
    piece, step = _unrolled(np.maximum(last - first + 1, 0).astype(np.int64))
    return piece, first[piece].astype(np.int64) + step


def _perspective_weights(corners: Array, column: Indices, row: Indices) -> tuple[Array, Array]:
    """Barycentric weights on the surface [M, 3] and 1 / depth [M] at the samples' centres in triangles [M, 3, 3]."""
    px, py = corners[..., 0] - (column + 0.5)[:, None], corners[..., 1] - (row + 0.5)[:, None]
    areas = np.roll(px, -1, 1) * np.roll(py, -2, 1) - np.roll(py, -1, 1) * np.roll(px, -2, 1)
    flat = areas / areas.sum(1, keepdims=True)
    scaled = flat * corners[..., 2]
    nearness = scaled.sum(1)
    return scaled / nearness[:, None], nearness


def _nearest(place: Indices, nearness: Array, places: int) -> Indices:
    """For each place that occurs, the index of its nearest entry; the first of equals."""
    best = np.zeros(places)
    np.maximum.at(best, place, nearness)
    on_top = np.flatnonzero(nearness == best[place])
    _, first = np.unique(place[on_top], return_index=True)
    return on_top[first]
