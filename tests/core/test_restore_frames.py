"""Correctors, their weights and their cache, on frames whose truth is known in closed form."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from rsavatar.errors import DataError, Interrupted
from rsavatar.restore.base import AbstractCorrector, Bytes, Picture, Shot
from rsavatar.restore.cache import Film, key, read_restored, restored
from rsavatar.restore.classical import FlowCorrector, filled, ways
from rsavatar.restore.cvr import CVR
from rsavatar.restore.jamnet import JAMNet
from rsavatar.restore.networks import NetworkCorrector, network_corrector
from rsavatar.restore.weights import VARIABLE, Origin, Shape, files_of, find, header_of, load, read_state, which

SIZE, SPEED = 96, 9.0  # pixels, pixels a frame period


def seen(shift: Bytes | np.ndarray[tuple[int], np.dtype[np.float64]]) -> Picture:
    """A textured block whose row v stands ``shift[v]`` pixels to the right."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    x = x - np.asarray(shift)[:, None]
    inside = (np.abs(x - 48) < 20) & (np.abs(y - 48) < 34)
    wave = 0.5 + 0.25 * np.sin(0.55 * x + 0.2 * y) + 0.25 * np.sin(0.35 * y - 0.3 * x)
    rgb = np.stack([wave, wave**2, 1 - 0.5 * wave], -1) * 255 * inside[..., None]
    return rgb.astype(np.uint8), (255 * inside).astype(np.uint8)


def rolling(frame: int, speed: float = SPEED, gamma: float = 1.0) -> Picture:
    return seen(speed * (frame + gamma * (np.arange(SIZE) / SIZE - 0.5)))


def sharp(frame: int, speed: float = SPEED) -> Picture:
    return seen(np.full(SIZE, speed * frame))


def psnr(a: Bytes, b: Bytes) -> float:
    error = np.square(a.astype(float) - b).mean() / 255**2
    return float(-10 * np.log10(error + 1e-12))


class TestFlowCorrector:
    @pytest.mark.parametrize("ends", [(True, True), (False, True), (True, False)])
    def test_a_gliding_block_stands_upright_again(self, ends: tuple[bool, bool]) -> None:
        shot = Shot(rolling(-1) if ends[0] else None, rolling(0), rolling(1) if ends[1] else None)
        rgb, coverage = FlowCorrector().restore(shot)
        truth = sharp(0)
        assert psnr(rgb, truth[0]) > psnr(shot.frame[0], truth[0]) + 4
        union, both = (coverage > 127) | (truth[1] > 0), (coverage > 127) & (truth[1] > 0)
        assert both.sum() / union.sum() > 0.95
        assert not rgb[coverage == 0].any()

    def test_half_a_readout_needs_half_the_way(self) -> None:
        shot = Shot(rolling(-1, gamma=0.5), rolling(0, gamma=0.5), rolling(1, gamma=0.5), gamma=0.5)
        rgb, _ = FlowCorrector().restore(shot)
        assert psnr(rgb, sharp(0)[0]) > psnr(shot.frame[0], sharp(0)[0]) + 2

    def test_what_stands_still_stays(self) -> None:
        shot = Shot(rolling(-1, 0.0), rolling(0, 0.0), rolling(1, 0.0))
        assert psnr(FlowCorrector().restore(shot)[0], shot.frame[0]) > 45

    def test_no_readout_and_nobody_come_back_as_they_are(self) -> None:
        shot = Shot(rolling(-1), rolling(0), rolling(1), gamma=0.0)
        assert FlowCorrector().restore(shot) is shot.frame
        empty = (np.zeros((SIZE, SIZE, 3), np.uint8), np.zeros((SIZE, SIZE), np.uint8))
        assert FlowCorrector().restore(Shot(empty, empty, empty)) is empty

    def test_a_parabola_through_three_places_is_found_again(self) -> None:
        from rsavatar.restore.classical import _Step

        def place(
            t: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
        ) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
            return np.stack([3 * t + 2 * t * t, -t + 0.5 * t * t], -1).astype(np.float32)

        apart = [np.full((4, 1), t, np.float32) for t in (-0.9, 1.1)]
        one = np.ones((4, 1), np.float32)
        wanted = np.linspace(-0.5, 0.5, 4, dtype=np.float32)[:, None]
        steps = [_Step(place(t), one, t) for t in apart]
        np.testing.assert_allclose(ways(steps, wanted, 1.0)[0], place(wanted), atol=1e-5)

    def test_filling_continues_what_is_known(self) -> None:
        field = np.zeros((32, 32, 2), np.float32)
        known = np.zeros((32, 32), np.float32)
        field[10:20, 10:20], known[10:20, 10:20] = (2.0, -1.0), 1.0
        np.testing.assert_allclose(
            filled(field, known, 0.0)[::8, ::8], np.broadcast_to([2.0, -1.0], (4, 4, 2)), atol=1e-3
        )

    def test_a_frame_alone_and_pictures_of_two_sizes_are_named(self) -> None:
        with pytest.raises(DataError, match="neighbour"):
            Shot(None, rolling(0), None)
        small = tuple(part[:50] for part in rolling(1))
        with pytest.raises(DataError, match="one size"):
            Shot(None, rolling(0), small)  # type: ignore[arg-type]


class TestNetworkCorrector:
    @pytest.mark.parametrize("model", ["cvr", "jamnet"])
    def test_any_size_goes_in_and_comes_out(self, model: str) -> None:
        torch.manual_seed(0)
        network = (CVR(0.05) if model == "cvr" else JAMNet(0.1)).eval()
        corrector = NetworkCorrector(model, network, Origin("random", "0" * 64))  # type: ignore[arg-type]
        cut = [tuple(part[:90] for part in rolling(n)) for n in (-1, 0)]
        rgb, coverage = corrector.restore(Shot(cut[0], cut[1], None))  # type: ignore[arg-type]
        assert rgb.shape == (90, SIZE, 3)
        assert coverage.shape == (90, SIZE)
        assert not rgb[coverage == 0].any()

    def test_the_first_frame_is_restored_from_a_film_that_runs_backwards(self) -> None:
        torch.manual_seed(0)
        corrector = NetworkCorrector("jamnet", JAMNet(0.1).eval(), Origin("random", "0" * 64))
        down = [tuple(np.ascontiguousarray(part[::-1]) for part in rolling(n)) for n in (0, 1)]
        first = corrector.restore(Shot(None, rolling(0), rolling(1)))
        second = corrector.restore(Shot(down[1], down[0], None))  # type: ignore[arg-type]
        np.testing.assert_array_equal(first[0], second[0][::-1])


class TestWeights:
    def test_the_authors_files_load_by_their_names(self, tmp_path: Path) -> None:
        torch.manual_seed(0)
        (tmp_path / "jamnet").mkdir()
        torch.save(
            {f"module.{k}": v for k, v in JAMNet().state_dict().items()}, tmp_path / "jamnet" / "pre_net_flow.pth"
        )
        network, origin = load("jamnet", files_of("jamnet", tmp_path / "jamnet"))
        assert isinstance(network, JAMNet)
        assert "authors' layout" in origin.label
        assert len(origin.sha256) == 64

    def test_without_biases_in_the_feed_forward_layer_as_well(self, tmp_path: Path) -> None:
        torch.save(JAMNet(ffn_bias=False).state_dict(), tmp_path / "pre_net_flow.pth")
        assert isinstance(load("jamnet", files_of("jamnet", tmp_path))[0], JAMNet)

    def test_a_file_of_ours_says_its_width_and_recipe(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "cvr").mkdir()
        file = tmp_path / "cvr" / "mine.safetensors"
        state = {k: v.half() for k, v in CVR(0.05, star=True).state_dict().items()}
        save_file(state, file, header_of(Shape("cvr", 0.05, True), {"steps_done": 7, "data": "test pairs"}))
        monkeypatch.setenv(VARIABLE, str(tmp_path))
        assert find("cvr") == (file,)
        corrector = network_corrector("cvr")
        assert "reduced width 0.05, 7 steps on test pairs" in corrector.identity
        assert which("cvr") in corrector.identity

    def test_the_packages_own_weights_are_whole(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delenv(VARIABLE, raising=False)
        for model in ("cvr", "jamnet"):
            assert "shipped, trained by this project" in network_corrector(model).identity  # type: ignore[arg-type]

    def test_nothing_in_a_file_is_run(self, tmp_path: Path) -> None:
        bad = tmp_path / "pre_net_flow.pth"
        torch.save({"x": Path}, bad)
        with pytest.raises(DataError, match="state dict"):
            read_state(bad)

    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            (lambda s: s.pop("encoder.conv0.net.0.bias"), "encoder.conv0.net.0.bias: expected .*16.*, got nothing"),
            (lambda s: s.update(more=torch.zeros(1)), "more: expected nothing"),
            (lambda s: s["encoder.conv0.net.0.bias"].fill_(float("nan")), "finite"),
        ],
    )
    def test_what_does_not_fit_is_named(
        self, tmp_path: Path, change: Callable[[dict[str, torch.Tensor]], None], sentence: str
    ) -> None:
        state = JAMNet().state_dict()
        change(state)
        torch.save(dict(state), tmp_path / "pre_net_flow.pth")
        with pytest.raises(DataError, match=sentence):
            load("jamnet", (tmp_path / "pre_net_flow.pth",))

    def test_a_folder_without_weights_is_named(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with pytest.raises(DataError, match=r"one .safetensors, or one each"):
            files_of("cvr", tmp_path)
        monkeypatch.setenv(VARIABLE, str(tmp_path / "none"))
        with pytest.raises(DataError, match=VARIABLE):
            find("cvr")


class Brighten(AbstractCorrector):
    """Counts how often it is asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[bool, bool]] = []

    @property
    def identity(self) -> str:
        return "brighten"

    def restore(self, shot: Shot) -> Picture:
        self.asked.append((shot.before is not None, shot.after is not None))
        return shot.frame[0] // 2 + 10, shot.frame[1]


class TestCache:
    def film(self, gamma: float = 1.0) -> Film:
        return Film(rolling, 3, gamma)

    def test_a_film_is_restored_once(self, tmp_path: Path) -> None:
        corrector, told = Brighten(), list[int]()
        folder = restored(self.film(), corrector, tmp_path, told.append)
        assert restored(self.film(), corrector, tmp_path) == folder
        assert corrector.asked == [(False, True), (True, True), (True, False)]
        assert told == [0, 1, 2]
        rgb, coverage = read_restored(folder, 1)
        np.testing.assert_array_equal(rgb, rolling(1)[0] // 2 + 10)
        np.testing.assert_array_equal(coverage, rolling(1)[1])

    def test_the_key_is_pictures_corrector_and_readout(self, tmp_path: Path) -> None:
        other = Film(lambda n: rolling(n + 1), 3, 1.0)
        keys = {key(self.film(), Brighten()), key(self.film(0.5), Brighten()), key(other, Brighten())}
        assert len(keys | {key(self.film(), FlowCorrector())}) == 4

    def test_a_stop_leaves_nothing_behind(self, tmp_path: Path) -> None:
        with pytest.raises(Interrupted):
            restored(self.film(), Brighten(), tmp_path, should_stop=lambda: True)
        assert [p.suffix for p in tmp_path.iterdir()] == [".lock"]

    def test_a_single_frame_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(DataError, match="at least 2"):
            restored(Film(rolling, 1, 1.0), Brighten(), tmp_path)
