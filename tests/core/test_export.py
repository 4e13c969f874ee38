"""What comes out of a finished job is the avatar that was trained: the same pictures, the same Gaussians."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from rsavatar.body.base import JOINTS
from rsavatar.errors import CheckpointError, SpecError
from rsavatar.evaluate import render_view as scored_view
from rsavatar.export.ply import PROPERTIES, Cloud, canonical_cloud, posed_cloud, write_ply
from rsavatar.export.replay import Replay, joints_at, open_replay
from rsavatar.export.scene import write_scene
from rsavatar.export.strip import busiest, exposures, on_white, views
from rsavatar.export.turntable import Turntable, write_turntable
from rsavatar.export.views import View, camera_of, encode, framing_camera, orbit, render_view
from rsavatar.imaging import expose
from rsavatar.render.base import Gaussians, Scene, TimedRows
from tests.core.finished_run import run_figure


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Replay:
    return open_replay(run_figure(tmp_path_factory.mktemp("export")))


def difference(a: np.ndarray, b: np.ndarray) -> int:
    return int(np.abs(a.astype(int) - b.astype(int)).max())


def test_a_calibrated_view_is_the_one_that_was_scored(replay: Replay) -> None:
    name = replay.subject.held_out[0]
    size = max(replay.subject.cameras[name].height, replay.subject.cameras[name].width)
    with torch.no_grad():
        scored = scored_view(replay.actor, replay.subject, name, 2, replay.skin_weights, replay.spec.sh_degree)
    assert scored.max() > 30
    assert difference(render_view(replay, View(camera=name, time=2, size=size)), scored) == 0


def test_shutters_without_a_readout_are_the_global_one(replay: Replay) -> None:
    sharp = render_view(replay, View(time=1.3, size=96))
    for word in ("blur", "blur:3", "rolling", "bands:5"):
        assert difference(render_view(replay, View(time=1.3, shutter=word, readout=0.0, size=96)), sharp) <= 1, word
    for word in ("blur:1", "bands:1"):
        assert difference(render_view(replay, View(time=1.3, shutter=word, size=96)), sharp) <= 1, word


def test_many_bands_come_near_the_rolling_shutter(replay: Replay) -> None:
    looks = {word: View(time=2, shutter=word, size=96) for word in ("global", "bands:2", "bands:24", "rolling")}
    seen = {word: render_view(replay, look).astype(float) for word, look in looks.items()}
    error = {word: float(np.square(seen[word] - seen["rolling"]).mean()) for word in seen}
    assert error["bands:24"] < error["bands:2"] < error["global"]


def test_a_transparent_picture_over_black_and_white_is_the_black_and_the_white_one(replay: Replay) -> None:
    look = View(time=1, size=96, background="transparent")
    rgba = render_view(replay, look).astype(float)
    colour, alpha = rgba[..., :3], rgba[..., 3:] / 255
    for background, value in (("black", 0), ("white", 255)):
        over = colour * alpha + value * (1 - alpha)
        assert difference(over.round(), render_view(replay, replace(look, background=background))) <= 2


def test_the_framing_camera_holds_the_whole_motion_upright_and_from_the_front(replay: Replay) -> None:
    stage, camera = replay.stage, framing_camera(replay.stage, 100)
    for frame in range(replay.subject.frames):
        places, depth = camera.project(joints_at(replay.actor, frame, 0.0))
        assert (depth > 0).all()
        assert ((places > 0) & (places < 100)).all()
    assert camera.rotation[1] @ stage.up == pytest.approx(-1)
    assert camera.rotation[2] @ stage.front == pytest.approx(-1)


@pytest.mark.parametrize(("azimuth", "elevation"), [(90, 0), (-30, 40), (180, -20), (0, 60)])
def test_an_orbit_keeps_its_distance_its_aim_and_the_horizon(replay: Replay, azimuth: float, elevation: float) -> None:
    stage, base = replay.stage, framing_camera(replay.stage, 64)
    turned = orbit(base, stage, azimuth, elevation)
    away = turned.centre - stage.centre
    assert np.linalg.norm(away) == pytest.approx(np.linalg.norm(base.centre - stage.centre))
    assert turned.project(stage.centre)[0] == pytest.approx([32, 32])
    assert turned.rotation[0] @ stage.up == pytest.approx(0, abs=1e-9)
    assert away @ stage.up / np.linalg.norm(away) == pytest.approx(np.sin(np.radians(elevation)))
    assert orbit(base, stage, 360, 0).centre == pytest.approx(base.centre)


@pytest.mark.parametrize(
    ("look", "name"),
    [
        (View(camera="99"), "camera"),
        (View(time=99), "time"),
        (View(shutter="roling"), "shutter"),
        (View(shutter="bands:0"), "shutter"),
        (View(shutter="blur:"), "shutter"),
        (View(readout=-1.0), "readout"),
        (View(readout=1e3), "readout"),
    ],
)
def test_what_the_subject_does_not_have_is_named(replay: Replay, look: View, name: str) -> None:
    with pytest.raises(SpecError, match=f"^{name}: expected"):
        render_view(replay, look)


@pytest.mark.parametrize(("fmt", "kind"), [("png", "PNG"), ("webp", "WEBP")])
def test_pictures_are_files_of_their_kind(replay: Replay, fmt: str, kind: str) -> None:
    picture = Image.open(io.BytesIO(encode(render_view(replay, View(size=40, background="transparent")), fmt)))  # type: ignore[arg-type]
    assert (picture.format, picture.size, picture.mode) == (kind, (40, 40), "RGBA")


def read_ply(data: bytes) -> tuple[list[str], np.ndarray]:
    """Header lines and the table [M, properties], by the format's own definition."""
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    count = int(next(line for line in lines if line.startswith("element vertex")).split()[-1])
    return lines, np.frombuffer(body, "<f4").reshape(count, -1)


def column(table: np.ndarray, *names: str) -> np.ndarray:
    return table[:, [PROPERTIES.index(name) for name in names]]


def test_the_ply_is_what_viewers_of_gaussian_splatting_read(replay: Replay) -> None:
    lines, table = read_ply(write_ply(canonical_cloud(replay)))
    avatar = replay.actor.avatar
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", f"element vertex {avatar.count}"]
    assert lines[3:] == [f"property float {name}" for name in PROPERTIES]
    assert PROPERTIES[:9] == ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2")
    assert table.shape == (avatar.count, 62)
    assert column(table, "x", "y", "z") == pytest.approx(avatar.means.T.numpy())
    assert column(table, "f_dc_0", "f_dc_1", "f_dc_2") == pytest.approx(avatar.sh_constant[0].T.numpy())
    green = column(table, "f_rest_15", "f_rest_16", "f_rest_17")  # channel by channel, 15 each
    assert green == pytest.approx(avatar.sh_linear[:, 1].T.numpy())
    assert column(table, "opacity")[:, 0] == pytest.approx(avatar.opacity_logits.numpy())
    assert column(table, "scale_0", "scale_1", "scale_2") == pytest.approx(avatar.log_scales.T.numpy(), abs=1e-5)
    assert np.linalg.norm(column(table, "rot_0", "rot_1", "rot_2", "rot_3"), axis=1) == pytest.approx(1, abs=1e-5)


def rigid_scene(cloud: Cloud, like: Scene) -> Scene:
    """The cloud as it lies, under a motion that moves nothing."""
    count = len(cloud.means)
    weights = torch.zeros(JOINTS, count)
    weights[0] = 1
    gaussians = Gaussians(
        cloud.means.T.float().contiguous(),
        cloud.rotations.T.float().contiguous(),
        cloud.scales.T.float().log().contiguous(),
        cloud.opacity_logits,
        cloud.sh.permute(1, 2, 0).contiguous(),
        weights,
        torch.zeros(2, count),
    )
    still = torch.eye(3, 4).expand(1, 1, JOINTS, 3, 4).contiguous()
    return Scene(gaussians, still, (TimedRows(0, like.camera.height, 0.0, 0.0),), like.camera)


def test_a_posed_cloud_looks_like_the_avatar_at_that_instant(replay: Replay) -> None:
    camera, _ = camera_of(replay, View(azimuth=40, size=96))
    posed = posed_cloud(replay, 2.4)
    seen = render_view(replay, View(time=2.4, azimuth=40, size=96)).astype(float) / 255
    frozen = rigid_scene(posed, Scene(None, torch.zeros(0), (), camera))  # type: ignore[arg-type]
    rebuilt = expose(frozen).rgb.permute(1, 2, 0).clamp(0, 1).numpy()
    assert seen.max() > 0.1
    assert np.square(seen - rebuilt).mean() < 10**-5  # 50 dB: a byte's rounding is 59 dB


def test_the_scene_file_holds_the_avatar_and_its_motion(replay: Replay) -> None:
    data = write_scene(replay)
    assert data[:4] == b"RSAV"
    length = struct.unpack("<I", data[4:8])[0]
    header = json.loads(data[8 : 8 + length])
    start = (8 + length + 3) // 4 * 4
    arrays = {}
    for name, about in header["arrays"].items():
        assert about["offset"] % 4 == 0
        kind = {"f4": "<f4", "u1": "u1"}[about["dtype"]]
        count = int(np.prod(about["shape"]))
        arrays[name] = np.frombuffer(data, kind, count, start + about["offset"]).reshape(about["shape"])
    frames, period = replay.subject.frames, replay.subject.timing.period_frames
    assert (header["frames"], header["period"], header["still"]) == (frames, period, False)
    assert arrays["weights"].sum(1) == pytest.approx(1, abs=1e-5)
    middle = replay.actor.transforms(3, torch.zeros(1, dtype=torch.float64))[0].numpy()
    assert arrays["maps"][3, 6] == pytest.approx(middle, abs=1e-5)
    affine = np.einsum("mk,mkrc->mrc", arrays["weights"], arrays["maps"][3, 6][arrays["joints"]])
    means = arrays["means"] + arrays["offsets"][3]
    posed = np.einsum("mrc,mc->mr", affine[:, :, :3], means) + affine[:, :, 3]
    assert posed == pytest.approx(posed_cloud(replay, 3.0).means.numpy(), abs=1e-4)


def test_a_still_method_says_so(tmp_path: Path) -> None:
    still = open_replay(run_figure(tmp_path, "gauhuman"))
    length = struct.unpack("<I", (data := write_scene(still))[4:8])[0]
    assert json.loads(data[8 : 8 + length])["still"] is True


@pytest.mark.parametrize("fmt", ["mp4", "webm"])
def test_a_turntable_plays(replay: Replay, tmp_path: Path, fmt: str) -> None:
    path = tmp_path / f"t.{fmt}"
    path.write_bytes(write_turntable(replay, Turntable(View(size=65, background="white"), pictures=6), fmt))
    video = cv2.VideoCapture(str(path))
    frames = []
    while True:
        there, picture = video.read()
        if not there:
            break
        frames.append(picture)
    assert len(frames) == 6
    assert frames[0].shape == (64, 64, 3)  # cut to even sides
    assert difference(frames[0], frames[3]) > 60


def test_a_gif_has_all_its_pictures(replay: Replay) -> None:
    data = write_turntable(replay, Turntable(View(size=48), pictures=4, moving=False), "gif")
    assert getattr(Image.open(io.BytesIO(data)), "n_frames") == 4  # noqa: B009 - Pillow adds it for such files


def test_a_video_needs_a_background_and_a_known_format(replay: Replay) -> None:
    with pytest.raises(SpecError, match="background"):
        write_turntable(replay, Turntable(View(background="transparent"), pictures=2), "mp4")
    with pytest.raises(SpecError, match="format: expected one of mp4, webm, gif"):
        write_turntable(replay, Turntable(View(), pictures=2), "avi")


def test_an_avatar_of_other_data_is_refused(replay: Replay, tmp_path: Path) -> None:
    source = run_figure(tmp_path, iterations=1)
    picture = next((tmp_path / "figure" / "rs" / "images").rglob("*.png"))
    pixels = cv2.imread(str(picture))
    assert pixels is not None
    cv2.imwrite(str(picture), 255 - pixels)
    with pytest.raises(CheckpointError, match="checkpoint data: expected the data that the job was trained with"):
        open_replay(source)


def test_a_strip_has_every_picture_at_one_size_and_scores_as_evaluation_does(replay: Replay) -> None:
    camera = replay.subject.held_out[0]
    found = views({"a": replay}, camera, 1)
    shape = found["truth"].shape
    assert found["input"].shape == found["a"].shape == shape
    assert found["error:a"].shape == shape[:2]
    x0, y0, x1, y1 = found["box"]
    assert 0 <= x0 < x1 <= shape[1]
    assert 0 <= y0 < y1 <= shape[0]
    scores = json.loads((replay.source.checkpoint.parent / "metrics.json").read_text())["scores"]
    scored = next(s["psnr"] for s in scores if (s["camera"], s["frame"]) == (camera, 1))
    assert found["psnr:a"] == pytest.approx(scored, abs=1e-9)


def test_exposures_are_cut_alike(replay: Replay) -> None:
    found = exposures(replay, 1)
    assert {found[name].shape for name in ("global", "blur", "bands", "rolling")} == {found["global"].shape}
    assert found["global"].min() < 200


def test_the_busiest_square_is_the_one_with_the_most() -> None:
    values = np.zeros((100, 60), np.float32)
    values[70:76, 40:46] = 1
    x0, y0, x1, y1 = busiest(values)
    assert x0 <= 40
    assert x1 >= 46
    assert y0 <= 70
    assert y1 >= 76


def test_on_white_keeps_the_body_and_whitens_the_rest() -> None:
    picture, mask = np.full((2, 2, 3), 90, np.uint8), np.array([[255, 0], [128, 255]], np.uint8)
    picture[0, 1] = 0
    picture[1, 0] = 45
    white = on_white(picture, mask)
    assert white[0, 0].tolist() == [90, 90, 90]
    assert white[0, 1].tolist() == [255, 255, 255]
    assert white[1, 0].tolist() == [172, 172, 172]
