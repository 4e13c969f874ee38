"""Is this subject fit for training? Minutes of looking before hours of computing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rsavatar.body.base import BodyModel
from rsavatar.body.find import find_body
from rsavatar.data.annots import fit_folder, read_calibrations
from rsavatar.data.base import BodyFit, Subject
from rsavatar.data.catalogue import layout_of, open_subject
from rsavatar.data.consistency import (
    Pair,
    check_cameras,
    check_jumps,
    check_masks,
    check_pictures,
    check_timing,
)
from rsavatar.data.findings import Finding, Report, Severity, render
from rsavatar.data.footage import read_own
from rsavatar.data.images import Lens
from rsavatar.data.mistakes import AS_GIVEN, Diagnosis, diagnose, mean_iou, trial_of
from rsavatar.data.rolling import name_of
from rsavatar.data.silhouettes import Score
from rsavatar.data.zju import camera_folders
from rsavatar.errors import BodyError, DataError

__all__ = ["Finding", "Report", "check", "render"]

_SAMPLED_FRAMES = 6
_SAMPLED_CAMERAS = 4
_GOOD_IOU, _POOR_IOU = 0.6, 0.4  # clothed people overlap a naked body's silhouette by 0.7 to 0.8
_GOOD_INSIDE, _POOR_INSIDE = 0.9, 0.7


def check(root: Path, body: str = "auto") -> Report:
    """Looks at files, cameras, timing and masks, projects the fitted body into sampled masks, and names what is wrong.

    ``body`` is as for ``find_body``: "auto", "anny" or a path. Nothing is raised for bad data: all of it is in the
    report. A few seconds.
    """
    findings: list[Finding] = []
    try:
        layout = layout_of(root)
        findings += check_pictures(root, _picture_folders(root, layout))
        subject = open_subject(root.name, root)
        findings.append(_summary(subject))
        findings += [*check_cameras(subject), *check_timing(subject.timing), *check_jumps(subject.fit)]
        findings += _check_absent(root, layout, subject)
        pairs = _sample(subject)
        findings += check_masks(subject, pairs)
        lenses = _lenses(root, layout)
        findings += [*_check_rows(subject, lenses), *_check_projection(subject, lenses, body, pairs)]
    except (DataError, BodyError) as error:
        findings.append(_failure(error))
    return Report(root, tuple(findings))


def _picture_folders(root: Path, layout: str) -> list[Path]:
    if layout == "rolling":
        return [root / "rs"]
    if layout == "footage":
        return [root / "images", root / "masks"]
    return [folder for folders in camera_folders(root).values() for folder in (folders.images, folders.masks)]


def _summary(subject: Subject) -> Finding:
    trained, held = ", ".join(subject.training), ", ".join(subject.held_out) or "none"
    got = f"{subject.frames} frames; cameras {trained} train, {held} held out"
    return Finding("ok", "subject", "frames, cameras, fits", got)


def _failure(error: Exception) -> Finding:
    name, _, rest = str(error).partition(": expected ")
    wanted, _, got = rest.rpartition(", got ")
    return Finding("error", name, wanted or "a readable subject", got or str(error))


def _check_absent(root: Path, layout: str, subject: Subject) -> list[Finding]:
    """Cameras that are calibrated but not on disk, and fits that were made for another body formula."""
    if layout != "zju":
        return []
    findings = []
    calibrated = {f"{index:02d}" for index in range(len(read_calibrations(root / "annots.npy")))}
    absent = sorted(calibrated - set(subject.cameras) - {"03"})
    if absent:
        hint = "they are left out"
        findings.append(
            Finding("warning", "cameras", "folders of all calibrated cameras", f"none for {', '.join(absent)}", hint)
        )
    if fit_folder(root).name == "params":
        hint = "fitted without pose blend shapes in ZJU-MoCap's original release: new_params is better"
        findings.append(Finding("warning", "fits", "new_params or smpl_params", "params", hint))
    return findings


def _sample(subject: Subject) -> list[Pair]:
    """The frames where the body moves most, in evenly chosen training cameras."""
    names = subject.training
    chosen = sorted({names[i] for i in np.linspace(0, len(names) - 1, _SAMPLED_CAMERAS).round().astype(int)})
    return [(name, index) for index in _lively(subject.fit) for name in chosen]


def _lively(fit: BodyFit) -> list[int]:
    """The frame of largest motion in each of a few equal stretches: errors of a fit are alike in close frames."""
    n = len(fit.poses)
    if n <= _SAMPLED_FRAMES:
        return list(range(n))
    steps = 10 * np.linalg.norm(np.diff(fit.Th, axis=0), axis=1) + np.abs(np.diff(fit.poses, axis=0)).sum(1)
    inner = steps[1:] + steps[:-1]  # of frames 1 .. n-2: fits of both neighbours exist
    stretches = np.array_split(np.arange(1, n - 1), min(_SAMPLED_FRAMES, n - 2))
    return [int(stretch[np.argmax(inner[stretch - 1])]) for stretch in stretches]


def _lenses(root: Path, layout: str) -> dict[str, Lens]:
    if layout == "footage":
        footage = read_own(root)
        return {name_of(footage.index[name]): footage.lens(name) for name in (*footage.train, *footage.test)}
    path = root / "rs" / "annots.npy" if layout == "rolling" else root / "annots.npy"
    # Half a pixel of the principal point moves no diagnosis.
    return {f"{index:02d}": each.lens(0.5) for index, each in enumerate(read_calibrations(path))}


def _check_rows(subject: Subject, lenses: Mapping[str, Lens]) -> list[Finding]:
    """The model's clock follows undistorted rows; pictures that a real sensor read have theirs on distorted ones."""
    if subject.timing.readout_frames == 0:
        return []
    sizes = {name: (camera.height, camera.width) for name, camera in subject.cameras.items()}
    parts = {name: lenses[name].row_shift(sizes[name]) / sizes[name][0] for name in subject.training}
    worst = max(parts, key=lambda name: parts[name])
    wanted = "rows that carry the time where the model looks for them"
    if not parts[worst]:
        return [Finding("ok", "rows", wanted, "pictures without distortion")]
    late = parts[worst] * subject.timing.readout_frames
    got = f"distorted pictures: in camera {worst} a row's time is off by up to {late:.2f} source frames"
    hint = "the lens moves rows after they were read; footage can be built with --rows undistorted"
    return [Finding("warning", "rows", wanted, got, hint)]


def _check_projection(subject: Subject, lenses: Mapping[str, Lens], body: str, pairs: Sequence[Pair]) -> list[Finding]:
    model, sentence = find_body(body, subject)
    findings = [Finding("ok", "body", "a body model", sentence)]
    trial = trial_of(subject, model, {name: lenses[name] for name in subject.training}, pairs)
    if not trial.targets:
        return findings
    given = trial.scores(AS_GIVEN)
    fits = mean_iou(given) >= _GOOD_IOU and _mean_inside(given) >= _GOOD_INSIDE
    diagnoses = diagnose(trial, given, subtle_only=fits)
    findings.append(_judge(given, bool(diagnoses)))
    findings += _odd_cameras(given)
    return findings + [_told(diagnosis, model) for diagnosis in diagnoses[:2]]


def _mean_inside(scores: Mapping[Pair, Score]) -> float:
    return float(np.mean([score.inside for score in scores.values()]))


def _judge(scores: Mapping[Pair, Score], explained: bool) -> Finding:
    iou, inside = mean_iou(scores), _mean_inside(scores)
    wanted = f"{_GOOD_INSIDE:.0%} of the body's vertices in the masks, overlap at least {_GOOD_IOU}"
    got = f"{inside:.0%} of the vertices inside, overlap {iou:.2f} over {len(scores)} pictures"
    if iou >= _GOOD_IOU and inside >= _GOOD_INSIDE:
        return Finding("ok", "fitted body in masks", wanted, got)
    hint = "see below" if explained else "no usual mistake explains it: wrong body model, or fits of another sequence?"
    bad = iou < _POOR_IOU or inside < _POOR_INSIDE
    return Finding("error" if bad else "warning", "fitted body in masks", wanted, got, hint)


def _odd_cameras(scores: Mapping[Pair, Score]) -> list[Finding]:
    """Cameras in which the body misses the masks although it meets them in others."""
    names = sorted({name for name, _ in scores})
    by_camera = {name: mean_iou(scores, [pair for pair in scores if pair[0] == name]) for name in names}
    best = max(by_camera.values())
    odd = [f"{name} (overlap {iou:.2f})" for name, iou in by_camera.items() if iou < _POOR_IOU <= _GOOD_IOU <= best]
    if not odd:
        return []
    hint = "their calibration is wrong, or their images belong to another camera or time"
    return [Finding("error", "cameras", "the body in the masks of every camera", ", ".join(odd), hint)]


def _told(diagnosis: Diagnosis, model: BodyModel) -> Finding:
    mistake = diagnosis.mistake
    got = f"overlap {diagnosis.before:.2f} as given, {diagnosis.after:.2f} with that undone ({model.name})"
    severity: Severity = "warning" if mistake.subtle else "error"
    return Finding(severity, mistake.what, "the data as given to fit best", got, mistake.hint)
