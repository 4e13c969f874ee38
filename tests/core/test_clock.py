"""Self-calibration: corrections are affine, the gauge is fixed, gradients are right, schedules are recovered."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rsavatar import kernels
from rsavatar.calibration import found_schedule, schedule_errors
from rsavatar.data.disturb import disturb
from rsavatar.errors import SpecError
from rsavatar.imaging import Actor, Schedule, expose
from rsavatar.methods.base import Case, build_actor, observations
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.motion.sequence import SequenceSpline
from rsavatar.motion.spline import FrameSpline
from rsavatar.shutter.clock import ReadoutClock
from rsavatar.spec import Disturbance
from rsavatar.train import Observation
from tests.core import small_subject

METHOD = RollingShutterAvatar()
WRONG = {"readout": 0.2, "trigger": 0.1}


def clock(stretch: list[float], shift: list[float], period: float = 10.0) -> ReadoutClock:
    made = ReadoutClock(len(stretch), period, ("readout", "trigger"))
    made.load_state_dict({"stretch": torch.tensor(stretch), "shift": torch.tensor(shift)})
    return made


class TestCorrections:
    def test_nothing_is_corrected_at_the_start(self) -> None:
        offsets, reading = torch.tensor([1.0, -2.0]).double(), torch.tensor([0.5, -2.5]).double()
        for unknown in ((), ("readout",), ("trigger",), ("readout", "trigger")):
            assert torch.equal(ReadoutClock(3, 11.0, unknown)(1, offsets, reading), offsets)  # type: ignore[arg-type]

    def test_a_row_moves_by_the_trigger_and_by_its_part_of_the_readout(self) -> None:
        """delta + rho s becomes delta + shift + rho (1 + stretch) s."""
        reading = torch.tensor([-4.0, 0.0, 4.0]).double()
        got = clock([0.25, 0.0], [0.2, 0.0])(0, 1.5 + reading, reading)
        torch.testing.assert_close(got, 1.5 + 1.0 + 1.25 * reading, atol=1e-6, rtol=0)  # mean shift 0.1 taken off

    def test_a_common_delay_is_no_correction(self) -> None:
        assert clock([0.0, 0.0, 0.0], [0.3, 0.3, 0.3]).trigger_shifts().abs().max() < 1e-6

    @pytest.mark.parametrize("T", ["scanline", 5, "K"])
    def test_reading_is_what_a_longer_readout_adds(self, T: int | str) -> None:
        case = small_subject.case(T=T)
        longer = replace(case.subject, timing=replace(case.subject.timing, readout_frames=11.0 * 1.2))
        given, wanted = (observations(METHOD, c) for c in (case, replace(case, subject=longer)))
        for a, b in zip(given, wanted, strict=True):
            made = clock([0.2, 0.2], [0.0, 0.0])(a.schedule.camera, a.schedule.offsets, reading_of(a.schedule))
            torch.testing.assert_close(made, b.schedule.offsets, atol=1e-6, rtol=0)

    def test_what_is_known_has_no_parameter(self) -> None:
        made = build_actor(METHOD, small_subject.case(calibrate=["trigger"])).clock
        assert made is not None
        assert [name for name, _ in made.named_parameters()] == ["shift"]
        assert build_actor(METHOD, small_subject.case()).clock is None

    @pytest.mark.parametrize(
        "words", [{"method": "gauhuman"}, {"ablation": {"no_rs": True}}, {"ablation": {"no_spline": True}}]
    )
    def test_a_method_that_sees_no_instants_calibrates_nothing(self, words: dict[str, object]) -> None:
        with pytest.raises(SpecError, match=r"calibrate: expected none, or mad-avatar or rs-avatar.*got readout"):
            small_subject.case(calibrate=["readout"], **words)


@pytest.mark.parametrize("kind", [SequenceSpline, FrameSpline])
def test_gradients_reach_the_clock_through_the_motion(kind: type) -> None:
    initial = small_subject.case().initial_motion()
    motion = (kind(initial) if kind is SequenceSpline else kind(initial, bands=11)).double()
    with torch.no_grad():
        motion.control += 0.1 * torch.randn(motion.control.shape, generator=torch.Generator().manual_seed(1)).double()
    offsets, reading = torch.tensor([-3.0, 0.2, 4.0]).double(), torch.tensor([-4.0, -0.8, 3.0]).double()
    made = ReadoutClock(2, 11.0, ("readout", "trigger")).double()

    def place(stretch: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        instants = torch.func.functional_call(made, {"stretch": stretch, "shift": shift}, (0, offsets, reading))
        state = motion.state(1, instants)
        return torch.cat([state.rotations.flatten(), state.Rh.flatten(), state.Th.flatten()])

    start = [torch.tensor([0.1, 0.0]).double().requires_grad_(), torch.tensor([0.02, -0.01]).double().requires_grad_()]
    assert torch.autograd.gradcheck(place, start)


def reading_of(schedule: Schedule) -> torch.Tensor:
    assert schedule.reading is not None
    return schedule.reading


def moving(case: Case) -> Actor:
    """An opaque, coloured body that moves fast through its frames."""
    actor = build_actor(METHOD, case)
    g = torch.Generator().manual_seed(0)
    with torch.no_grad():
        actor.avatar.opacity_logits.fill_(2.0)
        actor.avatar.sh_constant.add_(torch.randn(actor.avatar.sh_constant.shape, generator=g))
        control = next(actor.motion.parameters())
        control.add_(0.15 * torch.randn(control.shape, generator=g))
    return actor


def photographed(actor: Actor, seen: list[Observation]) -> list[torch.Tensor]:
    """What cameras with these schedules see of the actor."""
    with torch.no_grad():
        weights = actor.skin_weights()
        return [expose(actor.scene(o.frame, o.camera, o.schedule, weights, 0)).rgb for o in seen]


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
def test_a_wrong_schedule_is_recovered_from_images() -> None:
    """All else known: of 20 % in the readouts and a tenth of a frame in the triggers less than a tenth is left."""
    case = small_subject.case(T="scanline", calibrate=["readout", "trigger"])
    wrong = replace(case, subject=disturb(case.subject, Disturbance(**WRONG), 0))
    actor = moving(case)
    pictures, given = photographed(actor, observations(METHOD, case)), observations(METHOD, wrong)
    assert actor.clock is not None
    adam = torch.optim.Adam(actor.clock.parameters(), lr=1e-2)
    weights = actor.skin_weights().detach()
    before = schedule_errors(found_schedule(wrong.subject.timing, case.subject.training, actor.clock), case.subject)
    for step in range(150):
        adam.param_groups[0]["lr"] = 1e-2 * 0.02 ** (step / 150)
        adam.zero_grad()
        for picture, o in zip(pictures, given, strict=True):
            image = expose(actor.scene(o.frame, o.camera, actor.timed(o.schedule), weights, 0))
            (image.rgb - picture).square().sum().backward()  # type: ignore[no-untyped-call]
        adam.step()
    after = schedule_errors(found_schedule(wrong.subject.timing, case.subject.training, actor.clock), case.subject)
    assert before["readout_error_frames"] == pytest.approx(0.2 * 11)
    assert before["trigger_error_frames"] == pytest.approx(0.1 * 11)
    assert after["readout_error_frames"] < 0.1 * before["readout_error_frames"]
    assert after["trigger_error_frames"] < 0.1 * before["trigger_error_frames"]


def test_errors_are_told_in_milliseconds_where_the_rate_is_known() -> None:
    subject = small_subject.subject()
    timed = replace(subject, timing=replace(subject.timing, fps=110.0))
    found = found_schedule(timed.timing, timed.training, clock([0.1, 0.1], [0.1, -0.1]))
    errors = schedule_errors(found, timed)
    assert errors["readout_error_ms"] == pytest.approx(1000 * 1.1 / 110, rel=1e-5)
    assert errors["trigger_error_ms"] == pytest.approx(1000 * 1.0 / 110, rel=1e-5)
    assert set(schedule_errors(found_schedule(subject.timing, subject.training, None), subject)) == {
        "readout_error_frames", "trigger_error_frames"
    }  # fmt: skip
    assert found.to_json(timed.timing)["trigger_ms"]["01"] == pytest.approx(1000 * (2.0 - 1.0) / 110, rel=1e-5)
