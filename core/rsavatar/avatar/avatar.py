"""Canonical Gaussians bound to a body (paper, section 3.1)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rsavatar.avatar.surface import Surface
from rsavatar.render.base import Gaussians

INITIAL_OPACITY = 0.1
PARAMETERS = ("means", "rotations", "log_scales", "opacity_logits", "sh_constant", "sh_linear")


class Avatar(torch.nn.Module):
    """M Gaussians in the body's rest pose, channel-first.

    Starts with one grey, isotropic, nearly transparent Gaussian on each vertex. ``vertex`` [M] is the body vertex that
    each one takes its skinning weights and blend shapes from; it is found anew when Gaussians come and go.
    """

    vertex: Tensor
    prior: Tensor

    def __init__(self, surface: Surface) -> None:
        super().__init__()
        self.surface = surface
        count = len(surface.vertices)
        spacing = surface.spacing()
        logit = torch.logit(torch.tensor(INITIAL_OPACITY))
        self.means = torch.nn.Parameter(torch.from_numpy(surface.vertices.T.copy()).float())
        self.rotations = torch.nn.Parameter(torch.tensor([[1.0], [0.0], [0.0], [0.0]]).repeat(1, count))
        self.log_scales = torch.nn.Parameter(spacing.log().repeat(3, 1))
        self.opacity_logits = torch.nn.Parameter(logit.repeat(count))
        self.sh_constant = torch.nn.Parameter(torch.zeros(1, 3, count))
        self.sh_linear = torch.nn.Parameter(torch.zeros(3, 3, count))
        self.register_buffer("vertex", torch.arange(count))
        self._gathered: tuple[Tensor | None, Tensor] = (None, torch.empty(0))
        self.register_buffer("prior", surface.weights.clone())  # [24, M] skinning weights of `vertex`

    @property
    def count(self) -> int:
        """M."""
        return self.means.shape[1]

    def bind(self) -> Tensor:
        """Find each Gaussian's vertex anew; returns its distance [M], metres."""
        self.vertex, distance = self.surface.nearest(self.means)
        self.prior = self.surface.weights[:, self.vertex].contiguous()
        return distance

    def limit_scales(self, largest: float) -> None:
        """Cut every axis of every Gaussian to at most ``largest`` metres."""
        if largest < math.inf:
            self.log_scales.data.clamp_(max=math.log(largest))

    def shaped_means(self, shape_change: Tensor, pose_offset: Tensor | None) -> Tensor:
        """Canonical means [3, M] with blend shapes added.

        Args:
            shape_change: [10], shape coefficients minus the initial ones.
            pose_offset: [3, V] from ``Surface.pose_offsets``, or None.
        """
        shaped: Tensor = self.means + torch.tensordot(shape_change, self._shape_directions(), 1)
        return shaped if pose_offset is None else shaped + pose_offset.index_select(1, self.vertex)

    def _shape_directions(self) -> Tensor:
        """The surface's [10, 3, M] at each Gaussian, gathered once a binding: no step's backward pass scatters."""
        vertex, directions = self._gathered
        if vertex is not self.vertex:
            vertex, directions = self.vertex, self.surface.shape_directions.index_select(2, self.vertex)
            self._gathered = vertex, directions
        return directions

    def gaussians(self, means: Tensor, skin_weights: Tensor, sh_degree: int) -> Gaussians:
        """The renderer's words for these Gaussians, with a fresh ``screen`` to catch screen-space gradients."""
        sh = self.sh_constant if sh_degree == 0 else torch.cat([self.sh_constant, self.sh_linear])
        screen = torch.zeros(2, self.count, requires_grad=torch.is_grad_enabled())
        return Gaussians(means, self.rotations, self.log_scales, self.opacity_logits, sh, skin_weights, screen)
