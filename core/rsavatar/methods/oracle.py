"""The ceiling: the same avatar, trained with the true motion and the true row times."""

from __future__ import annotations

import numpy as np

from rsavatar.data.base import BodyFit
from rsavatar.errors import DataError, expected
from rsavatar.methods.base import AbstractMethod, Case
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.motion.base import AbstractMotion, InitialMotion
from rsavatar.motion.known import KnownMotion
from rsavatar.shutter.base import AbstractShutter


class Oracle(AbstractMethod):
    """Knows what no method can know; says how much of the remaining error is not the motion's."""

    def motion(self, case: Case) -> AbstractMotion:
        """The subject's true motion.

        Raises:
            DataError: if the subject has none.
        """
        truth, timing = case.subject.motion, case.subject.timing
        if truth is None:
            raise DataError(expected(f"subject {case.subject.name}", "a true motion (truth/motion.npz)", "none"))
        instants = truth.sub_poses.shape[1]
        spread = timing.readout_frames * (np.linspace(0.0, 1.0, instants) - 0.5)
        times = (timing.mid_frames[:, None] + spread).ravel()
        order = np.unique(times.round(9), return_index=True)[1]  # windows that meet share an instant
        flat = (truth.sub_poses.reshape(-1, 72), truth.sub_Rh.reshape(-1, 3), truth.sub_Th.reshape(-1, 3))
        poses, Rh, Th = (value[order] for value in flat)
        states = InitialMotion(poses, Rh, Th, times[order], timing.period_frames, timing.readout_frames)
        return KnownMotion(times[order], states.stacked(), timing.mid_frames)

    def initial_fit(self, case: Case) -> BodyFit:
        """The true poses and shape."""
        return case.subject.fit if case.subject.motion is None else case.subject.motion.mid

    def shutter(self, case: Case) -> AbstractShutter:
        """As ``RollingShutterAvatar``'s."""
        return RollingShutterAvatar().shutter(case)
