"""Blur and scan together: a subject's exposure becomes slots, and modelling it beats ignoring it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rsavatar import kernels
from rsavatar.errors import SpecError
from rsavatar.imaging import Actor, expose
from rsavatar.methods.base import Case, build_actor, observations
from rsavatar.methods.oblivious import ShutterObliviousAvatar
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.train import Observation
from tests.core import small_subject

METHOD = RollingShutterAvatar()
EXPOSURE = 8.0  # source frames, of a readout of 11


def exposed(**words: object) -> Case:
    case = small_subject.case(T="scanline", **words)
    return replace(case, subject=replace(case.subject, timing=replace(case.subject.timing, exposure_frames=EXPOSURE)))


def test_an_exposure_is_a_slot_a_scan_spread_over_it() -> None:
    """Four scans at the middles of quarters of 8 source frames: -3, -1, 1 and 3 from the sharp one."""
    sharp, soft = small_subject.case(T="scanline"), exposed()
    (alone,) = METHOD.shutter(sharp).slots(40, 11.0, 0.5)
    slots = METHOD.shutter(soft).slots(40, 11.0, 0.5)
    np.testing.assert_allclose([s.start - alone.start for s in slots], [-3.0, -1.0, 1.0, 3.0], atol=1e-12)
    assert {s.weight for s in slots} == {0.25}
    assert {s.rate for s in slots} == {alone.rate}


def test_a_spec_may_know_better_than_the_subject() -> None:
    assert len(METHOD.shutter(exposed(exposure_frames=0.0)).slots(40, 11.0, 0.0)) == 1
    assert len(METHOD.shutter(exposed(exposure_samples=7)).slots(40, 11.0, 0.0)) == 7
    assert len(ShutterObliviousAvatar().shutter(exposed()).slots(40, 11.0, 0.0)) == 1


@pytest.mark.parametrize("words", [{"method": "gauhuman"}, {"method": "rs-avatar", "T": "K"}])
def test_who_does_not_scan_has_no_exposure_to_set(words: dict[str, object]) -> None:
    with pytest.raises(SpecError, match="exposure_frames: expected none, or T = scanline"):
        small_subject.case(exposure_frames=2.0, **words)


def render(actor: Actor, seen: Observation, weights: torch.Tensor) -> torch.Tensor:
    return expose(actor.scene(seen.frame, seen.camera, seen.schedule, weights, 0)).rgb


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
def test_the_image_is_the_mean_of_scans_at_shifted_triggers() -> None:
    case, actor = exposed(), moving()
    weights = actor.skin_weights().detach()
    with torch.no_grad():
        for k, soft in enumerate(observations(METHOD, case)):
            scans = []
            for shift in (-3.0, -1.0, 1.0, 3.0):
                late = {c: case.subject.timing.trigger(c) + shift for c in case.subject.training}
                timing = replace(case.subject.timing, exposure_frames=0.0, trigger_frames=late)
                sharp = observations(METHOD, replace(case, subject=replace(case.subject, timing=timing)))[k]
                scans.append(render(actor, sharp, weights))
            torch.testing.assert_close(render(actor, soft, weights), torch.stack(scans).mean(0), atol=2e-6, rtol=0)


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
def test_who_models_the_exposure_stays_at_the_true_motion_and_who_ignores_it_leaves() -> None:
    """The gradient of the squared error at the truth: zero with the combined operator, and not without the blur."""
    actor, pulls = moving(), []
    weights = actor.skin_weights().detach()
    with torch.no_grad():
        pictures = [render(actor, o, weights) for o in observations(METHOD, exposed())]
    for words in ({}, {"exposure_frames": 0.0}):
        actor.zero_grad()
        for picture, o in zip(pictures, observations(METHOD, exposed(**words)), strict=True):
            (render(actor, o, weights) - picture).square().sum().backward()  # type: ignore[no-untyped-call]
        gradient = next(actor.motion.parameters()).grad
        assert gradient is not None
        pulls.append(float(gradient.norm()))
    assert pulls[0] < 1e-4 * pulls[1]


def moving() -> Actor:
    """An opaque, coloured body that moves fast through its frames."""
    actor = build_actor(METHOD, exposed())
    g = torch.Generator().manual_seed(0)
    with torch.no_grad():
        actor.avatar.opacity_logits.fill_(2.0)
        actor.avatar.sh_constant.add_(torch.randn(actor.avatar.sh_constant.shape, generator=g))
        control = next(actor.motion.parameters())
        control[:, 24] += 0.15 * torch.randn(control[:, 24].shape, generator=g)
    return actor
