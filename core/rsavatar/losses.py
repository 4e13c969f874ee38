"""Losses on rendered images: L1 fused with its gradient in native code, and structural dissimilarity in torch."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rsavatar import kernels
from rsavatar.render import native, reference
from rsavatar.render.base import Comparison, Rendering, Scene


class _NativeL1(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: Tensor, transmittance: Tensor, static: tuple[Tensor, Tensor, float, float]) -> Tensor:
        target, mask, background, mask_weight = static
        ctx.gradients = torch.empty_like(rgb), torch.empty_like(transmittance)
        compared = kernels.Target(target.data_ptr(), mask.data_ptr(), background, mask_weight)
        value = kernels.library().rs_l1(
            rgb.data_ptr(),
            transmittance.data_ptr(),
            ctypes.byref(compared),
            *transmittance.shape,
            kernels.threads(),
            *(g.data_ptr() for g in ctx.gradients),
        )
        return torch.tensor(value, dtype=torch.float64)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        scale = float(upstream[0])
        rgb, transmittance = ctx.gradients
        return (rgb, transmittance, None) if scale == 1.0 else (scale * rgb, scale * transmittance, None)


_apply: Callable[..., Tensor] = _NativeL1.apply  # torch leaves apply untyped


def l1(image: Rendering, target: Tensor, mask: Tensor, background: float, mask_weight: float) -> Tensor:
    """Mean absolute error over a grey background, plus ``mask_weight`` times that of opacity against mask.

    |rgb + background T - target| over 3HW values + mask_weight |1 - T - mask| over HW (paper, eq. loss, first term).

    Args:
        image: [3, H, W] and [H, W].
        target: [3, H, W] uint8, premultiplied by coverage, on black.
        mask: [H, W] uint8 coverage.
        background: grey level in [0, 1] that both images are laid over.
        mask_weight: at least 0; 0 for the paper's loss.

    Returns:
        A float64 scalar, differentiable in ``image``.
    """
    if kernels.available():
        static = (target.contiguous(), mask.contiguous(), background, mask_weight)
        return _apply(image.rgb.contiguous(), image.transmittance.contiguous(), static)
    coverage = mask.to(image.rgb.dtype) / 255
    colour = target.to(image.rgb.dtype) / 255 + background * (1 - coverage)
    error = (image.over(background) - colour).abs().mean()
    return (error + mask_weight * (1 - image.transmittance - coverage).abs().mean()).double()


def render_l1(scene: Scene, target: Tensor, mask: Tensor, background: float, mask_weight: float) -> Comparison:
    """``l1`` of the image of ``scene``, in one pass that keeps no image; in two where there are no kernels."""
    if kernels.available():
        return native.render_l1(scene, target, mask, background, mask_weight)
    return compare(reference.render(scene), target, mask, background, mask_weight)


def compare(image: Rendering, target: Tensor, mask: Tensor, background: float, mask_weight: float) -> Comparison:
    """``l1`` of an image, with its squared error and counters."""
    loss = l1(image, target, mask, background, mask_weight)
    with torch.no_grad():
        error = image.over(background) - target / 255 - background * (1 - mask / 255)
    return Comparison(loss, float(error.square().mean()), image.projected, image.splats, image.pairs, image.broken)


WINDOW, DEVIATION = 11, 1.5  # pixels: GauHuman's, and Wang et al.'s


def dissimilarity(image: Rendering, target: Tensor) -> Tensor:
    """1 - SSIM (Wang et al., 2004) of images on black: Gaussian window, constants for a range of 1, whole windows only.

    Args:
        image: [3, H, W], at least ``WINDOW`` pixels wide and high.
        target: [3, H, W] uint8.

    Returns:
        A float64 scalar in [0, 2], differentiable in ``image``; 0 for images that hold no whole window.
    """
    if min(target.shape[1:]) < WINDOW:
        return (0.0 * image.rgb.sum()).double()
    x, y = image.rgb, target.to(image.rgb.dtype) / 255
    mean_x, mean_y, xx, yy, xy = _windowed(torch.stack([x, y, x * x, y * y, x * y]))
    var_x, var_y, both = xx - mean_x * mean_x, yy - mean_y * mean_y, xy - mean_x * mean_y
    c1, c2 = 0.01**2, 0.03**2
    likeness = (2 * mean_x * mean_y + c1) * (2 * both + c2)
    norm = (mean_x * mean_x + mean_y * mean_y + c1) * (var_x + var_y + c2)
    unlike: Tensor = (1 - (likeness / norm).mean()).double()
    return unlike


def _windowed(images: Tensor) -> Tensor:
    """Gaussian-weighted means [N, 3, H - 10, W - 10] of images [N, 3, H, W], first along rows, then along columns."""
    places = torch.arange(WINDOW, dtype=images.dtype) - WINDOW // 2
    weights = torch.softmax(-places * places / (2 * DEVIATION**2), 0)
    flat = images.flatten(0, 1)[:, None]
    along = torch.nn.functional.conv2d(flat, weights[None, None, None, :])
    both: Tensor = torch.nn.functional.conv2d(along, weights[None, None, :, None])
    return both.reshape(*images.shape[:2], *both.shape[-2:])
