"""The paper's sub-frame motion: P control vectors per frame and joint, combined by a uniform B-spline of order P.

**Convention**: u = 1/2 + offset / period, so that u in [0, 1] is the frame's own window; a camera whose trigger lies
off centre reads the same polynomial beyond it. Control vectors are not shared between frames: ``penalty`` ties them.
"""

from __future__ import annotations

from math import comb, factorial
from typing import Literal

import torch
from torch import Tensor

from rsavatar.motion.base import AbstractMotion, BodyState, Continuity, InitialMotion, split
from rsavatar.motion.continuity import gap

Perturbation = Literal["zero-mean", "positive"]
ZERO_MEAN_DEVIATION = 1e-3  # radians and metres: breaks ties between control points, moves no joint visibly
POSITIVE_RANGE = (0.001, 0.05)  # radians and metres, MAD-Avatar's public code; biases the pose by about half of it


def basis_matrix(P: int) -> Tensor:
    """B-spline basis matrix M [P, P], float64 (paper, eq. Mmatrix, with 0^0 = 1): value(u) = [1, u, ...] M c.

    Rows are powers of u, columns are control points; order P is degree P - 1. P = 4 is the uniform cubic B-spline.
    """
    rows = []
    for i in range(P):
        front = comb(P - 1, P - 1 - i) / factorial(P - 1)
        signed = [
            [(-1) ** (s - j) * comb(P, s - j) * (P - s - 1) ** (P - 1 - i) for s in range(j, P)] for j in range(P)
        ]
        rows.append([front * sum(terms) for terms in signed])
    return torch.tensor(rows, dtype=torch.float64)


class FrameSpline(AbstractMotion):
    """A polynomial of degree P - 1 in axis-angle components and translation per frame (paper, eq. spline).

    ``control`` [N, P, 25, 3] float32 holds Rh in channel 0, joints 1..23, and Th in channel 24. It starts at the fit,
    perturbed, so the initial trajectory of a frame is nearly constant: "zero-mean" noise is normal, on all control
    points; "positive" is uniform on all but the first, as in MAD-Avatar's public code. ``bands`` is the paper's T,
    which only "paper" continuity speaks of. ``P`` is at least 2.
    """

    basis: Tensor  # [P, P] float64
    meeting: Tensor  # [N - 1] weights of the pairs (n, n + 1): equal where their windows meet, else 0; they sum to 1

    def __init__(
        self, initial: InitialMotion, bands: int, P: int = 4, perturbation: Perturbation = "zero-mean", seed: int = 0
    ) -> None:
        super().__init__()
        fit = initial.stacked()[:, None].expand(-1, P, -1, -1)
        self.control = torch.nn.Parameter((fit + _noise(fit.shape, perturbation, seed)).float())
        self.period = initial.period_frames
        self.readout = initial.readout_frames
        self.bands = bands
        self.register_buffer("basis", basis_matrix(P), persistent=False)
        self._ends: dict[tuple[float, ...], Tensor] = {}
        mids = torch.as_tensor(initial.mid_frames, dtype=torch.float64)
        meeting = ((mids.diff() - self.period).abs() < 1e-6 * self.period).double()
        self.register_buffer("mid_frames", mids, persistent=False)
        self.register_buffer("meeting", meeting / meeting.sum().clamp_min(1), persistent=False)

    def state(self, frame: int, offsets: Tensor) -> BodyState:
        """States [D] of frame ``frame`` at ``offsets`` [D] source frames from its mid time: one product for all."""
        weights = self._weights(0.5 + offsets / self.period)
        points = self.control[frame]
        return split((weights @ points.flatten(1)).reshape(-1, *points.shape[1:]))

    def at(self, times: Tensor) -> BodyState:
        """States at absolute ``times`` [...], source frames, by the trajectory of the nearest frame."""
        frame = self.nearest(times)
        weights = self._weights(0.5 + (times - self.mid_frames[frame]) / self.period)
        return split(torch.einsum("...p,...pjc->...jc", weights, self.control[frame]))

    def penalty(self, kind: Continuity) -> Tensor:
        """Mean gap between the end of each frame's trajectory and the start of the next frame's, radians.

        ``"paper"`` (eq. reg) compares the last band's instant of frame n with the first band's of n + 1. These are not
        the same instant (1 / T of a readout apart, and more where the readout is shorter than the period), so it also
        pulls true motion towards none. ``"aligned"`` compares both
        trajectories at the one instant where their windows meet (u = 1 and u = 0), and adds the distance of the two
        translations there, metres, with weight 1. Rh counts as joint 0. Only frames whose windows meet are compared.
        """
        reach = 0.5 if kind == "aligned" else 0.5 * (self.bands - 1) / self.bands * self.readout / self.period
        return gap(self.control, self._basis_at(0.5 + reach, 0.5 - reach), self.meeting, kind == "aligned")

    def _basis_at(self, *instants: float) -> Tensor:
        """Weights [E, P] float64 of the control points at ``instants``, u; computed once."""
        if instants not in self._ends:
            self._ends[instants] = _powers(torch.tensor(instants, dtype=torch.float64), len(self.basis)) @ self.basis
        return self._ends[instants]

    def _weights(self, u: Tensor) -> Tensor:
        """Weights [..., P] of the control points at ``u`` [...], which may leave [0, 1]."""
        return (_powers(u, len(self.basis)).to(self.basis) @ self.basis).to(self.control.dtype)


def _powers(u: Tensor, count: int) -> Tensor:
    """1, u, ... [..., count]."""
    return u[..., None] ** torch.arange(count, device=u.device)


def _noise(shape: torch.Size, perturbation: Perturbation, seed: int) -> Tensor:
    """The perturbation of the control points [N, P, 25, 3]."""
    generator = torch.Generator().manual_seed(seed)
    if perturbation == "zero-mean":
        return ZERO_MEAN_DEVIATION * torch.randn(shape, generator=generator, dtype=torch.float64)
    low, high = POSITIVE_RANGE
    noise = low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)
    noise[:, 0] = 0.0
    return noise
