"""`rsavatar restore`: a pack is drawn, a network is trained on it, its weights are scored on a subject."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rsavatar.cli import main
from tests.core.subject_files import write_rolling
from tests.core.test_restore_training import take


def test_from_pairs_to_a_score(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from rsavatar.restore.pairs import write_pack

    monkeypatch.setenv("RSAVATAR_CACHE", str(tmp_path / "cache"))
    write_pack(tmp_path / "blocks.npz", [take(0), take(1)])
    out = tmp_path / "weights" / "jamnet" / "ours.safetensors"
    words = ["--width", "0.1", "--steps", "2", "--batch", "1", "--columns", "64", "--held-out", "1"]
    assert (
        main(
            ["restore", "train", "--model", "jamnet", "--data", str(tmp_path / "blocks.npz"), "--out", str(out), *words]
        )
        == 0
    )
    assert json.loads(out.with_suffix(".json").read_text())["recipe"]["data"] == "blocks"
    write_rolling(tmp_path / "subject")
    capsys.readouterr()
    assert main(["restore", "score", "--model", "jamnet", "--weights", str(out.parent), str(tmp_path / "subject")]) == 0
    told = capsys.readouterr().out
    assert "reduced width 0.1, 2 steps on blocks" in told
    assert "dB, frame" in told


def test_a_pack_is_drawn_in_the_studio(tmp_path: Path) -> None:
    from rsavatar.restore.pairs import read_pack

    assert main(["restore", "pack", str(tmp_path / "pairs.npz"), "--seeds", "3", "--size", "64"]) == 0
    assert [take.rolling.shape for take in read_pack(tmp_path / "pairs.npz")] == [(5, 64, 64, 3)] * 8


@pytest.mark.parametrize("seeds", ["", "x", "7-3", "1-"])
def test_seeds_that_cannot_be_are_named(tmp_path: Path, seeds: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["restore", "pack", str(tmp_path / "pairs.npz"), f"--seeds={seeds}"]) == 2
    assert "seeds: expected a number, or A-B" in capsys.readouterr().err
