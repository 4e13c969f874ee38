"""Linear blend skinning against closed forms, the smplx package, and its own symmetries."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from rsavatar.body.base import BodyModel
from rsavatar.body.skinning import (
    easymocap_to_smplx,
    joint_transforms,
    pose_feature,
    posed_joints,
    posed_vertices,
    skin,
    smplx_to_easymocap,
    world_transforms,
)
from rsavatar.body.smpl import load_body
from rsavatar.geometry.rotations import exp_so3
from tests.core.bodies import PARENTS, smpl_arrays, write_pickle

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
ELBOW, WRIST, HAND = 18, 20, 22


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def random_joints(seed: int) -> Tensor:
    return torch.randn(24, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_rotations(seed: int, batch: int = 2) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return exp_so3(torch.randn(batch, 24, 3, generator=generator, dtype=torch.float64))


def test_no_rotation_moves_nothing() -> None:
    still = torch.eye(3, dtype=torch.float64).expand(3, 24, 3, 3)
    moved = joint_transforms(still, random_joints(0), PARENTS)
    torch.testing.assert_close(moved, torch.eye(3, 4, dtype=torch.float64).expand(3, 24, 3, 4), atol=1e-14, rtol=0)


def test_a_bent_elbow_carries_the_forearm_about_the_elbow() -> None:
    joints = random_joints(1)
    bend = torch.zeros(1, 24, 3, dtype=torch.float64)
    bend[0, ELBOW, 2] = torch.pi / 2
    moved = joint_transforms(exp_so3(bend), joints, PARENTS)[0]
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    for joint in range(24):
        point = joints[joint] + 0.3
        wanted = quarter @ (point - joints[ELBOW]) + joints[ELBOW] if joint in (ELBOW, WRIST, HAND) else point
        torch.testing.assert_close(moved[joint, :, :3] @ point + moved[joint, :, 3], wanted, atol=1e-12, rtol=0)


def test_the_chain_equals_the_product_joint_by_joint() -> None:
    rotations, joints = random_rotations(2), random_joints(3)
    moved = joint_transforms(rotations, joints, PARENTS)
    turns, places = [rotations[:, 0]], [joints[0].expand(2, 3)]
    for j in range(1, 24):
        parent = PARENTS[j]
        turns.append(turns[parent] @ rotations[:, j])
        places.append(places[parent] + (turns[parent] @ (joints[j] - joints[parent]).unsqueeze(-1)).squeeze(-1))
    posed = (moved[..., :3] @ joints.unsqueeze(-1)).squeeze(-1) + moved[..., 3]
    torch.testing.assert_close(moved[..., :3], torch.stack(turns, 1), atol=1e-12, rtol=0)
    torch.testing.assert_close(posed, torch.stack(places, 1), atol=1e-12, rtol=0)


def test_rest_joints_may_differ_within_a_batch() -> None:
    rotations, joints = random_rotations(4), torch.stack([random_joints(5), random_joints(6)])
    together = joint_transforms(rotations, joints, PARENTS)
    apart = [joint_transforms(rotations[k : k + 1], joints[k], PARENTS) for k in range(2)]
    torch.testing.assert_close(together, torch.cat(apart), atol=1e-14, rtol=0)


def test_half_and_half_is_the_mean_of_two_places() -> None:
    points = torch.tensor([[0.3, -0.2, 0.9]], dtype=torch.float64)
    weights = torch.zeros(1, 24, dtype=torch.float64)
    weights[0, [4, 7]] = 0.5
    moved = joint_transforms(random_rotations(7, 1), random_joints(8), PARENTS)
    single = [moved[0, j, :, :3] @ points[0] + moved[0, j, :, 3] for j in (4, 7)]
    torch.testing.assert_close(skin(points, weights, moved)[0, 0], (single[0] + single[1]) / 2, atol=1e-14, rtol=0)


def test_points_may_differ_within_a_batch() -> None:
    moved = joint_transforms(random_rotations(9), random_joints(10), PARENTS)
    weights = torch.softmax(torch.randn(5, 24, dtype=torch.float64), -1)
    points = torch.randn(2, 5, 3, dtype=torch.float64)
    apart = [skin(points[k], weights, moved[k : k + 1]) for k in range(2)]
    torch.testing.assert_close(skin(points, weights, moved), torch.cat(apart), atol=1e-14, rtol=0)


def test_pose_feature_is_row_major_and_leaves_the_root_out() -> None:
    rotations = torch.eye(3).expand(1, 24, 3, 3).clone()
    rotations[0, 0] += 5
    rotations[0, 2, 0, 1] = 7.0
    feature = pose_feature(rotations)
    assert feature.shape == (1, 207)
    assert feature[0].nonzero().flatten().tolist() == [9 + 1]


def test_float32_stays_float32() -> None:
    moved = joint_transforms(random_rotations(0).float(), random_joints(0).float(), PARENTS)
    world = world_transforms(moved, torch.eye(3).expand(2, 3, 3), torch.ones(2, 3))
    assert skin(torch.ones(4, 3), torch.full((4, 24), 1 / 24), world).dtype == torch.float32


def test_gradients_of_every_input() -> None:
    rest = random_joints(11).requires_grad_()
    poses = (0.5 * torch.randn(2, 24, 3, dtype=torch.float64)).requires_grad_()
    spin = torch.randn(2, 3, dtype=torch.float64).requires_grad_()
    shift = torch.randn(2, 3, dtype=torch.float64).requires_grad_()
    points = torch.randn(3, 3, dtype=torch.float64).requires_grad_()
    weights = torch.softmax(torch.randn(3, 24, dtype=torch.float64), -1).requires_grad_()

    def moved(*values: Tensor) -> Tensor:
        poses, rest, spin, shift, points, weights = values
        local = joint_transforms(exp_so3(poses), rest, PARENTS)
        return skin(points, weights, world_transforms(local, exp_so3(spin), shift))

    assert torch.autograd.gradcheck(moved, (poses, rest, spin, shift, points, weights))


axis_angle = st.tuples(*[st.floats(-3, 3)] * 3)


@settings(max_examples=40, deadline=None)
@given(root=axis_angle, spin=axis_angle, shift=axis_angle, seed=st.integers(0, 1000))
def test_turning_the_root_is_turning_the_person_about_the_pelvis(
    root: tuple[float, ...], spin: tuple[float, ...], shift: tuple[float, ...], seed: int
) -> None:
    """The posed body follows a rigid motion exactly, whether it is given to the root or to the world transform."""
    joints, rotations = random_joints(seed), random_rotations(seed, 1)
    Q = exp_so3(torch.tensor(root, dtype=torch.float64))
    plain = joint_transforms(rotations, joints, PARENTS)
    turned = rotations.clone()
    turned[0, 0] = Q @ rotations[0, 0]
    about_pelvis = world_transforms(plain, Q[None], (joints[0] - Q @ joints[0])[None])
    torch.testing.assert_close(joint_transforms(turned, joints, PARENTS), about_pelvis, atol=1e-11, rtol=0)
    R, Th = exp_so3(torch.tensor([spin], dtype=torch.float64)), torch.tensor([shift], dtype=torch.float64)
    points = torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    weights = torch.softmax(points @ points.new_ones(3, 24), -1)
    moved = skin(points, weights, world_transforms(plain, R, Th))
    torch.testing.assert_close(moved, skin(points, weights, plain) @ R.mT + Th, atol=1e-11, rtol=0)


@settings(max_examples=40, deadline=None)
@given(spin=axis_angle, shift=axis_angle, pelvis=axis_angle)
def test_the_two_conventions_are_inverse(
    spin: tuple[float, ...], shift: tuple[float, ...], pelvis: tuple[float, ...]
) -> None:
    Rh, Th, p0 = (torch.tensor(v, dtype=torch.float64) for v in (spin, shift, pelvis))
    back = smplx_to_easymocap(*easymocap_to_smplx(Rh, Th, p0), p0)
    torch.testing.assert_close(back[0], Rh)
    torch.testing.assert_close(back[1], Th, atol=1e-12, rtol=0)


def smplx_twin(path: Path) -> torch.nn.Module:
    """The smplx package's model of the same file, in float64."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the other package: deprecations that we cannot mend
        import smplx

        model: torch.nn.Module = smplx.SMPL(str(path), dtype=torch.float64)
        return model


def compare_with_smplx(path: Path, body: BodyModel, seed: int) -> None:
    """Vertices and joints agree in both conventions. Tolerance: smplx adds 1e-8 to the rotation vector before its
    norm, an angle error of up to 2e-8 rad a joint, and metres are of order 1; measured 1e-7."""
    rng = np.random.default_rng(seed)
    pose, shapes = rng.normal(0, 0.4, 72), rng.normal(0, 1, 10)
    pose[:3] = 0
    Rh, Th = rng.normal(0, 1, 3), rng.normal(0, 1, 3)
    pelvis = torch.from_numpy(body.rest_joints(shapes)[0])
    orient, transl = easymocap_to_smplx(torch.from_numpy(Rh), torch.from_numpy(Th), pelvis)
    with torch.no_grad():
        theirs = smplx_twin(path)(
            betas=torch.from_numpy(shapes)[None],
            body_pose=torch.from_numpy(pose[3:])[None],
            global_orient=orient[None],
            transl=transl[None],
        )
    np.testing.assert_allclose(posed_vertices(body, pose, Rh, Th, shapes), theirs.vertices[0], atol=1e-6)
    np.testing.assert_allclose(posed_joints(body, pose, Rh, Th, shapes), theirs.joints[0, :24], atol=1e-6)
    root = pose.copy()
    root[:3] = Rh  # the same state in smplx's convention: the root turns, the world only shifts
    np.testing.assert_allclose(
        posed_vertices(body, root, np.zeros(3), transl.numpy(), shapes), theirs.vertices[0], atol=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
def test_smplx_agrees_on_a_synthetic_body(tmp_path: Path, seed: int) -> None:
    arrays = smpl_arrays(seed, vertices=7000)  # smplx adds landmarks at vertex numbers of the real model
    path = write_pickle(tmp_path / "SMPL_NEUTRAL.pkl", arrays)
    compare_with_smplx(path, load_body(path), seed)


@pytest.mark.shared
def test_smplx_agrees_on_the_shared_body(tmp_path: Path) -> None:
    path = SHARED / "body" / "body_smpl.npz"
    if not path.is_file():
        pytest.skip("no shared/body beside the checkout")
    with np.load(path) as held:
        arrays = {key: held[key] for key in ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs")}
        arrays["posedirs"] = np.asarray(held["posedirs"], np.float64)
    compare_with_smplx(write_pickle(tmp_path / "SMPL_NEUTRAL.pkl", arrays), load_body(path), 5)
