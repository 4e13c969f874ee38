"""GauHuman trained on rolling-shutter frames as if they were instantaneous: what a practitioner does today."""

from __future__ import annotations

from rsavatar.methods.base import AbstractMethod, Case
from rsavatar.motion.base import AbstractMotion
from rsavatar.motion.still import StillPose
from rsavatar.shutter.base import AbstractShutter
from rsavatar.shutter.rolling import Instant


class ShutterObliviousAvatar(AbstractMethod):
    """One pose per frame, one instant per image."""

    def motion(self, case: Case) -> AbstractMotion:
        """A learnable pose per frame, from the initial fit."""
        return StillPose(case.initial_motion())

    def shutter(self, case: Case) -> AbstractShutter:
        """Every row at once."""
        return Instant()
