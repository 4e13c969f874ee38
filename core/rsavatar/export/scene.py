"""An avatar in motion as one compact file for a viewer in the browser.

Layout: the bytes ``RSAV``, the length of a JSON header as a little-endian uint32, the header, zeros up to a multiple
of 4, then the arrays one after another, each at a multiple of 4. The header says what there is: ``arrays`` maps a name
to ``dtype``, ``shape`` and ``offset`` (bytes from the end of the padding).

    means    [M, 3] f4   canonical, shape included, metres       axes    [M, 9] f4   R(q) diag(s), row by row
    opacity  [M] f4      after the sigmoid                       sh      [M, B, 3] f4
    joints   [M, 4] u1   the four joints that bind it most       weights [M, 4] f4   theirs, summing to 1
    maps     [N, S, 24, 3, 4] f4   joint transforms, canonical to world, at S instants over each frame's period
    offsets  [N, M, 3] f4   pose blend shapes of each frame, metres; only where the body has some
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import torch

from rsavatar.export.ply import shaped_means
from rsavatar.export.replay import Replay
from rsavatar.export.views import DISTANCE, MARGIN, framing_camera
from rsavatar.geometry.rotations import quaternion_to_matrix

MAGIC = b"RSAV"
INSTANTS = 13  # S: over a frame's period, ends included; between them maps are interpolated linearly
BINDING = 4  # joints per Gaussian: as many as an SMPL-format body binds a vertex to


def write_scene(replay: Replay) -> bytes:
    """The file."""
    arrays = {name: np.ascontiguousarray(value) for name, value in _arrays(replay).items()}
    described, offset = {}, 0
    for name, value in arrays.items():
        described[name] = {"dtype": value.dtype.str[1:], "shape": list(value.shape), "offset": offset}
        offset += _padded(value.nbytes)
    header = json.dumps({**_about(replay), "arrays": described}).encode()
    start = 8 + len(header)
    parts = [MAGIC, struct.pack("<I", len(header)), header, bytes(_padded(start) - start)]
    for value in arrays.values():
        parts += [value.tobytes(), bytes(_padded(value.nbytes) - value.nbytes)]
    return b"".join(parts)


def _padded(length: int) -> int:
    return (length + 3) // 4 * 4


def _about(replay: Replay) -> dict[str, Any]:
    stage, timing = replay.stage, replay.subject.timing
    camera = framing_camera(stage, 1)
    return {
        "format": 1,
        "frames": replay.subject.frames,
        "period": timing.period_frames,
        "readout": timing.readout_frames,
        "still": not _moves(replay),
        "centre": stage.centre.tolist(),
        "up": stage.up.tolist(),
        "front": stage.front.tolist(),
        "reach": stage.reach,
        "distance": DISTANCE * stage.reach,
        "focal": camera.fx,  # of a picture of height 1
        "margin": MARGIN,
    }


def _moves(replay: Replay) -> bool:
    """Whether the pose changes within a frame: a still avatar looks the same under every shutter."""
    reach = torch.tensor([-0.5, 0.5], dtype=torch.float64) * replay.subject.timing.period_frames
    first, last = replay.actor.transforms(0, reach)
    return bool((first - last).abs().max() > 1e-6)


def _arrays(replay: Replay) -> dict[str, Any]:
    actor, avatar = replay.actor, replay.actor.avatar
    axes = quaternion_to_matrix(avatar.rotations.T) * avatar.log_scales.exp().T[:, None, :]
    weights, joints = replay.skin_weights.topk(BINDING, 0)
    degree = replay.spec.sh_degree
    sh = avatar.sh_constant if degree == 0 else torch.cat([avatar.sh_constant, avatar.sh_linear])
    bare = shaped_means(replay, 0) if actor.pose_offsets is None else _without_pose(replay)
    spread = torch.linspace(-0.5, 0.5, INSTANTS, dtype=torch.float64) * replay.subject.timing.period_frames
    maps = torch.stack([actor.transforms(frame, spread) for frame in range(replay.subject.frames)])
    found = {
        "means": bare.T.float(),
        "axes": axes.flatten(1).float(),
        "opacity": avatar.opacity_logits.sigmoid().float(),
        "sh": sh.permute(2, 0, 1).float(),
        "weights": (weights / weights.sum(0)).T.float(),
        "joints": joints.T.to(torch.uint8),
        "maps": maps.float(),
    }
    if actor.pose_offsets is not None:
        found["offsets"] = actor.pose_offsets[:, :, avatar.vertex].permute(0, 2, 1).float()
    return {name: value.detach().numpy() for name, value in found.items()}


def _without_pose(replay: Replay) -> torch.Tensor:
    actor = replay.actor
    return actor.avatar.shaped_means(actor.shapes - actor.avatar.surface.shapes, None)
