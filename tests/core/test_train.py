"""Training: it learns, it repeats, it resumes, it refuses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from rsavatar import kernels, optimization
from rsavatar.adam import Adam
from rsavatar.avatar.density import DensityRules
from rsavatar.checkpoint import Owner
from rsavatar.errors import CheckpointError, DivergedError, Interrupted
from rsavatar.events import Event, Note, Progress
from rsavatar.methods.base import AbstractMethod, build_actor, observations, settings
from rsavatar.methods.blur import BlurAvatar
from rsavatar.methods.oblivious import ShutterObliviousAvatar
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.optimization import BLOCK, Rates, Saver, Settings, SkinBlock
from rsavatar.train import Trained, fit, pick
from tests.core import small_subject

pytestmark = pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")

OWNER = Owner("spec", "data", "body", "code")
DENSITY = DensityRules(start=50, stop=200, every=50, gradient=1e-5)


def train(
    folder: Path, method: AbstractMethod, stop_after: int | None = None, **changes: object
) -> tuple[Trained, list[Event], dict[str, torch.Tensor]]:
    """Train on the small subject; asked to stop at the first block that ends at ``stop_after`` or later.

    ``changes`` are of the settings; ``calibrate`` is of the spec.
    """
    words: dict[str, Any] = {"calibrate": changes.pop("calibrate", [])}
    case = small_subject.case(iterations=150, checkpoint_every=1000, **words)
    how = replace(settings(case), density=DENSITY, sh_from=60, **changes)  # type: ignore[arg-type]
    actor, events = build_actor(method, case), list[Event]()
    steps = [0]

    def listen(event: Event) -> None:
        events.append(event)
        steps[0] = event.step if isinstance(event, Progress) else steps[0]

    saver = Saver(folder / "checkpoint.safetensors", OWNER)
    done = fit(
        actor,
        observations(method, case),
        how,
        saver,
        listen,
        lambda: stop_after is not None and steps[0] >= stop_after,
    )
    return done, events, load_file(done.checkpoint)


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert set(a) == set(b)
    different = [n for n in a if n != "progress" and not torch.equal(a[n], b[n])]
    assert not different


@pytest.mark.parametrize("method", [RollingShutterAvatar(), ShutterObliviousAvatar(), BlurAvatar()])
def test_it_learns_and_repeats_bit_for_bit(method: AbstractMethod, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    _, events, first = train(tmp_path / "a", method)
    _, _, second = train(tmp_path / "b", method)
    assert_same(first, second)
    losses = [e.loss for e in events if isinstance(e, Progress) and e.loss is not None]
    assert losses[-1] < 0.8 * losses[0]
    assert any("Gaussians" in e.text for e in events if isinstance(e, Note))


def test_a_resumed_run_ends_like_an_undisturbed_one(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    _, _, whole = train(tmp_path / "whole", RollingShutterAvatar())
    with pytest.raises(Interrupted, match=f"step {BLOCK} of 150"):
        train(tmp_path, RollingShutterAvatar(), stop_after=25)
    with pytest.raises(Interrupted, match=f"step {2 * BLOCK} of 150"):
        train(tmp_path, RollingShutterAvatar(), stop_after=75)
    _, events, parts = train(tmp_path, RollingShutterAvatar())
    assert min(e.step for e in events if isinstance(e, Progress)) > 2 * BLOCK
    assert_same(whole, parts)


def test_calibration_and_doubt_are_resumed_too(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    words: dict[str, Any] = {
        "calibrate": ["readout", "trigger"],
        "doubt": True,
        "doubt_after": 50,
        "doubt_from": 0.0,
        "ssim_weight": 0.1,
    }
    _, _, whole = train(tmp_path / "whole", RollingShutterAvatar(), **words)
    with pytest.raises(Interrupted):
        train(tmp_path, RollingShutterAvatar(), stop_after=75, **words)
    _, _, parts = train(tmp_path, RollingShutterAvatar(), **words)
    assert_same(whole, parts)
    assert float(whole["actor.clock.stretch"].abs().max()) > 0


def test_the_number_of_threads_does_not_change_the_result(tmp_path: Path) -> None:
    before, results = kernels.threads(), []
    try:
        for threads in (1, 2):
            kernels.use_threads(threads)
            (tmp_path / str(threads)).mkdir()
            results.append(train(tmp_path / str(threads), RollingShutterAvatar())[2])
    finally:
        kernels.use_threads(before)
    assert_same(*results)


def test_skinning_weights_in_chunks_are_those_of_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optimization, "CHUNK", 48)
    method, networks, before = RollingShutterAvatar(), [], kernels.threads()
    try:
        for threads in (1, 2, None):  # None: torch's own way
            actor = build_actor(method, small_subject.case())
            network = actor.skin_offset
            assert network is not None
            torch.nn.init.normal_(network.head.weight, std=0.1, generator=torch.Generator().manual_seed(2))
            start = [p.detach().clone() for p in network.parameters()]
            adam = Adam([{"params": list(network.parameters())}], 1.0, epsilon=1.0)  # a step is g / (|g| + 1)
            gradient = torch.randn(actor.avatar.prior.shape, generator=torch.Generator().manual_seed(1))
            if threads is None:
                weights = actor.skin_weights()
                weights.backward(gradient)  # type: ignore[no-untyped-call]
                adam.advance()
            else:
                kernels.use_threads(threads)
                block = SkinBlock(actor)
                weights, block.weights.grad = block.weights, gradient
                block.close(adam)
            moved = [p.detach() - old for p, old in zip(network.parameters(), start, strict=True)]
            networks.append((weights.detach(), moved))
    finally:
        kernels.use_threads(before)
    one, two, whole = networks
    assert torch.equal(one[0], two[0])
    assert all(torch.equal(a, b) for a, b in zip(one[1], two[1], strict=True))
    torch.testing.assert_close(one[0], whole[0])
    torch.testing.assert_close(one[1], whole[1], rtol=1e-3, atol=1e-5)
    assert all(float(change.abs().max()) > 0.01 for change in one[1])


def test_a_checkpoint_of_another_job_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        train(tmp_path, RollingShutterAvatar(), stop_after=25)
    case = small_subject.case(iterations=150)
    saver = Saver(tmp_path / "checkpoint.safetensors", replace(OWNER, data="other"))
    with pytest.raises(CheckpointError, match="data: expected other, got data"):
        saver.restore(build_actor(RollingShutterAvatar(), case), settings(case), 6)


def test_a_truncated_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        train(tmp_path, RollingShutterAvatar(), stop_after=25)
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match="whole checkpoint"):
        train(tmp_path, RollingShutterAvatar())


def test_a_step_size_that_is_absurd_ends_in_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(DivergedError, match="diverged"):
        train(tmp_path, RollingShutterAvatar(), rates=Rates(motion=float("inf")))


def test_one_bad_step_is_rejected_and_counted(tmp_path: Path) -> None:
    case = small_subject.case(iterations=60)
    method = RollingShutterAvatar()
    seen = observations(method, case)
    poisoned = replace(seen[0], schedule=replace(seen[0].schedule, offsets=seen[0].schedule.offsets * float("nan")))
    actor = build_actor(method, case)
    how: Settings = replace(settings(case), density=None)
    saver = Saver(tmp_path / "c.safetensors", OWNER)
    done = fit(actor, [poisoned, *seen[1:]], how, saver, lambda _: None, lambda: False)
    assert done.rejected == 10  # once an epoch of 6
    assert all(torch.isfinite(p).all() for p in actor.parameters())


def test_an_epoch_sees_every_image_once() -> None:
    epochs = [[pick(3, 7 * e + k, 7) for k in range(7)] for e in range(3)]
    assert [sorted(e) for e in epochs] == [list(range(7))] * 3
    assert len({tuple(e) for e in epochs}) > 1
