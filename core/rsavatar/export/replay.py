"""A trained avatar, read back from its checkpoint: the actor, the subject it was trained on, and the stage it moves on.

**Convention**: ``time`` is in output frames: 3 is the mid time of frame 3, 3.5 lies half a period later.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rsavatar import catalog, kernels
from rsavatar.body.base import BodyModel
from rsavatar.body.find import find_body
from rsavatar.checkpoint import Owner, read
from rsavatar.data.base import Array, Subject
from rsavatar.data.catalogue import open_subject
from rsavatar.data.disturb import disturb
from rsavatar.errors import CheckpointError, SpecError, expected
from rsavatar.geometry.rotations import exp_so3
from rsavatar.imaging import Actor
from rsavatar.methods.base import AbstractMethod, Case, build_actor
from rsavatar.optimization import load_actor
from rsavatar.spec import JobSpec

AROUND_JOINTS = 0.16  # metres from a joint to where the body ends: crown, fingers, soles


@dataclass(frozen=True)
class Source:
    """What a finished job left: its spec, its checkpoint, and where its subject lies (None: the built-in one)."""

    spec: JobSpec
    checkpoint: Path
    subject_dir: Path | None

    @property
    def place(self) -> tuple[str, Path | None, str]:
        """What subject and body are found by."""
        return self.spec.subject, self.subject_dir, self.spec.body


@dataclass(frozen=True)
class Stage:
    """Where the body is over the whole sequence, so that a camera can be put in front of it."""

    centre: Array  # [3] metres, world
    up: Array  # [3] unit vector: away from the floor, as the cameras stand
    front: Array  # [3] unit vector, level: where the body faces in the middle of the sequence
    reach: float  # metres from the centre to the outermost point, up, down or sideways


@dataclass(frozen=True)
class Replay:
    """An avatar that can be looked at. Nothing here needs or keeps gradients."""

    source: Source
    subject: Subject
    body: BodyModel
    actor: Actor
    skin_weights: Tensor  # [24, M], refined
    stage: Stage

    @property
    def spec(self) -> JobSpec:
        """What the job was asked to do."""
        return self.source.spec

    def place(self, time: float) -> tuple[int, float]:
        """The frame whose trajectory is asked, and the offset from its mid time in source frames.

        Raises:
            SpecError: if ``time`` is more than half a frame outside the sequence.
        """
        last = self.subject.frames - 1
        if not -0.5 <= time <= last + 0.5:
            raise SpecError(expected("time", f"an output frame from 0 to {last}", time))
        frame = min(max(round(time), 0), last)
        return frame, (time - frame) * self.subject.timing.period_frames


def prepare(threads: int) -> None:
    """Once a process: ``threads`` for the kernels, one for torch, as in training; pictures do not depend on it."""
    kernels.use_threads(max(1, threads))
    torch.set_num_threads(1)


def open_replay(source: Source, known: Replay | None = None) -> Replay:
    """Load the subject and the checkpoint and put the actor together again; ``known`` may lend its subject and body.

    Raises:
        DataError, BodyError: if the subject or the body cannot be read.
        CheckpointError: if the checkpoint is damaged, or was trained on other data than lies there now.
    """
    shares = known is not None and known.source.place == source.place
    subject = known.subject if known and shares else open_subject(source.spec.subject, source.subject_dir)
    body = known.body if known and shares else find_body(source.spec.body, subject)[0]
    tensors, owner, _ = read(source.checkpoint)
    _check_owner(owner, data=subject.fingerprint, body=body.sha256)
    method: AbstractMethod = catalog.load(catalog.METHODS, source.spec.method)()
    with torch.no_grad():
        actor = build_actor(method, Case(source.spec, disturb(subject, source.spec.disturb, source.spec.seed), body))
        load_actor(actor, tensors)
        actor.requires_grad_(False)
        weights = actor.skin_weights().contiguous()
        return Replay(source, subject, body, actor, weights, find_stage(actor, subject))


def _check_owner(owner: Owner, **now: str) -> None:
    for name, value in now.items():
        if getattr(owner, name) != value:
            wanted = f"the {name} that the job was trained with ({getattr(owner, name)[:12]})"
            raise CheckpointError(expected(f"checkpoint {name}", wanted, value[:12]))


def find_stage(actor: Actor, subject: Subject) -> Stage:
    """The stage of a sequence, from the joints at every frame's mid time."""
    joints = np.concatenate([joints_at(actor, frame, 0.0) for frame in range(subject.frames)])
    down = np.mean([camera.rotation[1] for camera in subject.cameras.values()], axis=0)
    up = -down / np.linalg.norm(down)
    heights = joints @ up
    level = joints - heights[:, None] * up
    middle = (level.min(0) + level.max(0)) / 2
    aside = float(np.linalg.norm(level - middle, axis=1).max())
    reach = max((heights.max() - heights.min()) / 2, aside) + AROUND_JOINTS
    centre = middle + up * (heights.max() + heights.min()) / 2
    return Stage(centre, up, _facing(actor, subject.frames // 2, up), float(reach))


def joints_at(actor: Actor, frame: int, offset: float) -> Array:
    """World joints [24, 3] of a frame at ``offset`` source frames from its mid time."""
    world = actor.transforms(frame, torch.tensor([offset], dtype=torch.float64))[0].double()
    rest = (actor.joints + actor.joint_directions @ actor.shapes).double()
    joints: Array = ((world[..., :3] @ rest[:, :, None])[..., 0] + world[..., 3]).numpy()
    return joints


def _facing(actor: Actor, frame: int, up: Array) -> Array:
    """The body's own forward axis (z), levelled; any level direction for a body that lies."""
    state = actor.motion.state(frame, torch.zeros(1, dtype=torch.float64))
    rotation = exp_so3(state.Rh.double())[0].numpy()
    for axis in (rotation[:, 2], rotation[:, 1], rotation[:, 0]):
        level = axis - (axis @ up) * up
        if np.linalg.norm(level) > 0.2:
            break
    forward: Array = level / np.linalg.norm(level)
    return forward
