"""Moving images along flows: backward (every pixel fetches) and forward (every pixel is thrown, softmax splatting).

**Convention**: flows are in pixels, channel 0 is x (columns), channel 1 is y (rows); a flow of (0, 0) leaves the image
as it is. Places are counted in pixel indices, so the convention of pixel centres does not matter.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from rsavatar.errors import DataError, expected


def backward_warp(image: Tensor, flow: Tensor, padding: Literal["border", "zeros"] = "border") -> Tensor:
    """``out(p) = image(p + flow(p))``, bilinear; differentiable in both.

    Args:
        image: [B, C, H, W].
        flow: [B, 2, H, W], pixels.
        padding: what lies outside the image: its nearest pixel, or 0.

    Returns:
        [B, C, H, W].

    Raises:
        DataError: if the shapes do not belong together.
    """
    _check(image, flow)
    height, width = image.shape[-2:]
    place = _places(flow) + flow
    scale = flow.new_tensor([2 / max(width - 1, 1), 2 / max(height - 1, 1)]).view(1, 2, 1, 1)
    grid = (place * scale - 1).permute(0, 2, 3, 1)
    return grid_sample(image, grid, mode="bilinear", padding_mode=padding, align_corners=True)


def softmax_splat(image: Tensor, flow: Tensor, metric: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Throws every pixel p to p + flow(p): each of the four pixels around gets its bilinear share.

    What arrives is averaged with the weights exp(metric) times the share (softmax splatting); where nothing arrives,
    the result is 0. Differentiable in all three.

    Args:
        image: [B, C, H, W].
        flow: [B, 2, H, W], pixels.
        metric: [B, 1, H, W], importance of a pixel where several land in one place; None: all alike.

    Returns:
        The image [B, C, H, W], and the sum of the bilinear shares that arrived [B, 1, H, W], without the importance: 0
        in a hole, 1 where an undisturbed image lands.

    Raises:
        DataError: if the shapes do not belong together.
    """
    _check(image, flow)
    if metric is None:
        metric = torch.zeros_like(flow[:, :1])
    if metric.shape != flow[:, :1].shape:
        raise DataError(expected("splatting metric", tuple(flow[:, :1].shape), tuple(metric.shape)))
    # A common factor of all weights cancels; without it exp(metric) may overflow.
    weight = (metric - metric.detach().amax((1, 2, 3), keepdim=True)).clamp(min=-60).exp()
    thrown = splat(torch.cat([image * weight, weight, torch.ones_like(weight)], 1), flow)
    total = thrown[:, -2:-1]
    return thrown[:, :-2] / torch.where(total > 0, total, torch.ones_like(total)), thrown[:, -1:]


def splat(values: Tensor, flow: Tensor) -> Tensor:
    """Throws every pixel p to p + flow(p) and adds up there: values [B, C, H, W] times their bilinear shares.

    What falls outside is lost. ``flow`` is [B, 2, H, W], pixels. Differentiable in both.
    """
    batch, channels, height, width = values.shape
    place = _places(flow) + flow
    corner = place.detach().floor()
    along = place - corner
    flat = values.flatten(2)
    out = values.new_zeros(batch, channels, height * width)
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = corner[:, 0] + dx, corner[:, 1] + dy
            share = (along[:, 0] if dx else 1 - along[:, 0]) * (along[:, 1] if dy else 1 - along[:, 1])
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            share = torch.where(inside, share, torch.zeros_like(share)).flatten(1)
            index = torch.where(inside, y * width + x, torch.zeros_like(x)).long().flatten(1)
            out = out.scatter_add(2, index[:, None].expand(-1, channels, -1), flat * share[:, None])
    return out.view_as(values)


def _places(flow: Tensor) -> Tensor:
    """Pixel indices (x, y) [1, 2, H, W]."""
    height, width = flow.shape[-2:]
    rows = torch.arange(height, dtype=flow.dtype, device=flow.device)
    columns = torch.arange(width, dtype=flow.dtype, device=flow.device)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([x, y])[None]


def _check(image: Tensor, flow: Tensor) -> None:
    wanted = (image.shape[0], 2, *image.shape[-2:])
    if image.dim() != 4 or tuple(flow.shape) != wanted:
        raise DataError(expected("flow", f"shape {wanted} for an image {tuple(image.shape)}", tuple(flow.shape)))
