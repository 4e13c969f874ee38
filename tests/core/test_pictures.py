"""What a finished job shows: the archives hold what they say, and the paths are the motion's."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from rsavatar.catalog import METHODS, load
from rsavatar.evaluate import evaluate, world_joints
from rsavatar.events import silent
from rsavatar.methods.base import build_actor, observations
from rsavatar.pictures import INSTANTS, JOINTS, Shown, references_of, work_of, write_pictures
from tests.core import small_subject


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RSAVATAR_CACHE", str(tmp_path / "cache"))


def shown(**request: object) -> Shown:
    case = small_subject.case(**request)
    method = load(METHODS, case.spec.method)()
    return Shown(method, case, build_actor(method, case))


def written(out: Path, **request: object) -> tuple[Shown, dict[str, Path]]:
    it = shown(**request)
    out.mkdir()
    evaluate(it.actor, it.subject, 0, out, silent)
    return it, write_pictures(it, out)


def names_of(path: Path) -> set[str]:
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


def picture_of(path: Path, name: str) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    with zipfile.ZipFile(path) as archive:
        found = cv2.imdecode(np.frombuffer(archive.read(name), np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    return found[..., ::-1].astype(np.uint8)


def test_archives_hold_every_view_and_only_what_was_seen(tmp_path: Path) -> None:
    it, files = written(tmp_path / "out", T="scanline")
    frames = [f"{n:06d}" for n in range(it.subject.frames)]
    training = {f"{c}/{f}/{k}.png" for c in ("00", "01") for f in frames for k in ("result", "exposed")}
    assert names_of(files["pictures"]) == training | {f"02/{f}/result.png" for f in frames}
    assert names_of(files["references"]) == {
        *(f"{c}/{f}/truth.png" for c in ("00", "01", "02") for f in frames),
        *(f"{c}/{f}/input.png" for c in ("00", "01") for f in frames),
    }
    seen = picture_of(files["references"], "00/000001/input.png")
    np.testing.assert_array_equal(seen, it.subject.observe("00", 1)[0])
    scored = cv2.imread(str(tmp_path / "out" / "predictions" / "02" / "000001.png"))
    assert scored is not None
    np.testing.assert_array_equal(picture_of(files["pictures"], "02/000001/result.png"), scored[..., ::-1])


def test_an_instant_shutter_predicts_nothing_of_its_own(tmp_path: Path) -> None:
    _, files = written(tmp_path / "out", method="gauhuman")
    assert not any("exposed" in name for name in names_of(files["pictures"]))


def test_references_are_the_same_bytes_for_every_job(tmp_path: Path) -> None:
    first = references_of(small_subject.subject()).read_bytes()
    for path in (tmp_path / "cache").glob("references-*"):
        path.unlink()
    assert references_of(small_subject.subject()).read_bytes() == first


def test_paths_are_the_motion_in_whole_millimetres(tmp_path: Path) -> None:
    it, files = written(tmp_path / "out", T="K")
    paths = json.loads(files["paths"].read_text())
    with np.load(tmp_path / "out" / "motion.npz") as held, torch.no_grad():
        joints, _ = world_joints(it.actor, {name: held[name] for name in held.files}, "sub_")
    found = np.array(paths["found"])
    assert found.shape == (it.subject.frames, INSTANTS, len(JOINTS), 3)
    chosen = joints[:, :, list(JOINTS.values())] * 1000
    np.testing.assert_allclose(found[:, 0], chosen[:, 0], atol=0.5)
    np.testing.assert_allclose(found[:, -1], chosen[:, -1], atol=0.5)
    camera = it.subject.cameras["00"]
    matrix = np.array(paths["cameras"]["00"]["matrix"])
    homogeneous = np.append(found[1, 3, 2], 1.0) @ matrix.T
    np.testing.assert_allclose(homogeneous[:2] / homogeneous[2], camera.project(found[1, 3, 2] / 1000)[0], atol=1e-4)
    slots = paths["cameras"]["00"]["slots"]
    assert [slot[:2] for slot in slots] == [[s.lo, s.hi] for s in it.slots("00")]
    assert paths["cameras"]["02"]["slots"] == []


def test_work_is_counted_against_whole_frames_a_band() -> None:
    it = shown(T="scanline")
    seen = observations(it.method, it.case)
    work = work_of(it, seen)
    images = len(it.subject.training) * it.subject.frames
    assert (work["images"], work["images_without_body"], work["drawn_passes"]) == (images, 0, images)
    assert work["full_pixels"] == images * small_subject.SIZE**2
    assert work["paper_pixels"] == it.case.bands * work["full_pixels"]
    assert work["drawn_pixels"] == sum(o.camera.height * o.camera.width for o in seen) == work["body_pixels"]
    bands = shown(T="K")
    cut = work_of(bands, observations(bands.method, bands.case))
    assert work["images"] <= cut["drawn_passes"] <= cut["paper_passes"]
    assert cut["drawn_pixels"] == cut["body_pixels"]
