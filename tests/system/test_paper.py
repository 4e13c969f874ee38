"""``make paper-table``: from a folder of ZJU-MoCap's layout to the printed table, through the service."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.core.footage_files import ball_picture, write_zju_footage


def test_zju_on_disk_to_the_main_table(tmp_path: Path) -> None:
    """One of the six subjects and one method, tiny; that all six are built is tested where the builder is."""
    write_zju_footage(tmp_path / "zju/my_377", 23, ball_picture(64, 0.6, radius=9), (0, 3, 4, 10, 16, 22))
    words = ["--zju", str(tmp_path / "zju"), "--out", str(tmp_path / "rs"), "--only", "377", "--methods", "gauhuman"]
    small = ["--set", "preset=smoke", "--set", "iterations=3", "--home", str(tmp_path / "home")]
    run = subprocess.run(
        [sys.executable, "-m", "services.paper", *words, *small, "--build", "--jobs", "1", "--interpolator", "linear"],
        capture_output=True,
        text=True,
        timeout=400,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert "| GauHuman |" in run.stdout
    assert "data: zju-377 sha256" in run.stdout
    assert (tmp_path / "rs/zju-377/BENCHMARK.md").is_file()
    assert "1 frames a view in all" in (tmp_path / "rs/RS-ZJU.md").read_text()


def test_a_missing_subject_is_named_before_any_work(tmp_path: Path) -> None:
    (tmp_path / "zju/my_377").mkdir(parents=True)
    run = subprocess.run(
        [sys.executable, "-m", "services.paper", "--zju", str(tmp_path / "zju"), "--home", str(tmp_path / "home")],
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
        cwd=Path(__file__).resolve().parents[2],
    )
    assert run.returncode == 2
    assert "none for 386, 387, 392, 393, 394" in run.stderr
    assert not (tmp_path / "home").exists()
