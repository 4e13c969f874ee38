"""Building rolling-shutter subjects: every row from its own instant, told by pictures that are clocks."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from rsavatar.data import build as building
from rsavatar.data import build_work
from rsavatar.data.base import Array, Bytes
from rsavatar.data.build import Settings, build
from rsavatar.data.build_card import readable
from rsavatar.data.build_motion import displacements
from rsavatar.data.build_plan import Clock
from rsavatar.data.build_table import SUBJECTS, build_all, find_subjects
from rsavatar.data.footage import Footage
from rsavatar.data.footage_sources import open_footage
from rsavatar.data.rolling import load
from rsavatar.errors import DataError
from rsavatar.events import Event, Note, Progress
from tests.core.footage_files import ball_picture, clock_picture, write_own_footage, write_zju_footage

SIZE, STEP, BENT, FRAMES = 32, 4, 10, 23
K5 = Clock(5)
PROTOCOL = {"mask_radius_px": 2}
LENS = np.array([-0.22, 0.03, -0.005, 0.002, 0.06])


@pytest.fixture(scope="module")
def clocks(tmp_path_factory: pytest.TempPathFactory) -> Footage:
    """One training and one held-out camera; frame f is grey 4 f."""
    root = write_own_footage(tmp_path_factory.mktemp("own") / "mine", FRAMES, clock_picture(SIZE), ["a"], ["b"])
    return open_footage(root)


def linear(**other: object) -> Settings:
    return Settings(**({"clock": K5, "interpolator": "linear", "recursion": "rows"} | other))  # type: ignore[arg-type]


def grey(path: Path) -> Array:
    return cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(float)


def test_each_row_is_from_its_own_instant(clocks: Footage, tmp_path: Path) -> None:
    root = build(clocks, tmp_path / "rs", linear(), PROTOCOL, 1)
    meta = json.loads((root / "meta.json").read_text())
    assert meta["mid"] == [7, 12, 17]
    for n, mid in enumerate(meta["mid"]):
        times = mid + 5 * (np.arange(SIZE) / SIZE - 0.5)
        rows = grey(root / f"rs/images/00/{n:06d}.png")
        np.testing.assert_allclose(rows, np.repeat(STEP * times[:, None], SIZE, 1), atol=0.51)
    quantised = build(clocks, tmp_path / "rs2", linear(recursion=1), PROTOCOL, 1)
    times = np.round(2 * (7 + 5 * (np.arange(SIZE) / SIZE - 0.5))) / 2
    np.testing.assert_allclose(grey(quantised / "rs/images/00/000000.png")[:, 3], STEP * times, atol=0.51)


def test_ground_truth_is_the_real_mid_frame(clocks: Footage, tmp_path: Path) -> None:
    root = build(clocks, tmp_path / "rs", linear(), PROTOCOL, 1)
    for number, camera in (("00", "a"), ("01", "b")):
        for n, mid in enumerate((7, 12, 17)):
            there = clocks.read(camera, mid, undistorted=True)
            np.testing.assert_array_equal(grey(root / f"rs/gt/{number}/{n:06d}.png"), there[..., 0])
    assert not (root / "rs/images/01").exists()  # held-out cameras have no rolling shutter


def test_triggers_shift_a_camera_and_its_truth(clocks: Footage, tmp_path: Path) -> None:
    root = build(clocks, tmp_path / "rs", linear(triggers={"a": 1.25}), PROTOCOL, 1)
    subject = load(root)
    mid = subject.timing.mid_frames[0]
    assert subject.timing.trigger("00") == 1.25
    assert subject.timing.trigger("01") == 0
    rows = subject.observe("00", 0)[0][..., 0]
    np.testing.assert_allclose(rows[:, 0], STEP * (mid + 1.25 + 5 * (np.arange(SIZE) / SIZE - 0.5)), atol=0.51)
    np.testing.assert_allclose(subject.truth("00", 0)[0][..., 0], STEP * (mid + 1.25), atol=0.51)
    np.testing.assert_allclose(subject.truth("01", 0)[0][..., 0], STEP * mid, atol=0.51)
    card = json.loads((root / "benchmark.json").read_text())
    assert card["ground_truth"] == {"real": len(subject.timing.mid_frames), "interpolated": card["frames"]}


@pytest.fixture(scope="module")
def bent(tmp_path_factory: pytest.TempPathFactory) -> Footage:
    """The same clocks behind a real lens's distortion, in ZJU-MoCap's layout."""
    root = tmp_path_factory.mktemp("bent") / "my_000"
    return open_footage(write_zju_footage(root, FRAMES, clock_picture(64, BENT), (4, 5), D=LENS), "04:05")


def test_rows_of_the_undistorted_picture_carry_the_time(bent: Footage, tmp_path: Path) -> None:
    """The default: what the model assumes. The lens leaves black borders, so only what it shows is looked at."""
    subject = load(build(bent, tmp_path / "rs", linear(), PROTOCOL, 1))
    rgb, coverage = subject.observe("04", 0)
    times = 7 + 5 * (np.arange(64) / 64 - 0.5)
    seen = cv2.erode(coverage, np.ones((3, 3), np.uint8)) > 0
    assert seen.mean() > 0.7
    np.testing.assert_allclose(rgb[..., 0][seen], np.repeat(BENT * times[:, None], 64, 1)[seen], atol=0.6)
    annots = np.load(subject.root / "rs/annots.npy", allow_pickle=True).item()
    assert not np.any(annots["cams"]["D"])


def test_rows_of_the_raw_picture_carry_the_time_of_a_real_sensor(bent: Footage, tmp_path: Path) -> None:
    """With rows="raw" the file's rows are steady in time, and after undistortion a pixel has its raw row's time."""
    root = build(bent, tmp_path / "rs", linear(rows="raw"), PROTOCOL, 1)
    times = 7 + 5 * (np.arange(64) / 64 - 0.5)
    np.testing.assert_allclose(
        grey(root / "rs/images/04/000000.png"), np.repeat(BENT * times[:, None], 64, 1), atol=0.6
    )
    rgb, coverage = load(root).observe("04", 0)
    where = bent.lens("04").raw_rows((64, 64))
    seen = cv2.erode(coverage, np.ones((5, 5), np.uint8)) > 250
    wanted = BENT * (7 + 5 * (where / 64 - 0.5))
    np.testing.assert_allclose(
        rgb[..., 0][seen], wanted[seen], atol=1.1
    )  # rounded twice, and undistorted on a grid of 1/32
    assert np.abs(wanted - BENT * times[:, None])[seen].max() > 1  # and that is not the undistorted row's
    card = json.loads((root / "benchmark.json").read_text())
    assert card["lens_shift_rows"] == pytest.approx(bent.lens("04").row_shift((64, 64)), abs=1e-9)
    assert card["lens_shift_rows"] > 1
    assert "the model's clock, which follows undistorted rows, is off" in readable(card)


def test_labels_stay_labels(bent: Footage, tmp_path: Path) -> None:
    assert bent.labelled
    root = build(bent, tmp_path / "rs", linear(), PROTOCOL, 1)
    assert set(np.unique(grey(root / "rs/mask/04/000001.png"))) <= {0, 255}


@pytest.mark.parametrize("speed", [0.8, 1.7])
def test_displacement_is_speed_times_readout(speed: float) -> None:
    paint = ball_picture(64, speed)
    found = displacements(lambda frame: paint(0, frame), [7.0, 12.0, 17.0], K5, 64)
    np.testing.assert_allclose(found, 5 * speed, rtol=0.06)
    halved = displacements(lambda frame: paint(0, frame), [7.0], Clock(5, 0.5), 64)
    np.testing.assert_allclose(halved, 2.5 * speed, rtol=0.06)


def test_large_pictures_are_measured_small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rsavatar.data.build_motion.LARGEST_SIDE", 48)
    paint = ball_picture(96, 3.0, radius=12)
    np.testing.assert_allclose(displacements(lambda n: paint(0, n), [5.0], K5, 96), 15, rtol=0.1)


def test_nobody_moves_nowhere() -> None:
    assert displacements(lambda frame: np.zeros((32, 32, 4), np.uint8), [7.0], K5, 32).tolist() == [0.0]


@pytest.fixture(scope="module")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Footage:
    root = tmp_path_factory.mktemp("balls") / "balls"
    return open_footage(write_own_footage(root, FRAMES, ball_picture(64, 1.5), ["a", "c"], ["b"]))


def files_of(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_the_card_says_what_was_built(balls: Footage, tmp_path: Path) -> None:
    heard: list[Event] = []
    root = build(balls, tmp_path / "rs", Settings(clock=K5), PROTOCOL, 1, heard.append)
    card = json.loads((root / "benchmark.json").read_text())
    assert card["motion"]["D"] == pytest.approx(7.5, rel=0.06)
    assert card["e"] == 2  # 7.5 / (5 * 4) = 0.375; 7.5 / 10 is too much
    assert card["seam_px"] == pytest.approx(card["motion"]["D"] / 20)
    assert card["instants"] == 21
    assert card["frames"] == 3
    assert card["pictures"] == {"rolling": 6, "sharp": 9}
    assert card["cameras"] == {"train": ["a", "c"], "test": ["b"], "excluded": []}
    assert card["source"] == {"name": "balls", "layout": "footage", "frames": FRAMES, "licence": "CC0"}
    text = (root / "BENCHMARK.md").read_text()
    assert "e = 2: 21 a frame, a seam of 0.38 px" in text or "e = 2: 21 a frame, a seam of 0.37 px" in text
    assert "mask_radius_px: 2" in text
    steps = [(event.stage, event.step, event.steps) for event in heard if isinstance(event, Progress)]
    assert steps == [("measure", 1, 3), ("measure", 2, 3), ("measure", 3, 3)] + [("build", k, 9) for k in (3, 6, 9)]


def test_the_built_frames_are_near_the_exact_rows(balls: Footage, tmp_path: Path) -> None:
    """The ball at every row's own instant, painted exactly, against what was interpolated and what was only copied."""
    error = {}
    for name in ("flow", "linear", "copy"):
        root = build(balls, tmp_path / name, Settings(clock=K5, interpolator=name), PROTOCOL, 1)
        times = 12 + 5 * (np.arange(64) / 64 - 0.5)
        exact = np.stack([ball_picture(64, 1.5)(0, t)[v] for v, t in enumerate(times)])  # type: ignore[arg-type]
        built = grey_and_mask(root, "00", 1)
        error[name] = float(np.sqrt(np.mean((built[..., :3] - exact[..., :3].astype(float)) ** 2)))
    assert error["flow"] < 0.6 * error["linear"] < 0.6 * error["copy"]


def grey_and_mask(root: Path, camera: str, n: int) -> Bytes:
    rgb = cv2.imread(str(root / f"rs/images/{camera}/{n:06d}.png"))[..., ::-1]
    return np.dstack([rgb, cv2.imread(str(root / f"rs/mask/{camera}/{n:06d}.png"), cv2.IMREAD_GRAYSCALE)])


def test_two_processes_build_the_same(balls: Footage, tmp_path: Path) -> None:
    one = build(balls, tmp_path / "one", Settings(clock=K5), PROTOCOL, 1)
    two = build(balls, tmp_path / "two", Settings(clock=K5), PROTOCOL, 2)
    assert files_of(one) == files_of(two)


def test_what_is_built_is_not_built_again(clocks: Footage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = build(clocks, tmp_path / "rs", linear(), PROTOCOL, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["rs"]
    monkeypatch.setattr(building, "Crew", None)
    heard: list[Event] = []
    assert build(clocks, root, linear(), PROTOCOL, 1, heard.append) == root
    assert heard == [Note(f"{root} is built already, of the same content.")]
    with pytest.raises(DataError, match="other inputs or settings"):
        build(clocks, root, linear(recursion=1), PROTOCOL, 1)
    (tmp_path / "else").mkdir()
    with pytest.raises(DataError, match="something else"):
        build(clocks, tmp_path / "else", linear(), PROTOCOL, 1)


def test_a_changed_picture_is_another_source(clocks: Footage, tmp_path: Path) -> None:
    shutil.copytree(clocks.root, tmp_path / "mine")
    footage = open_footage(tmp_path / "mine")
    assert building.key_of(footage, linear()) == building.key_of(clocks, linear())
    path = tmp_path / "mine/images/a/000003.png"
    pixels = bytearray(path.read_bytes())
    path.write_bytes(bytes(pixels) + b"\0")
    assert building.key_of(footage, linear()) != building.key_of(clocks, linear())


def test_an_interrupted_build_goes_on(clocks: Footage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = files_of(build(clocks, tmp_path / "whole", linear(), PROTOCOL, 1))
    write_png, written = build_work.write_png, []

    def stumble(path: Path, pixels: Bytes) -> None:
        if len(written) == 5:
            raise KeyboardInterrupt
        written.append(path.name)
        write_png(path, pixels)

    monkeypatch.setattr(build_work, "write_png", stumble)
    with pytest.raises(KeyboardInterrupt):
        build(clocks, tmp_path / "rs", linear(), PROTOCOL, 1)
    assert not (tmp_path / "rs").exists()
    monkeypatch.setattr(
        build_work, "write_png", lambda path, pixels: (written.append(path.name), write_png(path, pixels))
    )
    monkeypatch.setattr("rsavatar.data.build_work.displacements", None)  # measured already
    assert files_of(build(clocks, tmp_path / "rs", linear(), PROTOCOL, 1)) == whole
    pictures = sum(name.endswith(".png") for name in whole)
    assert len(written) in (pictures, pictures + 1)  # of one picture, the image was there and the mask was not
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rs", "whole"]


def test_what_is_wrong_is_named(clocks: Footage, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="at least 47 frames for K = 23"):
        build(clocks, tmp_path / "rs", linear(clock=Clock(23)), PROTOCOL, 1)
    with pytest.raises(DataError, match="e of rife"):
        linear(interpolator="rife")
    with pytest.raises(DataError, match="e: expected auto, rows, or 0 to 8"):
        linear(recursion=9)
    shutil.copytree(clocks.root, tmp_path / "mine")
    path = tmp_path / "mine/images/a/000008.png"
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(DataError, match=r"a/000008\.png: expected a complete image file"):
        build(open_footage(tmp_path / "mine"), tmp_path / "rs", linear(), PROTOCOL, 1)


def test_the_fit_as_rolling_shutter_frames_show_it(clocks: Footage, tmp_path: Path) -> None:
    """The root walks 0.01 m a frame: its place tells at which time it was seen, and that follows from its row."""
    seen = load(build(clocks, tmp_path / "rows", linear(fit="rows"), PROTOCOL, 1))
    sharp = load(build(clocks, tmp_path / "mid", linear(), PROTOCOL, 1))
    np.testing.assert_allclose(sharp.fit.Th[:, 0], [0.07, 0.12, 0.17], atol=1e-6)
    row = seen.cameras["00"].project(sharp.fit.Th[:1])[0][0, 1] / SIZE
    offset = (seen.fit.Th[:, 0] - sharp.fit.Th[:, 0]) / 0.01
    assert np.abs(offset - 5 * (row - 0.5)).max() < 0.6  # the pelvis is not quite at the body's origin
    assert np.abs(seen.fit.poses - sharp.fit.poses).max() > 1e-3
    turn = (seen.fit.poses - sharp.fit.poses)[0, 3:].reshape(23, 3)
    along = 0.01 * np.linspace(-1, 1, 69).reshape(23, 3)
    frames = (turn * along).sum(1) / (along**2).sum(1)
    assert np.abs(frames).max() < 2.5  # no joint was seen outside of the window


def test_the_papers_six_subjects(tmp_path: Path) -> None:
    """A folder of exactly ZJU-MoCap-refine's layout, all 23 cameras: cameras, counts and the card over all."""
    paint = ball_picture(24, 0.3, radius=5)
    pictures = {n: paint(0, n) for n in range(23)}
    first = write_zju_footage(tmp_path / "zju/my_377", 23, lambda _, n: pictures[n], range(23))
    for number in list(SUBJECTS)[1:]:
        shutil.copytree(first, tmp_path / f"zju/my_{number}", copy_function=os.link)
    built = build_all(find_subjects(tmp_path / "zju"), tmp_path / "rs", Settings(interpolator="copy"), PROTOCOL, 1)
    assert [each.name for each in built] == [f"zju-{number}" for number in SUBJECTS]
    subject = load(built[0].folder)
    assert subject.training == ("04", "10", "16", "22")
    assert len(subject.held_out) == 18
    assert "03" not in subject.cameras
    assert subject.timing.mid_frames.tolist() == [16.0]
    text = (tmp_path / "rs/RS-ZJU.md").read_text()
    assert "6 frames a view in all, K = 11." in text
    assert "The paper has 354" in text
    shutil.rmtree(tmp_path / "zju/my_392")
    with pytest.raises(DataError, match="none for 392"):
        find_subjects(tmp_path / "zju")
    assert list(find_subjects(tmp_path / "zju", ["386"])) == ["386"]
    with pytest.raises(DataError, match="some of 377"):
        find_subjects(tmp_path / "zju", ["400"])
