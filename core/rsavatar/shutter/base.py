"""The slot, the one word that every shutter is spelled with.

**Convention**: row ``v`` (an integer, 0 at the top) of an image of ``height`` rows is exposed at ``start + rate * v``,
in source frames relative to the frame's mid time. A slot contributes ``weight`` times its render to rows [lo, hi).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from rsavatar.errors import SpecError, expected


@dataclass(frozen=True)
class Slot:
    """Rows [lo, hi) exposed at ``start + rate * v`` source frames from the mid time, counted ``weight`` times.

    Raises:
        SpecError: if the row range is empty or negative, or a number is not finite.
    """

    lo: int
    hi: int
    start: float
    rate: float = 0.0
    weight: float = 1.0

    def __post_init__(self) -> None:
        if not 0 <= self.lo < self.hi:
            raise SpecError(expected("slot rows", "0 <= lo < hi", f"[{self.lo}, {self.hi})"))
        if not all(abs(x) < 1e9 for x in (self.start, self.rate, self.weight)):
            raise SpecError(expected("slot times and weight", "finite numbers", self))

    @property
    def span(self) -> tuple[float, float]:
        """First and last instant of the slot's rows, in row order."""
        return self.start + self.rate * self.lo, self.start + self.rate * (self.hi - 1)


def upwards(slots: Sequence[Slot], height: int) -> tuple[Slot, ...]:
    """The same slots of a sensor that is read from its last row to its first."""
    turned = [Slot(height - s.hi, height - s.lo, s.start + s.rate * (height - 1), -s.rate, s.weight) for s in slots]
    return tuple(sorted(turned, key=lambda s: (s.lo, s.start)))


class AbstractShutter(ABC):
    """Turns a frame height and a camera's clock into slots.

    **Contract**: weights of the slots that cover a row sum to 1 for every row of [0, height); slots are ordered by
    ``lo`` and then by time.
    """

    @abstractmethod
    def slots(self, height: int, readout: float, trigger: float) -> tuple[Slot, ...]:
        """Slots of one frame: ``height`` rows, ``readout`` and ``trigger`` in source frames."""
