"""The studio subject: an exact renderer, an exact clock, and a folder that the ordinary loader reads."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rsavatar.body.skinning import posed_vertices
from rsavatar.data import studio
from rsavatar.data.base import Array
from rsavatar.data.build import Settings
from rsavatar.data.build import build as build_rs
from rsavatar.data.build_plan import Clock
from rsavatar.data.footage_sources import open_footage
from rsavatar.data.rolling import load
from rsavatar.data.studio import Shoot, build, shoot
from rsavatar.data.studio_motion import STYLES, bones, pose_meshes, skinning_table
from rsavatar.data.studio_paint import drawn_wardrobe
from rsavatar.data.studio_render import Indices, Paint, Strip, draw
from rsavatar.data.studio_stage import TRAINING, Stage, image_motion, row_times, set_stage
from rsavatar.errors import DataError
from rsavatar.events import Event
from rsavatar.geometry.cameras import Camera

SIZE, FRAMES = 48, 2


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("studio") / "tiny", size=SIZE, frames=FRAMES)


@pytest.fixture(scope="module")
def stage() -> Stage:
    return set_stage(0, SIZE)


def straight_camera(size: int = 8, focal: float = 8.0) -> Camera:
    """At the origin, looking along z; the image plane spans [-1, 1] at depth 2 focal / size."""
    return Camera(np.eye(3), np.zeros(3), focal, focal, size / 2, size / 2, size, size)


def by_triangle(colours: Array) -> Paint:
    """A paint that gives each triangle one colour."""
    return lambda triangles, weights: colours[triangles]


def test_a_rectangle_covers_exactly_its_pixels() -> None:
    """Corners on pixel borders: columns [2, 6), rows [1, 5); at depth 1 and focal length 8, a pixel is 1/8 m."""
    x0, x1, y0, y1 = -2 / 8, 2 / 8, -3 / 8, 1 / 8
    points = np.array([[x0, y0, 1], [x1, y0, 1], [x1, y1, 1], [x0, y1, 1.0]])
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    rgb, coverage = draw([Strip(0, 8, points)], faces, straight_camera(), by_triangle(np.ones((2, 3))))
    wanted = np.zeros((8, 8), np.uint8)
    wanted[1:5, 2:6] = 255
    np.testing.assert_array_equal(coverage, wanted)
    np.testing.assert_array_equal(rgb, np.repeat(wanted[..., None], 3, 2))


def test_half_covered_pixels_are_half() -> None:
    points = np.array([[-0.5 / 8, -1, 1], [1, -1, 1], [1, 1, 1], [-0.5 / 8, 1, 1.0]])
    _, coverage = draw(
        [Strip(0, 8, points)], np.array([[0, 2, 1], [0, 3, 2]]), straight_camera(), by_triangle(np.ones((2, 3))), 4
    )
    assert set(coverage[:, 3].tolist()) == {128}
    assert set(coverage[:, 4].tolist()) == {255}
    assert not coverage[:, :3].any()


def test_the_nearer_triangle_wins_even_where_two_cross() -> None:
    """Two planes z = 1 + x and z = 1 - x cross at x = 0: each is seen on the side where it is nearer."""
    points = np.array(
        [[x, y, 1 + slope * x] for slope in (1.0, -1.0) for x, y in ((-0.4, -0.4), (0.4, -0.4), (0.0, 0.9))]
    )
    faces = np.array([[0, 2, 1], [3, 5, 4]])
    rgb, _ = draw([Strip(0, 8, points)], faces, straight_camera(), by_triangle(np.eye(3)[:2]))
    assert (rgb[3, 2:4] == [255, 0, 0]).all()
    assert (rgb[3, 4:6] == [0, 255, 0]).all()


def test_the_back_of_a_surface_is_not_drawn() -> None:
    points = np.array([[-1, -1, 1], [1, -1, 1], [0, 1, 1.0]])
    _, front = draw([Strip(0, 8, points)], np.array([[0, 2, 1]]), straight_camera(), by_triangle(np.ones((1, 3))))
    _, back = draw([Strip(0, 8, points)], np.array([[0, 1, 2]]), straight_camera(), by_triangle(np.ones((1, 3))))
    assert front.any()
    assert not back.any()


def test_colours_are_interpolated_in_perspective() -> None:
    """On a slanted plane the place on the surface, not on the image, decides: weights reproduce the ray's hit point."""
    points = np.array([[-1, -1, 1], [3, -1, 3], [-1, 3, 3.0]])
    seen: list[Array] = []

    def paint(triangles: Indices, weights: Array) -> Array:
        seen.append(weights @ points)
        return np.ones((len(triangles), 3))

    draw([Strip(0, 8, points)], np.array([[0, 2, 1]]), straight_camera(), paint, 1)
    hit = seen[0]
    pixels = straight_camera().project(hit)[0]
    np.testing.assert_allclose(pixels % 1, 0.5, atol=1e-9)  # every hit projects onto its pixel's centre
    np.testing.assert_allclose(hit[:, 0] + hit[:, 1] - 2 * hit[:, 2], -4, atol=1e-9)  # and lies on the plane


def test_posing_equals_the_bodys_own_skinning(stage: Stage) -> None:
    states = stage.motion.at(np.array([3.0, 17.5]))
    meshes = pose_meshes(stage.table, bones(stage.body, states)[0])
    for k in range(2):
        wanted = posed_vertices(stage.body, states.poses[k], states.Rh[k], states.Th[k], states.shapes)
        np.testing.assert_allclose(meshes[k], wanted, atol=1e-12)
    rest = stage.body.shaped(states.shapes)
    assert skinning_table(rest, stage.body.weights).shape == (stage.body.vertices, 96)


def test_without_readout_every_row_sees_the_sharp_picture(stage: Stage) -> None:
    camera = stage.cameras[0]
    still = stage.picture(camera, row_times(16.0, 0.0, SIZE))
    sharp = stage.picture(camera, np.full(SIZE, 16.0))
    for a, b in zip(still, sharp, strict=True):
        np.testing.assert_array_equal(a, b)


def test_each_row_is_the_row_of_a_sharp_picture_at_its_own_time(stage: Stage) -> None:
    """The definition of a rolling shutter, bit for bit, on rows from head to foot."""
    camera, times = stage.cameras[2], row_times(27.0, 11.0, SIZE)
    rolling = stage.picture(camera, times)
    for v in range(8, SIZE, 6):
        sharp = stage.picture(camera, np.full(SIZE, times[v]))
        np.testing.assert_array_equal(rolling[0][v], sharp[0][v])
        np.testing.assert_array_equal(rolling[1][v], sharp[1][v])
    assert times[SIZE // 2] == 27.0


def test_the_loader_reads_it(root: Path) -> None:
    subject = load(root)
    assert subject.frames == FRAMES
    assert subject.training == ("00", "02", "04", "06")
    assert subject.held_out == ("01", "03", "05", "07")
    assert subject.body == root / "body.npz"
    assert subject.timing.readout_frames == 11.0
    assert subject.timing.mid_frames.tolist() == [16.0, 27.0]
    rgb, coverage = subject.observe("02", 1)
    assert rgb.shape == (SIZE, SIZE, 3)
    assert 0.03 < coverage.mean() / 255 < 0.3
    assert not rgb[coverage == 0].any()
    camera = subject.cameras["00"]
    assert 2 < np.linalg.norm(camera.centre) < 4  # metres: millimetres would be thousands


def test_the_truth_lies_in_the_sharp_pictures(root: Path) -> None:
    subject = load(root)
    assert subject.motion is not None
    for name in (*subject.training, *subject.held_out):
        for n in range(FRAMES):
            pixels, _ = subject.cameras[name].project(subject.motion.mid_joints[n])
            column, row = np.floor(pixels).astype(int).T
            assert (subject.truth(name, n)[1][row, column] > 0).mean() > 0.9  # a joint may lie near the outline
    assert subject.motion.sub_poses.shape == (FRAMES, 89, 72)
    np.testing.assert_allclose(subject.motion.sub_joints[:, 44], subject.motion.mid_joints, atol=1e-12)


def test_the_first_fit_is_near_and_noisy(root: Path) -> None:
    meta = json.loads((root / "meta.json").read_text(encoding="utf-8"))
    assert 10 < meta["init_error"]["joint_mm"] < 80
    fit = load(root).fit
    assert not fit.poses[:, :3].any()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_motion_is_large_and_no_cubic(seed: int) -> None:
    stage = set_stage(seed, 256)
    mids = np.arange(1.0, 15.0) * 11 + 5
    assert 20 < image_motion(stage, mids, 11.0).max() < 45  # pixels at 256
    times = np.linspace(0, 88, 89)  # eight frame periods
    angle = stage.motion.at(times).poses
    cubic = np.polynomial.polynomial.polyfit(times, angle, 3)
    misfit = angle - np.polynomial.polynomial.polyval(times, cubic).T
    assert np.degrees(np.abs(misfit).max()) > 3


def test_building_twice_is_building_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studio, "set_stage", None)
    assert build(root, size=SIZE, frames=FRAMES) == root
    with pytest.raises(DataError, match="something else"):
        build(root, size=SIZE, frames=FRAMES + 1)
    with pytest.raises(DataError, match="at least 1"):
        build(root / "x", frames=0)


def test_the_same_seed_gives_the_same_files(root: Path, tmp_path: Path) -> None:
    heard: list[Event] = []
    again = build(tmp_path / "again", size=SIZE, frames=FRAMES, report=heard.append)
    assert len(heard) == FRAMES
    names = sorted(path.relative_to(root) for path in root.rglob("*.png"))
    assert len(names) == 2 * FRAMES * (len(TRAINING) + 8)
    assert all((root / name).read_bytes() == (again / name).read_bytes() for name in names)
    assert load(root).fit.poses.tobytes() == load(again).fit.poses.tobytes()


def test_a_failed_build_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(studio, "_write_meta", fail)
    with pytest.raises(OSError, match="disk full"):
        build(tmp_path / "s", size=16, frames=1)
    assert list(tmp_path.iterdir()) == []


def test_the_cached_subject_is_built_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[Path] = []

    def note(out: Path, wanted: Shoot) -> Path:
        built.append(out)
        return out

    monkeypatch.setenv("RSAVATAR_CACHE", str(tmp_path))
    monkeypatch.setattr(studio, "shoot", note)
    assert studio.studio_subject_dir().name == "studio"
    assert studio.studio_subject_dir(2).name == "studio-2"
    assert all(tmp_path in path.parents for path in built)


@pytest.mark.parametrize("style", STYLES[3:])
def test_other_motions_are_as_large(style: str) -> None:
    stage = set_stage(3, 256, style, drawn_clothes=True)
    assert stage.motion.style == style
    assert 20 < image_motion(stage, np.arange(1.0, 15.0) * 11 + 5, 11.0).max() < 45


def test_drawn_clothes_are_a_seeds_own() -> None:
    drawn = [drawn_wardrobe(seed) for seed in range(6)]
    assert len({wardrobe.shirt for wardrobe in drawn}) == 6
    assert drawn_wardrobe(4) == drawn[4]
    for wardrobe in drawn:
        colours = [wardrobe.skin, wardrobe.hair, wardrobe.shirt, wardrobe.stripe, wardrobe.trousers, wardrobe.shoes]
        assert all(0 <= part <= 1 for colour in colours for part in colour)


def test_every_shutter_is_exact(tmp_path: Path) -> None:
    """Another K, gamma, motion, clothes and triggers: rows of a triggered camera are rows of sharp pictures."""
    wanted = Shoot(5, SIZE, 1, gamma=0.6, period=7, motion="punch", clothes="drawn", triggers="random")
    subject = load(shoot(tmp_path / "s", wanted))
    stage, mid = set_stage(5, SIZE, "punch", drawn_clothes=True), 10.0
    late = subject.timing.trigger("02")
    assert 0 < abs(late) <= 7 / 4
    assert subject.timing.trigger("01") == 0  # held-out cameras show the mid frame itself
    assert (subject.timing.readout_frames, subject.timing.mid_frames.tolist()) == (pytest.approx(4.2), [mid])
    times = mid + late + 4.2 * (np.arange(SIZE) / SIZE - 0.5)
    np.testing.assert_array_equal(subject.observe("02", 0)[0], stage.picture(stage.cameras[2], times)[0])
    sharp = stage.picture(stage.cameras[2], np.full(SIZE, mid + late))[0]
    np.testing.assert_array_equal(subject.truth("02", 0)[0], sharp)
    assert shoot(tmp_path / "s", wanted) == tmp_path / "s"
    with pytest.raises(DataError, match="something else"):
        shoot(tmp_path / "s", replace(wanted, triggers="0"))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"motion": "fly"}, "one of wave"),
        ({"size": 0}, "size at least 1"),
        ({"size": 9999}, "4096"),
        ({"seed": -1}, "seed"),
    ],
)
def test_impossible_studios(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        Shoot(**wrong)


def test_the_source_builds_to_nearly_the_same_subject(tmp_path: Path) -> None:
    """Sharp frames and the builder against rows drawn at their own instants: the whole benchmark without any data."""
    root = shoot(tmp_path / "s", Shoot(1, 96, 2, period=5, source=True))
    footage = open_footage(root / "source")
    assert (footage.length, footage.train, footage.test) == (16, ("00", "02", "04", "06"), ("01", "03", "05", "07"))
    errors = {}
    for name in ("flow", "copy"):
        made = build_rs(footage, tmp_path / name, Settings(Clock(5), name), {}, 1)
        built, exact = load(made), load(root)
        assert built.timing.mid_frames.tolist() == exact.timing.mid_frames.tolist()
        differences = []
        for camera in exact.training:
            rgb, mask = exact.observe(camera, 1)
            off = built.observe(camera, 1)[0].astype(float) - rgb
            differences.append(np.mean(off[mask > 0] ** 2))
            np.testing.assert_array_equal(built.truth(camera, 1)[0], exact.truth(camera, 1)[0])
        errors[name] = 10 * np.log10(255**2 / np.mean(differences))
    assert errors["flow"] > errors["copy"] + 2
    assert errors["flow"] > 30
