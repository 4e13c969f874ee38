"""What every method keeps, and what each ablation flag removes: exactly its component."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rsavatar import catalog
from rsavatar.data.base import TrueMotion
from rsavatar.errors import DataError, SpecError
from rsavatar.geometry.rotations import exp_so3
from rsavatar.imaging import Actor
from rsavatar.methods.base import AbstractMethod, Case, build_actor, check_case, observations, settings
from rsavatar.motion.base import AbstractMotion
from rsavatar.shutter.base import AbstractShutter
from tests.core import small_subject

LEARNED = ["gauhuman", "flow+gauhuman", "cvr+gauhuman", "jamnet+gauhuman", "mad-avatar", "rs-avatar"]


def method_of(case: Case) -> AbstractMethod:
    method: AbstractMethod = catalog.load(catalog.METHODS, case.spec.method)()
    return method


def build(case: Case) -> Actor:
    return build_actor(method_of(case), case)


def parts(case: Case) -> set[str]:
    """The modules that hold parameters, by name."""
    return {name.partition(".")[0] for name, _ in build(case).named_parameters()}


class TestMethods:
    @pytest.mark.parametrize("name", LEARNED)
    def test_a_method_is_a_motion_and_a_shutter(self, name: str) -> None:
        case = small_subject.case(method=name)
        assert isinstance(method_of(case).motion(case), AbstractMotion)
        assert isinstance(method_of(case).shutter(case), AbstractShutter)

    @pytest.mark.parametrize("name", LEARNED)
    def test_all_get_the_same_gaussians_losses_and_steps(self, name: str) -> None:
        case, ours = small_subject.case(method=name), small_subject.case(method="rs-avatar")
        assert settings(case) == settings(ours)
        mine, theirs = build(case).avatar.state_dict(), build(ours).avatar.state_dict()
        assert all(mine[key].equal(theirs[key]) for key in theirs)
        assert len(observations(method_of(case), case)) == 6

    def test_blur_differs_from_bands_in_the_operator_alone(self) -> None:
        blur, bands = small_subject.case(method="mad-avatar", T=5), small_subject.case(method="rs-avatar", T=5)
        a, b = build(blur).state_dict(), build(bands).state_dict()
        assert set(a) == set(b)
        assert all(a[key].equal(b[key]) for key in a)
        slots = [method_of(c).shutter(c).slots(40, 11.0, 0.0) for c in (blur, bands)]
        assert [s.start for s in slots[0]] == [s.start for s in slots[1]]
        assert {(s.lo, s.hi, s.weight) for s in slots[0]} == {(0, 40, 0.2)}
        assert {(s.hi - s.lo, s.weight) for s in slots[1]} == {(8, 1.0)}

    def test_T_defaults_to_K_for_what_counts_and_to_rows_for_ours(self) -> None:
        ours, blur = small_subject.case(method="rs-avatar"), small_subject.case(method="mad-avatar")
        assert len(method_of(ours).shutter(ours).slots(40, 11.0, 0.0)) == 1
        assert len(method_of(blur).shutter(blur).slots(40, 11.0, 0.0)) == 11
        doubled = small_subject.case(method="rs-avatar", T="2K")
        assert len(method_of(doubled).shutter(doubled).slots(400, 11.0, 0.0)) == 22

    def test_a_K_that_is_not_the_subjects_is_refused(self) -> None:
        with pytest.raises(SpecError, match="K: expected 11, which subject small was built with, got 7"):
            check_case(small_subject.case(K=7))


class TestAblations:
    def test_the_whole_method(self) -> None:
        assert parts(small_subject.case()) == {"avatar", "motion", "shapes", "pose_residual", "skin_offset"}

    @pytest.mark.parametrize(
        ("flag", "part"), [("no_pose_deformation", "pose_residual"), ("no_lbs_refinement", "skin_offset")]
    )
    def test_a_network_goes_and_nothing_else(self, flag: str, part: str) -> None:
        whole, without = parts(small_subject.case()), parts(small_subject.case(ablation={flag: True}))
        assert whole - without == {part}

    def test_calibration_adds_a_clock_and_nothing_else(self) -> None:
        assert parts(small_subject.case(calibrate=["readout"])) - parts(small_subject.case()) == {"clock"}

    def test_the_residual_is_composed_or_added(self) -> None:
        """About one axis the two are the same rotation; about two they are not."""
        built = [build(small_subject.case(residual=kind)) for kind in ("composed", "additive")]
        for actor in built:
            assert actor.pose_residual is not None
            with torch.no_grad():  # whatever the pose, 0.3 about x
                last = list(actor.pose_residual.parameters())[-2:]
                last[0].zero_()
                last[1].copy_(torch.tensor([0.3, 0.0, 0.0]).repeat(23))
        for axis, same in (((0.5, 0.0, 0.0), True), ((0.0, 0.5, 0.0), False)):
            pose = torch.zeros(1, 24, 3)
            pose[:, 1:] = torch.tensor(axis)
            turned = [
                exp_so3(r) if d is None else exp_so3(r) @ exp_so3(d) for r, d in (a.deformed(pose) for a in built)
            ]
            assert torch.allclose(turned[0], turned[1], atol=1e-6) == same

    def test_no_rs_takes_the_readout_for_zero(self) -> None:
        case = small_subject.case(ablation={"no_rs": True})
        assert [s.rate for s in method_of(case).shutter(case).slots(40, 11.0, 2.0)] == [0.0]
        assert parts(case) == parts(small_subject.case())

    def test_no_spline_leaves_one_pose_a_frame(self) -> None:
        shape = next(build(small_subject.case(ablation={"no_spline": True})).motion.parameters()).shape
        assert shape == (small_subject.FRAMES, 25, 3)

    def test_knots_are_per_frame(self) -> None:
        """An interval a period, from a period before the first mid time to one after the last: 4, and 3 more points."""
        counts = [len(next(build(small_subject.case(knots=k)).motion.parameters())) for k in (1, 2)]
        assert counts == [4 + 3, 8 + 3]

    def test_no_reg_takes_the_penalty_away(self) -> None:
        assert settings(small_subject.case(ablation={"no_reg": True})).lambda_reg == 0
        assert settings(small_subject.case()).lambda_reg == 1


class TestOracle:
    def test_it_needs_the_truth(self) -> None:
        with pytest.raises(DataError, match="true motion"):
            build(small_subject.case(method="oracle"))

    def test_it_moves_as_the_truth_and_learns_no_motion(self) -> None:
        case = small_subject.case(method="oracle")
        object.__setattr__(case.subject, "motion", truth(case))
        actor = build(case)
        assert not list(actor.motion.parameters())
        assert actor.pose_residual is None
        state = actor.motion.at(case.subject.timing.mid_frames[1] + torch.tensor([-5.5, 0.0, 5.5], dtype=torch.float64))
        known = case.subject.motion
        assert known is not None
        np.testing.assert_allclose(state.Th.numpy(), known.sub_Th[1, [0, 2, 4]], atol=1e-6)


def truth(case: Case) -> TrueMotion:
    """A body that glides: five instants a readout, windows that meet."""
    fit, n = case.subject.fit, small_subject.FRAMES
    glide = np.linspace(-0.5, 0.5, 5)[None, :, None] + np.arange(n)[:, None, None]
    still = np.zeros((n, 5, 3))
    return TrueMotion(
        fit,
        np.zeros((n, 24, 3)),
        np.repeat(fit.poses[:1, None], n, 0).repeat(5, 1),
        still,
        glide * np.array([0.1, 0.0, 0.0]),
        np.zeros((n, 5, 24, 3)),
    )
