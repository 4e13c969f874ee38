"""How far the trajectories of consecutive frames are from joining up (paper, eq. reg)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rsavatar import kernels
from rsavatar.geometry.rotations import rotvec_distance
from rsavatar.motion.base import JOINTS

_TINY = 1e-20  # keeps the gradient of a length finite at 0


def gap(control: Tensor, ends: Tensor, meeting: Tensor, translation: bool) -> Tensor:
    """Mean gap between the end of each frame's trajectory and the start of the next frame's, radians.

    Args:
        control: [N, P, 25, 3] control points: axis-angle of the root and of joints 1..23, and the translation, metres.
        ends: [2, P] float64, weights of the control points at a frame's end, and at its start.
        meeting: [N - 1] float64, weights of the pairs (n, n + 1).
        translation: whether the distance of the translations is added, metres, with weight 1.

    Returns:
        A scalar, differentiable in ``control``.
    """
    if kernels.available() and control.dtype == torch.float32:
        return _apply(control, ends, meeting, translation)
    last, first = torch.einsum("ep,npjc->enjc", ends.to(control.dtype), control)
    last, first = last[:-1], first[1:]
    apart = rotvec_distance(last[:, :JOINTS], first[:, :JOINTS]).mean(-1)
    if translation:
        apart = apart + ((last[:, JOINTS] - first[:, JOINTS]).square().sum(-1) + _TINY).sqrt()
    return (apart * meeting.to(apart.dtype)).sum()


class _Gap(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, control: Tensor, ends: Tensor, meeting: Tensor, translation: bool) -> Tensor:
        control, ends, meeting = control.detach().contiguous(), ends.contiguous(), meeting.contiguous()
        ctx.gradient = torch.empty_like(control)
        value = kernels.library().rs_continuity(
            control.data_ptr(),
            *control.shape[:2],
            ends.data_ptr(),
            meeting.data_ptr(),
            translation,
            kernels.threads(),
            ctx.gradient.data_ptr(),
        )
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        return upstream[0] * ctx.gradient, None, None, None


_apply: Callable[..., Tensor] = _Gap.apply  # torch leaves apply untyped
