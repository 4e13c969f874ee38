"""The training losses of CVR and JAMNet, as their authors state them; the VGG terms only where weights are given."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from rsavatar.errors import DataError, expected
from rsavatar.restore.cvr import CVR, Synthesis
from rsavatar.restore.jamnet import Restored
from rsavatar.restore.warp import backward_warp

CHARBONNIER_EPSILON = 1e-3
LEVEL_WEIGHTS = (0.5, 0.25, 0.25, 0.25)  # JAMNet's levels, half resolution to a sixteenth
VGG19 = ((0, 3, 64), (2, 64, 64), (5, 64, 128), (7, 128, 128), (10, 128, 256), (12, 256, 256), (14, 256, 256))
VGG_POOL_BEFORE = (5, 10)
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Perception(nn.Module):
    """Features of VGG19's conv3_3 from the user's weights; ``forward`` is the L1 between two images' features."""

    mean: Tensor
    std: Tensor

    def __init__(self, path: Path) -> None:
        super().__init__()
        from rsavatar.restore.weights import read_state  # the file is read as restricted as any weights

        state = read_state(path)
        self.layers = nn.ModuleList(nn.Conv2d(before, after, 3, 1, 1) for _, before, after in VGG19)
        for (index, before, after), layer in zip(VGG19, self.layers, strict=True):
            for name, shape in (("weight", (after, before, 3, 3)), ("bias", (after,))):
                value = state.get(f"features.{index}.{name}")
                if value is None or tuple(value.shape) != shape:
                    got = "nothing" if value is None else tuple(value.shape)
                    raise DataError(expected(f"VGG19 weights {path}: features.{index}.{name}", shape, got))
                getattr(layer, name).data.copy_(value)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1))
        self.requires_grad_(False)

    def forward(self, image: Tensor, truth: Tensor) -> Tensor:
        """Mean absolute difference of the features of two [B, 3, H, W] in [0, 1]."""
        return (self._features(image) - self._features(truth)).abs().mean()

    def _features(self, image: Tensor) -> Tensor:
        x = (image - self.mean) / self.std
        for (index, _, _), layer in zip(VGG19, self.layers, strict=True):
            x = F.max_pool2d(x, 2) if index in VGG_POOL_BEFORE else x
            x = layer(x)
            x = x if index == VGG19[-1][0] else F.relu(x)
        return x


def charbonnier(a: Tensor, b: Tensor) -> Tensor:
    """Mean of sqrt((a - b)^2 + eps^2)."""
    return ((a - b).square() + CHARBONNIER_EPSILON**2).sqrt().mean()


def total_variation(flow: Tensor) -> Tensor:
    """Mean absolute difference of neighbours down columns plus that along rows; a single pixel has none."""
    down, along = flow.diff(dim=2).abs(), flow.diff(dim=3).abs()
    return down.sum() / max(down.numel(), 1) + along.sum() / max(along.numel(), 1)


def jamnet_loss(made: Restored, frames: Tensor, truth: Tensor, perception: Perception | None) -> Tensor:
    """100 Charbonnier of the result and of the levels', both frames' warps against the truth, TV of the flows, VGG.

    Args:
        made: of ``JAMNet``.
        frames: [B, 6, H, W], what went in.
        truth: [B, 3, H, W], the sharp second frame.
        perception: None leaves its term out.
    """
    loss = 100 * charbonnier(made.image, truth)
    if perception is not None:
        loss = loss + perception(made.image, truth)
    for level, weight in zip(made.levels, LEVEL_WEIGHTS, strict=True):
        size = level.image.shape[2:]
        sharp, pair = (F.interpolate(x, size, mode="area") for x in (truth, frames))
        loss = loss + 100 * weight / 4 * charbonnier(level.image, sharp)
        for k in (0, 1):
            moved = level.moved[:, 2 * k : 2 * k + 2]
            fetched = backward_warp(pair[:, 3 * k : 3 * k + 3], moved)
            loss = loss + 12.5 / 4 * charbonnier(fetched, sharp) + 0.1 / 8 * total_variation(moved)
    return loss


def cvr_loss(made: Mapping[float, Synthesis], truths: Mapping[float, Tensor], perception: Perception | None) -> Tensor:
    """10 L1 and VGG of the results, 5 L1 of the splatted candidates, 0.1 TV of the flows; means over the instants.

    Args:
        made: by instant, of ``CVR.at``.
        truths: by instant, [B, 3, H, W].
        perception: None leaves its term out.
    """
    terms = []
    for time, result in made.items():
        truth = truths[time]
        term = 10 * (result.image - truth).abs().mean()
        if perception is not None:
            term = term + perception(result.image, truth)
        candidates = sum((g - truth).abs().mean() for g in result.fine)
        term = term + 5 / 2 * candidates + 0.1 / 2 * sum(total_variation(flow) for flow in result.flows)
        terms.append(term)
    return torch.stack(terms).mean()


def flow_loss(model: CVR, frames: Tensor) -> Tensor:
    """How badly each frame explains the other along the flow of every level: teaches the flow network from nothing.

    Not the authors': they start from weights of an earlier network. Charbonnier of the difference on the level's own
    resolution, and a little TV.
    """
    a, b = frames[:, :3], frames[:, 3:]
    loss = frames.new_zeros(())
    for here, there in ((a, b), (b, a)):
        for flow in model.net_flow.levels(here, there):
            mine, other = (F.interpolate(x, flow.shape[2:], mode="area") for x in (here, there))
            loss = loss + 10 * charbonnier(backward_warp(other, flow), mine) + 0.02 * total_variation(flow)
    return loss / 2
