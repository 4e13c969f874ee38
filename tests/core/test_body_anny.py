"""The free body: a person in SMPL's format, whose joints come back from its surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rsavatar.body.anny import anny_body, draw_phenotypes, load_converter
from rsavatar.body.base import Array, BodyModel, Indices
from rsavatar.body.find import find_body
from rsavatar.body.skinning import posed_joints, posed_vertices
from rsavatar.body.thin import thinned

PELVIS, LEFT_HIP, RIGHT_HIP, HEAD, LEFT_ELBOW = 0, 1, 2, 15, 18


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return anny_body()


def volume(vertices: Array, faces: Indices) -> float:
    """Of a closed surface that faces outward, by the divergence theorem."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def test_the_body_is_a_person_in_a_t_pose(body: BodyModel) -> None:
    joints = body.rest_joints(np.zeros(10))
    assert 1.5 < np.ptp(body.v_template[:, 1]) < 2.0  # y up, metres
    assert joints[LEFT_HIP, 0] > 0 > joints[RIGHT_HIP, 0]  # x to the left
    assert joints[10, 2] > joints[7, 2]  # toes before ankles: facing +z
    arms = joints[[16, 18, 20, 22]]
    np.testing.assert_allclose(arms[:, 1], arms[0, 1], atol=0.005)
    np.testing.assert_allclose(np.ptp(arms[:, 2]), 0, atol=0.005)
    assert body.pose_directions is None
    assert 0.04 < volume(body.v_template, body.faces) < 0.12  # cubic metres; a grown-up has about 0.07


def test_left_and_right_mirror_each_other(body: BodyModel) -> None:
    joints = body.joint_template
    for left, right in ((1, 2), (4, 5), (7, 8), (10, 11), (13, 14), (16, 17), (18, 19), (20, 21), (22, 23)):
        np.testing.assert_allclose(joints[left], joints[right] * [-1, 1, 1], atol=0.002)


def test_shape_coefficients_are_ordered_and_change_the_build(body: BodyModel) -> None:
    spread = np.sqrt((body.shape_directions**2).sum((0, 1)) / body.vertices)
    assert (np.diff(spread) < 0).all()
    assert spread[0] > 0.03  # metres, root mean square over the surface for one standard deviation


def test_a_raised_arm_moves_the_hand_and_not_the_feet(body: BodyModel) -> None:
    pose, zero = np.zeros(72), np.zeros(3)
    pose[3 * LEFT_ELBOW + 2] = 1.0
    rest, bent = (posed_vertices(body, p, zero, zero, np.zeros(10)) for p in (np.zeros(72), pose))
    feet = body.weights[:, [7, 8, 10, 11]].sum(1) > 0.5
    hand = body.weights[:, 22] > 0.5
    np.testing.assert_allclose(bent[feet], rest[feet], atol=1e-12)
    assert (bent[hand, 1] - rest[hand, 1]).min() > 0.1
    np.testing.assert_allclose(
        posed_joints(body, pose, zero, zero, np.zeros(10))[:18], body.joint_template[:18], atol=1e-12
    )


def test_the_regressor_finds_the_joints_of_people_it_has_not_seen(body: BodyModel) -> None:
    """Measured: mean 2.8 mm, largest 28 mm (a knee of an extreme build). The bounds leave room for rounding only."""
    unseen = load_converter().persons(draw_phenotypes(40, seed=77))
    found = np.einsum("jv,svd->sjd", body.joint_regressor, unseen.vertices)
    error = 1000 * np.linalg.norm(found - unseen.joints, axis=-1)
    assert error.mean() < 3.5
    assert error.max() < 35
    residual = (unseen.vertices - body.v_template).reshape(40, -1)
    directions = body.shape_directions.reshape(-1, 10)
    residual -= residual @ np.linalg.pinv(directions).T @ directions.T
    assert 1000 * np.sqrt((residual**2).sum(1) / body.vertices).mean() < 2.5  # measured 1.5 mm


def test_the_cache_is_used_and_moves_with_the_environment(
    body: BodyModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RSAVATAR_CACHE", str(tmp_path))
    monkeypatch.setattr("rsavatar.body.anny.convert", lambda: body)
    assert anny_body().sha256 == body.sha256
    monkeypatch.setattr("rsavatar.body.anny.convert", None)
    found, why = find_body("auto", None)
    assert found.sha256 == body.sha256
    assert found.name == "anny"
    assert "free default" in why
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]


def sphere(rings: int, sides: int) -> tuple[Array, Indices]:
    """A closed sphere of latitude rings."""
    theta = np.pi * np.arange(1, rings) / rings
    phi = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack(
        [
            np.outer(np.sin(theta), np.cos(phi)),
            np.outer(np.sin(theta), np.sin(phi)),
            np.outer(np.cos(theta), np.ones(sides)),
        ],
        -1,
    )
    points = np.concatenate([[[0, 0, 1.0]], ring.reshape(-1, 3), [[0, 0, -1.0]]])
    faces = []
    for k in range(sides):
        n = (k + 1) % sides
        faces.append((0, 1 + k, 1 + n))
        for r in range(rings - 2):
            a, b = 1 + r * sides, 1 + (r + 1) * sides
            faces += [(a + k, b + k, b + n), (a + k, b + n, a + n)]
        last = 1 + (rings - 2) * sides
        faces.append((last + n, last + k, len(points) - 1))
    return points, np.array(faces)


def test_thinning_keeps_the_surface_closed_and_its_volume() -> None:
    points, faces = sphere(16, 24)
    kept, fewer = thinned(points, faces, 150)
    assert len(kept) == 150
    edges = np.sort(np.concatenate([fewer[:, [0, 1]], fewer[:, [1, 2]], fewer[:, [2, 0]]]), 1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    assert len(kept) - len(unique) + len(fewer) == 2  # Euler's number of a sphere
    before, after = volume(points, faces), volume(points[kept], fewer)
    assert 0.93 * before < after < before  # vertices of a sphere's subset span a smaller hull


def test_thinning_a_flat_sheet_keeps_its_border() -> None:
    side = 12
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1).astype(np.float64)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + side], 1), np.stack([corner + 1, corner + side + 1, corner + side], 1)]
    )
    kept, fewer = thinned(points, faces, 60)
    border = np.flatnonzero((x.ravel() % (side - 1) == 0) | (y.ravel() % (side - 1) == 0))
    assert set(border) <= set(kept)
    a, b, c = (points[kept][fewer[:, k], :2] for k in range(3))
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (area > 0).all()
    np.testing.assert_allclose(area.sum(), (side - 1) ** 2, rtol=1e-12)
