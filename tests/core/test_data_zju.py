"""ZJU-MoCap layouts and EasyMocap's files."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rsavatar.body.skinning import posed_vertices
from rsavatar.data.catalogue import open_subject
from rsavatar.data.easymocap import SmplxFit, from_smplx, read_calibrations, read_frames, to_smplx
from rsavatar.data.zju import load
from rsavatar.errors import DataError
from tests.core.subject_files import FRAMES, edit, figure, matrix, motion, ring, write_zju


@pytest.mark.parametrize("original", [False, True])
def test_both_layouts_give_the_same_subject(tmp_path: Path, original: bool) -> None:
    files = write_zju(tmp_path / "figure", original)
    subject = open_subject("figure", files.root)
    assert subject.training == ("04", "10", "16", "22")
    assert subject.held_out == ("00", "13")
    assert list(subject.timing.mid_frames) == list(range(FRAMES))
    assert (subject.timing.readout_frames, subject.timing.period_frames) == (0, 1)
    points = np.random.default_rng(0).normal([0, 0, 1], 0.3, (50, 3))
    R, T = ring(10)
    theirs = cv2.projectPoints(points, cv2.Rodrigues(R)[0], T, matrix(), None)[0][:, 0]
    np.testing.assert_allclose(subject.cameras["10"].project(points)[0], theirs + 0.5, atol=1e-9)
    colours, mask = subject.observe("10", 3)
    assert set(np.unique(mask)) == {0, 255}
    assert not colours[mask == 0].any()
    assert np.array_equal(subject.truth("10", 3)[0], colours)


def test_frames_are_those_with_a_fit(tmp_path: Path) -> None:
    root = write_zju(tmp_path / "figure").root
    (root / "smpl_params/0.npy").unlink()
    subject = load(root)
    assert list(subject.timing.mid_frames) == [1, 2, 3, 4]
    (root / "images/13/000004.jpg").unlink()
    with pytest.raises(DataError, match="images/13/000004"):
        load(root)


def test_numbers_in_the_fifth_field(tmp_path: Path) -> None:
    root = write_zju(tmp_path / "figure", original=True).root
    for path in [*root.glob("Camera_B*/*.jpg"), *root.glob("mask_cihp/*/*.png")]:
        number = int(path.parent.name.removeprefix("Camera_B"))
        folder = path.parent.with_name(f"Camera ({number})")
        folder.mkdir(exist_ok=True)
        path.rename(folder / f"a_b_c_d_{path.stem[2:]}_e{path.suffix}")
    for path in [*root.glob("Camera_B*"), *root.glob("mask_cihp/Camera_B*")]:
        path.rmdir()
    assert open_subject("figure", root).training == ("04", "10", "16", "22")


def test_no_training_camera_no_masks(tmp_path: Path) -> None:
    root = write_zju(tmp_path / "figure").root
    for name in ("04", "10", "16", "22"):
        (root / "images" / name).rename(tmp_path / name)
    with pytest.raises(DataError, match="at least one of 04"):
        load(root)
    (root / "mask").rename(tmp_path / "mask")
    with pytest.raises(DataError, match="mask or mask_cihp"):
        load(root)


def test_a_synthetic_sequence_states_its_pixel_centre(tmp_path: Path) -> None:
    root = write_zju(tmp_path / "figure").root
    assert load(root).cameras["04"].cx == pytest.approx(matrix()[0, 2] + 0.5)
    (tmp_path / "meta.json").write_text(json.dumps({"pixel_centre": 0.5}))
    assert load(root).cameras["04"].cx == pytest.approx(matrix()[0, 2])
    assert load(root, pixel_centre=0.0).cameras["04"].cx == pytest.approx(matrix()[0, 2] + 0.5)


def test_damaged_calibrations_are_named(tmp_path: Path) -> None:
    root = write_zju(tmp_path / "figure").root
    edit(root / "annots.npy", lambda annots: annots["cams"]["T"].pop())
    with pytest.raises(DataError, match="of one length"):
        load(root)
    edit(root / "annots.npy", lambda annots: annots.pop("cams"))
    with pytest.raises(DataError, match=r"annots\.npy cams"):
        load(root)


@pytest.mark.parametrize("wrapped", [False, True])
@pytest.mark.parametrize("numbers", [69, 72])
def test_easymocap_frames(tmp_path: Path, wrapped: bool, numbers: int) -> None:
    poses, Rh, Th = motion()
    for n in range(FRAMES):
        person = {"id": 7, "Rh": Rh[n : n + 1].tolist(), "Th": Th[n : n + 1].tolist(), "shapes": [[0.5] * 10]}
        person["poses"] = poses[n : n + 1, 72 - numbers :].tolist()
        held = [{**person, "id": 8}, person]
        (tmp_path / f"{n:06d}.json").write_text(json.dumps({"annots": held} if wrapped else held))
    paths = sorted(tmp_path.glob("*.json"))
    fit = read_frames(paths, person=7)
    assert np.array_equal(fit.poses, poses)
    assert np.array_equal(fit.Th, Th)
    assert np.array_equal(fit.shapes, np.full(10, 0.5))
    with pytest.raises(DataError, match=r"one person.*\[8, 7\]"):
        read_frames(paths)


def test_easymocap_frames_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{")
    (tmp_path / "b.json").write_text('{"annots": 3}')
    for name, message in (("a", "a JSON file"), ("b", "list of persons"), ("c", "a JSON file")):
        with pytest.raises(DataError, match=message):
            read_frames([tmp_path / f"{name}.json"])


def test_smplx_turns_about_the_pelvis() -> None:
    """Definition: x_world = R (x - p0) + p0 + transl for every vertex; and back."""
    model = figure()
    poses, Rh, Th = motion()
    pelvis = model.rest_joints(np.zeros(10))[0]
    fit = from_smplx(SmplxFit(Rh, poses[:, 3:], Th, np.zeros(10)), pelvis)
    ours = posed_vertices(model, fit.poses[2], fit.Rh[2], fit.Th[2], fit.shapes)
    local = posed_vertices(model, poses[2], np.zeros(3), np.zeros(3), np.zeros(10))
    np.testing.assert_allclose(ours, (local - pelvis) @ cv2.Rodrigues(Rh[2])[0].T + pelvis + Th[2], atol=1e-12)
    back = to_smplx(fit, pelvis)
    np.testing.assert_allclose(back.transl, Th, atol=1e-12)
    np.testing.assert_allclose(back.global_orient, Rh, atol=1e-12)


@pytest.mark.parametrize("as_vector", [False, True])
def test_easymocap_cameras(tmp_path: Path, as_vector: bool) -> None:
    inner = cv2.FileStorage(str(tmp_path / "intri.yml"), cv2.FILE_STORAGE_WRITE)
    outer = cv2.FileStorage(str(tmp_path / "extri.yml"), cv2.FILE_STORAGE_WRITE)
    for storage in (inner, outer):
        storage.startWriteStruct("names", cv2.FileNode_SEQ)
        for name in ("B1", "B2"):
            storage.write("", name)
        storage.endWriteStruct()
    for index, name in enumerate(("B1", "B2")):
        R, T = ring(index)
        inner.write(f"K_{name}", matrix())
        inner.write(f"dist_{name}", np.array([[-0.2, 0.03, 0, 0, 0.1]]))
        outer.write(*((f"R_{name}", cv2.Rodrigues(R)[0]) if as_vector else (f"Rot_{name}", R)))
        outer.write(f"T_{name}", T[:, None])
    inner.release()
    outer.release()
    found = read_calibrations(tmp_path / "intri.yml", tmp_path / "extri.yml")
    assert list(found) == ["B1", "B2"]
    np.testing.assert_allclose(found["B2"].rotation, ring(1)[0], atol=1e-9)
    np.testing.assert_allclose(found["B2"].camera((64, 64), 0.0).centre, -ring(1)[0].T @ ring(1)[1], atol=1e-9)
    assert found["B1"].distortion[0] == -0.2
    with pytest.raises(DataError, match="nothing there"):
        read_calibrations(tmp_path / "none.yml", tmp_path / "extri.yml")
