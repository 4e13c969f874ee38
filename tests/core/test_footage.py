"""Footage in every layout says the same; conversions come back; what is missing or in the wrong unit is named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from rsavatar.cli import main
from rsavatar.data.catalogue import open_subject
from rsavatar.data.check import check, render
from rsavatar.data.convert import convert
from rsavatar.data.easymocap import to_smplx
from rsavatar.data.footage import Footage
from rsavatar.data.footage_sources import open_footage, parse_views
from rsavatar.data.rolling import load
from rsavatar.errors import DataError
from tests.core.footage_files import (
    clock_picture,
    fit_of,
    write_easymocap_footage,
    write_own_footage,
    write_zju_footage,
)
from tests.core.subject_files import write_rolling, write_zju

FRAMES = 9
PAINT = clock_picture(24, 20)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_own_footage(tmp_path_factory.mktemp("own") / "mine", FRAMES, PAINT, ["a", "b"], ["c"])


@pytest.fixture
def root(own: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(own, tmp_path / "mine"))


def edit(path: Path, **changes: object) -> None:
    held = json.loads(path.read_text()) | changes
    path.write_text(json.dumps(held))


def same(a: Footage, b: Footage) -> None:
    assert (a.train, a.test, a.length, a.first, a.labelled) == (b.train, b.test, b.length, b.first, b.labelled)
    for name in (*a.train, *a.test):
        here, there = (f.calibrations[f.index[name]] for f in (a, b))
        for part in ("matrix", "rotation", "translation", "distortion"):
            np.testing.assert_allclose(getattr(here, part), getattr(there, part), atol=1e-9)
        np.testing.assert_array_equal(a.read(name, 3, True), b.read(name, 3, True))
    for part in ("poses", "Rh", "Th", "shapes"):
        np.testing.assert_allclose(getattr(a.fit, part), getattr(b.fit, part), atol=1e-12)


def test_our_folder(own: Path) -> None:
    footage = open_footage(own)
    assert (footage.layout, footage.train, footage.test, footage.length) == ("footage", ("a", "b"), ("c",), FRAMES)
    assert footage.licence == "CC0"
    np.testing.assert_allclose(footage.fit.Th[:, 0], 0.01 * np.arange(FRAMES))
    assert (footage.read("b", 4, True)[..., :3] == 80).all()


def test_views_can_be_chosen(own: Path) -> None:
    footage = open_footage(own, "c:rest")
    assert (footage.train, footage.test) == (("c",), ("a", "b"))
    assert open_footage(own, "a").excluded == ("b", "c")
    assert parse_views("a, b:c", ["a"]) == (["a", "b"], ["c"])
    assert open_footage(own, "a:").test == ()
    for views, message in (("z", "folders of z"), ("a:a", "in both"), (",", "TRAIN:TEST"), ("a:,", "TRAIN:TEST")):
        with pytest.raises(DataError, match=message):
            open_footage(own, views)


@pytest.mark.parametrize("original", [False, True])
def test_zju_comes_back_from_our_folder(tmp_path: Path, original: bool) -> None:
    lens = np.array([-0.2, 0.03, -0.005, 0.002, 0.06])
    cameras = (0, 3, 4, 10, 16, 22)
    zju = open_footage(write_zju_footage(tmp_path / "zju", FRAMES, PAINT, cameras, original=original, D=lens))
    assert (zju.train, zju.test) == (("04", "10", "16", "22"), ("00",))
    assert "03" in zju.excluded
    assert zju.labelled
    back = open_footage(convert(zju, tmp_path / "mine"))
    assert back.layout == "footage"
    same(zju, back)
    with pytest.raises(DataError, match="nothing there"):
        convert(zju, tmp_path / "mine")


def test_easymocap_comes_in(tmp_path: Path) -> None:
    """Its JSON holds three decimals; everything else is exact."""
    mocap = open_footage(write_easymocap_footage(tmp_path / "em", FRAMES, PAINT, ["01", "02", "05"]), "01,05:02")
    assert (mocap.layout, mocap.train, mocap.test) == ("easymocap", ("01", "05"), ("02",))
    wanted = np.concatenate([fit_of(n)["poses"] for n in range(FRAMES)])
    np.testing.assert_allclose(mocap.fit.poses, wanted, atol=5.1e-4)
    assert np.linalg.norm(mocap.calibrations[0].translation) < 10  # metres
    same(mocap, open_footage(convert(mocap, tmp_path / "mine")))
    with pytest.raises(DataError, match="views: expected --views"):
        open_footage(tmp_path / "em")
    (tmp_path / "em/smpl/000004.json").unlink()
    with pytest.raises(DataError, match=r"000004\.json"):
        open_footage(tmp_path / "em", "01")


def test_smplx_fits_are_told_by_their_names(root: Path, own: Path) -> None:
    """The same motion in smplx's convention, about a pelvis off the origin, is the same footage."""
    pelvis, fit = np.array([0.01, -0.23, 0.03]), open_footage(own).fit
    other = to_smplx(fit, pelvis)
    assert np.abs(other.transl - fit.Th).max() > 0.1
    names = {"global_orient": other.global_orient, "body_pose": other.body_pose, "transl": other.transl}
    np.savez(root / "fits.npz", **names, shapes=fit.shapes, pelvis=pelvis)
    same(open_footage(own), open_footage(root))
    np.savez(root / "fits.npz", **names, shapes=fit.shapes)
    with pytest.raises(DataError, match="no pelvis"):
        open_footage(root)


def test_fits_follow_their_numbers(root: Path) -> None:
    with np.load(root / "fits.npz") as held:
        values = {name: held[name] for name in held.files}
    order = np.random.default_rng(0).permutation(FRAMES)
    shuffled = {name: value[order] for name, value in values.items() if name != "shapes"}
    np.savez(root / "fits.npz", **shuffled, shapes=values["shapes"], frames=order)
    np.testing.assert_allclose(open_footage(root).fit.Th[:, 0], 0.01 * np.arange(FRAMES))
    np.savez(root / "fits.npz", **shuffled, shapes=values["shapes"], frames=order + 1)
    with pytest.raises(DataError, match="none of 0"):
        open_footage(root)


def test_what_is_wrong_is_named(root: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="a folder with a sequence"):
        open_footage(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="an empty folder"):
        open_footage(tmp_path / "empty")
    (root / "masks/b/000005.png").unlink()
    with pytest.raises(DataError, match=r"masks/b/000005\.png"):
        open_footage(root)
    (root / "images/b/000005.png").unlink()
    with pytest.raises(DataError, match=r"camera b.*no frame 5"):
        open_footage(root)
    shutil.rmtree(root / "images/b")
    with pytest.raises(DataError, match="folders of b"):
        open_footage(root)


def test_units_and_values_are_checked(root: Path) -> None:
    path = root / "footage.json"
    cameras = json.loads(path.read_text())["cameras"]
    millimetres = {name: each | {"T": [1000 * t for t in each["T"]]} for name, each in cameras.items()}
    for changes, message in (
        ({"cameras": millimetres}, "T: expected METRES"),
        ({"cameras": {**cameras, "a": {"K": 1}}}, "camera a"),
        ({"cameras": {}}, "K, R, T by camera"),
        ({"pixel_centre": 0.3}, "pixel_centre"),
        ({"train": "a"}, "list of cameras"),
        ({"train": []}, "at least one"),
    ):
        held = path.read_text()
        edit(path, **changes)
        with pytest.raises(DataError, match=message):
            open_footage(root)
        path.write_text(held)
    path.write_text("{")
    with pytest.raises(DataError, match="a JSON file"):
        open_footage(root)


def test_the_command_line_builds_and_converts(own: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["data", "build-rs", str(own), "--out", str(tmp_path / "rs"), "--K", "3", "--jobs", "1"]
    assert main([*given, "--interpolator", "linear", "--e", "2", "--views", "a:c"]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'rs'}\n"
    subject = load(tmp_path / "rs")
    assert (subject.training, subject.held_out, subject.frames) == (("00",), ("02",), 1)
    assert main(["data", "convert", str(own), "--out", str(tmp_path / "copy"), "--views", "a:b"]) == 0
    assert open_footage(tmp_path / "copy").test == ("b",)
    capsys.readouterr()
    for wrong, message in (("--e=often", "--e: expected auto"), ("--delta=late", "--delta: expected"),
                           ("--interpolator=magic", "interpolator: expected"), ("--jobs=0", "--jobs")):  # fmt: skip
        assert main([*given, wrong]) == 2
        assert message in capsys.readouterr().err
    (tmp_path / "delta.json").write_text(json.dumps({"a": 0.5, "b": -0.25}))
    assert (
        main([*given[:4], str(tmp_path / "rs2"), "--K", "2", "--jobs", "1", "--delta", str(tmp_path / "delta.json")])
        == 0
    )
    assert load(tmp_path / "rs2").timing.trigger("01") == -0.25


def test_our_folder_is_a_sharp_subject_too(own: Path) -> None:
    subject = open_subject("mine", own)
    assert (subject.training, subject.held_out, subject.frames) == (("00", "01"), ("02",), FRAMES)
    assert subject.timing.readout_frames == 0
    assert (subject.observe("02", 3)[0] == 60).all()
    assert len(subject.fingerprint) == 64


def test_check_looks_at_our_folder(tmp_path: Path) -> None:
    """The drawn figure, converted: sound; with metres times a thousand in its fits: named."""
    sound = write_zju(tmp_path / "zju").root
    root = convert(open_footage(sound), tmp_path / "mine")
    report = check(root)
    assert report.ok, render(report)
    with np.load(root / "fits.npz") as held:
        values = {name: held[name] for name in held.files}
    np.savez(root / "fits.npz", **(values | {"Th": 1000 * values["Th"]}))
    assert "Th of the fits is in millimetres" in render(check(root))


def test_check_says_when_distorted_rows_carry_the_time(tmp_path: Path) -> None:
    lens = np.array([-0.2, 0.03, 0, 0, 0])
    report = check(write_rolling(tmp_path / "bent", D=lens).root)
    rows = [finding for finding in report.findings if finding.what == "rows"]
    assert [finding.severity for finding in rows] == ["warning"]
    assert "off by up to" in rows[0].got
    straight = check(write_rolling(tmp_path / "straight").root)
    assert [finding.severity for finding in straight.findings if finding.what == "rows"] == ["ok"]
