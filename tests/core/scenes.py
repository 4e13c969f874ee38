"""Small scenes with every difficulty that a renderer meets and no threshold that decides a test by itself."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import torch

from rsavatar.geometry.cameras import Camera
from rsavatar.geometry.rotations import exp_so3
from rsavatar.render.base import Gaussians, Options, Scene, TimedRows

HEIGHT, WIDTH = 60, 52


def camera() -> Camera:
    angle = 0.2
    rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return Camera(rotation, np.array([0.02, -0.03, 2.4]), 70.0, 74.0, 25.3, 31.2, HEIGHT, WIDTH)


def gaussians(count: int, seed: int, bases: int = 4, dtype: torch.dtype = torch.float64) -> Gaussians:
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    weights = torch.zeros(24, count, dtype=torch.float64)
    for k in range(count):
        joints = torch.randperm(24, generator=g)[:4]
        weights[joints, k] = torch.rand(4, generator=g, dtype=torch.float64) + 0.1
    made = Gaussians(
        means=normal(3, count) * 0.35,
        rotations=normal(4, count),
        log_scales=-3.0 + 0.5 * normal(3, count),
        opacity_logits=1.0 * normal(count),
        sh=0.7 * normal(bases, 3, count),
        skin_weights=weights / weights.sum(0),
        screen=torch.zeros(2, count, dtype=torch.float64),
    )
    return cast(made, dtype)


def cast(g: Gaussians, dtype: torch.dtype) -> Gaussians:
    """The same numbers (rounded to float32 first, so that both precisions see the same) in ``dtype``."""
    return replace(g, **{f.name: getattr(g, f.name).float().to(dtype) for f in fields(g)})


def pose(slots: int, coefficients: int, seed: int, speed: float = 0.1) -> torch.Tensor:
    """Joint transforms that turn and move: coefficient d shrinks like 1 / d!."""
    g = torch.Generator().manual_seed(1000 + seed)
    out = torch.zeros(slots, coefficients, 24, 3, 4, dtype=torch.float64)
    for t in range(slots):
        out[t, 0, :, :, :3] = exp_so3(0.3 * torch.randn(24, 3, generator=g, dtype=torch.float64))
        out[t, 0, :, :, 3] = 0.05 * torch.randn(24, 3, generator=g, dtype=torch.float64)
        scale = speed
        for d in range(1, coefficients):
            out[t, d] = scale * torch.randn(24, 3, 4, generator=g, dtype=torch.float64)
            scale = scale / (d + 1)
    return out


def rows_of(kind: str) -> tuple[tuple[TimedRows, ...], int]:
    """Slots of one kind of shutter, and the pose coefficients that they need."""
    full = 2.0 / HEIGHT
    kinds: dict[str, tuple[tuple[TimedRows, ...], int]] = {
        "global": ((TimedRows(0, HEIGHT, 0.0, 0.0),), 1),
        "instant": ((TimedRows(0, HEIGHT, 0.0, 0.3),), 3),
        "blur": (tuple(TimedRows(0, HEIGHT, 0.0, 0.0, 1 / 3) for _ in range(3)), 1),
        "bands": (tuple(TimedRows(12 * i, 12 * i + 12, 0.0, 0.0) for i in range(5)), 1),
        "scanline": ((TimedRows(0, HEIGHT, full, -1.0),), 4),
        "upward": ((TimedRows(0, HEIGHT, -full, 1.0),), 4),
        "part": ((TimedRows(7, 41, 2.0 / 34, -1.0 - 14.0 / 34),), 3),
        "rows": (tuple(TimedRows(y, y + 1, r, 0.0, 0.5) for y in range(HEIGHT) for r in (0.0, full)), 3),  # many slots
        "exposed": (tuple(TimedRows(0, HEIGHT, 0.9 * full, -0.9 + s, 0.5) for s in (-0.1, 0.1)), 4),
    }
    return kinds[kind]


KINDS = ("global", "instant", "blur", "bands", "scanline", "upward", "part", "exposed", "rows")


def scene(kind: str, count: int = 150, seed: int = 0, bases: int = 4, dtype: torch.dtype = torch.float64) -> Scene:
    rows, coefficients = rows_of(kind)
    transforms = pose(len(rows), coefficients, seed).float().to(dtype)
    return Scene(gaussians(count, seed, bases, dtype), transforms, rows, camera(), Options())


def orderly(s: Scene) -> Scene:
    """The same Gaussians in a pole, in the order of their height, all moving as joint 0: a block keeps to few rows."""
    order = s.gaussians.means[1].argsort()
    sorted_ones = {f.name: getattr(s.gaussians, f.name)[..., order].contiguous() for f in fields(Gaussians)}
    sorted_ones["means"][::2] *= 0.1
    return replace(s, gaussians=Gaussians(**sorted_ones), pose=s.pose[:, :, :1].expand_as(s.pose).contiguous())
