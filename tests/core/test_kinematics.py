"""The native chain against the torch one in float64."""

from __future__ import annotations

import pytest
import torch

from rsavatar import kernels
from rsavatar.body import kinematics

PARENTS = torch.tensor(
    [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21], dtype=torch.int32
)


def inputs(size: float) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(3)
    shapes = [(5, 24, 3), (5, 24, 3), (5, 3), (5, 3), (24, 3)]
    scales = [size, 0.3 * size, size, 1.0, 0.5]
    return [(s * torch.randn(n, generator=g)).float() for n, s in zip(shapes, scales, strict=True)]


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5, 1e-2, 1.0, 3.0])
@pytest.mark.parametrize("refined", [False, True])
def test_transforms_and_gradients_equal_the_torch_chain(size: float, refined: bool) -> None:
    results = []
    for dtype in (torch.float64, torch.float32):
        tensors = [t.to(dtype).requires_grad_() for t in inputs(size)]
        out = kinematics.pose(tensors[0], tensors[1] if refined else None, *tensors[2:], PARENTS)
        weight = torch.randn(out.shape, generator=torch.Generator().manual_seed(4)).to(dtype)
        (out * weight).sum().backward()
        results.append([out, *(t.grad for t in tensors if t.grad is not None)])
    assert len(results[0]) == len(results[1]) == 5 + refined
    for want, got in zip(*results, strict=True):
        assert (got.double() - want).norm() <= 2e-6 * want.norm().clamp(min=1.0)  # float32 in and out
