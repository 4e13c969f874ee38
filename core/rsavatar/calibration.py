"""The schedule that a job ended with, beside the one that its subject states (paper, last limitation)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rsavatar.data.base import Subject, Timing
from rsavatar.shutter.clock import ReadoutClock


@dataclass(frozen=True)
class FoundSchedule:
    """Readout and trigger by training camera, source frames; as given where nothing was calibrated."""

    readout_frames: Mapping[str, float]
    trigger_frames: Mapping[str, float]

    def to_json(self, timing: Timing) -> dict[str, Any]:
        """Plain values; also in milliseconds where the source's rate is known."""
        found: dict[str, Any] = {
            "readout_frames": dict(self.readout_frames),
            "trigger_frames": dict(self.trigger_frames),
        }
        if timing.fps is not None:
            for name in ("readout", "trigger"):
                found[f"{name}_ms"] = {c: 1000 * v / timing.fps for c, v in found[f"{name}_frames"].items()}
        return found


def found_schedule(given: Timing, cameras: tuple[str, ...], clock: ReadoutClock | None) -> FoundSchedule:
    """``given`` with the clock's corrections of the training ``cameras``."""
    factors = np.ones(len(cameras)) if clock is None else clock.readout_factors().detach().numpy()
    shifts = np.zeros(len(cameras)) if clock is None else clock.trigger_shifts().detach().numpy()
    return FoundSchedule(
        {c: given.readout_frames * float(f) for c, f in zip(cameras, factors, strict=True)},
        {c: given.trigger(c) + float(s) for c, s in zip(cameras, shifts, strict=True)},
    )


def schedule_errors(found: FoundSchedule, subject: Subject) -> dict[str, float]:
    """Mean absolute errors against the schedule that ``subject`` states, over training cameras.

    Triggers are compared after their common part is taken off both: a motion that runs later looks the same.

    Returns:
        ``readout_error_frames`` and ``trigger_error_frames``, and the same in ``_ms`` where the rate is known.
    """
    timing = subject.timing
    readouts = np.array([found.readout_frames[c] - timing.readout_frames for c in subject.training])
    triggers = np.array([found.trigger_frames[c] - timing.trigger(c) for c in subject.training])
    triggers -= triggers.mean()
    errors = {"readout_error": float(np.abs(readouts).mean()), "trigger_error": float(np.abs(triggers).mean())}
    stated = {f"{name}_frames": value for name, value in errors.items()}
    if timing.fps is not None:
        stated |= {f"{name}_ms": 1000 * value / timing.fps for name, value in errors.items()}
    return stated
