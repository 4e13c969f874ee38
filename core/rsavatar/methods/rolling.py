"""RS-Avatar: a trajectory within every frame, and rows that select their instant (paper, sections 3.2 to 3.4)."""

from __future__ import annotations

from rsavatar.methods.base import AbstractMethod, Case, sub_frame_motion
from rsavatar.motion.base import AbstractMotion
from rsavatar.shutter.base import AbstractShutter
from rsavatar.shutter.rolling import Bands, Instant, Scanline


class RollingShutterAvatar(AbstractMethod):
    """Ours: the shutter that the sensor has."""

    def motion(self, case: Case) -> AbstractMotion:
        """One spline over the sequence, or the paper's one per frame (eq. spline)."""
        return sub_frame_motion(case)

    def shutter(self, case: Case) -> AbstractShutter:
        """Rows, blurred where exposed for long (eq. rs), or T bands (eq. rs_discrete); the mid one with ``no_rs``."""
        if case.spec.ablation.no_rs:
            return Instant()
        if case.spec.T != "scanline":
            return Bands(case.bands)
        exposure = case.exposure
        return Scanline(exposure, case.spec.exposure_samples) if exposure else Scanline()
