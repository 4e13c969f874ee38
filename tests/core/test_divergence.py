"""Training that went wrong says so, by block, and keeps the last good checkpoint."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from rsavatar import kernels
from rsavatar.avatar.density import divergence
from rsavatar.bench.stability_subject import case
from rsavatar.bench.stability_training import train
from rsavatar.checkpoint import read
from rsavatar.errors import DivergedError
from rsavatar.methods.base import build_actor, settings
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.optimization import FAR, Rates, State

pytestmark = pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")


def test_a_block_far_above_the_best_is_divergence_and_one_below_the_limit_is_not() -> None:
    job = case()
    actor = build_actor(RollingShutterAvatar(), job)
    state = State(actor, settings(job))
    for mean in (0.2, 0.1, 0.099 * FAR):
        state.losses = [mean] * 50
        state.close_block(actor)
    state.losses = [0.1 * FAR + 1e-3] * 50
    with pytest.raises(DivergedError, match=r"diverged at step 0: mean loss: expected at most 3 times"):
        state.close_block(actor)


def test_what_places_the_body_settles_by_the_end_of_a_run() -> None:
    how = settings(case())
    state = State(build_actor(RollingShutterAvatar(), case()), how)
    state.step = how.iterations
    state.set_rates(how)
    left = {group["name"]: group["lr"] / group["initial"] for group in state.optimizer.param_groups}
    settled = {name for name, share in left.items() if share == pytest.approx(0.01)}
    assert settled == {"means", "motion", "pose_residual"}
    assert all(left[name] == 1.0 for name in left.keys() - settled)


def test_a_parameter_that_is_no_number_is_named() -> None:
    job = case()
    actor = build_actor(RollingShutterAvatar(), job)
    actor.avatar.opacity_logits.data[3] = math.nan
    with pytest.raises(DivergedError, match=r"avatar\.opacity_logits: expected finite numbers"):
        State(actor, settings(job)).close_block(actor)


def test_steps_that_are_far_too_large_end_in_an_error_that_keeps_the_last_good_checkpoint(tmp_path: Path) -> None:
    wild = Rates(**{name: 1e3 * rate for name, rate in asdict(Rates()).items()})
    job = case(iterations=600, checkpoint_every=50)
    train(replace(job, spec=job.spec.model_copy(update={"iterations": 100})), tmp_path)  # a good start
    kept = read(tmp_path / "checkpoint.safetensors")[2]
    with pytest.raises(DivergedError, match="diverged at step"):
        train(job, tmp_path, lambda how: replace(how, rates=wild))
    tensors, _, step = read(tmp_path / "checkpoint.safetensors")
    assert step >= kept
    assert all(torch.isfinite(t).all() for name, t in tensors.items() if name != "progress")


def test_a_needle_too_thin_to_invert_decides_nothing_and_stops_nobody() -> None:
    flat = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)).expand(2, 3, 3)
    found = divergence(torch.zeros(2, 3, dtype=torch.float64), flat, torch.tensor([1, 0]))
    assert not (found > 0.4).any()
    assert not (found < 0.1).any()
