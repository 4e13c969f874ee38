"""MAD-Avatar's operator on rolling-shutter frames: the same spline, the same T renders, averaged (paper, eq. blur)."""

from __future__ import annotations

from rsavatar.methods.base import AbstractMethod, Case, sub_frame_motion
from rsavatar.motion.base import AbstractMotion
from rsavatar.shutter.base import AbstractShutter
from rsavatar.shutter.rolling import Blur


class BlurAvatar(AbstractMethod):
    """Differs from the paper's rolling-shutter model in the operator alone; triggers belong to the operator."""

    def motion(self, case: Case) -> AbstractMotion:
        """The same as ``RollingShutterAvatar``'s."""
        return sub_frame_motion(case)

    def shutter(self, case: Case) -> AbstractShutter:
        """The mean of T instants over the readout, without the triggers unless the spec gives them."""
        return Blur(case.bands, synchronised=not case.spec.blur_triggers)
