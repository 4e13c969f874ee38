"""Backward and forward warps against whole shifts, loops over pixels, and each other."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rsavatar.errors import DataError
from rsavatar.restore.warp import backward_warp, softmax_splat


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def constant(x: float, y: float, size: tuple[int, int] = (7, 9)) -> Tensor:
    return torch.tensor([x, y], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, *size)


def splat_by_loops(image: Tensor, flow: Tensor, metric: Tensor) -> Tensor:
    """The definition: sum of exp(metric) * share * colour over sum of exp(metric) * share."""
    height, width = image.shape[1:]
    total, weights = torch.zeros_like(image), torch.zeros(height, width, dtype=image.dtype)
    for row in range(height):
        for column in range(width):
            x, y = column + flow[0, row, column].item(), row + flow[1, row, column].item()
            for v in (math.floor(y), math.floor(y) + 1):
                for u in (math.floor(x), math.floor(x) + 1):
                    if 0 <= u < width and 0 <= v < height:
                        share = (1 - abs(u - x)) * (1 - abs(v - y)) * math.exp(metric[0, row, column].item())
                        total[:, v, u] += share * image[:, row, column]
                        weights[v, u] += share
    return torch.where(weights > 0, total / weights.clamp(min=1e-300), torch.zeros_like(total))


def test_no_flow_changes_nothing() -> None:
    image = random(2, 3, 7, 9)
    flow = torch.zeros(2, 2, 7, 9, dtype=torch.float64)
    torch.testing.assert_close(backward_warp(image, flow), image)
    splatted, arrived = softmax_splat(image, flow)
    torch.testing.assert_close(splatted, image)
    torch.testing.assert_close(arrived, torch.ones_like(arrived))


def test_whole_shifts() -> None:
    """A flow of (2, 1) fetches from two columns right and one row down, and throws there."""
    image = random(1, 3, 7, 9)
    fetched = backward_warp(image, constant(2, 1))
    torch.testing.assert_close(fetched[..., :-1, :-2], image[..., 1:, 2:])
    thrown, arrived = softmax_splat(image, constant(2, 1))
    torch.testing.assert_close(thrown[..., 1:, 2:], image[..., :-1, :-2])
    assert not thrown[..., 0, :].any()
    assert not arrived[..., :, :2].any()


def test_padding() -> None:
    image = random(1, 1, 4, 5)
    far = constant(50, 0, (4, 5))
    torch.testing.assert_close(backward_warp(image, far), image[..., -1:].expand_as(image))
    assert not backward_warp(image, far, "zeros").any()


def test_bilinear_fetching_is_exact_on_a_plane() -> None:
    y, x = torch.meshgrid(torch.arange(8.0), torch.arange(8.0), indexing="ij")
    plane = (3 * x - 2 * y + 1)[None, None].double()
    flow = 0.99 * random(1, 2, 8, 8) - 0.5
    inner = (slice(None), slice(None), slice(1, -1), slice(1, -1))
    torch.testing.assert_close(backward_warp(plane, flow)[inner], (plane + 3 * flow[:, :1] - 2 * flow[:, 1:])[inner])


def test_splatting_equals_its_definition() -> None:
    image, metric = random(2, 3, 6, 8), 6 * random(2, 1, 6, 8, seed=1) - 3
    flow = 8 * random(2, 2, 6, 8, seed=2) - 4
    wanted = torch.stack([splat_by_loops(image[b], flow[b], metric[b]) for b in range(2)])
    torch.testing.assert_close(softmax_splat(image, flow, metric)[0], wanted)


def test_the_important_pixel_covers_the_other() -> None:
    """Two pixels land in one place; the difference of their metrics decides as in a softmax."""
    image = torch.tensor([[[[1.0, 0.0]]]], dtype=torch.float64)
    flow = torch.zeros(1, 2, 1, 2, dtype=torch.float64)
    flow[0, 0, 0, 0] = 1.0
    for gap in (0.0, 3.0, 800.0):
        metric = torch.tensor([[[[gap, 0.0]]]], dtype=torch.float64)
        splatted, arrived = softmax_splat(image, flow, metric)
        assert splatted[0, 0, 0, 1].item() == pytest.approx(1 / (1 + math.exp(-min(gap, 60))))
        assert arrived[0, 0, 0].tolist() == [0.0, 2.0]


def test_gradients() -> None:
    image, metric = random(1, 2, 4, 5).requires_grad_(), random(1, 1, 4, 5, seed=1).requires_grad_()
    flow = (0.7 * random(1, 2, 4, 5, seed=2) + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(backward_warp, (image, flow))
    assert torch.autograd.gradcheck(lambda *given: softmax_splat(*given)[0], (image, flow, metric))


def test_shapes_are_checked() -> None:
    with pytest.raises(DataError, match="flow: expected"):
        backward_warp(random(1, 3, 4, 5), random(1, 2, 5, 4))
    with pytest.raises(DataError, match="metric: expected"):
        softmax_splat(random(1, 3, 4, 5), random(1, 2, 4, 5), random(1, 2, 4, 5))
