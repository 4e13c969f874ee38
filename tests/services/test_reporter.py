from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path

import pytest

from rsavatar import errors
from services.store import artifacts
from services.store.records import Checkpoint
from services.store.session import Store
from services.worker.child import describe
from services.worker.launch import child_environment, describe_death
from services.worker.reporter import Reporter
from tests.services.conftest import Settings


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def progress(step: int, stage: str = "train", **more: object) -> dict[str, object]:
    return {"kind": "progress", "stage": stage, "step": step, "steps": 100, "seconds": 1.0, "eta_seconds": 9.0, **more}


def test_a_fast_job_costs_one_look_and_one_point_a_heartbeat(store: Store) -> None:
    reporter = Reporter(partial(artifacts.keep, store))
    for step in range(1, 51):
        reporter.take(progress(step, loss=1.0 / step, gaussians=step))
    batch = reporter.flush()
    assert [e.kind for e in batch.events] == ["progress"]
    assert {(p.key, p.step, p.value) for p in batch.points} == {("loss", 50, 0.02), ("gaussians", 50, 50.0)}
    assert batch.look is not None
    assert batch.look.step == 50
    assert reporter.flush() == type(batch)([], [], [], None)


def test_only_getting_somewhere_counts_as_movement(store: Store) -> None:
    clock = Clock()
    reporter = Reporter(partial(artifacts.keep, store), clock)
    for now, message, moved in (
        (1.0, progress(1), 1.0),
        (2.0, progress(1), 1.0),
        (3.0, progress(2), 3.0),
        (4.0, progress(2, stage="evaluate"), 4.0),
        (5.0, {"kind": "note", "text": "x"}, 5.0),
    ):
        clock.now = now
        reporter.take(message)
        assert reporter.moved_at == moved


def test_a_checkpoint_is_stored_unless_it_is_another_by_now(store: Store, tmp_path: Path) -> None:
    reporter = Reporter(partial(artifacts.keep, store))
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(b"state")
    sha256 = hashlib.sha256(b"state").hexdigest()
    told = {"kind": "checkpointed", "step": 5, "path": str(file), "sha256": sha256}
    reporter.take(told)
    assert reporter.flush().checkpoint == Checkpoint(5, sha256, 5)
    reporter.take({**told, "sha256": "0" * 64})
    reporter.take({**told, "path": str(tmp_path / "none")})
    batch = reporter.flush()
    assert batch.checkpoint is None
    assert [e.kind for e in batch.events] == ["checkpointed", "note", "checkpointed"]


def test_a_lost_picture_does_not_cost_the_job(store: Store, tmp_path: Path) -> None:
    reporter = Reporter(partial(artifacts.keep, store))
    reporter.take({"kind": "preview", "step": 1, "path": str(tmp_path / "none.png"), "caption": "x"})
    (tmp_path / "one.png").write_bytes(b"png")
    reporter.take({"kind": "preview", "step": 2, "path": str(tmp_path / "one.png"), "caption": "x"})
    batch = reporter.flush()
    assert [e.kind for e in batch.events] == ["note", "preview"]
    assert [a.name for a in batch.artifacts] == ["preview/00000002-one.png"]
    assert "path" not in batch.events[1].payload


@pytest.mark.parametrize(
    ("error", "failure"),
    [
        (errors.DivergedError("x"), "diverged"),
        (errors.DataError("x"), "bad data"),
        (errors.BodyError("x"), "bad data"),
        (MemoryError(), "out of memory"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried"), "out of memory"),
        (OSError(28, "No space left on device"), "infrastructure"),
        (ZeroDivisionError(), "bug"),
        (errors.KernelError("x"), "bug"),
    ],
)
def test_failures_are_classified(error: Exception, failure: str) -> None:
    assert describe(error)["failure"] == failure


def test_deaths_are_told_by_signal_or_status() -> None:
    assert "SIGKILL" in describe_death(-9)
    assert "status 3" in describe_death(3)


def test_threads_are_set_before_the_process_starts_and_secrets_stay_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RSAVATAR_DATABASE_URL", "postgresql://user:hidden@host/db")
    env = child_environment(Settings(threads_per_job=3))
    assert (env["OMP_NUM_THREADS"], env["OMP_WAIT_POLICY"]) == ("3", "passive")
    assert "hidden" not in str(env)
