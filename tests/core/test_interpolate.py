"""Interpolators: the contract of all, then flow on motion that is known, then RIFE on weights that are known."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import nn

from rsavatar.errors import DataError
from rsavatar.restore.interpolate import AbstractInterpolator, Bytes, Floats, LinearBlend, RowCopy, Shots, interpolator
from rsavatar.restore.rife import Rife, RifeV4
from rsavatar.restore.rife_nets import IFNet, IFNetV4

SIZE = 64
ROWS, TIMES = np.arange(SIZE), np.full(SIZE, 0.5)


def zero_weights(network: nn.Module, path: Path, prefix: str = "", more: dict[str, torch.Tensor] | None = None) -> Path:
    state = {prefix + name: torch.zeros_like(value) for name, value in network.state_dict().items()}
    torch.save(state | (more or {}), path)
    return path


@pytest.fixture(scope="module")
def rife_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The published file's names: everything under ``module.``, the teacher included."""
    teacher = {"module.block_tea.conv0.0.0.weight": torch.zeros(45, 20, 3, 3)}
    return zero_weights(IFNet(), tmp_path_factory.mktemp("rife") / "flownet.pkl", "module.", teacher)


@pytest.fixture(scope="module")
def v4_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return zero_weights(IFNetV4(), tmp_path_factory.mktemp("rife4") / "flownet.pkl")


@pytest.fixture(scope="module", params=["copy", "linear", "flow", "rife", "rife-v4"])
def each(request: pytest.FixtureRequest, rife_file: Path, v4_file: Path) -> AbstractInterpolator:
    weights = {"rife": rife_file, "rife-v4": v4_file}.get(request.param)
    return interpolator(request.param, weights)


def ball(x: float, y: float, radius: float = 13.0, size: int = SIZE) -> Bytes:
    """A painted ball on black whose centre and paint are at (x, y); samples are exact, no picture is resampled."""
    v, u = np.mgrid[: 4 * size, : 4 * size] / 4 + 0.125
    inside = ((u - x) ** 2 + (v - y) ** 2 < radius**2).astype(float)
    paint = np.stack([np.sin(0.5 * (u - x)), np.cos(0.4 * (v - y)), np.sin(0.35 * (u - x + v - y))], -1)
    shaded = np.concatenate([(0.55 + 0.4 * paint) * inside[..., None], inside[..., None]], -1)
    return np.floor(255 * shaded.reshape(size, 4, size, 4, 4).mean((1, 3)) + 0.5).astype(np.uint8)


def rms(a: Floats, b: Bytes) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


def test_at_the_ends_pictures_come_back(each: AbstractInterpolator) -> None:
    shots = Shots(ball(24, 30), ball(27, 31), ball(30, 32), ball(33, 33))
    rows = np.array([3, 30, 31, 40])
    np.testing.assert_allclose(each.rows(shots, rows, np.zeros(4)), shots.first[rows], atol=2e-5)
    np.testing.assert_allclose(each.rows(shots, rows, np.ones(4)), shots.second[rows], atol=2e-5)


def test_where_nothing_moves_nothing_changes(each: AbstractInterpolator) -> None:
    still = Shots(None, ball(30, 30), ball(30, 30), None)
    np.testing.assert_allclose(each.rows(still, ROWS, np.linspace(0, 1, SIZE)), still.first, atol=1e-3)


def test_rows_are_rows_of_the_picture_at_their_time(each: AbstractInterpolator) -> None:
    shots = Shots(ball(24, 30), ball(27, 31), ball(30, 32), None)
    times = np.array([0.25, 0.75, 0.25])
    rows = each.rows(shots, np.array([20, 30, 40]), times)
    whole = each.rows(shots, ROWS, np.full(SIZE, 0.25))
    assert rows.shape == (3, SIZE, 4)
    np.testing.assert_allclose(rows[[0, 2]], whole[[20, 40]], atol=1e-3)


def test_pictures_must_match() -> None:
    with pytest.raises(DataError, match="picture 'second'"):
        Shots(None, ball(1, 1), ball(1, 1, size=32), None)
    with pytest.raises(DataError, match=r"\(H, W, 4\)"):
        Shots(None, ball(1, 1)[..., :3], ball(1, 1)[..., :3], None)


@pytest.mark.parametrize(("step", "limit"), [((2.0, 0.0), 4.0), ((3.3, -1.7), 4.5), ((0.0, 6.0), 6.0)])
def test_flow_follows_a_steady_motion(step: tuple[float, float], limit: float) -> None:
    """Within a few grey levels of the exact picture, where a cross-fade is off by several times as much."""
    dx, dy = step
    shots = Shots(*(ball(30 + k * dx, 31 + k * dy) for k in (-1, 0, 1, 2)))
    exact = ball(30 + 0.5 * dx, 31 + 0.5 * dy)
    flow, linear, copy = (each.rows(shots, ROWS, TIMES) for each in (interpolator("flow"), LinearBlend(), RowCopy()))
    assert rms(flow, exact) < min(limit, 0.5 * rms(linear, exact)), (rms(flow, exact), rms(linear, exact))
    assert rms(flow, exact) < 0.4 * rms(copy, exact)


def test_flow_follows_an_acceleration() -> None:
    """x = 30 + 6 t + 2 t**2: half-way it is at 33.5, not at 34."""
    where = [30 + 6 * t + 2 * t * t for t in (-1, 0, 1, 2)]
    pictures = [ball(x, 32) for x in where]
    exact = ball(33.5, 32)
    bent = interpolator("flow").rows(Shots(*pictures), ROWS, TIMES)
    straight = interpolator("flow").rows(Shots(None, pictures[1], pictures[2], None), ROWS, TIMES)
    assert rms(bent, exact) < 0.8 * rms(straight, exact)


def test_flow_uncovers_a_background() -> None:
    """A ball before a painted wall: what it uncovers is taken from the one picture that shows it."""
    wall = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (SIZE, SIZE, 3)), (0, 0), 2)
    wall = np.clip(3 * (wall - wall.mean()) + 110, 0, 255)

    def before_wall(x: float) -> Bytes:
        front = ball(x, 32).astype(float)
        mixed = front[..., :3] + wall * (1 - front[..., 3:] / 255)
        return np.floor(np.concatenate([mixed, front[..., 3:]], -1) + 0.5).astype(np.uint8)

    shots = Shots(*(before_wall(32 + 3 * k) for k in (-1, 0, 1, 2)))
    flow, linear = (each.rows(shots, ROWS, TIMES) for each in (interpolator("flow"), LinearBlend()))
    assert rms(flow, before_wall(33.5)) < 0.6 * rms(linear, before_wall(33.5))
    np.testing.assert_allclose(flow[:10], shots.first[:10], atol=3)


def test_rife_has_the_published_size() -> None:
    assert sum(p.numel() for p in IFNet().parameters()) == pytest.approx(10.07e6, abs=5e3)
    assert sum(p.numel() for p in IFNetV4().parameters()) == pytest.approx(5.31e6, abs=5e3)


def test_rife_has_the_published_names() -> None:
    shapes = {name: tuple(value.shape) for name, value in IFNet().state_dict().items()}
    assert shapes["block0.conv0.0.0.weight"] == (120, 6, 3, 3)
    assert shapes["block1.convblock.7.1.weight"] == (150,)
    assert shapes["block2.lastconv.weight"] == (90, 5, 4, 4)
    assert shapes["contextnet.conv4.conv2.0.bias"] == (128,)
    assert shapes["unet.down0.conv1.0.weight"] == (32, 17, 3, 3)
    assert shapes["unet.up3.0.weight"] == (64, 16, 4, 4)
    assert shapes["unet.conv.weight"] == (3, 16, 3, 3)
    v4 = {name: tuple(value.shape) for name, value in IFNetV4().state_dict().items()}
    assert v4["block0.conv0.0.0.weight"] == (96, 7, 3, 3)
    assert v4["block1.convblock.3.beta"] == (1, 128, 1, 1)
    assert v4["block3.lastconv.0.weight"] == (64, 24, 4, 4)


def test_rife_of_zero_weights_is_a_cross_fade(rife_file: Path) -> None:
    """No flow, equal shares, no residual: each halving is a mean, so e halvings are a linear blend on the grid."""
    shots = Shots(None, ball(24, 30, size=40), ball(30, 30, size=40), None)
    rows, times = np.arange(40), np.arange(40) % 9 / 8
    got = Rife(rife_file, recursion=3).rows(shots, rows, times)
    np.testing.assert_allclose(got, LinearBlend().rows(shots, rows, times), atol=1e-3)
    off_grid = Rife(rife_file, recursion=1).rows(shots, rows, np.full(40, 0.6))
    np.testing.assert_allclose(off_grid, LinearBlend().rows(shots, rows, np.full(40, 0.5)), atol=1e-3)


def test_rife_halves_and_halves_again(tmp_path: Path) -> None:
    """With weights that do something: time 1/4 is half-way between the first picture and the one half-way."""
    torch.manual_seed(0)
    network = IFNet().eval()
    torch.save(network.state_dict(), tmp_path / "flownet.pkl")
    shots = Shots(None, ball(14, 16, 8, size=32), ball(17, 16, 8, size=32), None)
    first, second = (torch.from_numpy(p).permute(2, 0, 1)[None].float() / 255 for p in (shots.first, shots.second))
    with torch.no_grad():
        middle = network(first[:, :3], second[:, :3])
        wanted = network(first[:, :3], middle.picture).picture[0].permute(1, 2, 0).numpy() * 255
    got = Rife(tmp_path / "flownet.pkl", recursion=4).rows(shots, np.arange(32), np.full(32, 0.25))
    np.testing.assert_allclose(got[..., :3], wanted, atol=0.05)
    assert 0 < got[..., 3].max() <= 255


def test_rife_v4_takes_the_time(tmp_path: Path, v4_file: Path) -> None:
    shots = Shots(None, ball(14, 16, 8, size=32), ball(17, 16, 8, size=32), None)
    mean = (shots.first.astype(float) + shots.second) / 2
    np.testing.assert_allclose(RifeV4(v4_file).rows(shots, np.arange(32), np.full(32, 0.3)), mean, atol=1e-3)
    torch.manual_seed(0)
    torch.save(IFNetV4().state_dict(), tmp_path / "flownet.pkl")
    early, late = (RifeV4(tmp_path / "flownet.pkl").rows(shots, np.arange(32), np.full(32, t)) for t in (0.2, 0.8))
    assert np.abs(early - late).max() > 0.01


class _Mischief:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("echo run",)


def test_weights_are_checked(tmp_path: Path, rife_file: Path, v4_file: Path) -> None:
    with pytest.raises(DataError, match="nothing there"):
        Rife(tmp_path / "none.pkl", 4)
    with pytest.raises(DataError, match="names of that network"):
        Rife(v4_file, 4)
    state = dict(IFNetV4().state_dict())
    torch.save(state | {"block0.conv0.0.0.weight": torch.zeros(96, 8, 3, 3)}, tmp_path / "shape.pkl")
    with pytest.raises(DataError, match=r"block0\.conv0\.0\.0\.weight: expected shape"):
        RifeV4(tmp_path / "shape.pkl")
    torch.save(state | {"block3.convblock.0.beta": torch.full((1, 64, 1, 1), torch.nan)}, tmp_path / "nan.pkl")
    with pytest.raises(DataError, match="finite numbers"):
        RifeV4(tmp_path / "nan.pkl")
    torch.save({"weight": _Mischief()}, tmp_path / "mischief.pkl")
    with pytest.raises(DataError, match="state dictionary of tensors"):
        Rife(tmp_path / "mischief.pkl", 4)
    (tmp_path / "half.pkl").write_bytes(v4_file.read_bytes()[:5000])
    with pytest.raises(DataError, match="complete state dictionary"):
        RifeV4(tmp_path / "half.pkl")


def test_names_are_checked(rife_file: Path) -> None:
    with pytest.raises(DataError, match="one of flow, linear, copy, rife, rife-v4"):
        interpolator("magic")
    with pytest.raises(DataError, match="weights of rife"):
        interpolator("rife")
    with pytest.raises(DataError, match="it has no weights"):
        interpolator("flow", rife_file)
