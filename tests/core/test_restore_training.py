"""Pairs, batches and training of the correction networks, on pictures of 64 pixels."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from rsavatar.data.pairs import StudioPairs, studio_takes, subject_takes
from rsavatar.errors import DataError, Interrupted
from rsavatar.events import Event, Progress
from rsavatar.restore.beginnings import begin
from rsavatar.restore.jamnet import JAMNet
from rsavatar.restore.losses import Perception
from rsavatar.restore.pairs import Take, read_pack, shrunk, write_pack
from rsavatar.restore.sampling import Sampler
from rsavatar.restore.train import Recipe, Start, Trainer, validate
from rsavatar.restore.weights import load
from tests.core import small_subject

CPU = torch.device("cpu")


def take(seed: int = 0, half: bool = True) -> Take:
    """A textured block that glides, read row by row."""
    rng = np.random.default_rng(seed)
    speed, phase = rng.uniform(2, 6), rng.uniform(0, 6)

    def drawn(shift: np.ndarray[tuple[int], np.dtype[np.float64]]) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        y, x = np.mgrid[:64, :64].astype(np.float64)
        x = x - shift[:, None]
        wave = 0.5 + 0.4 * np.sin(0.4 * x + 0.3 * y + phase)
        inside = (np.abs(x - 28) < 14) & (np.abs(y - 32) < 26)
        return np.asarray(np.stack([wave, 1 - wave, wave**2], -1) * 255 * inside[..., None], np.uint8)

    late = np.arange(64) / 64 - 0.5
    stacks = [np.stack([drawn(speed * (n + clock)) for n in range(3)]) for clock in (late, 0 * late, 0 * late - 0.5)]
    return Take(stacks[0], stacks[1], stacks[2] if half else None)


class TestPairs:
    def test_a_pack_holds_what_was_put_in(self, tmp_path: Path) -> None:
        takes = [take(0), take(1, half=False)]
        write_pack(tmp_path / "pairs.npz", takes)
        for mine, read in zip(takes, read_pack(tmp_path / "pairs.npz"), strict=True):
            np.testing.assert_array_equal(read.rolling, mine.rolling)
            np.testing.assert_array_equal(read.middle, mine.middle)
            assert (read.first is None) == (mine.first is None)

    def test_what_is_no_pack_is_named(self, tmp_path: Path) -> None:
        (tmp_path / "pairs.npz").write_bytes(b"PK not a zip")
        with pytest.raises(DataError, match="a pack of training pairs"):
            read_pack(tmp_path / "pairs.npz")
        write_pack(tmp_path / "cut.npz", [take()])
        (tmp_path / "cut.npz").write_bytes((tmp_path / "cut.npz").read_bytes()[:5000])
        with pytest.raises(DataError, match="a pack of training pairs"):
            read_pack(tmp_path / "cut.npz")

    def test_shrinking_takes_means(self) -> None:
        small = shrunk(take(), 2)
        assert small.rolling.shape == (3, 32, 32, 3)
        whole = take().rolling[0, :2, 24:26].reshape(-1, 3).mean(0)
        np.testing.assert_allclose(small.rolling[0, 0, 12], whole, atol=0.51)

    def test_studio_pairs_agree_at_the_middle_row(self) -> None:
        found = studio_takes(StudioPairs((0,), size=64, frames=2, cameras=1))[0]
        assert found.first is not None
        rolling, middle, first = (stack[1].astype(int) for stack in (found.rolling, found.middle, found.first))
        assert rolling.any()
        np.testing.assert_array_equal(rolling[32], middle[32])
        np.testing.assert_array_equal(rolling[0], first[0])

    def test_a_subject_gives_a_take_for_each_camera(self) -> None:
        takes = subject_takes(small_subject.subject())
        assert len(takes) == 2
        assert takes[0].first is None


class TestSampler:
    def test_the_same_step_gives_the_same_batch(self) -> None:
        batches = [Sampler([take(0), take(1)], 64, CPU, 3).batch(5, 4) for _ in range(2)]
        assert torch.equal(batches[0].frames, batches[1].frames)
        assert batches[0].frames.shape == (4, 6, 64, 64)
        assert set(batches[0].truths) == {0.0, 0.5, 1.0}

    def test_augmented_pairs_are_still_pairs(self) -> None:
        """The middle row of a rolling frame is the sharp frame's, whichever way the film runs."""
        batch = Sampler([take(0)], 64, CPU, 0).batch(0, 16)
        for time, rolling in ((0.0, batch.frames[:, :3]), (1.0, batch.frames[:, 3:])):
            rows = (rolling - batch.truths[time]).abs().amax((1, 3))
            closest = rows[:, 31:33].amin(1)
            assert float(closest.max()) < 1e-6
            assert float(rows.amax(1).min()) > 0.05

    def test_without_the_first_rows_instants_there_are_two_truths(self) -> None:
        assert set(Sampler([take(0, half=False)], 64, CPU, 0).batch(0, 1).truths) == {0.0, 1.0}

    def test_columns_that_do_not_fit_are_named(self) -> None:
        with pytest.raises(DataError, match="128 columns"):
            Sampler([take(0)], 128, CPU, 0)


def recipe(**words: object) -> Recipe:
    small = Recipe("jamnet", width=0.1, steps=4, batch=1, columns=64, rate=1e-3, held_out=1, every=2, data="blocks")
    return replace(small, **words)  # type: ignore[arg-type]


class TestTrainer:
    def test_training_from_nothing_begins_at_the_rolling_frame(self) -> None:
        torch.manual_seed(0)
        network = JAMNet(0.25)
        begin(network)
        found = validate(network, Sampler([take(0)], 64, CPU, 0).pairs())
        assert abs(found["gain_db"]) < 0.3

    @pytest.mark.parametrize("model", ["jamnet", "cvr"])
    def test_weights_and_recipe_are_written_and_load(self, tmp_path: Path, model: str) -> None:
        events: list[Event] = []
        width = 0.1 if model == "jamnet" else 0.05
        trainer = Trainer(
            recipe(model=model, width=width, warmup=0.5), [take(0), take(1)], tmp_path / "w.safetensors", Start()
        )
        file = trainer.run(events.append)
        network, origin = load(model, (file,))  # type: ignore[arg-type]
        assert type(network) is type(trainer.network)
        beside = json.loads(file.with_suffix(".json").read_text())
        assert beside["sha256"] == origin.sha256
        assert beside["recipe"]["steps_done"] == 4
        assert [point["step"] for point in beside["curve"]] == [2, 4]
        assert {"body_db", "gain_db", "loss"} <= beside["curve"][-1].keys()
        assert [event.step for event in events if isinstance(event, Progress)] == [2, 4]
        assert sorted(path.name for path in tmp_path.iterdir()) == ["w.json", "w.safetensors"]

    def test_a_run_that_was_stopped_ends_where_it_would_have(self, tmp_path: Path) -> None:
        takes = [take(0), take(1)]
        whole = Trainer(recipe(), takes, tmp_path / "whole.safetensors", Start()).run()
        asked = iter([False, False, True])
        with pytest.raises(Interrupted):
            Trainer(recipe(), takes, tmp_path / "cut.safetensors", Start()).run(should_stop=lambda: next(asked))
        cut = Trainer(recipe(), takes, tmp_path / "cut.safetensors", Start()).run()
        mine, other = load("jamnet", (whole,))[0].state_dict(), load("jamnet", (cut,))[0].state_dict()
        assert all(torch.equal(mine[name], other[name]) for name in mine)

    def test_the_state_of_another_recipe_is_refused(self, tmp_path: Path) -> None:
        out = tmp_path / "w.safetensors"
        with pytest.raises(Interrupted):
            Trainer(recipe(), [take(0), take(1)], out, Start()).run(should_stop=lambda: True)
        with pytest.raises(DataError, match="the state of this recipe"):
            Trainer(recipe(seed=1), [take(0), take(1)], out, Start()).run()

    def test_it_starts_from_weights_and_adds_perceptual_terms(self, tmp_path: Path) -> None:
        takes = [take(0), take(1)]
        first = Trainer(recipe(steps=1), takes, tmp_path / "a.safetensors", Start()).run()
        torch.save(vgg(), tmp_path / "vgg.pth")
        start = Start(init=first, vgg=tmp_path / "vgg.pth")
        made = Trainer(recipe(steps=1), takes, tmp_path / "b.safetensors", start).run()
        assert json.loads(made.with_suffix(".json").read_text())["recipe"]["perceptual_terms"] is True
        assert "1 steps on blocks, then 1 steps on blocks" in load("jamnet", (made,))[1].label

    @pytest.mark.parametrize("words", [{"columns": 100}, {"width": 0.0}, {"steps": 0}, {"rate": 0.0}, {"model": "x"}])
    def test_a_recipe_that_cannot_be_is_named(self, words: dict[str, object]) -> None:
        with pytest.raises(DataError, match="expected"):
            recipe(**words)

    def test_too_few_pairs_and_no_gpu_are_named(self, tmp_path: Path) -> None:
        with pytest.raises(DataError, match="more than the 1 takes"):
            Trainer(recipe(), [take(0)], tmp_path / "w.safetensors", Start())
        if not torch.cuda.is_available():
            with pytest.raises(DataError, match="device cuda"):
                Trainer(recipe(), [take(0), take(1)], tmp_path / "w.safetensors", Start("cuda"))


def vgg() -> dict[str, torch.Tensor]:
    from rsavatar.restore.losses import VGG19

    g = torch.Generator().manual_seed(0)
    state = {}
    for index, before, after in VGG19:
        state[f"features.{index}.weight"] = 0.02 * torch.randn(after, before, 3, 3, generator=g)
        state[f"features.{index}.bias"] = torch.zeros(after)
    return state


def test_perception_is_zero_for_equals_and_names_what_is_missing(tmp_path: Path) -> None:
    torch.save(vgg(), tmp_path / "vgg.pth")
    perception, image = Perception(tmp_path / "vgg.pth"), torch.rand(1, 3, 32, 32)
    assert float(perception(image, image)) == 0.0
    assert float(perception(image, 1 - image)) > 0
    torch.save({k: v for k, v in vgg().items() if "14" not in k}, tmp_path / "less.pth")
    with pytest.raises(DataError, match=r"features.14.weight"):
        Perception(tmp_path / "less.pth")
