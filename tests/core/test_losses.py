"""The fused L1 against the same sum in torch."""

from __future__ import annotations

import pytest
import torch

from rsavatar import kernels
from rsavatar.losses import l1
from rsavatar.render.base import Rendering

pytestmark = pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")


@pytest.mark.parametrize("size", [(1, 1), (3, 7), (9, 8), (16, 33), (50, 41)])
@pytest.mark.parametrize(("background", "mask_weight"), [(0.0, 0.0), (0.0, 0.1), (0.7, 2.0)])
def test_value_and_gradient_equal_torch(size: tuple[int, int], background: float, mask_weight: float) -> None:
    g = torch.Generator().manual_seed(size[0])
    target = torch.randint(0, 256, (3, *size), generator=g, dtype=torch.uint8)
    mask = torch.randint(0, 256, size, generator=g, dtype=torch.uint8)
    results = []
    for dtype in (torch.float32, torch.float64):
        g.manual_seed(7)
        rgb = torch.rand(3, *size, generator=g).to(dtype).requires_grad_()
        transmittance = torch.rand(*size, generator=g).to(dtype).requires_grad_()
        if dtype == torch.float32:
            value = l1(Rendering(rgb, transmittance), target, mask, background, mask_weight)
        else:
            coverage = mask.to(dtype) / 255
            error = rgb + background * transmittance - target.to(dtype) / 255 - background * (1 - coverage)
            value = error.abs().mean() + mask_weight * (1 - transmittance - coverage).abs().mean()
        (3 * value).backward()
        results.append((value.detach(), rgb.grad, transmittance.grad))
    assert float(results[0][0]) == pytest.approx(float(results[1][0]), rel=1e-6)
    for got, want in zip(results[0][1:], results[1][1:], strict=True):
        assert got is not None
        assert want is not None
        # an error within rounding of 0 may take either sign: none is that small here
        torch.testing.assert_close(got.double(), want, rtol=1e-6, atol=1e-9)


def test_the_number_of_threads_does_not_matter() -> None:
    g = torch.Generator().manual_seed(0)
    image = Rendering(torch.rand(3, 61, 47, generator=g), torch.rand(61, 47, generator=g))
    target = torch.randint(0, 256, (3, 61, 47), generator=g, dtype=torch.uint8)
    before, values = kernels.threads(), set()
    try:
        for threads in (1, 2, 5):
            kernels.use_threads(threads)
            values.add(float(l1(image, target, target[0], 0.2, 0.3)))
    finally:
        kernels.use_threads(before)
    assert len(values) == 1
