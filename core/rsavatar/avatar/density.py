"""Adaptive density control by KL divergence (GauHuman, section 3.3): clone, split, merge, prune.

All decisions of one round are taken on the same Gaussians, before any of them is touched; then one edit is made. So
no gradient is ever read at another Gaussian's index.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from rsavatar.avatar.avatar import PARAMETERS, Avatar
from rsavatar.geometry.rotations import quaternion_to_matrix


@dataclass(frozen=True)
class DensityRules:
    """When and where Gaussians come and go; GauHuman's constants."""

    start: int = 400  # after this step,
    stop: int = 1000  # before this one,
    every: int = 100  # every so many
    gradient: float = 2e-4  # mean norm of the screen gradient, in units of half the image
    relative_size: float = 0.01  # of the extent; larger Gaussians are split, smaller ones cloned
    distinct: float = 0.4  # KL divergence to the nearest neighbour above which a Gaussian may multiply
    alike: float = 0.1  # below which two are merged
    least_opacity: float = 0.005
    farthest: float = 0.05  # metres from the body
    most: int = 200_000  # Gaussians

    def due(self, step: int) -> bool:
        """Whether a round follows step ``step`` (counted from 1)."""
        return self.start < step < self.stop and step % self.every == 0


@dataclass(frozen=True)
class Edit:
    """Gaussians to keep (a mask [M]) and to append (parameter name -> [..., added])."""

    keep: Tensor
    added: Mapping[str, Tensor]


@dataclass(frozen=True)
class Round:
    """What one round did, in Gaussians."""

    cloned: int
    split: int
    merged: int
    pruned: int
    count: int


class ScreenGradients:
    """Running mean of the screen-space gradient's norm of each Gaussian, over the images where it was seen."""

    def __init__(self, count: int) -> None:
        self.total = torch.zeros(count)
        self.seen = torch.zeros(count)

    def add(self, gradient: Tensor, height: int, width: int) -> None:
        """``gradient`` [2, M] of an image of ``height`` x ``width`` pixels, per pixel."""
        norm = torch.hypot(gradient[0] * (width / 2), gradient[1] * (height / 2))
        self.total += norm
        self.seen += norm > 0

    def mean(self) -> Tensor:
        """[M]; 0 where never seen."""
        return self.total / self.seen.clamp(min=1)


def divergence(means: Tensor, covariances: Tensor, other: Tensor) -> Tensor:
    """KL(self || other) [M] of Gaussians of ``means`` [M, 3] and ``covariances`` [M, 3, 3]; ``other`` [M] is an index.

    1/2 (tr(S1^-1 S0) + d^T S1^-1 d + ln(det S1 / det S0) - 3), 0 = self, 1 = other.
    """
    s0, s1 = covariances, covariances[other]
    d = (means[other] - means)[:, :, None]
    inverse = torch.linalg.inv_ex(s1).inverse  # of a needle too thin to invert: a divergence that decides nothing
    trace = torch.einsum("mij,mji->m", inverse, s0)
    distance = (d.transpose(1, 2) @ inverse @ d)[:, 0, 0]
    result: Tensor = 0.5 * (trace + distance + torch.logdet(s1) - torch.logdet(s0) - 3.0)
    return result


def neighbours(points: Tensor) -> Tensor:
    """Index [M] of the nearest other point of ``points`` [M, 3]."""
    _, index = cKDTree(points.numpy()).query(points.numpy(), k=2)
    index = np.asarray(index, np.int64)
    own = np.arange(len(index))
    return torch.from_numpy(np.where(index[:, 0] == own, index[:, 1], index[:, 0]))


def decide(avatar: Avatar, gradient: Tensor, extent: float, rules: DensityRules, seed: int) -> tuple[Edit, Round]:
    """One round on ``avatar``, given mean screen gradients [M] and the scene's extent in metres."""
    p = {name: getattr(avatar, name).detach() for name in PARAMETERS}
    means, scales = p["means"].T.double(), p["log_scales"].T.double().exp()
    factor = quaternion_to_matrix(p["rotations"].T.double()) * scales[:, None, :]
    nearest = neighbours(means)
    kl = divergence(means, factor @ factor.transpose(1, 2), nearest)
    hot, small = gradient >= rules.gradient, scales.amax(1) <= rules.relative_size * extent
    room = rules.most - avatar.count
    clone = _first(hot & small & (kl > rules.distinct), room)
    split = _first(hot & ~small & (kl > rules.distinct), room - int(clone.sum()))
    first, second = _pairs(hot & small & (kl < rules.alike), nearest)
    noise = torch.Generator().manual_seed(seed)
    added = [
        _sampled(p, factor, clone, 1, noise),
        _sampled(p, factor, split, 2, noise),
        _merged(p, first, second),
    ]
    joined = {name: torch.cat([a[name] for a in added], -1) for name in PARAMETERS}
    gone = split.clone()
    gone[first] = gone[second] = True
    return Edit(~gone, joined), Round(int(clone.sum()), int(split.sum()), len(first), 0, 0)


def prune(avatar: Avatar, distance: Tensor, rules: DensityRules) -> Edit:
    """Gaussians that are nearly transparent, or farther from the body than ``rules.farthest``, go."""
    opaque = avatar.opacity_logits.detach().sigmoid() >= rules.least_opacity
    near = distance <= rules.farthest
    empty = {name: getattr(avatar, name).detach()[..., :0] for name in PARAMETERS}
    return Edit(opaque & near, empty)


def _first(mask: Tensor, most: int) -> Tensor:
    """The first ``most`` set entries of ``mask``."""
    return mask & (mask.cumsum(0) <= max(most, 0))


def _pairs(candidate: Tensor, nearest: Tensor) -> tuple[Tensor, Tensor]:
    """Disjoint pairs (i, nearest[i]) among candidates, lowest index first."""
    taken: set[int] = set()
    pairs = []
    for i in torch.nonzero(candidate)[:, 0].tolist():
        j = int(nearest[i])
        if i not in taken and j not in taken:
            taken |= {i, j}
            pairs.append((i, j))
    both = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2)
    return both[:, 0], both[:, 1]


def _sampled(
    p: Mapping[str, Tensor], factor: Tensor, mask: Tensor, copies: int, noise: torch.Generator
) -> dict[str, Tensor]:
    """``copies`` samples of each masked Gaussian, drawn from it; halves of a split are 1.6 times smaller."""
    chosen = {name: value[..., mask].repeat_interleave(copies, -1) for name, value in p.items()}
    parents = factor[mask].repeat_interleave(copies, 0)
    draw = torch.randn(len(parents), 3, 1, generator=noise, dtype=torch.float64)
    chosen["means"] = chosen["means"] + (parents @ draw)[:, :, 0].T.float()
    if copies > 1:
        chosen["log_scales"] = chosen["log_scales"] - float(np.log(1.6))
    return chosen


def _merged(p: Mapping[str, Tensor], first: Tensor, second: Tensor) -> dict[str, Tensor]:
    """One for two: the mean of positions, colours and opacities; the first's rotation; its scale over 0.8."""
    result = {name: (value[..., first] + value[..., second]) / 2 for name, value in p.items()}
    result["rotations"] = p["rotations"][..., first]
    result["log_scales"] = p["log_scales"][..., first] - float(np.log(0.8))
    return result
