"""Scoring: held-out views at the mid-row time, and the recovered motion (paper, section 4.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rsavatar.body.kinematics import pose
from rsavatar.data.base import Array, Subject
from rsavatar.errors import DataError, expected
from rsavatar.events import Progress, Report
from rsavatar.geometry.cameras import Camera
from rsavatar.geometry.rotations import compose, exp_so3
from rsavatar.imaging import Actor, expose, plan
from rsavatar.metrics.base import protocol, score
from rsavatar.metrics.pose import joint_error_mm, rotation_error_deg, sub_frame_joint_error_mm
from rsavatar.metrics.timing import Stopwatch
from rsavatar.shutter.base import Slot
from rsavatar.shutter.rolling import Instant

SUB_INSTANTS = 45  # S of motion.npz: instants over each readout, ends included


@dataclass(frozen=True)
class Score:
    """Metrics of one held-out image; a metric that could not be computed is None (the protocol says why)."""

    camera: str
    frame: int
    values: Mapping[str, float | None]


@dataclass(frozen=True)
class Evaluation:
    """Scores, their means, and how they were taken."""

    scores: tuple[Score, ...]
    means: Mapping[str, float | None]
    protocol: Mapping[str, Any]
    seconds: float


def evaluate(actor: Actor, subject: Subject, sh_degree: int, out: Path, report: Report) -> Evaluation:
    """Render every held-out view at its mid-row instant, write and score it; write and score the motion.

    Writes ``out/predictions/<cc>/<nnnnnn>.png`` (8 bits, on black: what is scored is what is written) and
    ``out/motion.npz``.
    """
    watch = Stopwatch()
    with watch, torch.no_grad():
        scores = tuple(_score_views(actor, subject, sh_degree, out / "predictions", report, watch))
        means = {**mean_scores(scores), **_score_motion(actor, subject, out / "motion.npz")}
    stated = {**protocol(), "cameras": list(subject.held_out), "frames": subject.frames}
    return Evaluation(scores, means, stated, watch.seconds)


def _score_views(
    actor: Actor, subject: Subject, sh_degree: int, folder: Path, report: Report, watch: Stopwatch
) -> list[Score]:
    skin_weights = actor.skin_weights()
    total = len(subject.held_out) * subject.frames
    scores: list[Score] = []
    for name in subject.held_out:
        (folder / name).mkdir(parents=True, exist_ok=True)
        for frame in range(subject.frames):
            pixels = render_view(actor, subject, name, frame, skin_weights, sh_degree)
            path = folder / name / f"{frame:06d}.png"
            if not cv2.imwrite(str(path), pixels[..., ::-1]):
                raise DataError(expected(str(path), "a writable file", "no success"))
            truth, mask = subject.truth(name, frame)
            values = score(unit(pixels), unit(truth), mask > 0) if mask.any() else {}
            scores.append(Score(name, frame, values))
            report(Progress("evaluate", len(scores), total, watch.seconds, psnr=values.get("psnr")))
    return scores


def render_view(
    actor: Actor, subject: Subject, camera: str, frame: int, skin_weights: Tensor, sh_degree: int
) -> npt.NDArray[np.uint8]:
    """A sharp view of ``frame`` at the camera's mid-row instant, on black: [H, W, 3] uint8."""
    view, timing = subject.cameras[camera], subject.timing
    slots = Instant().slots(view.height, timing.readout_frames, timing.trigger(camera))
    return render_slots(actor, view, frame, slots, skin_weights, sh_degree)


def render_slots(
    actor: Actor, view: Camera, frame: int, slots: Sequence[Slot], skin_weights: Tensor, sh_degree: int
) -> npt.NDArray[np.uint8]:
    """A whole picture of ``frame`` exposed as ``slots`` say, on black: [H, W, 3] uint8."""
    scene = actor.scene(frame, view, plan(slots, 0, view.height), skin_weights, sh_degree)
    rgb = expose(scene).rgb.permute(1, 2, 0).clamp(0, 1)
    pixels: npt.NDArray[np.uint8] = (rgb * 255 + 0.5).to(torch.uint8).numpy()
    return pixels


def unit(pixels: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Bytes to [0, 1]."""
    return pixels.astype(np.float32) / np.float32(255)


def mean_scores(scores: tuple[Score, ...]) -> dict[str, float | None]:
    """Mean over the frames of each camera, then over cameras; None where no image has the metric."""
    names = sorted({name for s in scores for name in s.values})
    means: dict[str, float | None] = {}
    for name in names:
        by_camera: dict[str, list[float]] = {}
        for s in scores:
            value = s.values.get(name)
            if value is not None:
                by_camera.setdefault(s.camera, []).append(value)
        means[name] = float(np.mean([np.mean(v) for v in by_camera.values()])) if by_camera else None
    return means


def write_preview(scores: tuple[Score, ...], subject: Subject, out: Path) -> tuple[Path, str] | None:
    """The view of median PSNR beside its truth and their difference, ``out/preview.png``; None without held-out views.

    Returns:
        The file and a caption for it.
    """
    ranked = sorted((s for s in scores if s.values.get("psnr") is not None), key=lambda s: s.values["psnr"] or 0.0)
    if not ranked:
        return None
    chosen = ranked[len(ranked) // 2]
    written = out / "predictions" / chosen.camera / f"{chosen.frame:06d}.png"
    image = cv2.imread(str(written))
    if image is None:
        raise DataError(expected(str(written), "the picture that was just written", "nothing readable"))
    truth, mask = subject.truth(chosen.camera, chosen.frame)
    x, y, width, height = cv2.boundingRect(mask)
    box = np.s_[max(y - 8, 0) : y + height + 8, max(x - 8, 0) : x + width + 8]
    tiles = [image[box], truth[..., ::-1][box], cv2.convertScaleAbs(cv2.absdiff(image, truth[..., ::-1])[box], alpha=3)]
    path = out / "preview.png"
    cv2.imwrite(str(path), np.hstack(tiles))
    psnr = chosen.values["psnr"]
    return path, f"camera {chosen.camera}, frame {chosen.frame}: reconstruction, truth, difference x3 ({psnr:.1f} dB)"


def recovered_motion(actor: Actor, subject: Subject) -> dict[str, Array]:
    """The motion in the body fit's words, refined poses included: see ``motion.npz`` in the README.

    poses [N, 72], Rh [N, 3], Th [N, 3] at the mid row, shapes [10], and sub_poses [N, S, 72], sub_Rh [N, S, 3],
    sub_Th [N, S, 3] at S instants over the readout, ends included.
    """
    spread = torch.linspace(-0.5, 0.5, SUB_INSTANTS, dtype=torch.float64) * subject.timing.readout_frames
    offsets = torch.cat([torch.zeros(1, dtype=torch.float64), spread])
    found: dict[str, list[Array]] = {"poses": [], "Rh": [], "Th": []}
    for frame in range(subject.frames):
        state = actor.motion.state(frame, offsets)
        rotations, residuals = actor.deformed(state.rotations)
        poses = rotations.double() if residuals is None else compose(rotations.double(), residuals.double())
        for name, value in (("poses", poses.flatten(1)), ("Rh", state.Rh), ("Th", state.Th)):
            found[name].append(value.double().numpy())
    stacked = {name: np.stack(values) for name, values in found.items()}
    middle = {name: value[:, 0] for name, value in stacked.items()}
    sub = {f"sub_{name}": value[:, 1:] for name, value in stacked.items()}
    return {**middle, **sub, "shapes": actor.shapes.detach().double().numpy()}


def _score_motion(actor: Actor, subject: Subject, path: Path) -> dict[str, float | None]:
    motion = recovered_motion(actor, subject)
    np.savez_compressed(path, **motion)  # type: ignore[arg-type] # stubs take the names for options
    truth = subject.motion
    if truth is None:
        return {}
    joints, rotations = world_joints(actor, motion, "")
    sub_joints, _ = world_joints(actor, motion, "sub_")
    true_pose = torch.from_numpy(truth.mid.poses.reshape(-1, 24, 3))
    true_rotations = _global_rotations(exp_so3(true_pose), torch.from_numpy(truth.mid.Rh), actor.parents.tolist())
    return {
        "joint_mm": joint_error_mm(joints, truth.mid_joints),
        "joint_deg": rotation_error_deg(rotations, true_rotations),
        "sub_frame_joint_mm": sub_frame_joint_error_mm(sub_joints, truth.sub_joints),
    }


def world_joints(actor: Actor, motion: Mapping[str, Array], prefix: str) -> tuple[Array, Array]:
    """World joints [..., 24, 3] and global rotations [..., 24, 3, 3] of a motion's states."""
    poses, Rh, Th = (torch.from_numpy(motion[prefix + name]) for name in ("poses", "Rh", "Th"))
    rest = (actor.joints + actor.joint_directions @ actor.shapes).double()
    world = pose(poses.reshape(-1, 24, 3), None, Rh.reshape(-1, 3), Th.reshape(-1, 3), rest, actor.parents)
    joints = (world[..., :3] @ rest[:, :, None])[..., 0] + world[..., 3]
    shape = poses.shape[:-1]
    return joints.reshape(*shape, 24, 3).numpy(), world[..., :3].reshape(*shape, 24, 3, 3).numpy()


def _global_rotations(local: Tensor, Rh: Tensor, parents: list[int]) -> Array:
    """Joint-to-world rotations [N, 24, 3, 3] of local ones."""
    chain = [exp_so3(Rh)]
    for joint in range(1, 24):
        chain.append(chain[parents[joint]] @ local[:, joint])
    result: Array = torch.stack(chain, 1).numpy()
    return result
