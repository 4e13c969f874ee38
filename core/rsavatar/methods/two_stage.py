"""Correct first, reconstruct second: a 2D rolling-shutter corrector on every view, then GauHuman (paper, section 4.2).

A subject is restored once for the same pictures, corrector and weights, and kept in the cache. Where it knows its
training cameras' sharp frames, the gain of the pictures themselves is measured, before any avatar is trained.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rsavatar.body.cache import cache_dir
from rsavatar.data.base import Direction, Image, Subject
from rsavatar.errors import DataError, expected
from rsavatar.events import Note, Progress, Report, silent
from rsavatar.methods.base import AbstractMethod, Case, Prepared
from rsavatar.methods.oblivious import ShutterObliviousAvatar
from rsavatar.metrics.image import dilate, psnr
from rsavatar.motion.base import AbstractMotion
from rsavatar.restore.base import AbstractCorrector
from rsavatar.restore.cache import Film, read_restored, restored
from rsavatar.restore.classical import FlowCorrector
from rsavatar.restore.networks import network_corrector
from rsavatar.shutter.base import AbstractShutter

Stop = Callable[[], bool]


@dataclass(frozen=True)
class Gain:
    """PSNR of restored frames minus that of the rolling ones against the sharp ones, dB; means over frames, cameras."""

    body_db: float  # in the sharp frame's body mask, dilated as all metrics' is
    full_db: float  # over the whole frame


class AbstractTwoStage(AbstractMethod):
    """GauHuman on restored frames."""

    @abstractmethod
    def corrector(self) -> AbstractCorrector:
        """What restores the frames."""

    def prepare(self, case: Case, report: Report, should_stop: Stop) -> Prepared:
        """Restore the subject's training views, and measure what that gained."""
        corrector = self.corrector()
        report(Note(f"Restoring with {corrector.identity}"))
        subject = restored_subject(case.subject, corrector, report, should_stop)
        gain = measure_gain(case.subject, subject)
        means = {} if gain is None else {"restore_gain_body_db": gain.body_db, "restore_gain_full_db": gain.full_db}
        return Prepared(replace(case, subject=subject), means, corrector.identity)

    def motion(self, case: Case) -> AbstractMotion:
        """As ``ShutterObliviousAvatar``'s."""
        return ShutterObliviousAvatar().motion(case)

    def shutter(self, case: Case) -> AbstractShutter:
        """As ``ShutterObliviousAvatar``'s."""
        return ShutterObliviousAvatar().shutter(case)


class FlowThenAvatar(AbstractTwoStage):
    """``flow+gauhuman``: the classical corrector, which needs no weights."""

    def corrector(self) -> AbstractCorrector:
        """Dense flow, scaled by the rows' times."""
        return FlowCorrector()


class CVRThenAvatar(AbstractTwoStage):
    """``cvr+gauhuman``."""

    def corrector(self) -> AbstractCorrector:
        """CVR with the user's weights, else with the package's."""
        return network_corrector("cvr")


class JAMNetThenAvatar(AbstractTwoStage):
    """``jamnet+gauhuman``."""

    def corrector(self) -> AbstractCorrector:
        """JAMNet with the user's weights, else with the package's."""
        return network_corrector("jamnet")


def restored_subject(
    subject: Subject, corrector: AbstractCorrector, report: Report = silent, should_stop: Stop = lambda: False
) -> Subject:
    """The subject with its training views restored; restores what the cache does not hold.

    Raises:
        DataError: if a picture cannot be read, or there is a single frame.
        Interrupted: when ``should_stop`` asked for it; finished cameras stay in the cache.
    """
    gamma = subject.timing.readout_frames / subject.timing.period_frames
    total, begun = len(subject.training) * subject.frames, time.monotonic()
    folders: dict[str, Path] = {}
    for index, camera in enumerate(subject.training):

        def read(frame: int, camera: str = camera) -> Image | None:
            if (camera, frame) in subject.missing:
                return None
            return turned(subject.observe(camera, frame), subject.timing.direction)

        def each(frame: int, before: int = index * subject.frames) -> None:
            report(Progress("restore", before + frame + 1, total, time.monotonic() - begun))

        film = Film(read, subject.frames, gamma)
        folders[camera] = restored(film, corrector, cache_dir() / "restored", each, should_stop)
    return replace(subject, observe=_reader(folders, subject.timing.direction))


def turned(picture: Image, direction: Direction, back: bool = False) -> Image:
    """The picture of a sensor that is read in ``direction`` as one that is read downwards; or ``back``."""
    sideways, mirrored = direction in ("left", "right"), direction in ("up", "left")
    first, second = picture
    for step in ("mirror", "turn") if back else ("turn", "mirror"):
        if step == "turn" and sideways:
            first, second = first.swapaxes(0, 1), second.swapaxes(0, 1)
        elif step == "mirror" and mirrored:
            first, second = first[::-1], second[::-1]
    return np.ascontiguousarray(first), np.ascontiguousarray(second)


def _reader(folders: Mapping[str, Path], direction: Direction) -> Callable[[str, int], Image]:
    def read(camera: str, frame: int) -> Image:
        if camera not in folders:
            raise DataError(expected("restored camera", f"one of {sorted(folders)}", repr(camera)))
        return turned(read_restored(folders[camera], frame), direction, back=True)

    return read


def measure_gain(rolling: Subject, sharper: Subject) -> Gain | None:
    """What restoring gained; None where the sharp frames of the training cameras are not known."""
    there = {c: [n for n in range(rolling.frames) if (c, n) not in rolling.missing] for c in rolling.training}
    seen = {camera: frames for camera, frames in there.items() if frames}
    try:
        for camera, frames in seen.items():
            rolling.truth(camera, frames[0])
    except DataError:
        return None
    gains = [np.mean([_gain(rolling, sharper, camera, n) for n in frames], 0) for camera, frames in seen.items()]
    body, full = np.mean(gains, 0)
    return Gain(float(body), float(full))


def _gain(rolling: Subject, sharper: Subject, camera: str, frame: int) -> tuple[float, float]:
    truth, mask = rolling.truth(camera, frame)
    body, everywhere = dilate(mask > 0), np.ones(mask.shape, np.bool_)
    if not body.any():
        return 0.0, 0.0
    before, after, sharp = (
        image.astype(np.float32) / np.float32(255)
        for image in (rolling.observe(camera, frame)[0], sharper.observe(camera, frame)[0], truth)
    )
    return tuple(psnr(after, sharp, where) - psnr(before, sharp, where) for where in (body, everywhere))  # type: ignore[return-value]
