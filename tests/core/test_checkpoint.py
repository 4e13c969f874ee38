"""A checkpoint is whole or it is not used; the one before takes its place."""

from __future__ import annotations

import resource
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rsavatar import checkpoint, kernels
from rsavatar.checkpoint import Owner
from rsavatar.errors import CheckpointError, Interrupted
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.optimization import BLOCK
from tests.core.test_train import OWNER as TRAINED
from tests.core.test_train import assert_same, train

OWNER = Owner("spec", "data", "body", "code")


def write(path: Path, step: int, owner: Owner = OWNER) -> dict[str, torch.Tensor]:
    tensors = {
        "weights": torch.arange(1000, dtype=torch.float32) + step,
        "empty": torch.zeros(0, 3),
        "seen": torch.tensor([True, False]),
        "scalar": torch.tensor(float(step), dtype=torch.float64),
    }
    checkpoint.write(path, tensors, owner, step)
    return tensors


def flip(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(data)


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    tensors = write(path, 7)
    read, owner, step = checkpoint.read(path)
    assert (owner, step) == (OWNER, 7)
    assert all(torch.equal(read[name], tensors[name]) for name in tensors)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("share", [0.05, 0.3, 0.5, 0.7, 0.999])
def test_one_flipped_bit_is_noticed(tmp_path: Path, share: float) -> None:
    path = tmp_path / "checkpoint.safetensors"
    write(path, 7)
    flip(path, int(share * path.stat().st_size))
    with pytest.raises(CheckpointError, match=r"checkpoint\.safetensors"):
        checkpoint.read(path)


def test_the_one_before_takes_the_place_of_a_damaged_one(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    write(path, 50)
    write(path, 100)
    assert checkpoint.read(checkpoint.before(path))[2] == 50
    flip(path, path.stat().st_size - 20)
    step, said = checkpoint.settle(path, OWNER)
    assert step == 50
    assert "damaged" in said[0]
    assert said[1:] == ["Going on from checkpoint.before.safetensors.", "Resuming from step 50."]
    assert checkpoint.read(path)[2] == 50


def test_with_both_damaged_the_start_is_all_that_is_left(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    assert checkpoint.settle(path, OWNER) == (None, [])
    write(path, 50)
    write(path, 100)
    flip(path, 900)
    flip(checkpoint.before(path), 900)
    step, said = checkpoint.settle(path, OWNER)
    assert (step, said[-1], path.exists()) == (None, "Starting anew.", False)


def test_a_crash_between_the_renames_leaves_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    write(path, 50)
    path.replace(checkpoint.before(path))
    assert checkpoint.settle(path, OWNER)[0] == 50


def test_a_copy_from_elsewhere_is_used_only_where_it_is_newer(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    write(tmp_path / checkpoint.STORED, 100)
    assert checkpoint.settle(path, OWNER) == (100, ["Going on from checkpoint.stored.", "Resuming from step 100."])
    write(tmp_path / checkpoint.STORED, 50)
    assert checkpoint.settle(path, OWNER) == (100, ["Resuming from step 100."])
    assert list(tmp_path.iterdir()) == [path]


def test_another_jobs_checkpoint_is_set_aside(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    write(path, 50, replace(OWNER, spec="other"))
    step, said = checkpoint.settle(path, OWNER)
    assert (step, said[-1]) == (None, "Starting anew.")
    assert "spec: expected spec, got other" in said[0]
    assert checkpoint.read(tmp_path / "checkpoint.other.safetensors")[2] == 50


def test_a_full_disk_leaves_the_old_checkpoints_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    write(path, 50)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, limits[1]))  # the write fails in its middle, as on a full disk
    try:
        with pytest.raises(OSError, match="File too large"):
            write(path, 100)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert checkpoint.settle(path, OWNER)[0] == 50
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
def test_a_run_that_falls_back_ends_like_an_undisturbed_one(tmp_path: Path) -> None:
    (tmp_path / "whole").mkdir()
    _, _, whole = train(tmp_path / "whole", RollingShutterAvatar())
    for stop in (25, 75):
        with pytest.raises(Interrupted):
            train(tmp_path, RollingShutterAvatar(), stop_after=stop)
    path = tmp_path / "checkpoint.safetensors"
    flip(path, path.stat().st_size // 2)
    assert checkpoint.settle(path, TRAINED)[0] == BLOCK
    _, _, parts = train(tmp_path, RollingShutterAvatar())
    assert_same(whole, parts)
