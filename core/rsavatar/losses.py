"""Losses on rendered images, fused with their gradients in native code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rsavatar import kernels
from rsavatar.render.base import Rendering


class _NativeL1(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rgb: Tensor, transmittance: Tensor, static: tuple[Tensor, Tensor, float, float]) -> Tensor:
        target, mask, background, mask_weight = static
        ctx.gradients = torch.empty_like(rgb), torch.empty_like(transmittance)
        value = kernels.library().rs_l1(
            rgb.data_ptr(),
            transmittance.data_ptr(),
            target.data_ptr(),
            mask.data_ptr(),
            *transmittance.shape,
            background,
            mask_weight,
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
