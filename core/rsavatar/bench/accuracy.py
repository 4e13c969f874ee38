"""Errors of every way to render, against the row-by-row truth, over several seeds of the scene.

A pixel's depth order is decided by differences that can be smaller than float32 resolves: where two splats are at the
same depth to 2.4e-7 m, their order is a matter of luck, and a few dozen pixels with it. They decide a PSNR above 75 dB.
So errors are medians over seeds, and every seed's value is kept; ``off_px`` counts such pixels, ``psnr_rest_db`` leaves
them out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rsavatar.bench.results import Accuracy, Order
from rsavatar.bench.scene import MovingBody
from rsavatar.bench.truth import Truth
from rsavatar.bench.ways import Exposure, Way, in_bands
from rsavatar.render.base import Rendering

Array = npt.NDArray[np.float64]
SHIFT_PX = 3


@dataclass(frozen=True)
class Errors:
    """One image's; the fields of ``results.Accuracy``."""

    psnr_db: float
    max_abs: float
    off_px: int
    psnr_rest_db: float


def compare(body: MovingBody, truth: Truth, ways: Sequence[Way]) -> dict[str, tuple[Errors, float]]:
    """Errors of each way's image, by its name, and the relative error of its motion gradient."""
    upstream, height = misaligned(truth), body.camera.height
    exact = Exposure(body, in_bands(height, height), upstream).motion_gradient()
    found = {}
    for way in ways:
        shot = Exposure(body, way, upstream)
        gradient = float((shot.motion_gradient() - exact).norm() / exact.norm())
        found[way.name] = errors(shot.forward(), truth), gradient
    return found


def over_seeds(found: Sequence[tuple[Errors, float]]) -> Accuracy:
    """One way's figures over the seeds: medians, but the worst pixel and the most pixels of any seed."""
    errors_of = [e for e, _ in found]
    return Accuracy(
        psnr_db=median(e.psnr_db for e in errors_of),
        psnr_by_seed_db=[e.psnr_db for e in errors_of],
        max_abs=max(e.max_abs for e in errors_of),
        off_px=max(e.off_px for e in errors_of),
        psnr_rest_db=median(e.psnr_rest_db for e in errors_of),
        motion_gradient_error=median(gradient for _, gradient in found),
    )


def errors(image: Rendering, truth: Truth) -> Errors:
    """PSNR over the foreground's pixels and channels, peak 1; the largest error anywhere."""
    difference = image.rgb.double().numpy() - truth.rgb
    inside = difference[:, truth.foreground]
    off = np.abs(inside).max(0) > 1 / 255
    return Errors(_psnr(inside), float(np.abs(difference).max()), int(off.sum()), _psnr(inside[:, ~off]))


def misaligned(truth: Truth) -> tuple[Tensor, Tensor]:
    """G: gradients [3, H, W] and [H, W] of half the squared error of the truth against itself, shifted."""

    def difference(image: Array) -> Tensor:
        return torch.from_numpy(image - np.roll(image, (SHIFT_PX, SHIFT_PX), (-2, -1))).float()

    return difference(truth.rgb), difference(truth.transmittance)


def order_of(bands: Sequence[int], psnr_db: Sequence[float], motion_px: float) -> Order:
    """Convergence of bands in T, from their PSNR."""
    rms = [10 ** (-p / 20) for p in psnr_db]
    slope = np.polyfit(np.log(bands), np.log(rms), 1)[0]
    return Order(motion_px=motion_px, bands=list(bands), rms_error=rms, order=-float(slope))


def _psnr(difference: Array) -> float:
    mean = float(np.square(difference).mean()) if difference.size else 0.0
    return -10 * float(np.log10(max(mean, 1e-20)))
