"""``rsavatar run`` on a tiny subject: the files that outside programs rely on, and stopping and going on."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rsavatar.cli import main
from tests.core.subject_files import FRAMES, TEST, write_rolling

WORDS = ("run", "smoke", "--set", "method=gauhuman")


def test_a_run_leaves_what_outside_programs_rely_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    files = write_rolling(tmp_path / "figure")
    monkeypatch.chdir(tmp_path)
    few = ("--set", "iterations=3", "--set", f"body={files.body}")
    assert main([*WORDS, *few, "--subject-dir", "figure"]) == 0
    (out,) = (tmp_path / "runs").glob("figure-gauhuman-????????")
    means = json.loads((out / "metrics.json").read_text())["means"]
    said = capsys.readouterr()
    assert f"{means['psnr']:.2f}" in said.out
    assert f"checkpoint   {out / 'checkpoint.safetensors'}" in said.out
    assert "train 3/3" in said.err
    names = {f"{camera:02d}/{frame:06d}.png" for camera in TEST for frame in range(FRAMES)}
    assert {str(p.relative_to(out / "predictions")) for p in out.glob("predictions/*/*.png")} == names
    assert (out / "preview.png").stat().st_size > 0
    with np.load(out / "motion.npz") as motion:
        shapes = {name: motion[name].shape for name in motion.files}
    n = FRAMES
    assert shapes == {
        "poses": (n, 72), "Rh": (n, 3), "Th": (n, 3), "shapes": (10,),
        "sub_poses": (n, 45, 72), "sub_Rh": (n, 45, 3), "sub_Th": (n, 45, 3),
    }  # fmt: skip


def test_an_interrupted_run_goes_on_to_the_same_numbers(tmp_path: Path) -> None:
    files = write_rolling(tmp_path / "figure")
    words = [*WORDS, "--set", "iterations=300", "--set", f"body={files.body}", "--subject-dir", str(files.root)]
    command = [sys.executable, "-m", "rsavatar.cli", *words, "--out", str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        while not process.stderr.readline().startswith("train"):
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        said = process.stdout.read()
    assert process.returncode == 130
    assert f"stopped; the checkpoint is in {tmp_path / 'out'}" in said
    assert (tmp_path / "out" / "checkpoint.safetensors").is_file()
    resumed = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "Resuming from step" in resumed.stderr
    subprocess.run([*command[:-1], str(tmp_path / "straight")], capture_output=True, check=True)
    first, second = (json.loads((tmp_path / d / "metrics.json").read_text()) for d in ("out", "straight"))
    assert first["scores"] == second["scores"]
