"""From slots to an image: slots -> instants -> poses -> polynomials -> one render (design, section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from math import cos, pi

import torch
from torch import Tensor

from rsavatar import kernels
from rsavatar.avatar.avatar import Avatar
from rsavatar.avatar.networks import PoseResidual, SkinOffset, refine
from rsavatar.body.kinematics import pose
from rsavatar.geometry.cameras import Camera
from rsavatar.motion.base import AbstractMotion
from rsavatar.render import native, reference
from rsavatar.render.base import Rendering, Scene, TimedRows
from rsavatar.shutter.base import Slot
from rsavatar.shutter.clock import ReadoutClock

NODES = 5  # Chebyshev nodes of a scanned slot: four leave 6 dB at 200 px of motion, and cost as much


@dataclass(frozen=True)
class Schedule:
    """Slots as the renderer takes them: T slots, each a polynomial through D instants of the motion."""

    offsets: Tensor  # [T * D] float64, source frames from the frame's mid time
    rows: tuple[TimedRows, ...]  # T of them
    coefficients: int  # D
    camera: int = 0  # whose clock it is on, an index; only a clock that is being calibrated asks
    reading: Tensor | None = None  # [T * D] the part of ``offsets`` that is proportional to the readout


def chebyshev_nodes(count: int) -> list[float]:
    """``count`` Chebyshev nodes in [-1, 1], falling."""
    return _nodes(count)[0]


@cache
def _nodes(count: int) -> tuple[list[float], Tensor]:
    """Chebyshev nodes in [-1, 1], and the matrix [D, D] from values there to monomial coefficients."""
    nodes = [cos((2 * k + 1) * pi / (2 * count)) for k in range(count)]
    powers = torch.tensor([[x**d for d in range(count)] for x in nodes], dtype=torch.float64)
    return nodes, torch.linalg.inv(powers)


def plan(slots: Sequence[Slot], top: int, bottom: int, nodes: int = NODES) -> Schedule:
    """Slots of a full frame, cut to its rows [top, bottom) and moved to the cut's own coordinates.

    Slots without a row there are left out before any work is done. A slot is a polynomial in tau in [-1, 1] over the
    instants of the rows that are left; where nothing scans, D is 1.
    """
    cut = [(s, max(s.lo, top), min(s.hi, bottom)) for s in slots if s.lo < bottom and s.hi > top]
    count = nodes if any(s.rate for s in slots) else 1
    offsets, rows = [], []
    for slot, lo, hi in cut:
        middle = slot.start + slot.rate * ((lo + hi - 1) / 2)
        half = slot.rate * (hi - lo) / 2
        offsets += [middle + half * node for node in _nodes(count)[0]]
        # row centre y of the cut belongs to row y + top - 1/2 of the frame
        rate = slot.rate / half if half else 0.0
        rows.append(TimedRows(lo - top, hi - top, rate, rate * (top - (lo + hi) / 2), slot.weight))
    return Schedule(torch.tensor(offsets, dtype=torch.float64), tuple(rows), count)


def polynomials(transforms: Tensor, coefficients: int) -> Tensor:
    """Joint transforms at the instants of a schedule [T * D, 24, 3, 4] to coefficients [T, D, 24, 3, 4]."""
    values = transforms.reshape(-1, coefficients, *transforms.shape[1:])
    if coefficients == 1:
        return values
    inverse = _nodes(coefficients)[1].to(transforms)
    result: Tensor = inverse @ values.flatten(2)
    return result.reshape(values.shape)


class Actor(torch.nn.Module):
    """An avatar that moves: Gaussians, body shape, motion, and the networks that refine them."""

    parents: Tensor
    joints: Tensor
    joint_directions: Tensor

    def __init__(
        self,
        avatar: Avatar,
        motion: AbstractMotion,
        pose_offsets: Tensor | None = None,
        pose_residual: PoseResidual | None = None,
        skin_offset: SkinOffset | None = None,
        clock: ReadoutClock | None = None,
    ) -> None:
        """``pose_offsets`` [N, 3, V] are the pose blend shapes of each frame; None where the body has none.

        ``clock`` corrects the schedules' instants; None where they are known.
        """
        super().__init__()
        body = avatar.surface.body
        self.avatar = avatar
        self.motion = motion
        self.pose_offsets = pose_offsets
        self.shapes = torch.nn.Parameter(avatar.surface.shapes.clone())
        self.register_buffer("parents", torch.tensor(body.parents, dtype=torch.int32), persistent=False)
        self.register_buffer("joints", torch.from_numpy(body.joint_template).float(), persistent=False)
        self.register_buffer("joint_directions", torch.from_numpy(body.joint_directions).float(), persistent=False)
        self.pose_residual = pose_residual
        self.skin_offset = skin_offset
        self.clock = clock

    def deformed(self, rotations: Tensor) -> tuple[Tensor, Tensor | None]:
        """Poses [D, 24, 3] and what is composed with them on SO(3), if anything (paper, eq. disp).

        The residual is composed on SO(3); where the network says ``additive``, it is the paper's: added, axis-angle.
        """
        if self.pose_residual is None:
            return rotations, None
        residual = torch.nn.functional.pad(self.pose_residual(rotations[:, 1:]), (0, 0, 1, 0))
        return (rotations + residual, None) if self.pose_residual.additive else (rotations, residual)

    def transforms(self, frame: int, offsets: Tensor) -> Tensor:
        """Canonical-to-world joint transforms [D, 24, 3, 4] of ``frame`` at ``offsets`` source frames from its mid."""
        state = self.motion.state(frame, offsets)
        rest = self.joints + self.joint_directions @ self.shapes
        return pose(*self.deformed(state.rotations), state.Rh, state.Th, rest, self.parents)

    def skin_weights(self) -> Tensor:
        """Skinning weights [24, M]; differentiable in the offset network where there is one."""
        if self.skin_offset is None:
            return self.avatar.prior
        return refine(self.avatar.prior, self.skin_offset(self.avatar.means.detach()))

    def timed(self, schedule: Schedule) -> Schedule:
        """``schedule`` at the instants that the clock has found so far (paper, eq. rowtime with rho_c and delta_c)."""
        if self.clock is None or schedule.reading is None:
            return schedule
        return replace(schedule, offsets=self.clock(schedule.camera, schedule.offsets, schedule.reading))

    def scene(self, frame: int, camera: Camera, schedule: Schedule, skin_weights: Tensor, sh_degree: int) -> Scene:
        """Everything that one image of ``frame`` needs."""
        offset = None if self.pose_offsets is None else self.pose_offsets[frame]
        means = self.avatar.shaped_means(self.shapes - self.avatar.surface.shapes, offset)
        coefficients = polynomials(self.transforms(frame, schedule.offsets), schedule.coefficients)
        return Scene(self.avatar.gaussians(means, skin_weights, sh_degree), coefficients, schedule.rows, camera)


def expose(scene: Scene) -> Rendering:
    """Render with the native kernels, or, where they could not be built, with the slow float64 twin."""
    return native.render(scene) if kernels.available() else reference.render(scene)
