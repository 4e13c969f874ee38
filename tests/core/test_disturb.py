"""Disturbances: each does what its word says, and nothing to the truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rsavatar.data.base import BodyFit, Subject, TrueMotion
from rsavatar.data.disturb import disturb
from rsavatar.errors import DataError, SpecError
from rsavatar.spec import Disturbance
from tests.core import small_subject


def subject() -> Subject:
    """The small one with a true motion: the fit, all rotations halved."""
    given = small_subject.subject()
    n = given.frames
    true = BodyFit(given.fit.poses / 2, given.fit.Rh / 2, given.fit.Th / 2, given.fit.shapes + 0.5)
    none = np.zeros((n, 5, 3))
    motion = TrueMotion(true, np.zeros((n, 24, 3)), np.zeros((n, 5, 72)), none, none, np.zeros((n, 5, 24, 3)))
    return replace(given, motion=motion)


def disturbed(**words: Any) -> Subject:
    return disturb(subject(), Disturbance(**words), seed=3)


def test_nothing_asked_is_nothing_changed() -> None:
    given = subject()
    assert disturb(given, Disturbance(), 0) is given


def test_readout_is_longer_and_triggers_late_and_early_about_the_same_mean() -> None:
    timing = disturbed(readout=0.2, trigger=0.25).timing
    assert timing.readout_frames == pytest.approx(1.2 * 11)
    assert {c: timing.trigger(c) for c in ("00", "01", "02")} == pytest.approx({"00": 2.75, "01": -0.75, "02": 0.0})


@pytest.mark.parametrize("factor", [0.0, 1.0, 2.0])
def test_the_fits_error_is_scaled(factor: float) -> None:
    """The true rotation is half the given one about the same axis: its error is the other half."""
    fit, given = disturbed(fit=factor).fit, subject()
    np.testing.assert_allclose(fit.poses, given.fit.poses * (1 + factor) / 2, atol=1e-9)
    np.testing.assert_allclose(fit.Rh, given.fit.Rh * (1 + factor) / 2, atol=1e-9)
    np.testing.assert_allclose(fit.Th, given.fit.Th * (1 + factor) / 2, atol=1e-12)
    np.testing.assert_allclose(fit.shapes, 0.5 - 0.5 * factor, atol=1e-12)


def test_scaling_an_unknown_error_is_refused() -> None:
    with pytest.raises(DataError, match=r"true motion, for disturb\.fit"):
        disturb(small_subject.subject(), Disturbance(fit=2.0), 0)


def test_a_share_of_the_training_images_is_missing_the_same_for_a_seed() -> None:
    once, again = disturbed(missing=0.5), disturbed(missing=0.5)
    assert once.missing == again.missing
    assert len(once.missing) == 3  # of 2 cameras x 3 frames
    assert all(camera in once.training for camera, _ in once.missing)


def test_masks_are_wrong_in_three_ways_and_the_image_is_cut_by_them() -> None:
    given, wrong = subject(), disturbed(masks=0.5)
    views = [(c, n) for c in given.training for n in range(given.frames)]
    hit = [v for v in views if not np.array_equal(wrong.observe(*v)[1], given.observe(*v)[1])]
    assert len(hit) == 3
    smaller, larger = 0, 0
    for view in hit:
        rgb, mask = wrong.observe(*view)
        before = given.observe(*view)[1]
        assert not rgb[mask == 0].any()
        smaller += bool((mask < before).any())
        larger += bool((mask > before).any())
    assert smaller >= 1
    assert larger >= 1


def test_a_global_shutter_sees_the_sharp_frames_at_the_mid_rows() -> None:
    given, sharp = subject(), disturbed(capture="global shutter")
    assert sharp.observe is given.truth
    assert sharp.timing.readout_frames == 0
    assert sharp.timing.trigger_frames["01"] == 2.0


def test_the_truth_and_the_held_out_views_stay_and_the_data_are_others() -> None:
    given, made = subject(), disturbed(readout=0.1, trigger=0.1, fit=2.0, missing=0.2, masks=0.2)
    assert made.truth is given.truth
    assert made.held_out == given.held_out
    assert made.motion is not None
    assert given.motion is not None
    np.testing.assert_array_equal(made.motion.mid.poses, given.motion.mid.poses)
    assert made.fingerprint != given.fingerprint


def test_the_oracle_is_not_disturbed() -> None:
    with pytest.raises(SpecError, match="disturb: expected nothing for oracle"):
        small_subject.case(method="oracle", disturb={"readout": 0.2})
