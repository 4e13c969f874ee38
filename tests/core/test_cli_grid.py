"""``rsavatar grid`` against the real application: planned, queued, followed, steered, and its table."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rsavatar import cli_grid
from rsavatar.cli import main
from rsavatar.client import Client
from services.store import leases
from tests.core.live_service import OWNER, Service, live_service

SMALL = ("--set", "preset=smoke", "--set", 'variant=[{label="full"},{label="no_rs",ablation={no_rs=true}}]')


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Service]:
    monkeypatch.setattr(cli_grid, "LOOK_SECONDS", 0.02)
    with live_service(tmp_path / "home") as running:
        monkeypatch.setenv("RSAVATAR_URL", running.url)
        yield running


def work(service: Service, psnr: float = 20.0) -> None:
    """Every waiting job succeeds, as a worker would end it."""
    while (claim := leases.claim(service.store, OWNER, 60.0)) is not None:
        service.succeed(claim, psnr)
        psnr += 1.0


def test_a_grid_from_plan_to_table(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["grid", "ablation", *SMALL, "--dry-run"]) == 0
    plan = capsys.readouterr().out
    assert "ablation: 2 jobs, 0 of which have a known result" in plan
    assert "2 x rs-avatar on studio, smoke, 300 steps: 45 s each (assumed: 0.05 s a step" in plan
    assert main(["grid", "ablation", *SMALL, "--key", "k"]) == 0
    grid = capsys.readouterr().out.strip()
    assert main(["grid", "ablation", *SMALL, "--key", "k"]) == 0
    assert capsys.readouterr().out.strip() == grid
    worker = threading.Thread(target=lambda: (time.sleep(0.1), work(service)))
    worker.start()
    assert main(["grid", grid, "--watch"]) == 0
    worker.join()
    assert "2 succeeded" in capsys.readouterr().err
    assert main(["table", "ablation", "--grid", grid, "--format", "tex"]) == 0
    tex = capsys.readouterr().out
    assert tex.index("full model (T = K) & 20.00") < tex.index(r"w/o RS model & \textbf{21.00}")
    assert main(["table", "main", "--grid", "00000000-0000-7000-8000-000000000000"]) == 0
    assert "No finished jobs." in capsys.readouterr().out


def test_a_grid_is_listed_cancelled_and_queued_again(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["grid", "seeds", "--set", "preset=smoke", "--set", "seed=[3,4]", "--subjects", "studio"]) == 0
    grid = capsys.readouterr().out.strip()
    assert main(["grid", grid, "--cancel"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("6 cancelled")
    assert "cancelled" in lines[1]
    assert "subject=studio, method=gauhuman, seed=3" in lines[1]
    assert main(["grid", grid, "--watch"]) == 1
    assert main(["grid", grid, "--retry"]) == 0
    assert "6 queued" in capsys.readouterr().out
    assert main(["grid"]) == 0
    listed = capsys.readouterr().out
    assert "sweep-T" in listed
    assert grid in listed
    with Client() as client:
        assert [found["id"] for found in client.grids()] == [grid]
    assert main(["jobs", "-q", "seed:4 method:gauhuman", "--sort", "submitted"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1


def test_mistakes_are_told_before_anything_is_sent(service: Service, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["grid", "nothing"]) == 2
    assert "GRID: expected a TOML file, the id of a grid, or one of ablation, main" in capsys.readouterr().err
    assert main(["grid", "main", "--set", "method=[nerf]"]) == 2
    assert main(["grid", "main", "--set", 'method=["nerf"]']) == 2
    assert "axes.method: expected" in capsys.readouterr().err
    assert main(["grid", "main", "--subjects", "nobody"]) == 2
    assert "axes.subject: expected" in capsys.readouterr().err
    with Client() as client:
        assert list(client.grids()) == []
