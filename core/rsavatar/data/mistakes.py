"""The classic mistakes of prepared data, each as the change that would undo it.

A mistake is diagnosed by trying: the body is projected with the change and without it, and the change is believed when
its silhouettes overlap the masks better by more than the mistake's margin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rsavatar.body.base import BodyModel
from rsavatar.body.skinning import posed_vertices
from rsavatar.data.base import Array, BodyFit, Subject
from rsavatar.data.consistency import Pair
from rsavatar.data.easymocap import SmplxFit, from_smplx
from rsavatar.data.images import Lens
from rsavatar.data.silhouettes import Score, Target, score, target_of
from rsavatar.geometry.cameras import Camera

# Off-by-one fits of the four sample subjects cost 0.016 to 0.125; the same test on sound ones gives at most 0.003.
_OFFSET_MARGIN = 0.012
COARSE = 0.1  # what a gross mistake costs at least; one that costs less is subtle


def _same_camera(camera: Camera) -> Camera:
    return camera


def _same_fit(fit: BodyFit, pelvis: Array) -> BodyFit:
    return fit


def _about_pelvis(fit: BodyFit, pelvis: Array) -> BodyFit:
    return from_smplx(SmplxFit(fit.Rh, fit.poses[:, 3:], fit.Th, fit.shapes), pelvis)


def _centred(camera: Camera) -> Camera:
    factor = 0.5 * camera.width / camera.cx
    names = ("fx", "fy", "cx", "cy")
    return replace(camera, **{name: getattr(camera, name) * factor for name in names}) if camera.cx > 0 else camera


def _inverted(camera: Camera) -> Camera:
    return replace(camera, rotation=camera.rotation.T, translation=-camera.rotation.T @ camera.translation)


@dataclass(frozen=True)
class Mistake:
    """What went wrong, what to do, and the change that undoes it; ``margin`` is in units of overlap (IoU)."""

    what: str
    hint: str
    camera: Callable[[Camera], Camera] = _same_camera
    fit: Callable[[BodyFit, Array], BodyFit] = _same_fit  # of N = 1; second argument: rest pelvis [3]
    offset: int = 0  # fit n + offset belongs to image n
    blended: bool = True  # pose blend shapes
    undistorted_twice: bool = False
    margin: float = COARSE

    @property
    def subtle(self) -> bool:
        """True where data with the mistake still look nearly right: tried always, and reported as a warning."""
        return self.margin < COARSE


AS_GIVEN = Mistake("as given", "")
MISTAKES = (
    Mistake(
        "T of the cameras is in metres",
        "annots.npy holds T in millimetres: multiply T by 1000",
        camera=lambda camera: replace(camera, translation=camera.translation * 1000),
    ),
    Mistake(
        "T of the cameras is 1000 times too large",
        "annots.npy holds T in millimetres: divide T by 1000",
        camera=lambda camera: replace(camera, translation=camera.translation / 1000),
    ),
    Mistake(
        "Th of the fits is in millimetres",
        "fits are in metres: divide Th by 1000",
        fit=lambda fit, pelvis: replace(fit, Th=fit.Th / 1000),
    ),
    Mistake(
        "Rh, Th are smplx's global_orient, transl",
        "smplx turns about the pelvis: Th = transl + p0 - R p0 (data.easymocap.from_smplx)",
        fit=_about_pelvis,
    ),
    Mistake(
        "R of the cameras is transposed",
        "R must take the world to the camera: store its transpose, leave T",
        camera=lambda camera: replace(camera, rotation=camera.rotation.T),
    ),
    Mistake(
        "R, T are the camera's pose in the world",
        "R and T must take the world to the camera: store R' and -R' T",
        camera=_inverted,
    ),
    Mistake(
        "K belongs to images of another size",
        "images were resized, K was not: scale its first two rows with the images",
        camera=_centred,
    ),
    Mistake("fits are numbered one too high", "fit n + 1 belongs to image n", offset=1, margin=_OFFSET_MARGIN),
    Mistake("fits are numbered one too low", "fit n - 1 belongs to image n", offset=-1, margin=_OFFSET_MARGIN),
    Mistake(
        "fits were made without pose blend shapes",
        "ZJU-MoCap's `params` were, its `new_params` were not: use new_params, or fit again",
        blended=False,
        margin=0.02,
    ),
    Mistake(
        "images are undistorted already",
        "D is applied when images are read: set D to zero in annots.npy",
        undistorted_twice=True,
        margin=0.02,
    ),
)


@dataclass(frozen=True)
class Trial:
    """The sampled masks and everything that projects the body into them."""

    body: BodyModel
    fit: BodyFit
    cameras: Mapping[str, Camera]
    lenses: Mapping[str, Lens]
    targets: Mapping[Pair, Target]

    def scores(self, mistake: Mistake) -> dict[Pair, Score]:
        """A score per sampled picture that has a fit, with the mistake undone."""
        body = self.body if mistake.blended else replace(self.body, pose_directions=None)
        pelvis = self.body.rest_joints(self.fit.shapes)[0]
        found: dict[Pair, Score] = {}
        for index in sorted({index for _, index in self.targets}):
            if not 0 <= index + mistake.offset < len(self.fit.poses):
                continue
            state = mistake.fit(_state(self.fit, index + mistake.offset), pelvis)
            vertices = posed_vertices(body, state.poses[0], state.Rh[0], state.Th[0], state.shapes)
            for name in (name for name, i in self.targets if i == index):
                found[name, index] = self._score(mistake, name, self.targets[name, index], vertices)
        return found

    def applicable(self, mistake: Mistake) -> bool:
        """False where the change would change nothing."""
        if mistake.undistorted_twice:
            return any(lens.distorts for lens in self.lenses.values())
        return mistake.blended or self.body.pose_directions is not None

    def _score(self, mistake: Mistake, name: str, target: Target, vertices: Array) -> Score:
        camera = mistake.camera(self.cameras[name]).scaled(target.factor)
        lens = self.lenses[name].scaled(target.factor) if mistake.undistorted_twice else None
        return score(target, camera, vertices, self.body.faces, lens)


def trial_of(subject: Subject, body: BodyModel, lenses: Mapping[str, Lens], pairs: Sequence[Pair]) -> Trial:
    """Reads the masks of ``pairs`` (training cameras); pictures where nobody is are left out.

    Raises:
        DataError: if a picture cannot be decoded.
    """
    read = {pair: subject.observe(*pair)[1] for pair in pairs}
    targets = {pair: target_of(subject.cameras[pair[0]], mask) for pair, mask in read.items() if mask.any()}
    return Trial(body, subject.fit, subject.cameras, lenses, targets)


def mean_iou(scores: Mapping[Pair, Score], pairs: Sequence[Pair] | None = None) -> float:
    """Mean overlap over ``pairs`` (default: all that were scored); 0 for none."""
    chosen = list(scores) if pairs is None else pairs
    return float(np.mean([scores[pair].iou for pair in chosen])) if chosen else 0.0


@dataclass(frozen=True)
class Diagnosis:
    """A mistake that is believed, with the mean overlap as given and with the mistake undone."""

    mistake: Mistake
    before: float
    after: float


def diagnose(trial: Trial, given: Mapping[Pair, Score], subtle_only: bool) -> list[Diagnosis]:
    """Mistakes whose undoing betters the overlap by more than their margin and in most frames, the likeliest first.

    Errors of a fit favour one change in one frame and another in the next; a mistake favours its undoing in all.
    """
    found = []
    for mistake in MISTAKES:
        if trial.applicable(mistake) and (mistake.subtle or not subtle_only):
            undone = trial.scores(mistake)
            diagnosis = Diagnosis(mistake, mean_iou(given, list(undone)), mean_iou(undone))
            if diagnosis.after > diagnosis.before + mistake.margin and _is_steady(given, undone):
                found.append(diagnosis)
    return sorted(found, key=lambda each: each.before - each.after)


def _is_steady(given: Mapping[Pair, Score], undone: Mapping[Pair, Score]) -> bool:
    """True when at most one frame in three gets worse."""
    frames = sorted({index for _, index in undone})
    pairs = [[pair for pair in undone if pair[1] == index] for index in frames]
    worse = sum(mean_iou(undone, each) <= mean_iou(given, each) for each in pairs)
    return worse * 3 <= len(frames)


def _state(fit: BodyFit, index: int) -> BodyFit:
    rows = slice(index, index + 1)
    return BodyFit(fit.poses[rows], fit.Rh[rows], fit.Th[rows], fit.shapes)
