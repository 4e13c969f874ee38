"""Self-calibration: readout and trigger of every camera as parameters (paper, eq. rowtime and last limitation).

**Gauge**: rows are exposed at ``delta_c + rho_c s``, s in [-1/2, 1/2]. Triggers that are all late by the same time are
a motion that is early by it: images cannot tell the two apart. So corrections of triggers sum to 0 over the cameras,
and what is recovered is each camera's trigger against the mean of all. Readouts need no gauge: the frames' period fixes
the unit of time.
"""

from __future__ import annotations

from collections.abc import Collection

import torch
from torch import Tensor

from rsavatar.spec import Unknown


class ReadoutClock(torch.nn.Module):
    """What the given schedule is off by, per camera; starts at nothing.

    ``stretch`` [C] is the readout's correction as a part of the given readout, ``shift`` [C] the trigger's in frame
    periods; each exists only where it is in ``unknown``. Both are of order 1, so one step size serves. They are float32
    as all parameters are: torch 2.13's fused Adam hardly moves float64 ones.
    """

    stretch: torch.nn.Parameter | None
    shift: torch.nn.Parameter | None

    def __init__(self, cameras: int, period: float, unknown: Collection[Unknown]) -> None:
        """``period`` in source frames."""
        super().__init__()
        self.cameras, self.period = cameras, period
        for name, word in (("stretch", "readout"), ("shift", "trigger")):
            free = torch.nn.Parameter(torch.zeros(cameras)) if word in unknown else None
            self.register_parameter(name, free)

    def readout_factors(self) -> Tensor:
        """[C] true readouts over given ones."""
        none = torch.zeros(self.cameras, dtype=torch.float64)
        return 1.0 + (none if self.stretch is None else self.stretch.double())

    def trigger_shifts(self) -> Tensor:
        """[C] true triggers minus given ones, source frames; their mean is 0 (the gauge)."""
        if self.shift is None:
            return torch.zeros(self.cameras, dtype=torch.float64)
        return self.period * (self.shift - self.shift.mean()).double()

    def forward(self, camera: int, offsets: Tensor, reading: Tensor) -> Tensor:
        """Corrected instants [D] of an image of ``camera`` (an index).

        Args:
            camera: which of the C cameras.
            offsets: [D] given instants, source frames from the frame's mid time.
            reading: [D] the part of ``offsets`` that is proportional to the readout: rho s.

        Returns:
            [D] source frames, differentiable in ``stretch`` and ``shift``.
        """
        corrected: Tensor = offsets + self.trigger_shifts()[camera]
        return corrected + (self.readout_factors()[camera] - 1.0) * reading
