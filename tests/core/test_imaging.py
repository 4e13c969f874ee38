"""Schedules: cut to the body's rows, the instants and the images stay what they were."""

from __future__ import annotations

import pytest
import torch

from rsavatar import kernels
from rsavatar.imaging import Schedule, expose, plan, polynomials
from rsavatar.methods.base import build_actor
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.shutter.base import AbstractShutter
from rsavatar.shutter.rolling import Bands, Blur, Instant, Scanline
from tests.contracts.test_shutters import Upwards
from tests.core import small_subject

SHUTTERS: list[AbstractShutter] = [Instant(), Blur(3), Bands(7), Scanline(), Scanline(0.2, 3), Upwards(Scanline())]


def instants(schedule: Schedule, row: int) -> list[float]:
    """Instants at which a row of the schedule is exposed, by interpolating the slots' own nodes linearly in tau."""
    found = []
    for t, rows in enumerate(schedule.rows):
        if not rows.lo <= row < rows.hi:
            continue
        d = schedule.coefficients
        offsets = schedule.offsets[t * d : (t + 1) * d].reshape(1, d, 1, 1, 1).reshape(d, 1, 1, 1)
        coefficients = polynomials(offsets.expand(d, 24, 3, 4).contiguous(), d)[0, :, 0, 0, 0]
        tau = rows.rate * (row + 0.5) + rows.start
        found.append(float(sum(c * tau**k for k, c in enumerate(coefficients))))
    return found


@pytest.mark.parametrize("shutter", SHUTTERS, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize(("top", "bottom"), [(0, 40), (5, 31), (17, 18)])
def test_every_row_keeps_its_instants(shutter: AbstractShutter, top: int, bottom: int) -> None:
    slots = shutter.slots(40, 11.0, 1.5)
    schedule = plan(slots, top, bottom)
    for row in range(bottom - top):
        wanted = [s.start + s.rate * (row + top) for s in slots if s.lo <= row + top < s.hi]
        assert instants(schedule, row) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("shutter", SHUTTERS, ids=lambda s: type(s).__name__)
def test_tau_stays_within_the_polynomials_range(shutter: AbstractShutter) -> None:
    for rows in plan(shutter.slots(40, 11.0, 0.0), 3, 37).rows:
        ends = [rows.rate * y + rows.start for y in (rows.lo, rows.hi)]
        assert max(map(abs, ends)) <= 1 + 1e-9


def test_bands_outside_the_cut_are_not_planned() -> None:
    assert len(plan(Bands(8).slots(40, 11.0, 0.0), 10, 20).rows) == 2


def test_a_readout_of_zero_is_an_instant() -> None:
    schedule = plan(Scanline().slots(40, 0.0, 2.0), 0, 40)
    assert schedule.coefficients == 1
    assert schedule.offsets.tolist() == [2.0]


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
@pytest.mark.parametrize("shutter", SHUTTERS, ids=lambda s: type(s).__name__)
def test_a_cut_image_is_the_cut_of_the_image(shutter: AbstractShutter) -> None:
    case = small_subject.case()
    actor = build_actor(RollingShutterAvatar(), case)
    actor.avatar.opacity_logits.data.fill_(1.0)
    camera = case.subject.cameras["00"]
    slots = shutter.slots(camera.height, 11.0, 1.0)
    with torch.no_grad():
        weights = actor.skin_weights()
        whole = expose(actor.scene(1, camera, plan(slots, 0, 40), weights, 1))
        part = expose(actor.scene(1, camera.cropped(6, 8, 35, 33), plan(slots, 8, 33), weights, 1))
    assert whole.transmittance.min() < 0.5
    # the two differ by the polynomial through other nodes
    assert (whole.rgb[:, 8:33, 6:35] - part.rgb).abs().max() < 0.02
    assert (whole.rgb[:, 8:33, 6:35] - part.rgb).square().mean() < 1e-6
