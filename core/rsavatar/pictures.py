"""What a finished job shows to people: every picture beside its truth, the recovered motion, the work that was saved.

``pictures.zip``     <camera>/<frame>/result.png    sharp, at the mid row, of every camera
                     <camera>/<frame>/exposed.png   what the method's own shutter predicts a training camera saw
``references.zip``   <camera>/<frame>/truth.png     sharp frame at the mid row, where the subject has one
                     <camera>/<frame>/input.png     what a training camera saw; held-out cameras have none
``paths.json``       joints over the readout, found and true, with the cameras and slots to draw them

Frames are six digits. References depend on the subject alone: they are built once, kept in the cache, and have the
same bytes for every job.
"""

from __future__ import annotations

import fcntl
import json
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from rsavatar.body.cache import cache_dir
from rsavatar.data.base import Array, Bytes, Subject
from rsavatar.errors import DataError, expected
from rsavatar.evaluate import render_slots, render_view, world_joints
from rsavatar.geometry.cameras import Camera
from rsavatar.imaging import Actor
from rsavatar.methods.base import AbstractMethod, Case, as_read, is_sideways, slots_as_read
from rsavatar.shutter.base import Slot
from rsavatar.train import Observation

FORMAT = 1  # raise it when references.zip changes: it is part of the cache's key
EPOCH = (1980, 1, 1, 0, 0, 0)  # one date in every archive, so that equal pictures give equal bytes
JOINTS = {"head": 15, "left wrist": 20, "right wrist": 21, "left elbow": 18, "right elbow": 19} | {
    "pelvis": 0,
    "left ankle": 7,
    "right ankle": 8,
}
INSTANTS = 12  # of a readout that are drawn
MILLIMETRES = 1000.0


@dataclass(frozen=True)
class Shown:
    """A trained job, as its pictures need it."""

    method: AbstractMethod
    case: Case
    actor: Actor

    @property
    def subject(self) -> Subject:
        """Whom it shows."""
        return self.case.subject

    def slots(self, camera: str) -> tuple[Slot, ...]:
        """How the method believes that ``camera`` exposes its rows."""
        return slots_as_read(self.method, self.case, camera, self.subject.timing.readout_frames)


def write_pictures(shown: Shown, out: Path) -> dict[str, Path]:
    """Write ``out/pictures.zip`` and ``out/paths.json``, find ``references.zip``; held-out views are read from ``out``.

    Returns:
        Name to file, as artifacts of the job.
    """
    with torch.no_grad():
        _archive(out / "pictures.zip", _rendered(shown, out / "predictions"))
        (out / "paths.json").write_text(json.dumps(_paths(shown, out / "motion.npz"), separators=(",", ":")))
    references = references_of(shown.subject)
    return {"pictures": out / "pictures.zip", "paths": out / "paths.json", "references": references}


def _rendered(shown: Shown, predictions: Path) -> Iterable[tuple[str, bytes]]:
    subject, actor = shown.subject, shown.actor
    for camera in subject.held_out:
        for frame in range(subject.frames):
            yield f"{camera}/{frame:06d}/result.png", (predictions / camera / f"{frame:06d}.png").read_bytes()
    weights, degree = actor.skin_weights(), shown.case.spec.sh_degree
    for camera in subject.training:
        slots = shown.slots(camera)
        for frame in range(subject.frames):
            place = f"{camera}/{frame:06d}"
            yield f"{place}/result.png", _png(render_view(actor, subject, camera, frame, weights, degree))
            if len(slots) > 1 or slots[0].rate:  # else it is the same picture
                shot = render_slots(actor, as_read(shown.case, camera), frame, slots, weights, degree)
                yield f"{place}/exposed.png", _png(np.rot90(shot) if is_sideways(shown.case) else shot)


def references_of(subject: Subject) -> Path:
    """The archive of a subject's inputs and truths, from the cache where it is there."""
    path = cache_dir() / f"references-{FORMAT}-{subject.fingerprint[:24]}.zip"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.is_file():
            part = path.with_suffix(".part")
            _archive(part, _references(subject))
            part.replace(path)
    return path


def _references(subject: Subject) -> Iterable[tuple[str, bytes]]:
    for camera in subject.held_out:
        for frame in range(subject.frames):
            yield f"{camera}/{frame:06d}/truth.png", _png(subject.truth(camera, frame)[0])
    for camera in subject.training:
        for frame in range(subject.frames):
            place = f"{camera}/{frame:06d}"
            if (camera, frame) in subject.missing:
                continue
            yield f"{place}/input.png", _png(subject.observe(camera, frame)[0])
            try:
                yield f"{place}/truth.png", _png(subject.truth(camera, frame)[0])
            except DataError:  # a real rig has no sharp frames of its training cameras
                continue


def _png(rgb: Bytes) -> bytes:
    written, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    if not written:
        raise DataError(expected("picture", "one that can be written as PNG", f"shape {rgb.shape}"))
    return data.tobytes()


def _archive(path: Path, members: Iterable[tuple[str, bytes]]) -> None:
    """A stored archive: PNG is compressed already, and a member can be read without the others."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members:
            archive.writestr(zipfile.ZipInfo(name, EPOCH), data)


def _paths(shown: Shown, motion: Path) -> dict[str, Any]:
    """Joints [N][S][J][3] in whole millimetres of the world, with what is needed to draw them over any picture."""
    subject, timing = shown.subject, shown.subject.timing
    with np.load(motion, allow_pickle=False) as held:
        joints, _ = world_joints(shown.actor, {name: held[name] for name in held.files}, "sub_")
    truth = None if subject.motion is None else subject.motion.sub_joints
    return {
        "joints": list(JOINTS),
        "offsets_frames": (np.linspace(-0.5, 0.5, INSTANTS) * timing.readout_frames).round(4).tolist(),
        "mid_frames": timing.mid_frames.tolist(),
        "period_frames": timing.period_frames,
        "readout_frames": timing.readout_frames,
        "found": _drawn(joints),
        "truth": None if truth is None else _drawn(truth),
        "cameras": {name: _camera(camera, shown, name) for name, camera in subject.cameras.items()},
    }


def _drawn(joints: Array) -> list[Any]:
    """[N, S, 24, 3] metres to the instants and joints that are drawn; instants are interpolated."""
    place = np.linspace(0, joints.shape[1] - 1, INSTANTS)
    low = np.minimum(place.astype(int), max(joints.shape[1] - 2, 0))
    high = np.minimum(low + 1, joints.shape[1] - 1)
    share = (place - low)[None, :, None, None]
    chosen = joints[:, :, list(JOINTS.values())]
    values = chosen[:, low] * (1 - share) + chosen[:, high] * share
    rounded: list[Any] = np.rint(values * MILLIMETRES).astype(int).tolist()
    return rounded


def _camera(camera: Camera, shown: Shown, name: str) -> dict[str, Any]:
    """Projection [3][4] of millimetres to homogeneous pixels, size, clock, and the slots that the method believes."""
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    matrix = intrinsics @ np.c_[camera.rotation / MILLIMETRES, camera.translation]
    training = name in shown.subject.training
    drawn = training and not is_sideways(shown.case)  # seams are drawn as rows
    return {
        "matrix": [[float(f"{value:.8g}") for value in row] for row in matrix],
        "size": [camera.width, camera.height],
        "trigger_frames": shown.subject.timing.trigger(name),
        "training": training,
        "slots": [[s.lo, s.hi, s.start, s.rate, s.weight] for s in shown.slots(name)] if drawn else [],
    }


def work_of(shown: Shown, seen: list[Observation]) -> dict[str, int]:
    """Counts of one look at every training image: what is drawn, and what the paper's way would draw.

    The paper renders the whole frame once for each of its T bands; here rows and columns beyond the body, and slots
    without a row on it, are cut from the plan before any work.
    """
    bands = shown.case.bands
    full = sum(height * width for height, width in (o.full_size for o in seen))
    drawn = sum(sum(r.hi - r.lo for r in o.schedule.rows) * o.camera.width for o in seen)
    return {
        "images": len(seen),
        "images_without_body": len(shown.subject.training) * shown.subject.frames - len(seen),
        "full_pixels": full,
        "body_pixels": sum(o.camera.height * o.camera.width for o in seen),
        "drawn_pixels": drawn,
        "drawn_passes": sum(len(o.schedule.rows) for o in seen),
        "paper_bands": bands,
        "paper_pixels": full * bands,
        "paper_passes": len(seen) * bands,
    }
