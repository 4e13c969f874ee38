"""Sound data are called sound; each classic mistake is named."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from rsavatar.data.check import Report, check, render
from rsavatar.data.silhouettes import silhouette, target_of
from rsavatar.geometry.cameras import Camera
from tests.core.subject_files import FRAMES, SIZE, TRAIN, edit, figure, write_rolling, write_zju

SHARED = Path(__file__).resolve().parents[2].parent / "shared"


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rolling(tmp_path_factory.mktemp("data") / "figure").root


@pytest.fixture
def root(sound: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "figure"))


def told(report: Report) -> list[str]:
    return [finding.what for finding in report.findings if finding.severity != "ok"]


def each_fit(root: Path, change: Callable[[Any], object]) -> None:
    for path in (root / "rs/new_params").iterdir():
        edit(path, change)


def test_sound_subjects(sound: Path, tmp_path: Path) -> None:
    roots = [sound, write_zju(tmp_path / "refined").root]
    for each in roots:
        report = check(each)
        assert report.ok, render(report)
        assert "fit for use: 0 errors" in render(report)
    assert told(check(sound)) == []
    assert told(check(roots[1])) == ["cameras"]  # most of the 23 have no folder: said, not refused


def test_metres_for_millimetres(root: Path) -> None:
    def change(annots: Any) -> None:
        annots["cams"]["T"] = [T / 1000 for T in annots["cams"]["T"]]

    edit(root / "rs/annots.npy", change)
    report = check(root)
    assert not report.ok
    assert {"camera positions", "T of the cameras is in metres"} <= set(told(report))
    assert "multiply T by 1000" in render(report)


def test_millimetres_for_metres(root: Path) -> None:
    each_fit(root, lambda fit: fit.update(Th=fit["Th"] * 1000))
    assert "Th of the fits is in millimetres" in told(check(root))


def test_transposed_rotations(root: Path) -> None:
    def change(annots: Any) -> None:
        annots["cams"]["R"] = [R.T for R in annots["cams"]["R"]]

    edit(root / "rs/annots.npy", change)
    report = check(root)
    assert not report.ok
    assert "R of the cameras is transposed" in told(report)


def test_poses_of_the_cameras_for_extrinsics(root: Path) -> None:
    def change(annots: Any) -> None:
        cams = annots["cams"]
        cams["T"] = [-R.T @ T for R, T in zip(cams["R"], cams["T"], strict=True)]
        cams["R"] = [R.T for R in cams["R"]]

    edit(root / "rs/annots.npy", change)
    assert "R, T are the camera's pose in the world" in told(check(root))


def test_smplx_values_under_easymocap_names(root: Path) -> None:
    pelvis = figure().rest_joints(np.zeros(10))[0]

    def change(fit: Any) -> None:
        fit["Th"] = fit["Th"] + pelvis @ cv2.Rodrigues(fit["Rh"])[0].T - pelvis

    each_fit(root, change)
    report = check(root)
    assert "Rh, Th are smplx's global_orient, transl" in told(report)
    assert "turns about the pelvis" in render(report)


@pytest.mark.parametrize(("shift", "what"), [(1, "one too high"), (-1, "one too low")])
def test_fits_numbered_off_by_one(root: Path, shift: int, what: str) -> None:
    folder = root / "rs/new_params"
    held = [(folder / f"{n}.npy").read_bytes() for n in range(FRAMES)]
    for n in range(FRAMES):
        (folder / f"{n}.npy").write_bytes(held[min(max(n - shift, 0), FRAMES - 1)])
    assert f"fits are numbered {what}" in told(check(root))


def test_images_resized_without_their_matrix(root: Path) -> None:
    for path in (root / "rs").rglob("*.png"):
        with Image.open(path) as picture:
            picture.resize((SIZE // 2, SIZE // 2), Image.Resampling.NEAREST).save(path)
    assert "K belongs to images of another size" in told(check(root))


def test_fits_without_pose_blend_shapes(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure", drawn=replace(figure(), pose_directions=None)).root
    assert "fits were made without pose blend shapes" in told(check(root))


def test_distortion_applied_twice(root: Path) -> None:
    def change(annots: Any) -> None:
        annots["cams"]["D"] = [np.array([[-0.5, 0.3, 0, 0, 0]]).T] * 23

    edit(root / "rs/annots.npy", change)
    assert "images are undistorted already" in told(check(root))


def test_one_camera_that_shows_something_else(root: Path) -> None:
    for folder in ("images", "mask"):
        for path in (root / "rs" / folder / "16").iterdir():
            with Image.open(path) as picture:
                picture.transpose(Image.Transpose.FLIP_TOP_BOTTOM).save(path)
    report = check(root)
    assert any(finding.what == "cameras" and "16" in finding.got for finding in report.of("error")), render(report)


@pytest.mark.parametrize(("value", "message"), [(0, "empty"), (255, "more than 90 % covered")])
def test_empty_and_full_masks(root: Path, value: int, message: str) -> None:
    for camera in TRAIN:
        for path in (root / "rs/mask" / f"{camera:02d}").iterdir():
            Image.new("L", (SIZE, SIZE), value).save(path)
    report = check(root)
    assert not report.ok
    assert message in render(report)


@pytest.mark.parametrize(
    ("change", "what", "ok"),
    [
        ({"gamma": 1.4}, "readout", False),
        ({"mid": [16, 27, 27, 49, 60]}, "mid", False),
        ({"mid": [16, 27, 40, 49, 60]}, "mid", True),
        ({"delta": [20.0] * 23}, "triggers", True),
    ],
)
def test_timing(root: Path, change: dict[str, Any], what: str, ok: bool) -> None:
    edit(root / "meta.json", lambda meta: meta.update(change))
    report = check(root)
    assert told(report) == [what]
    assert report.ok is ok


def test_a_jump_of_the_fit(root: Path) -> None:
    edit(root / "rs/new_params/2.npy", lambda fit: fit.update(Rh=fit["Rh"] + 2.5))
    report = check(root)
    assert "fit jumps" in told(report)
    assert "frame 2" in render(report)


@pytest.mark.parametrize("path", ["rs/images/04/000000.png", "rs/gt_mask/13/000004.png"])
def test_truncated_images_are_found_wherever_they_are(root: Path, path: str) -> None:
    (root / path).write_bytes((root / path).read_bytes()[:-20])
    report = check(root)
    assert not report.ok
    assert path in render(report)


def test_what_cannot_be_read_is_a_finding(root: Path, tmp_path: Path) -> None:
    (root / "rs/images/04/000000.png").unlink()
    report = check(root)
    assert not report.ok
    assert "images/04/000000.png: nothing there" in render(report)
    assert not check(tmp_path / "none").ok


def test_the_silhouette_of_a_square() -> None:
    """Closed form: a square of 1 m at 2 m, f = 20 px, covers [11, 21) x [5, 15): 100 pixels."""
    camera = Camera(np.eye(3), np.zeros(3), 20.0, 20.0, 16.0, 10.0, 20, 32)
    corners = np.array([[-0.5, -0.5, 2], [0.45, -0.5, 2], [0.45, 0.45, 2], [-0.5, 0.45, 2]])
    pixels, depth = camera.project(corners)
    drawn = silhouette(camera, pixels, depth > 0, np.array([[0, 1, 2], [0, 2, 3]]))
    wanted = np.zeros((20, 32), bool)
    wanted[5:15, 11:21] = True
    assert np.array_equal(drawn, wanted)
    assert np.array_equal(target_of(camera, drawn.astype(np.uint8)).mask, wanted)


@pytest.mark.shared
@pytest.mark.parametrize("name", ["wave", "sword", "walk", "wash1024"])
def test_sample_subjects_are_sound(name: str) -> None:
    body = SHARED / "body" / "body_smpl.npz"
    if not (SHARED / "subjects" / name).is_dir() or not body.is_file():
        pytest.skip(f"no sample subject {SHARED / 'subjects' / name}, or no body {body}")
    report = check(SHARED / "subjects" / name, str(body))
    assert told(report) == [], render(report)


@pytest.mark.shared
@pytest.mark.parametrize(("name", "shift", "what"), [("wave", 1, "one too high"), ("walk", -1, "one too low")])
def test_sample_subjects_with_fits_off_by_one(tmp_path: Path, name: str, shift: int, what: str) -> None:
    """On noisy fits that are biased by the shutter, too: the pictures are linked, the fits renumbered."""
    given, body = SHARED / "subjects" / name, SHARED / "body" / "body_smpl.npz"
    if not given.is_dir() or not body.is_file():
        pytest.skip(f"no sample subject {given}, or no body {body}")
    fits = tmp_path / "rs" / "new_params"
    fits.mkdir(parents=True)
    for path in ("meta.json", "rs/annots.npy", "rs/images", "rs/mask", "rs/gt", "rs/gt_mask"):
        (tmp_path / path).symlink_to(given / path)
    for n in range(24):
        shutil.copy(given / f"rs/new_params/{(n - shift) % 24}.npy", fits / f"{n}.npy")
    assert f"fits are numbered {what}" in told(check(tmp_path, str(body)))
