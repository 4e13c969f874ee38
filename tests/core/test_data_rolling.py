"""Rolling-shutter subjects: what is read, in which convention, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from rsavatar.data.catalogue import open_subject
from rsavatar.data.rolling import load
from rsavatar.errors import DataError
from tests.core.subject_files import FRAMES, SIZE, TRAIN, edit, load_object, matrix, ring, write_rolling

SUBJECTS = Path(__file__).resolve().parents[2].parent / "shared" / "subjects"
NAMES = ("wave", "sword", "walk", "wash1024")


def test_everything_is_there(tmp_path: Path) -> None:
    files = write_rolling(tmp_path / "figure")
    subject = open_subject("figure", files.root)
    assert subject.frames == FRAMES
    assert subject.training == ("04", "10", "16", "22")
    assert subject.held_out == ("00", "13")
    assert "03" not in subject.cameras
    assert subject.timing.readout_frames == pytest.approx(8.8)
    assert subject.timing.trigger("10") == pytest.approx(1.0)
    assert list(subject.timing.mid_frames) == [16, 27, 38, 49, 60]
    assert subject.body == files.body
    assert subject.motion is None
    assert np.array_equal(subject.fit.Th, files.Th)


def test_cameras_agree_with_opencv_but_for_half_a_pixel(tmp_path: Path) -> None:
    """OpenCV puts the first pixel's centre at 0, we at 0.5; the file's K says 0.5; T was in millimetres."""
    subject = load(write_rolling(tmp_path / "figure").root)
    points = np.random.default_rng(0).normal([0, 0, 1], 0.3, (50, 3))
    for name, camera in subject.cameras.items():
        R, T = ring(int(name))
        theirs = cv2.projectPoints(points, cv2.Rodrigues(R)[0], T, matrix(), None)[0][:, 0]
        np.testing.assert_allclose(camera.project(points)[0], theirs + 0.5, atol=1e-9)


def test_a_matrix_for_whole_integers_is_shifted(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure").root
    before = load(root).cameras["04"]
    edit(root / "meta.json", lambda meta: meta.update(pixel_centre=0))
    after = load(root).cameras["04"]
    assert (after.cx - before.cx, after.cy - before.cy) == (0.5, 0.5)


def test_images_are_rgb_and_black_outside_the_mask(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure").root
    for colours, mask in (load(root).observe("04", 2), load(root).truth("13", 2)):
        assert colours.dtype == mask.dtype == np.uint8
        assert colours.shape == (SIZE, SIZE, 3)
        assert not colours[mask == 0].any()
        assert (colours[mask != 0][:, 0] == 200).all()  # drawn as (200, ., 60)


def test_distorted_images_are_undistorted(tmp_path: Path) -> None:
    """A pinhole drawing and an undistorted lens drawing differ by the drawing's rounding only."""
    D = np.array([-0.25, 0.1, 0.003, -0.002, 0.0])
    straight = load(write_rolling(tmp_path / "straight").root).observe("04", 1)[1] >= 128
    curved = load(write_rolling(tmp_path / "curved", D=D).root)
    undone = curved.observe("04", 1)[1] >= 128
    raw = np.asarray(Image.open(curved.root / "rs/mask/04/000001.png")) >= 128
    overlap = [(straight & other).sum() / (straight | other).sum() for other in (undone, raw)]
    assert overlap[0] > 0.93
    assert overlap[0] > overlap[1] + 0.01


def test_the_fingerprint_follows_the_content(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "a").root
    first = load(root).fingerprint
    root.rename(tmp_path / "b")
    assert load(tmp_path / "b").fingerprint == first
    path = tmp_path / "b/rs/images/10/000003.png"
    path.write_bytes(path.read_bytes() + b"\0")
    assert load(tmp_path / "b").fingerprint != first


@pytest.mark.parametrize("folder", ["params", "smpl_params"])
def test_other_names_of_the_fits(tmp_path: Path, folder: str) -> None:
    root = write_rolling(tmp_path / "figure").root
    (root / "rs/new_params").rename(root / "rs" / folder)
    assert load(root).frames == FRAMES


def test_fits_of_69_numbers_are_padded(tmp_path: Path) -> None:
    files = write_rolling(tmp_path / "figure")
    for path in (files.root / "rs/new_params").iterdir():
        edit(path, lambda fit: fit.update(poses=fit["poses"][:, 3:]))
    assert np.array_equal(load(files.root).fit.poses, files.poses)


def test_exposure_rate_and_missing_images_are_read(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure").root
    edit_meta(root, exposure=2.5, fps=120, missing=[[4, 0], [10, 3]])
    (root / "rs/images/04/000000.png").unlink()
    (root / "rs/mask/10/000003.png").unlink()
    subject = load(root)
    assert (subject.timing.exposure_frames, subject.timing.fps) == (2.5, 120.0)
    assert subject.missing == {("04", 0), ("10", 3)}
    assert subject.observe("04", 1)[1].any()
    with pytest.raises(DataError, match="camera '04', frame 0"):
        subject.observe("04", 0)
    plain = load(write_rolling(tmp_path / "plain").root)
    assert (plain.timing.exposure_frames, plain.timing.fps, plain.missing) == (0.0, None, frozenset())


@pytest.mark.parametrize(
    ("word", "value", "sentence"),
    [
        ("exposure", -1.0, "exposure and fps: expected exposure >= 0"),
        ("fps", 0, "exposure and fps"),
        ("missing", [[0, 0]], "missing: expected pairs of a training camera and a frame"),
        ("missing", [[4, FRAMES]], "missing: expected pairs"),
    ],
)
def test_impossible_words_of_the_capture_are_refused(tmp_path: Path, word: str, value: object, sentence: str) -> None:
    root = write_rolling(tmp_path / "figure").root
    edit_meta(root, **{word: value})
    with pytest.raises(DataError, match=sentence):
        load(root)


def edit_meta(root: Path, **words: object) -> None:
    path = root / "meta.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **words}))


def test_without_sharp_images_nothing_is_held_out(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure").root
    (root / "rs/gt").rename(root / "elsewhere")
    subject = load(root)
    assert subject.held_out == ()
    assert tuple(subject.cameras) == subject.training
    with pytest.raises(DataError, match="sharp image"):
        subject.truth("04", 0)


@pytest.mark.parametrize(
    "path",
    [
        "rs/images/10/000003.png",
        "rs/mask/22/000000.png",
        "rs/gt/13/000004.png",
        "rs/gt_mask/00/000001.png",
        "rs/new_params/2.npy",
        "rs/annots.npy",
    ],
)
def test_a_missing_file_is_named_at_once(tmp_path: Path, path: str) -> None:
    root = write_rolling(tmp_path / "figure").root
    (root / path).unlink()
    with pytest.raises(DataError, match=path.replace(".", r"\.")):
        load(root)


def test_a_missing_camera_folder_is_named(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure").root
    (root / "rs/images/16").rename(root / "16")
    with pytest.raises(DataError, match=r"rs/images/16: expected a folder"):
        load(root)


def test_a_camera_without_calibration_is_named(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure").root
    edit(root / "rs/annots.npy", lambda annots: [values.pop() for values in annots["cams"].values()])
    with pytest.raises(DataError, match=r"22 cameras, none for \[22\]"):
        load(root)


def test_a_truncated_image_is_named_when_read(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure").root
    path = root / "rs/images/04/000001.png"
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(DataError, match=r"04/000001\.png: expected a complete image"):
        load(root).observe("04", 1)


def test_a_mask_of_another_size_is_named(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure").root
    Image.new("L", (SIZE, SIZE + 1)).save(root / "rs/mask/04/000001.png")
    with pytest.raises(DataError, match=r"mask/04/000001\.png"):
        load(root).observe("04", 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mid": [1, 2]}, "mid"),
        ({"mid": "soon"}, "numbers"),
        ({"K": 0}, "K > 0"),
        ({"pixel_centre": 0.25}, "pixel_centre"),
        ({"delta": [0.0]}, "delta"),
        ({"excluded": list(TRAIN)}, "train"),
    ],
)
def test_impossible_settings_are_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    root = write_rolling(tmp_path / "figure").root
    edit(root / "meta.json", lambda meta: meta.update(change))
    with pytest.raises(DataError, match=message):
        load(root)


def test_smplx_names_and_a_turned_root_are_refused(tmp_path: Path) -> None:
    root = write_rolling(tmp_path / "figure").root
    path = root / "rs/new_params/1.npy"
    given = load_object(path)
    edit(path, lambda fit: fit["poses"].__setitem__((0, 1), 0.2))
    with pytest.raises(DataError, match=r"1\.npy poses\[:3\]"):
        load(root)
    edit(path, lambda fit: (fit.clear(), fit.update(global_orient=given["Rh"], transl=given["Th"])))
    with pytest.raises(DataError, match="smplx names"):
        load(root)


def test_folders_without_a_layout_are_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(DataError, match=r"annots\.npy with images/.*notes\.txt"):
        open_subject("x", tmp_path)
    with pytest.raises(DataError, match="nothing there"):
        open_subject("x", tmp_path / "none")
    with pytest.raises(DataError, match="built-in 'studio'"):
        open_subject("x", None)


@pytest.mark.shared
@pytest.mark.parametrize("name", NAMES)
def test_true_joints_lie_in_the_sharp_masks(name: str) -> None:
    """Joints are inside the body, so their projections are inside its masks: one pixel of the 256 for rounding."""
    if not (SUBJECTS / name).is_dir():
        pytest.skip(f"no sample subject {SUBJECTS / name}")
    subject = load(SUBJECTS / name)
    assert subject.motion is not None
    for camera in subject.cameras:
        for index in range(0, subject.frames, 5):
            mask = cv2.dilate(subject.truth(camera, index)[1], np.ones((3, 3), np.uint8))
            column, row = np.floor(subject.cameras[camera].project(subject.motion.mid_joints[index])[0]).astype(int).T
            assert mask[row, column].all(), (camera, index)
