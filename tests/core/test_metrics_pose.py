"""Pose and time metrics: closed forms, and the outside scorer's numbers."""

import ast
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsavatar.errors import DataError
from rsavatar.metrics.pose import Array, joint_error_mm, rotation_error_deg, sub_frame_joint_error_mm
from rsavatar.metrics.timing import Stopwatch

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
RNG = np.random.default_rng(5)


def rotations(*shape: int) -> Array:
    return Rotation.random(int(np.prod(shape)), random_state=4).as_matrix().reshape(*shape, 3, 3)


def test_a_shifted_body_is_wrong_by_the_shift() -> None:
    truth = RNG.normal(size=(4, 24, 3))
    assert joint_error_mm(truth + np.array([0.003, 0.0, -0.004]), truth) == pytest.approx(5.0)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.3, np.pi / 2, np.pi - 1e-7, np.pi])
def test_a_turned_body_is_wrong_by_the_angle(angle: float) -> None:
    truth = rotations(3, 24)
    turn = Rotation.from_rotvec(angle * np.array([2.0, -1.0, 2.0]) / 3).as_matrix()
    assert rotation_error_deg(truth @ turn, truth) == pytest.approx(np.degrees(angle), abs=1e-6)


def test_feet_and_hands_are_not_scored() -> None:
    truth = rotations(2, 24)
    other = truth.copy()
    other[:, [10, 11, 22, 23]] = np.eye(3)
    assert rotation_error_deg(other, truth) < 1e-6


def test_the_geodesic_is_symmetric_and_blind_to_the_world_frame() -> None:
    a, b, world = rotations(2, 24), rotations(2, 24)[::-1].copy(), rotations(1)[0]
    assert rotation_error_deg(a, b) == pytest.approx(rotation_error_deg(b, a))
    assert rotation_error_deg(world @ a, world @ b) == pytest.approx(rotation_error_deg(a, b))


@pytest.mark.parametrize("instants", [1, 2, 7, 45])
def test_uniform_motion_between_the_true_instants_is_exact(instants: int) -> None:
    start, speed = RNG.normal(size=(3, 1, 24, 3)), RNG.normal(size=(3, 1, 24, 3))
    ours, true = (start + speed * np.linspace(0, 1, n)[None, :, None, None] for n in (instants, 11))
    assert sub_frame_joint_error_mm(ours, true) == pytest.approx(0.0, abs=1e-9)
    assert sub_frame_joint_error_mm(ours + np.array([0, 0.002, 0]), true) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("metric", "value", "truth"),
    [
        (joint_error_mm, np.zeros((2, 24, 3)), np.zeros((3, 24, 3))),
        (joint_error_mm, np.zeros((0, 24, 3)), np.zeros((0, 24, 3))),
        (joint_error_mm, np.full((2, 24, 3), np.nan), np.zeros((2, 24, 3))),
        (rotation_error_deg, np.zeros((2, 23, 3, 3)), np.zeros((2, 23, 3, 3))),
        (sub_frame_joint_error_mm, np.zeros((2, 24, 3)), np.zeros((2, 5, 24, 3))),
        (sub_frame_joint_error_mm, np.zeros((2, 0, 24, 3)), np.zeros((2, 5, 24, 3))),
        (sub_frame_joint_error_mm, np.zeros((2, 3, 23, 3)), np.zeros((2, 5, 24, 3))),
    ],
)
def test_what_does_not_fit_is_refused(metric: Callable[[Array, Array], float], value: Array, truth: Array) -> None:
    with pytest.raises(DataError, match="expected"):
        metric(value, truth)


def test_the_stopwatch_adds_up_what_is_inside() -> None:
    watch = Stopwatch()
    assert watch.seconds == 0
    for _ in range(2):
        with watch:
            time.sleep(0.01)
            assert watch.seconds > 0
    total = watch.seconds
    time.sleep(0.01)
    assert watch.seconds == total >= 0.02


PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)


def pose(rest: Array, poses: Array, Rh: Array, Th: Array) -> tuple[Array, Array]:
    """World joints [24, 3] and global rotations [24, 3, 3], SMPL's kinematic chain restated."""
    local = Rotation.from_rotvec(poses.reshape(24, 3)).as_matrix()
    world = Rotation.from_rotvec(Rh).as_matrix()
    spin, place = [world], [world @ rest[0] + Th]
    for j in range(1, 24):
        parent = PARENTS[j]
        place.append(place[parent] + spin[parent] @ (rest[j] - rest[parent]))
        spin.append(spin[parent] @ local[j])
    return np.stack(place), np.stack(spin)


@pytest.mark.shared
def test_agrees_with_the_outside_scorer(tmp_path: Path) -> None:
    subject, body = SHARED / "subjects/wave", SHARED / "body/body_smpl.npz"
    if not subject.is_dir() or not body.is_file():
        pytest.skip("sample subject wave and its body are not beside the checkout")
    with np.load(body) as b, np.load(subject / "truth/motion.npz") as t:
        truth = {k: t[k] for k in ("mid_poses", "mid_Rh", "mid_Th", "mid_joints", "sub_joints")}
        betas = RNG.normal(0, 0.3, 10)
        rest = b["J_regressor"] @ (b["v_template"] + b["shapedirs"] @ betas)
    n, s = len(truth["mid_poses"]), 6
    noisy = {k: truth[f"mid_{k}"] + RNG.normal(0, 0.03, truth[f"mid_{k}"].shape) for k in ("poses", "Rh", "Th")}
    noisy["poses"][:, :3] = 0
    subs = {f"sub_{k}": np.repeat(v[:, None], s, 1) for k, v in noisy.items()}
    save: Any = np.savez
    save(tmp_path / "motion.npz", shapes=betas, **noisy, **subs)

    ours = [pose(rest, *frame) for frame in zip(noisy["poses"], noisy["Rh"], noisy["Th"], strict=True)]
    true = [pose(rest, *(truth[f"mid_{k}"][i] for k in ("poses", "Rh", "Th"))) for i in range(n)]
    joints = np.stack([j for j, _ in ours])
    command = [sys.executable, str(SHARED / "subject-generator/score.py"), str(subject)]
    said = subprocess.run(
        [*command, "--params", str(tmp_path / "motion.npz"), "--pred", str(tmp_path)],
        capture_output=True, text=True, check=True, timeout=120, env={**os.environ, "SUBJECT_ASSETS": str(SHARED)},
    ).stdout  # fmt: skip
    theirs = ast.literal_eval(re.findall(r"\{.*\}", said)[0])
    assert joint_error_mm(joints, truth["mid_joints"]) == pytest.approx(theirs["mpjpe_mm"], abs=0.0051)  # 2 decimals
    assert rotation_error_deg(np.stack([r for _, r in ours]), np.stack([r for _, r in true])) == pytest.approx(
        theirs["global_rotation_deg"], abs=0.0051
    )
    assert sub_frame_joint_error_mm(np.repeat(joints[:, None], s, 1), truth["sub_joints"]) == pytest.approx(
        theirs["sub_frame_mpjpe_mm"], abs=0.0051
    )
