"""RS-Avatar: a spline in every frame, and rows that select their instant (paper, sections 3.2 to 3.4)."""

from __future__ import annotations

from rsavatar.methods.base import AbstractMethod, Case
from rsavatar.motion.base import AbstractMotion
from rsavatar.motion.spline import FrameSpline
from rsavatar.motion.still import StillPose
from rsavatar.shutter.base import AbstractShutter
from rsavatar.shutter.rolling import Bands, Instant, Scanline


class RollingShutterAvatar(AbstractMethod):
    """Ours: the shutter that the sensor has."""

    def motion(self, case: Case) -> AbstractMotion:
        """A spline per frame (eq. spline); one pose per frame without it."""
        spec = case.spec
        if spec.ablation.no_spline:
            return StillPose(case.initial_motion())
        return FrameSpline(case.initial_motion(), case.bands, spec.P, spec.perturbation, spec.seed)

    def shutter(self, case: Case) -> AbstractShutter:
        """Rows (eq. rs) or T bands of them (eq. rs_discrete); the mid instant for all without the shutter model."""
        if case.spec.ablation.no_rs:
            return Instant()
        continuous = case.spec.T == "scanline"
        return Scanline() if continuous else Bands(case.bands)
