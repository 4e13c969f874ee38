"""How the studio person moves: phase-modulated sines on every joint, which no polynomial fits exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from rsavatar.body.base import JOINTS, BodyModel
from rsavatar.body.skinning import joint_transforms, world_transforms
from rsavatar.data.base import Array, BodyFit
from rsavatar.geometry.rotations import compose, exp_so3

FPS = 120.0
_UPRIGHT = (np.pi / 2, 0.0, 0.0)  # body's y up to the world's z up
# joint -> (resting axis-angle, swing axis-angle, cycles per second, phase as a part of a cycle)
_Swing = tuple[tuple[float, float, float], tuple[float, float, float], float, float]
_STYLES: tuple[tuple[str, Mapping[int, _Swing]], ...] = (
    (
        "wave",
        {
            17: ((0.0, 0.0, -0.40), (0.0, -0.25, -0.45), 0.77, 0.00),
            19: ((0.0, 0.0, -0.85), (0.2, 0.0, -0.65), 0.77, 0.10),
            21: ((0.0, 0.0, 0.0), (0.0, 0.0, -0.30), 0.77, 0.25),
            16: ((0.0, 0.0, -1.15), (0.45, 0.0, 0.12), 0.51, 0.30),
            18: ((0.0, -0.5, 0.0), (0.0, -0.3, 0.0), 0.51, 0.40),
            3: ((0.0, 0.0, 0.0), (0.03, 0.14, 0.06), 0.4, 0.10),
            6: ((0.0, 0.0, 0.0), (0.03, 0.14, 0.05), 0.4, 0.15),
            15: ((0.0, 0.0, 0.0), (0.10, 0.25, 0.0), 0.34, 0.60),
            1: ((-0.05, 0.0, 0.06), (0.10, 0.0, 0.04), 0.51, 0.00),
            2: ((-0.05, 0.0, -0.06), (0.10, 0.0, 0.04), 0.51, 0.50),
            4: ((0.15, 0.0, 0.0), (0.12, 0.0, 0.0), 0.51, 0.05),
            5: ((0.15, 0.0, 0.0), (0.12, 0.0, 0.0), 0.51, 0.55),
        },
    ),
    (
        "twist",
        {
            3: ((0.0, 0.0, 0.0), (0.0, 0.22, 0.03), 0.92, 0.00),
            6: ((0.0, 0.0, 0.0), (0.0, 0.22, 0.03), 0.92, 0.05),
            9: ((0.0, 0.0, 0.0), (0.0, 0.20, 0.0), 0.92, 0.10),
            12: ((0.0, 0.0, 0.0), (0.0, -0.20, 0.0), 0.92, 0.05),
            16: ((0.0, 0.0, -0.35), (0.0, 0.15, 0.30), 0.92, 0.20),
            17: ((0.0, 0.0, 0.35), (0.0, 0.15, 0.30), 0.92, 0.25),
            18: ((0.0, -0.4, 0.0), (0.0, -0.3, 0.0), 0.92, 0.30),
            19: ((0.0, 0.4, 0.0), (0.0, -0.3, 0.0), 0.92, 0.30),
            1: ((-0.12, 0.0, 0.08), (0.10, -0.1, 0.0), 0.92, 0.10),
            2: ((-0.12, 0.0, -0.08), (0.10, -0.1, 0.0), 0.92, 0.60),
            4: ((0.25, 0.0, 0.0), (0.15, 0.0, 0.0), 0.92, 0.15),
            5: ((0.25, 0.0, 0.0), (0.15, 0.0, 0.0), 0.92, 0.65),
        },
    ),
    (
        "march",
        {
            1: ((-0.25, 0.0, 0.03), (-0.50, 0.0, 0.0), 0.79, 0.00),
            2: ((-0.25, 0.0, -0.03), (-0.50, 0.0, 0.0), 0.79, 0.50),
            4: ((0.55, 0.0, 0.0), (0.50, 0.0, 0.0), 0.79, 0.05),
            5: ((0.55, 0.0, 0.0), (0.50, 0.0, 0.0), 0.79, 0.55),
            7: ((-0.15, 0.0, 0.0), (0.25, 0.0, 0.0), 0.79, 0.20),
            8: ((-0.15, 0.0, 0.0), (0.25, 0.0, 0.0), 0.79, 0.70),
            16: ((0.0, 0.0, -1.10), (0.75, 0.0, 0.10), 0.79, 0.02),
            17: ((0.0, 0.0, 1.10), (0.75, 0.0, 0.10), 0.79, 0.52),
            18: ((0.0, -0.8, 0.0), (0.0, -0.45, 0.0), 0.79, 0.55),
            19: ((0.0, 0.8, 0.0), (0.0, 0.45, 0.0), 0.79, 0.05),
            3: ((0.04, 0.0, 0.0), (0.02, 0.12, 0.02), 0.79, 0.30),
            6: ((0.04, 0.0, 0.0), (0.02, 0.12, 0.02), 0.79, 0.33),
        },
    ),
    (
        "punch",
        {
            16: ((0.0, -0.5, -0.45), (0.0, -0.55, 0.10), 1.05, 0.00),
            17: ((0.0, 0.5, 0.45), (0.0, -0.55, -0.10), 1.05, 0.00),
            18: ((0.0, -1.2, 0.0), (0.0, 0.75, 0.0), 1.05, 0.06),
            19: ((0.0, 1.2, 0.0), (0.0, 0.75, 0.0), 1.05, 0.06),
            3: ((0.05, 0.0, 0.0), (0.0, 0.16, 0.0), 1.05, 0.95),
            6: ((0.05, 0.0, 0.0), (0.0, 0.16, 0.0), 1.05, 0.97),
            1: ((-0.25, 0.1, 0.10), (0.08, 0.0, 0.0), 1.05, 0.20),
            2: ((-0.10, -0.1, -0.10), (0.08, 0.0, 0.0), 1.05, 0.70),
            4: ((0.40, 0.0, 0.0), (0.12, 0.0, 0.0), 1.05, 0.25),
            5: ((0.30, 0.0, 0.0), (0.12, 0.0, 0.0), 1.05, 0.75),
        },
    ),
    (
        "squat",
        {
            1: ((-0.60, 0.0, 0.10), (-0.45, 0.0, 0.0), 0.72, 0.00),
            2: ((-0.60, 0.0, -0.10), (-0.45, 0.0, 0.0), 0.72, 0.00),
            4: ((0.90, 0.0, 0.0), (0.65, 0.0, 0.0), 0.72, 0.00),
            5: ((0.90, 0.0, 0.0), (0.65, 0.0, 0.0), 0.72, 0.00),
            3: ((0.15, 0.0, 0.0), (0.12, 0.0, 0.0), 0.72, 0.02),
            16: ((0.0, -0.3, -0.55), (0.0, -0.3, 0.50), 0.72, 0.10),
            17: ((0.0, 0.3, 0.55), (0.0, 0.3, -0.50), 0.72, 0.10),
            18: ((0.0, -0.3, 0.0), (0.0, -0.2, 0.0), 0.72, 0.20),
            19: ((0.0, 0.3, 0.0), (0.0, 0.2, 0.0), 0.72, 0.20),
            15: ((0.0, 0.0, 0.0), (-0.12, 0.0, 0.0), 0.72, 0.05),
        },
    ),
)
STYLES = tuple(name for name, _ in _STYLES)
_BY_SEED = 3  # a seed's own style is one of the first three


@dataclass(frozen=True, eq=False)
class Motion:
    """Exact motion of one person; times in source frames, ``FPS`` a second."""

    style: str
    rest: Array  # [24, 3]
    swing: Array  # [24, 3]
    rate: Array  # [24, 1] cycles per source frame
    phase: Array  # [24, 1] radians
    jerk: float  # depth of the phase modulation, radians
    shapes: Array  # [10]
    lift: float  # metres, height of the body's origin above the floor

    def at(self, times: Array) -> BodyFit:
        """State at S times [S]. **Convention**: z up, floor at z = 0, the person faces -y."""
        t = times[:, None, None]
        cycle = 2 * np.pi * self.rate * t + self.phase
        poses = self.rest + self.swing * np.sin(cycle + self.jerk * np.sin(2 * cycle + 1.0))
        poses = poses + 0.12 * self.swing * np.sin(2.7 * cycle + 0.5)
        poses[:, 0] = 0.0
        slow = 2 * np.pi * times / FPS
        yaw = np.column_stack([0 * slow, 0 * slow, 0.35 * np.sin(0.45 * slow + self.jerk)])
        upright = torch.tensor(_UPRIGHT, dtype=torch.float64)
        Rh: Array = compose(torch.from_numpy(yaw), upright.expand(len(times), 3)).numpy()
        sway = [0.05 * np.sin(0.8 * slow), 0.04 * np.sin(1.1 * slow + 1.0), self.lift + 0.015 * np.sin(2.2 * slow)]
        return BodyFit(poses.reshape(-1, 3 * JOINTS), Rh, np.column_stack(sway), self.shapes)


def choose_motion(body: BodyModel, seed: int, wanted: str = "") -> Motion:
    """The motion of a seed: one of three styles in turn, with its own tempo, phases, amplitudes and build.

    ``wanted`` names another of ``STYLES``.
    """
    rng = np.random.default_rng([seed, 7])
    style, swings = _STYLES[STYLES.index(wanted) if wanted else seed % _BY_SEED]
    rest, swing = np.zeros((JOINTS, 3)), rng.normal(0, 0.02, (JOINTS, 3))
    rate, phase = rng.uniform(0.5, 1.0, (JOINTS, 1)), rng.uniform(0, 1, (JOINTS, 1))
    tempo, offset = rng.uniform(0.95, 1.05), rng.uniform(0, 1)
    for joint, (at, by, hertz, lead) in swings.items():
        rest[joint], swing[joint] = at, np.array(by) * rng.uniform(0.92, 1.08)
        rate[joint], phase[joint] = hertz * tempo, lead + offset
    shapes = rng.normal(0, 0.5, 10)
    lift = -float(body.shaped(shapes)[:, 1].min())
    return Motion(style, rest, swing, rate / FPS, 2 * np.pi * phase, float(rng.uniform(0.3, 0.5)), shapes, lift)


def bones(body: BodyModel, states: BodyFit) -> tuple[Array, Array]:
    """Rest-to-world transforms [S, 24, 3, 4] and world joints [S, 24, 3] of S states."""
    rotations = exp_so3(torch.from_numpy(states.poses.reshape(-1, JOINTS, 3)))
    rest = torch.from_numpy(body.rest_joints(states.shapes))
    local = joint_transforms(rotations, rest, body.parents)
    world = world_transforms(local, exp_so3(torch.from_numpy(states.Rh)), torch.from_numpy(states.Th))
    joints = (world[..., :3] @ rest.unsqueeze(-1)).squeeze(-1) + world[..., 3]
    return world.numpy(), joints.numpy()


def skinning_table(rest: Array, weights: Array) -> Array:
    """Weight times homogeneous rest place [V, 24 * 4]: times the stacked transforms it gives the posed vertices."""
    places = np.concatenate([rest, np.ones((len(rest), 1))], 1)
    table: Array = (weights[:, :, None] * places[:, None, :]).reshape(len(rest), 4 * JOINTS)
    return table


def pose_meshes(table: Array, transforms: Array) -> Array:
    """World vertices [S, V, 3] of S states, from ``skinning_table`` and transforms [S, 24, 3, 4]."""
    stacked = transforms.transpose(1, 3, 2, 0).reshape(table.shape[1], -1)  # (joint, column) by (row, state)
    moved = (table @ stacked).reshape(len(table), 3, -1)
    return np.ascontiguousarray(moved.transpose(2, 0, 1))


def biased_noisy_fit(body: BodyModel, truth: BodyFit, seen: list[BodyFit], rng: np.random.Generator) -> BodyFit:
    """What a fitter makes of rolling-shutter frames: each joint at the time of its own row, with slow and fast errors.

    Args:
        body: for the number of joints.
        truth: N states at the mid-row times; only its shape coefficients are used.
        seen: for each frame, 24 states: state j at the time at which joint j was exposed.
        rng: source of the errors: about 3 degrees a joint (half of it in the trunk), 15 mm, 0.15 a shape coefficient.
    """
    joints = np.arange(JOINTS)
    frames = len(seen)
    poses = np.stack([state.poses.reshape(-1, JOINTS, 3)[joints, joints] for state in seen])
    Rh, Th = (np.stack([values[0] for values in stack]) for stack in ([s.Rh for s in seen], [s.Th for s in seen]))
    degrees = np.where(np.isin(joints, (0, 3, 6, 9)), 1.5, 3.3)[:, None]
    turn = np.radians(degrees) / np.sqrt(3) * _wandering(frames, 3 * JOINTS, rng).reshape(-1, JOINTS, 3)
    poses = compose(torch.from_numpy(poses), torch.from_numpy(turn)).numpy()
    poses[:, 0] = 0.0
    Rh = compose(torch.from_numpy(Rh), torch.from_numpy(turn[:, 0].copy())).numpy()
    Th = Th + 0.015 / np.sqrt(3) * _wandering(frames, 3, rng)
    return BodyFit(poses.reshape(-1, 3 * JOINTS), Rh, Th, truth.shapes + rng.normal(0, 0.15, truth.shapes.shape))


def _wandering(frames: int, size: int, rng: np.random.Generator, keep: float = 0.8, slow: float = 0.75) -> Array:
    """Unit-variance noise [N, size]: a first-order autoregression (share ``slow``) plus white noise."""
    walk = np.empty((frames, size))
    walk[0] = rng.normal(size=size)
    for n in range(1, frames):
        walk[n] = keep * walk[n - 1] + np.sqrt(1 - keep**2) * rng.normal(size=size)
    mixed: Array = np.sqrt(slow) * walk + np.sqrt(1 - slow) * rng.normal(size=(frames, size))
    return mixed
