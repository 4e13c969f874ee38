"""What a method decides, and how the rest of a job is put together around it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from rsavatar.avatar.avatar import Avatar
from rsavatar.avatar.density import DensityRules
from rsavatar.avatar.networks import PoseResidual, SkinOffset
from rsavatar.avatar.surface import Surface
from rsavatar.body.base import BodyModel
from rsavatar.data.base import BodyFit, Bytes, Subject
from rsavatar.errors import DataError, SpecError, expected
from rsavatar.events import Report
from rsavatar.geometry.cameras import Camera
from rsavatar.imaging import Actor, Schedule, plan
from rsavatar.motion.base import AbstractMotion, InitialMotion
from rsavatar.motion.sequence import SequenceSpline
from rsavatar.motion.spline import FrameSpline
from rsavatar.motion.still import StillPose
from rsavatar.optimization import POSE_FIRST, Rates, Settings
from rsavatar.shutter.base import AbstractShutter, Slot, upwards
from rsavatar.shutter.clock import ReadoutClock
from rsavatar.spec import JobSpec
from rsavatar.train import Observation

MARGIN = 0.12  # of the mask's box, on each side: room for the initial fit's error and the motion


@dataclass(frozen=True)
class Case:
    """A job's inputs."""

    spec: JobSpec
    subject: Subject
    body: BodyModel

    @property
    def bands(self) -> int:
        """T as a number: what the paper's discretisations count; K where rows are continuous."""
        period = round(self.subject.timing.period_frames)
        bands = self.spec.bands(period)
        return period if bands == "scanline" else bands

    @property
    def exposure(self) -> float:
        """How long a row is exposed, as a fraction of the readout; 0 where it is ignored or nothing is read out."""
        timing, wanted = self.subject.timing, self.spec.exposure_frames
        frames = timing.exposure_frames if wanted is None else wanted
        return frames / timing.readout_frames if timing.readout_frames else 0.0

    def initial_motion(self) -> InitialMotion:
        """The per-frame fit and the frames' clock."""
        fit, timing = self.subject.fit, self.subject.timing
        return InitialMotion(fit.poses, fit.Rh, fit.Th, timing.mid_frames, timing.period_frames, timing.readout_frames)


def sub_frame_motion(case: Case) -> AbstractMotion:
    """The motion of the methods that know of instants within a frame; one pose a frame under ``no_spline``."""
    spec, initial = case.spec, case.initial_motion()
    if spec.ablation.no_spline:
        return StillPose(initial)
    if spec.motion == "sequence-spline":
        return SequenceSpline(initial, spec.knots)
    return FrameSpline(initial, case.bands, spec.P, spec.perturbation, spec.seed)


@dataclass(frozen=True)
class Prepared:
    """A case that is ready to be trained on, and what was found and used on the way."""

    case: Case
    means: Mapping[str, float] = field(default_factory=dict)
    restorer: str = ""  # what changed the pictures, weights included


class AbstractMethod(ABC):
    """A motion model and an image formation model.

    **Contract**: both are functions of the case alone; every method gets the same Gaussians, losses, optimiser and
    number of steps.
    """

    def prepare(self, case: Case, report: Report, should_stop: Callable[[], bool]) -> Prepared:
        """What is done to the pictures before training: nothing, but by the methods that correct them first."""
        return Prepared(case)

    @abstractmethod
    def motion(self, case: Case) -> AbstractMotion:
        """Pose as a function of time."""

    def initial_fit(self, case: Case) -> BodyFit:
        """Where the body's shape starts, and the poses that its pose blend shapes are taken at."""
        return case.subject.fit

    @abstractmethod
    def shutter(self, case: Case) -> AbstractShutter:
        """How a training frame is exposed, as this method believes."""


def check_case(case: Case) -> None:
    """Refuse a spec that contradicts its subject.

    Raises:
        SpecError: if K is not the subject's.
        DataError: if there is nothing to train on.
    """
    period = case.subject.timing.period_frames
    if case.spec.K is not None and period != case.spec.K:
        raise SpecError(expected("K", f"{period:g}, which subject {case.subject.name} was built with", case.spec.K))
    if not case.subject.training or not case.subject.frames:
        raise DataError(expected(f"subject {case.subject.name}", "training cameras and frames", "none"))


def build_actor(method: AbstractMethod, case: Case) -> Actor:
    """The avatar at its start: Gaussians on the body's vertices, moving as the initial fit says."""
    torch.manual_seed(case.spec.seed)  # the networks' initial weights
    fit, lost = method.initial_fit(case), case.spec.ablation
    unknown, timing = case.spec.calibrate, case.subject.timing
    additive = case.spec.residual == "additive"
    surface = Surface(case.body, fit.shapes)
    motion = method.motion(case)
    return Actor(
        Avatar(surface),
        motion,
        surface.pose_offsets(fit.poses),
        None if lost.no_pose_deformation or not list(motion.parameters()) else PoseResidual(additive),
        None if lost.no_lbs_refinement else SkinOffset(),
        ReadoutClock(len(case.subject.training), timing.period_frames, unknown) if unknown else None,
    )


def observations(method: AbstractMethod, case: Case) -> list[Observation]:
    """Every training image, decoded once, cut to its body, with its schedule planned.

    Raises:
        DataError: if an image cannot be read or every mask is empty.
    """
    subject = case.subject
    views = [(name, frame) for name in subject.training for frame in range(subject.frames)]
    there = [_observe(method, case, *view) for view in views if view not in subject.missing]
    found = [observation for observation in there if observation is not None]
    if not found:
        raise DataError(expected(f"subject {subject.name}", "a training image with a body in its mask", "none"))
    return found


def _observe(method: AbstractMethod, case: Case, name: str, frame: int) -> Observation | None:
    """One training image; None where nobody is in it, so that there is nothing to learn from it."""
    subject, camera = case.subject, as_read(case, name)
    rgb, mask = (turn_as_read(case, picture) for picture in subject.observe(name, frame))
    box = body_box(mask)
    if box is None:
        return None
    x0, y0, x1, y1 = box if "body" in case.spec.skip else (0, 0, camera.width, camera.height)
    weight = (x1 - x0) * (y1 - y0) / ((box[2] - box[0]) * (box[3] - box[1]))
    pixels = torch.from_numpy(rgb[y0:y1, x0:x1].transpose(2, 0, 1).copy())
    coverage = torch.from_numpy(mask[y0:y1, x0:x1].copy())  # the subject's own may be read-only
    schedule, cut = _schedule(method, case, name, (y0, y1)), camera.cropped(x0, y0, x1, y1)
    size, label = (camera.height, camera.width), f"{name}/{frame:06d}"
    return Observation(frame, cut, schedule, pixels, coverage, size, label, weight)


def is_sideways(case: Case) -> bool:
    """Whether the subject's sensors are read column by column: their pictures are taken turned, so that rows scan."""
    return case.subject.timing.direction in ("right", "left")


def as_read(case: Case, name: str) -> Camera:
    """Camera ``name``, held so that what is exposed together is a row."""
    camera = case.subject.cameras[name]
    return camera.turned() if is_sideways(case) else camera


def turn_as_read(case: Case, picture: Bytes) -> Bytes:
    """A picture of such a camera, from the subject's."""
    return np.rot90(picture, -1) if is_sideways(case) else picture


def slots_as_read(method: AbstractMethod, case: Case, name: str, readout: float) -> tuple[Slot, ...]:
    """How the method believes that the rows of ``as_read``'s camera are exposed, in ``readout`` source frames."""
    height, timing = as_read(case, name).height, case.subject.timing
    slots = method.shutter(case).slots(height, readout, timing.trigger(name))
    return upwards(slots, height) if timing.direction in ("up", "left") else slots


def _schedule(method: AbstractMethod, case: Case, name: str, rows: tuple[int, int]) -> Schedule:
    """When the ``rows`` [top, bottom) of camera ``name`` are exposed, as the method believes."""
    readout = case.subject.timing.readout_frames
    once, twice = (plan(slots_as_read(method, case, name, length), *rows) for length in (readout, 2 * readout))
    # instants are affine in the readout: the difference is the part that is proportional to it
    return replace(once, camera=case.subject.training.index(name), reading=twice.offsets - once.offsets)


def body_box(mask: Bytes) -> tuple[int, int, int, int] | None:
    """Columns and rows (x0, y0, x1, y1) of the mask with a margin, within the image; None for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    height, width = mask.shape
    margin = 8 + round(MARGIN * max(rows[-1] - rows[0], columns[-1] - columns[0]))
    return (
        max(int(columns[0]) - margin, 0),
        max(int(rows[0]) - margin, 0),
        min(int(columns[-1]) + 1 + margin, width),
        min(int(rows[-1]) + 1 + margin, height),
    )


def settings(case: Case) -> Settings:
    """How to train: the spec's words in the trainer's."""
    spec = case.spec
    centres = np.stack([case.subject.cameras[name].centre for name in case.subject.training])
    spread = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    authors = spec.regime == "authors"
    return Settings(
        iterations=spec.iterations,
        seed=spec.seed,
        extent=1.1 * spread if len(centres) > 1 else 1.0,
        lambda_reg=0.0 if spec.ablation.no_reg else spec.lambda_reg,
        continuity=spec.continuity,
        mask_weight=spec.mask_weight,
        ssim_weight=spec.ssim_weight,
        sh_degree=spec.sh_degree,
        checkpoint_every=spec.checkpoint_every,
        density=(DensityRules() if authors else DensityRules(gradient=4e-4)) if spec.densify else None,
        rates=Rates() if authors else POSE_FIRST,
        paint=not authors,
        doubt=spec.doubt,
        skip=frozenset(spec.skip),
    )
