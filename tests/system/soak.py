"""``make soak``: many jobs while something is killed every few seconds.

Every distinct job is run once in peace. Then many of them are run again while workers, the processes that train, the
API and the broker (which also loses its memory) are killed in turn. At the end every job must have succeeded exactly
once with the numbers of its peaceful run, and no process, file or row may be left over.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import redis
from sqlalchemy import func, select

from services.demo import free_port
from services.settings import Settings
from services.store import events, garbage
from services.store.tables import ArtifactRow, CheckpointRow, EventRow, JobRow, ResultRow
from tests import postgresql
from tests.system.harness import Host, until

REAL = Settings.model_fields["child_command"].default
WORKERS = ("worker", "worker-2")
LEFT_OVER = ("*.tmp", "*.part", "incoming-*")
Numbers = dict[str, Any]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    words = argparse.ArgumentParser("tests.system.soak", description=__doc__)
    words.add_argument("--jobs", type=int, default=1000, help="jobs under fire (default: 1000)")
    words.add_argument("--distinct", type=int, default=4, help="distinct jobs among them (default: 4)")
    words.add_argument("--kill-every", type=float, default=4.0, metavar="SECONDS", help="mean pause (default: 4)")
    words.add_argument("--iterations", type=int, default=100, help="optimiser steps of a job (default: 100)")
    words.add_argument("--quick", action="store_true", help="count in place of training: tests the service alone")
    words.add_argument("--postgresql", action="store_true", help="on PostgreSQL (default: SQLite)")
    words.add_argument("--seed", type=int, default=0, help="of the order of kills")
    return words


class Soak:
    """One run."""

    def __init__(self, host: Host, options: argparse.Namespace) -> None:
        self.host = host
        self.options = options
        self.random = random.Random(options.seed)
        self.kills: Counter[str] = Counter()
        self.times: list[tuple[float, str]] = []  # database clock, job that lost its process

    def submit(self, number: int) -> str:
        """Job ``number`` of the distinct ones."""
        method = ("rs-avatar", "gauhuman")[number % 2]
        return self.host.submit(
            method=method, seed=number, iterations=self.options.iterations, checkpoint_every=50, priority=number % 3
        )

    def numbers(self, job: str) -> Numbers:
        """What a job found, without what depends on the clock."""
        found = self.host.client.get(f"/api/v1/jobs/{job}/results").json()
        return {name: found[name] for name in ("means", "per_camera", "scores", "gaussians")}

    def in_peace(self) -> list[Numbers]:
        """Every distinct job once, undisturbed."""
        jobs = [self.submit(number) for number in range(self.options.distinct)]
        for job in jobs:
            self.host.wait_for(job, "succeeded", seconds=600.0)
        return [self.numbers(job) for job in jobs]

    def under_fire(self) -> list[str]:
        """All jobs, with kills until the last has ended."""
        jobs = [self.submit(number % self.options.distinct) for number in range(self.options.jobs)]
        faults: list[Callable[[], None]] = [self.kill_worker, self.kill_child, self.kill_worker, self.kill_child]
        faults += [self.kill_api, self.kill_broker]
        while self.ended() < self.options.jobs + self.options.distinct:
            self.random.choice(faults)()
            time.sleep(self.random.uniform(0.5, 1.5) * self.options.kill_every)
        return jobs

    def ended(self) -> int:
        """Jobs that will not run again."""
        with self.host.store.read() as session:
            return session.scalar(select(func.count()).where(JobRow.state.in_(("succeeded", "failed", "dead")))) or 0

    def kill_worker(self) -> None:
        name = self.random.choice(WORKERS)
        self._note(name)
        self.host.kill(name)
        self.host.start(name)

    def kill_child(self) -> None:
        children = self.host.children()
        if children:
            self._note("child")
            self.random.choice(children).send_signal(signal.SIGKILL)

    def kill_api(self) -> None:
        self._note("api")
        self.host.kill("api")
        self.host.start("api")

    def kill_broker(self) -> None:
        self._note("redis with FLUSHALL")
        with redis.Redis(unix_socket_path=str(self.host.settings.socket)) as client:
            client.flushall()
        self.host.kill("redis")
        self.host.start("redis")

    def _note(self, what: str) -> None:
        self.kills[what.partition("-")[0]] += 1
        ended = self.ended()
        print(f"{time.strftime('%H:%M:%S')} kill {what}; {ended} ended", file=sys.stderr, flush=True)

    def recoveries(self) -> list[float]:
        """Seconds between the loss of an attempt, as the database noted it, and the next attempt's beginning."""
        with self.host.store.read() as session:
            rows = session.scalars(select(EventRow).where(EventRow.kind == "state").order_by(EventRow.id)).all()
        lost: dict[str, float] = {}
        found = []
        for row in rows:
            if row.payload["state"] == "queued" and "reason" in row.payload:
                lost[row.job_id] = row.created_at
            elif row.payload["state"] == "running" and row.job_id in lost:
                found.append(row.created_at - lost.pop(row.job_id))
        return found

    def verify(self, jobs: list[str], expected: list[Numbers]) -> list[str]:
        """Sentences about what is wrong."""
        wrong = []
        for number, job in enumerate(jobs):
            state = self.host.job(job)["state"]
            if state != "succeeded":
                wrong.append(f"job {job} is {state}")
            elif self.numbers(job) != expected[number % len(expected)]:
                wrong.append(f"job {job} has other numbers than its peaceful run")
            told = [e for e in events.after(self.host.store, 0, job, limit=100_000) if e.kind == "state"]
            endings = [e.payload["state"] for e in told if e.payload["state"] in {"succeeded", "failed", "dead"}]
            if len(endings) != 1:
                wrong.append(f"job {job} has ended {len(endings)} times: {endings}")
        return wrong + self.left_over()

    def left_over(self) -> list[str]:
        """Processes, files and rows that belong to nothing."""
        host, wrong = self.host, []
        wrong += [f"process {child.pid} still runs" for child in host.children()]
        garbage.collect(host.store, host.settings.home / "jobs", -1.0, dry_run=False)
        wrong += [f"file {path}" for pattern in LEFT_OVER for path in host.settings.home.rglob(pattern)]
        with host.store.read() as session:
            named = set(session.scalars(select(ArtifactRow.sha256)))
            ids = set(session.scalars(select(JobRow.id)))
            results = session.scalars(select(ResultRow.job_id)).all()
            checkpoints = session.scalars(select(CheckpointRow.job_id)).all()
        stored = {blob.sha256 for blob in host.store.blobs.all()}
        wrong += [f"blob {sha256} is {word}" for word, some in (("unnamed", stored - named), ("lost", named - stored))
                  for sha256 in some]  # fmt: skip
        wrong += [f"folder {path}" for path in (host.settings.home / "jobs").iterdir() if path.name not in ids]
        wrong += [f"{len(results)} results of {len(ids)} jobs"] if sorted(results) != sorted(ids) else []
        return wrong + [f"checkpoint row of {job}" for job in checkpoints]


def run(options: argparse.Namespace, host: Host) -> bool:
    """Everything; prints a report as JSON. Whether nothing is wrong."""
    for name in ("redis", "api", *WORKERS):
        host.start(name)
    soak = Soak(host, options)
    expected = soak.in_peace()
    begun = time.monotonic()
    jobs = soak.under_fire()
    seconds = time.monotonic() - begun
    until(lambda: not host.children(), 60.0)
    wrong = soak.verify(jobs, expected)
    attempts = Counter(host.job(job)["attempt"] for job in jobs)
    recoveries = soak.recoveries()
    report = {
        "jobs": len(jobs), "distinct": options.distinct, "seconds": round(seconds), "kills": dict(soak.kills),
        "attempts": dict(sorted(attempts.items())), "wrong": wrong,
        "database": host.store.engine.dialect.name, "child": "count" if options.quick else "training",
        "requeued_to_running_seconds": {"median": round(statistics.median(recoveries), 2),
                                        "max": round(max(recoveries), 2)} if recoveries else None,
    }  # fmt: skip
    print(json.dumps(report, indent=1))
    return not wrong


def main() -> int:
    """Run it in a home that disappears."""
    options = parser().parse_args()
    changes: dict[str, Any] = {"max_attempts": 1000, "worker_concurrency": 1, "threads_per_job": 1, "gc_hours": 0.0}
    changes |= {} if options.quick else {"child_command": REAL, "stall_seconds": 300.0}
    with tempfile.TemporaryDirectory(prefix="rsavatar-soak-") as folder, postgresql.running() as server:
        if options.postgresql:
            assert server is not None, "no PostgreSQL here"
            changes["database_url"] = server.migrated()
        host = Host(Path(folder) / "home", free_port(), **changes)
        try:
            return 0 if run(options, host) else 1
        finally:
            host.close()


if __name__ == "__main__":
    sys.exit(main())
