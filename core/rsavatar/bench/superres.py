"""``rsavatar bench superres``: what is known of the instants that no frame was taken at (the paper's open question).

A rolling-shutter rig sees the body at every instant of a frame's period, a row here and a row there; a global-shutter
rig of the same frame rate sees it once a period, whole. Both are trained alike and asked for pictures halfway between
frames, and for the motion at 45 instants a frame.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rsavatar import catalog, checkpoint
from rsavatar.bench.study import Column, Study, Variant
from rsavatar.body.find import find_body
from rsavatar.data import zju
from rsavatar.data.base import Image, Subject
from rsavatar.data.catalogue import open_subject
from rsavatar.data.disturb import disturb
from rsavatar.data.studio_stage import set_stage
from rsavatar.evaluate import render_slots, unit
from rsavatar.imaging import Actor
from rsavatar.methods.base import AbstractMethod, Case, build_actor
from rsavatar.metrics.image import dilate, psnr
from rsavatar.optimization import load_actor
from rsavatar.shutter.base import Slot
from rsavatar.spec import JobSpec

SHARES = (0.25, 0.5, 0.75)  # of the period after a frame's mid time
GLOBAL = {"disturb": {"capture": "global shutter"}}

STUDY = Study(
    name="superres",
    title="Temporal super-resolution",
    about="""\
Training frames come K source frames apart; the truth is known at all instants. "Between frames" is the PSNR of
views a quarter, a half and three quarters of a period after each frame: the held-out cameras of studio subjects,
whose truth is drawn for the purpose, or the training cameras of a subject that has its source frames (`source/`),
whose pictures at those instants nobody was shown. "At frames" is the usual score at the mid rows. Sub-frame joints
are over 45 instants a frame. The global-shutter input is the subject's sharp mid-row frames; both start from the
same fits.""",
    variants=(
        Variant("rolling input, ours", {}),
        Variant("global-shutter input, ours (one spline)", GLOBAL),
        Variant("global-shutter input, GauHuman (pose held)", {**GLOBAL, "method": "gauhuman"}),
        Variant("rolling input, GauHuman (pose held)", {"method": "gauhuman"}),
        Variant("rolling input, ours, a spline per frame", {"motion": "frame-spline"}),
        Variant("true motion given", {"method": "oracle"}),
    ),
    columns=(
        Column("psnr", "at frames, PSNR ↑"),
        Column("between_psnr", "between frames, PSNR ↑"),
        Column("joint_mm", "joints, mm ↓", 1),
        Column("sub_frame_joint_mm", "sub-frame joints, mm ↓", 1),
    ),
    subjects=("studio-0", "studio-1", "studio-2"),
    score="rsavatar.bench.superres:score",
)


def score(spec: JobSpec, folder: Path, out: Path) -> dict[str, float | None]:
    """``between_psnr`` of a finished job; None for a subject without truth between its frames."""
    subject = open_subject(spec.subject, folder)
    truth = truth_between(subject)
    if truth is None:
        return {"between_psnr": None}
    actor, period = restored(spec, subject, out), subject.timing.period_frames
    offsets = [round(share * period) for share in SHARES]  # source frames are at whole ones
    with torch.no_grad():
        weights = actor.skin_weights()
        values = [
            _psnr_at(actor, spec, subject, weights, truth.view(camera, frame, offset))
            for camera in truth.cameras
            for frame in range(subject.frames - 1)
            for offset in offsets
        ]
    return {"between_psnr": float(np.mean(values))}


@dataclass(frozen=True)
class View:
    """A true sharp picture of a camera at ``offset`` source frames from the mid time of the frame nearest to it."""

    camera: str
    frame: int
    offset: float
    image: Image


@dataclass(frozen=True)
class TruthBetween:
    """True pictures at any whole source frame, of some cameras."""

    subject: Subject
    cameras: tuple[str, ...]
    picture: Callable[[str, float], Image]  # camera, absolute source frame

    def view(self, camera: str, frame: int, offset: int) -> View:
        """The picture ``offset`` source frames after the mid time of ``frame``."""
        mids, period = self.subject.timing.mid_frames, self.subject.timing.period_frames
        later = 2 * offset > period
        near, rest = (frame + 1, offset - period) if later else (frame, float(offset))
        return View(camera, near, rest, self.picture(camera, float(mids[frame]) + offset))


def truth_between(subject: Subject) -> TruthBetween | None:
    """Drawn for studio subjects, read from ``source/`` where there is one, else None."""
    meta = json.loads((subject.root / "meta.json").read_text(encoding="utf-8"))
    if meta.get("source") == "made by rsavatar data studio":
        stage = set_stage(int(meta["seed"]), int(meta["size"]))

        def drawn(camera: str, time: float) -> Image:
            view = stage.cameras[int(camera)]
            return stage.picture(view, np.full(view.height, time))

        return TruthBetween(subject, subject.held_out[:2], drawn)
    if not (subject.root / "source").is_dir():
        return None
    source = zju.load(subject.root / "source")
    place = {float(time): index for index, time in enumerate(source.timing.mid_frames)}
    return TruthBetween(subject, subject.training, lambda camera, time: source.observe(camera, place[time]))


def restored(spec: JobSpec, subject: Subject, out: Path) -> Actor:
    """The actor of the finished job in ``out``."""
    body = find_body(spec.body, subject)[0]
    case = Case(spec, disturb(subject, spec.disturb, spec.seed), body)
    method: AbstractMethod = catalog.load(catalog.METHODS, spec.method)()
    actor = build_actor(method, case)
    load_actor(actor, checkpoint.read(out / "checkpoint.safetensors")[0])
    return actor


def _psnr_at(actor: Actor, spec: JobSpec, subject: Subject, weights: Tensor, view: View) -> float:
    camera, (rgb, mask) = subject.cameras[view.camera], view.image
    slots = (Slot(0, camera.height, view.offset),)
    image = render_slots(actor, camera, view.frame, slots, weights, spec.sh_degree)
    return psnr(unit(image), unit(rgb), dilate(mask > 0))
