"""The real computation, small: through HTTP, with its worker killed on the way, against the command line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.demo import free_port
from services.settings import ROOT, Settings
from tests.system.harness import Host

REAL_CHILD = Settings.model_fields["child_command"].default
SPEC = {"method": "rs-avatar", "iterations": 150, "checkpoint_every": 50}


@pytest.fixture
def training_host(tmp_path: Path) -> Iterator[Host]:
    host = Host(tmp_path / "home", free_port(), child_command=REAL_CHILD, stall_seconds=300.0, lease_seconds=60.0)
    for name in ("redis", "api", "worker"):
        host.start(name)
    yield host
    host.close()


def test_a_killed_worker_and_the_command_line_end_in_the_same_numbers(training_host: Host, tmp_path: Path) -> None:
    job = training_host.submit(**SPEC)
    training_host.wait_for_step(job, 75, seconds=120.0)
    training_host.kill("worker")
    training_host.start("worker")
    words = [word for key, value in {"subject": "studio", **SPEC}.items() for word in ("--set", f"{key}={value}")]
    command = [sys.executable, "-m", "rsavatar.cli", "run", "smoke", *words, "--out", str(tmp_path / "out")]
    subprocess.run(command, cwd=ROOT, env=os.environ | {"RSAVATAR_THREADS": "1"}, check=True, capture_output=True)
    view = training_host.wait_for(job, "succeeded", "failed", "dead", seconds=240.0)
    assert (view["state"], view["attempt"], view["failures"]) == ("succeeded", 2, 1), view["error"]
    assert any(note.startswith("Resuming from step") for note in training_host.notes(job))
    alone = json.loads((tmp_path / "out" / "metrics.json").read_text())
    served = training_host.client.get(f"/api/v1/jobs/{job}/results").json()
    assert served["means"] == alone["means"]
    assert served["per_camera"] == alone["per_camera"]
    assert f"{alone['means']['psnr']:.2f}" in training_host.client.get("/api/v1/tables/main.md").text
