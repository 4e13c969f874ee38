"""What every shutter promises (``AbstractShutter``), and the paper's equations for each."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsavatar.errors import SpecError
from rsavatar.shutter.base import AbstractShutter, Slot, upwards
from rsavatar.shutter.rolling import Bands, Blur, Instant, Scanline

ROUNDING = 1e-12  # float64 sums of numbers of order 10


class Upwards(AbstractShutter):
    """Another shutter's slots on a sensor that is read from its last row."""

    def __init__(self, inner: Scanline) -> None:
        self.inner, self.exposure = inner, inner.exposure

    def slots(self, height: int, readout: float, trigger: float) -> tuple[Slot, ...]:
        return upwards(self.inner.slots(height, readout, trigger), height)


SHUTTERS: dict[str, AbstractShutter] = {
    "instant": Instant(),
    "blur of one": Blur(1),
    "blur": Blur(11),
    "one band": Bands(1),
    "bands": Bands(11),
    "more bands than rows": Bands(100),
    "scanline": Scanline(),
    "scanline, upwards": Upwards(Scanline()),
    "scanline, exposed": Scanline(exposure=0.25, samples=4),
    "scanline, exposed, upwards": Upwards(Scanline(exposure=0.25, samples=3)),
}
CLOCKS = [(48, 11.0, 0.0), (48, 5.5, -1.25), (7, 11.0, 2.0), (1, 1.0, 0.0), (48, 0.0, 0.5)]  # rows, readout, trigger


def instants(slots: tuple[Slot, ...], row: int) -> list[tuple[float, float]]:
    """(time, weight) of every slot that covers a row."""
    return [(s.start + s.rate * row, s.weight) for s in slots if s.lo <= row < s.hi]


@pytest.mark.parametrize("shutter", SHUTTERS.values(), ids=SHUTTERS.keys())
@pytest.mark.parametrize("clock", CLOCKS, ids=str)
class TestShutterContract:
    def test_weights_of_every_row_sum_to_one(self, shutter: AbstractShutter, clock: tuple[int, float, float]) -> None:
        slots = shutter.slots(*clock)
        for row in range(clock[0]):
            assert sum(weight for _, weight in instants(slots, row)) == pytest.approx(1, abs=ROUNDING)

    def test_slots_lie_inside_the_image(self, shutter: AbstractShutter, clock: tuple[int, float, float]) -> None:
        assert all(0 <= s.lo < s.hi <= clock[0] for s in shutter.slots(*clock))

    def test_slots_are_ordered_by_row_then_time(
        self, shutter: AbstractShutter, clock: tuple[int, float, float]
    ) -> None:
        keys = [(s.lo, s.start) for s in shutter.slots(*clock)]
        assert keys == sorted(keys)

    def test_times_stay_within_readout_and_exposure(
        self, shutter: AbstractShutter, clock: tuple[int, float, float]
    ) -> None:
        height, readout, trigger = clock
        reach = readout / 2 * (1 + getattr(shutter, "exposure", 0.0)) + ROUNDING
        slots = shutter.slots(*clock)
        assert all(abs(t - trigger) <= reach for row in range(height) for t, _ in instants(slots, row))

    def test_trigger_moves_every_instant_and_nothing_else(
        self, shutter: AbstractShutter, clock: tuple[int, float, float]
    ) -> None:
        height, readout, trigger = clock
        for late, still in zip(shutter.slots(*clock), shutter.slots(height, readout, 0.0), strict=True):
            assert late.start == pytest.approx(still.start + trigger, abs=ROUNDING)
            assert (late.lo, late.hi, late.rate, late.weight) == (still.lo, still.hi, still.rate, still.weight)

    def test_without_readout_there_is_one_instant(
        self, shutter: AbstractShutter, clock: tuple[int, float, float]
    ) -> None:
        height, _, trigger = clock
        slots = shutter.slots(height, 0.0, trigger)
        assert all(t == trigger for row in range(height) for t, _ in instants(slots, row))


@settings(deadline=None)
@given(height=st.integers(1, 300), bands=st.integers(1, 400), readout=st.floats(0.1, 20), trigger=st.floats(-5, 5))
def test_bands_are_the_papers(height: int, bands: int, readout: float, trigger: float) -> None:
    """V_i = {v: ceil((i-1) H / T) <= v < ceil(i H / T)} at t_i = trigger + (i - 1/2) / T rho - rho / 2."""
    slots = Bands(bands).slots(height, readout, trigger)
    for row in range(height):
        ((time, weight),) = instants(slots, row)
        (i,) = (i for i in range(1, bands + 1) if (i - 1) * height <= row * bands < i * height)  # exact integers
        assert weight == 1
        assert time == pytest.approx(trigger + (i - 0.5) / bands * readout - readout / 2, abs=ROUNDING)


def test_band_edges_of_a_height_that_the_bands_do_not_divide() -> None:
    edges = [(s.lo, s.hi) for s in Bands(3).slots(10, 1.0, 0.0)]
    assert edges == [(0, 4), (4, 7), (7, 10)]  # ceil(10/3), ceil(20/3), 10


def test_empty_bands_are_left_out_and_the_rest_keep_their_times() -> None:
    slots = Bands(8).slots(4, 8.0, 0.0)
    assert [(s.lo, s.hi) for s in slots] == [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert [s.start for s in slots] == [-3.5, -1.5, 0.5, 2.5]  # bands 1, 3, 5, 7 of 8


@settings(deadline=None)
@given(height=st.integers(1, 300), readout=st.floats(0, 20), trigger=st.floats(-5, 5))
def test_scanline_is_the_row_clock(height: int, readout: float, trigger: float) -> None:
    """t(v) = trigger + v / H rho, for a window centred on the mid time; upwards row H - 1 - v has row v's instant."""
    down, up = Scanline().slots(height, readout, trigger), Upwards(Scanline()).slots(height, readout, trigger)
    for row in range(height):
        truth = trigger + readout * (row / height - 0.5)
        assert instants(down, row)[0][0] == pytest.approx(truth, abs=ROUNDING)
        assert instants(up, height - 1 - row)[0][0] == pytest.approx(truth, abs=ROUNDING)


def test_exposure_spreads_each_row_evenly_about_its_instant() -> None:
    sharp = Scanline().slots(48, 10.0, 1.0)
    soft = Scanline(exposure=0.2, samples=4).slots(48, 10.0, 1.0)
    for row in (0, 17, 47):
        times = [t for t, _ in instants(soft, row)]
        middle = instants(sharp, row)[0][0]
        assert [t - middle for t in times] == pytest.approx([-0.75, -0.25, 0.25, 0.75])  # 2 source frames, mid-points


def test_bands_converge_on_the_scanline() -> None:
    """At T = H the instants differ by half a row's time: band i is exposed at its middle, row v at its start."""
    height, readout = 64, 11.0
    rows = Scanline().slots(height, readout, 0.0)
    for bands, worst in ((8, readout / 16), (64, readout / 128)):
        slots = Bands(bands).slots(height, readout, 0.0)
        gaps = [abs(instants(slots, row)[0][0] - instants(rows, row)[0][0]) for row in range(height)]
        assert max(gaps) == pytest.approx(worst)


@pytest.mark.parametrize("shutter", [Bands(0), Blur(0), Scanline(samples=0)], ids=str)
def test_no_instants_is_refused(shutter: AbstractShutter) -> None:
    with pytest.raises(SpecError, match="instants: expected at least 1, got 0"):
        shutter.slots(48, 11.0, 0.0)


@pytest.mark.parametrize(("lo", "hi", "start"), [(3, 3, 0.0), (-1, 3, 0.0), (0, 3, math.nan), (0, 3, math.inf)])
def test_a_slot_refuses_what_it_cannot_mean(lo: int, hi: int, start: float) -> None:
    with pytest.raises(SpecError, match="slot"):
        Slot(lo, hi, start)


def test_span_is_the_first_and_last_rows_instant() -> None:
    assert Slot(2, 5, 10.0, rate=0.5).span == (11.0, 12.0)
