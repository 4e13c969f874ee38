"""The fused L1 against the same sum in torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rsavatar import kernels
from rsavatar.losses import dissimilarity, l1
from rsavatar.metrics.image import ssim_map
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
        (3 * value).backward()  # type: ignore[no-untyped-call]
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


class TestDissimilarity:
    def images(self, dtype: torch.dtype) -> tuple[Rendering, torch.Tensor]:
        g = torch.Generator().manual_seed(3)
        rgb = torch.rand(3, 21, 17, generator=g).to(dtype)
        return Rendering(rgb, torch.ones(21, 17)), torch.randint(0, 256, (3, 21, 17), generator=g, dtype=torch.uint8)

    def test_an_image_is_like_itself(self) -> None:
        _, target = self.images(torch.float64)
        same = Rendering(target.double() / 255, torch.ones(21, 17))
        assert float(dissimilarity(same, target)) == pytest.approx(0, abs=1e-12)

    def test_it_is_one_minus_the_metric_over_whole_windows(self) -> None:
        image, target = self.images(torch.float64)
        x, y = (t.permute(1, 2, 0).numpy() for t in (image.rgb, target.double() / 255))
        wanted = 1 - np.asarray(ssim_map(x, y))[5:-5, 5:-5].mean()
        assert float(dissimilarity(image, target)) == pytest.approx(wanted, abs=1e-9)

    def test_its_gradient_is_right(self) -> None:
        image, target = self.images(torch.float64)
        rgb = image.rgb[:, :13, :12].contiguous().requires_grad_()
        small = target[:, :13, :12].contiguous()
        assert torch.autograd.gradcheck(
            lambda x: dissimilarity(Rendering(x, torch.ones(13, 12)), small), rgb, fast_mode=True
        )

    def test_an_image_smaller_than_the_window_adds_nothing(self) -> None:
        rgb = torch.rand(3, 10, 30, requires_grad=True)
        value = dissimilarity(Rendering(rgb, torch.ones(10, 30)), torch.zeros(3, 10, 30, dtype=torch.uint8))
        value.backward()  # type: ignore[no-untyped-call]
        assert float(value.detach()) == 0
        assert rgb.grad is not None
        assert float(rgb.grad.abs().max()) == 0
