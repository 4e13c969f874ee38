"""Adam: torch's own as the twin, and what a step does that cannot be taken."""

from __future__ import annotations

import math

import pytest
import torch

from rsavatar import kernels
from rsavatar.adam import Adam

WAYS = [pytest.param(True, id="native"), pytest.param(False, id="torch")]


def parameters(generator: torch.Generator) -> list[torch.nn.Parameter]:
    shapes = [(3, 5001), (1,), (7, 2, 3)]
    return [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in shapes]


@pytest.fixture(params=WAYS)
def native(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    if not request.param:
        monkeypatch.setattr(kernels, "available", lambda: False)
    elif not kernels.available():
        pytest.skip("no native kernels here")
    return bool(request.param)


@pytest.mark.parametrize("epsilon", [1e-15, 1e-8])
def test_equals_torchs(native: bool, epsilon: float) -> None:
    ours, theirs = parameters(torch.Generator().manual_seed(0)), parameters(torch.Generator().manual_seed(0))
    groups = [{"params": ours[:2]}, {"params": ours[2:], "lr": 0.3}]
    mine = Adam(groups, 0.01, epsilon)
    twin = torch.optim.Adam([{"params": theirs[:2]}, {"params": theirs[2:], "lr": 0.3}], lr=0.01, eps=epsilon)
    noise = torch.Generator().manual_seed(1)
    for step in range(40):
        for a, b in zip(ours, theirs, strict=True):
            a.grad = torch.randn(a.shape, generator=noise) * 10.0 ** (step % 7 - 3)
            b.grad = a.grad.clone()
        assert mine.advance()
        twin.step()
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=2e-5, atol=2e-6)  # float32 rounding over 40 steps


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", [0, 7, 15_002])
def test_takes_no_step_on_what_is_not_finite(native: bool, bad: float, place: int) -> None:
    ours = parameters(torch.Generator().manual_seed(0))
    adam = Adam([{"params": ours}], 0.1)
    for p in ours:
        p.grad = torch.ones_like(p)
    assert adam.advance()
    before = [p.detach().clone() for p in ours]
    moments = [adam.state[p]["exp_avg"].clone() for p in ours]
    assert ours[0].grad is not None
    ours[0].grad.view(-1)[place] = bad
    assert not adam.advance()
    assert all(torch.equal(a, b) for a, b in zip(ours, before, strict=True))
    assert all(torch.equal(adam.state[p]["exp_avg"], m) for p, m in zip(ours, moments, strict=True))
    assert all(float(adam.state[p]["step"]) == 1 for p in ours)


def test_watches_what_it_does_not_move(native: bool) -> None:
    ours = parameters(torch.Generator().manual_seed(0))
    adam = Adam([{"params": ours}], 0.1)
    for p in ours:
        p.grad = torch.ones_like(p)
    assert not adam.advance(torch.tensor([0.0, math.nan]))
    assert adam.advance(torch.zeros(3))


def test_leaves_what_has_no_gradient(native: bool) -> None:
    ours = parameters(torch.Generator().manual_seed(0))
    adam = Adam([{"params": ours}], 0.1)
    before = ours[1].detach().clone()
    ours[0].grad = torch.ones_like(ours[0])
    assert adam.advance()
    assert torch.equal(ours[1], before)
    assert ours[1] not in adam.state


@pytest.mark.skipif(not kernels.available(), reason="no native kernels here")
def test_does_not_depend_on_the_threads() -> None:
    found = []
    before = kernels.threads()
    for threads in (1, 2, 3):
        kernels.use_threads(threads)
        ours = parameters(torch.Generator().manual_seed(0))
        adam = Adam([{"params": ours}], 0.1)
        for p in ours:
            p.grad = torch.randn(p.shape, generator=torch.Generator().manual_seed(2))
        adam.advance()
        found.append(ours)
    kernels.use_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))
