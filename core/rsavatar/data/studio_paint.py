"""Painted clothing: colours of the studio person as a function of the place on the T-posed body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rsavatar.data.base import Array
from rsavatar.data.studio_render import Paint

Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Wardrobe:
    """Colours in 0..1."""

    skin: tuple[float, float, float]
    hair: tuple[float, float, float]
    shirt: tuple[float, float, float]
    stripe: tuple[float, float, float]
    trousers: tuple[float, float, float]
    shoes: tuple[float, float, float]
    sleeve: float = 0.65  # where on the forearm the sleeve ends: 0 elbow, 1 wrist
    leg: float = 1.0  # where on the shin the trousers end: 0 knee, 1 ankle


WARDROBES = (
    Wardrobe(
        (0.84, 0.62, 0.50),
        (0.23, 0.14, 0.09),
        (0.93, 0.91, 0.86),
        (0.10, 0.22, 0.50),
        (0.25, 0.28, 0.36),
        (0.6, 0.1, 0.1),
    ),
    Wardrobe(
        (0.45, 0.29, 0.21),
        (0.06, 0.05, 0.05),
        (0.85, 0.55, 0.12),
        (0.30, 0.08, 0.10),
        (0.55, 0.50, 0.40),
        (0.9, 0.9, 0.9),
    ),
    Wardrobe(
        (0.93, 0.76, 0.66),
        (0.65, 0.45, 0.20),
        (0.16, 0.45, 0.36),
        (0.90, 0.88, 0.70),
        (0.14, 0.14, 0.18),
        (0.8, 0.8, 0.2),
    ),
)
_LIGHT = np.array([0.35, 0.75, 0.55]) / np.linalg.norm([0.35, 0.75, 0.55])


def drawn_wardrobe(seed: int) -> Wardrobe:
    """Clothes of a seed's own: any skin, hair and colours, short or long sleeves and legs."""
    rng = np.random.default_rng([seed, 19])

    def colour(low: float, high: float) -> tuple[float, float, float]:
        red, green, blue = rng.uniform(low, high, 3)
        return float(red), float(green), float(blue)

    light = rng.uniform(0.35, 1.0)
    skin = (0.93 * light, (0.55 + 0.21 * light) * light, (0.42 + 0.24 * light) * light)
    hair = rng.uniform(0.05, 0.7)
    return Wardrobe(
        skin=(float(skin[0]), float(skin[1]), float(skin[2])),
        hair=(float(hair), float(0.7 * hair), float(0.4 * hair)),
        shirt=colour(0.45, 0.95),
        stripe=colour(0.05, 0.45),
        trousers=colour(0.1, 0.55),
        shoes=colour(0.1, 0.9),
        sleeve=float(rng.choice([0.0, 0.3, 0.65, 0.95])),
        leg=float(rng.choice([0.2, 1.0])),
    )


def painter(rest: Array, faces: Indices, joints: Array, wardrobe: Wardrobe) -> Paint:
    """Colours of a dressed person; the light is painted on with the clothes, so it moves with the body.

    Args:
        rest: T-posed vertices [V, 3], metres, y up, facing +z.
        faces: [F, 3].
        joints: T-posed joints [24, 3].
        wardrobe: which colours.

    Returns:
        A function of triangles [M] and barycentric weights [M, 3].
    """
    corners = rest[faces]
    shade = 0.68 + 0.32 * np.clip(vertex_normals(rest, faces) @ _LIGHT, -0.6, 1)[faces]

    def paint(triangles: Indices, weights: Array) -> Array:
        place = (corners[triangles] * weights[..., None]).sum(1)
        light = (shade[triangles] * weights).sum(1)
        colour: Array = np.clip(_base_colour(place, joints, wardrobe) * light[:, None], 0, 1)
        return colour

    return paint


def vertex_normals(vertices: Array, faces: Indices) -> Array:
    """Unit normals [V, 3], area-weighted over the faces of each vertex."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], np.cross(b - a, c - a))
    unit: Array = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return unit


def _base_colour(p: Array, joints: Array, w: Wardrobe) -> Array:
    """Unshaded colours [M, 3] of places [M, 3]."""
    x, y, z = p.T
    side = np.abs(x)
    colour = np.tile(np.array(w.skin), (len(p), 1))
    freckles = 0.93 + 0.07 * np.sign(np.sin(140 * x) * np.sin(150 * y) * np.sin(130 * z))
    colour *= freckles[:, None]
    cuff = (1 - w.sleeve) * abs(joints[18, 0]) + w.sleeve * abs(joints[20, 0])
    collar, waist = joints[12, 1] + 0.01, joints[3, 1] - 0.02
    hem = joints[7, 1] + 0.06 + (1 - w.leg) * (joints[4, 1] - joints[7, 1])
    shirt = (y < collar) & (y > waist) & (side < cuff)
    _put(colour, shirt, _shirt(x, y, z, side, joints, w))
    _put(colour, (y <= waist) & (y > hem), _trousers(x, y, z, w))
    _put(colour, (y <= waist) & (y > waist - 0.035), np.array([[0.20, 0.11, 0.06]]) * (1 + (side < 0.03))[:, None])
    _put(colour, y <= joints[7, 1] + 0.02, _shoes(y, z, joints, w))
    _put(colour, _hair(y, z, joints), np.array(w.hair) * (0.8 + 0.4 * (np.sin(190 * x + 40 * y) > 0))[:, None])
    return colour


def _put(colour: Array, where: Mask, value: Array) -> None:
    colour[where] = np.broadcast_to(value, colour.shape)[where]


def _shirt(x: Array, y: Array, z: Array, side: Array, joints: Array, w: Wardrobe) -> Array:
    """Stripes across the trunk and round the sleeves, and a badge of checks on the chest."""
    sleeve = side > abs(joints[16, 0])
    along = np.where(sleeve, side, y)
    striped = np.where(np.sin(2 * np.pi * along / 0.075) > 0.1, 1.0, 0.0)[:, None]
    colour = striped * np.array(w.stripe) + (1 - striped) * np.array(w.shirt)
    badge = (side < 0.085) & (np.abs(y - joints[9, 1] - 0.09) < 0.085)
    checks = (np.floor(x / 0.0285) + np.floor(y / 0.0285)) % 2
    front, back = np.array([0.95, 0.80, 0.15]), np.array([0.75, 0.15, 0.20])
    picture = np.where((z > 0)[:, None], front, back) * (0.25 + 0.75 * checks)[:, None]
    return np.where(badge[:, None], picture, colour)


def _trousers(x: Array, y: Array, z: Array, w: Wardrobe) -> Array:
    """Checked cloth with a light seam along the outer side."""
    lines = (np.sin(2 * np.pi * y / 0.09) > 0.8) | (np.sin(2 * np.pi * x / 0.06) > 0.85)
    colour = np.array(w.trousers) * np.where(lines, 1.7, 1.0)[:, None]
    seam = (np.abs(z - 0.03) < 0.018) & (np.abs(x) > 0.13)
    return np.where(seam[:, None], np.array([0.85, 0.85, 0.80]), colour)


def _shoes(y: Array, z: Array, joints: Array, w: Wardrobe) -> Array:
    """Dark laces over the instep and a white sole."""
    laces = (np.sin(2 * np.pi * z / 0.03) > 0.3) & (z > joints[7, 2] + 0.05) & (z < joints[10, 2])
    colour = np.where(laces[:, None], 0.12, np.array(w.shoes))
    return np.where((y < joints[10, 1] - 0.005)[:, None], 0.92, colour)


def _hair(y: Array, z: Array, joints: Array) -> Mask:
    """Above the brow in front, down to the neck behind."""
    up, forward = y - joints[15, 1], z - joints[15, 2]
    covered: Mask = (up > 0.105 + 0.35 * (forward - 0.05)) & (up > -0.02)
    return covered
