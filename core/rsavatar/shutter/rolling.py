"""Shutters by their slots: instant, blur, row bands, scanline, and scanline with exposure (design table 1)."""

from __future__ import annotations

from dataclasses import dataclass

from rsavatar.errors import SpecError, expected
from rsavatar.shutter.base import AbstractShutter, Slot


@dataclass(frozen=True)
class Instant(AbstractShutter):
    """Global shutter: the whole image at the mid time (paper, table "Shutter regimes", first row)."""

    def slots(self, height: int, readout: float, trigger: float) -> tuple[Slot, ...]:
        """One slot, at the trigger."""
        return (Slot(0, height, trigger),)


@dataclass(frozen=True)
class Blur(AbstractShutter):
    """MAD-Avatar's operator: the mean of ``instants`` whole images over the readout (paper, eq. blur).

    Its instants t_i carry no camera in the paper, nor in its authors' code: where cameras are taken to be
    ``synchronised``, their triggers are not looked at.
    """

    instants: int
    synchronised: bool = False

    def slots(self, height: int, readout: float, trigger: float) -> tuple[Slot, ...]:
        """A slot per instant, all of them over all rows."""
        times = _band_times(self.instants, readout, 0.0 if self.synchronised else trigger)
        return tuple(Slot(0, height, t, weight=1.0 / self.instants) for t in times)


@dataclass(frozen=True)
class Bands(AbstractShutter):
    """The paper's operator: band i from the render at its middle instant (paper, eqs. bandtime and rs_discrete).

    Band i holds the rows ceil((i-1) H / T) <= v < ceil(i H / T); with T > H some bands are empty and left out.
    """

    bands: int

    def slots(self, height: int, readout: float, trigger: float) -> tuple[Slot, ...]:
        """A slot per band that holds a row."""
        times = _band_times(self.bands, readout, trigger)
        edges = [-(-i * height // self.bands) for i in range(self.bands + 1)]
        return tuple(Slot(lo, hi, t) for lo, hi, t in zip(edges, edges[1:], times, strict=False) if hi > lo)


@dataclass(frozen=True)
class Scanline(AbstractShutter):
    """The continuous rolling shutter: row v at its own instant (paper, eqs. rowtime and rs).

    ``exposure`` (a fraction of the readout) adds blur: each row is the mean of ``samples`` scans shifted over the
    exposure.
    """

    exposure: float = 0.0
    samples: int = 1

    def slots(self, height: int, readout: float, trigger: float) -> tuple[Slot, ...]:
        """A slot per sample of the exposure, all of them scanning."""
        start = trigger - readout / 2
        shifts = _band_times(self.samples, self.exposure * readout, 0.0)
        return tuple(Slot(0, height, start + s, readout / height, 1.0 / self.samples) for s in shifts)


def _band_times(count: int, readout: float, trigger: float) -> list[float]:
    """t_i = (i - 1/2) / T * readout, centred on the trigger; i = 1..T (paper, eq. bandtime)."""
    if count < 1:
        raise SpecError(expected("instants", "at least 1", count))
    return [trigger + readout * ((i + 0.5) / count - 0.5) for i in range(count)]
