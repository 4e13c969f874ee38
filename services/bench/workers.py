"""What running jobs costs: logging, dispatch, supervision, and how long a lost job stays lost."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from statistics import fmean
from typing import Any

import psutil

from rsavatar.spec import resolve
from services.bench.child import INSTANTS, STEP_MS
from services.bench.host import Host, host
from services.bench.load import Sample
from services.bench.requests import BASE, Found
from services.bench.sizes import Sizes
from services.settings import Settings
from services.store import intake, jobs, leases
from services.store.records import Batch, Claim, Event, Look, Point, State, Submission
from services.store.session import Store

LOGGERS = 20
PROCESSES = 4
WAIT_SECONDS = 600.0
CHILD = {"child_command": (sys.executable, "-m", "services.bench.child"), "worker_concurrency": 1}


def submit(store: Store, count: int, iterations: int = 1) -> list[str]:
    """Jobs that differ by their seeds."""
    ids = []
    for seed in range(count):
        spec = resolve({**BASE, "seed": seed, "iterations": iterations})
        stored = spec.model_dump(mode="json", by_alias=True)
        ids.append(intake.submit(store, Submission(stored, spec.sha256(), spec.sha256(), 5))[0].id)
    return ids


def logging(sizes: Sizes) -> Found:
    """Heartbeats with 10 and with 500 metrics, of 20 running jobs of several worker processes at once."""
    context = multiprocessing.get_context("spawn")
    found: Found = {}
    for points in (10, 500):
        with host() as running, context.Pool(PROCESSES) as pool:
            submit(running.store, LOGGERS)
            orders = [(running.settings, points, sizes.beats)] * PROCESSES
            latencies = sorted(ms for each in pool.map(_log, orders) for ms in each)
        sample = Sample(tuple(latencies), 1.0)
        found |= {f"log_{points}_p50_ms": sample.quantile(0.5), f"log_{points}_p95_ms": sample.quantile(0.95)}
    return found


def _log(order: tuple[Settings, int, int]) -> list[float]:
    """One worker process: it claims its share of the jobs, and all of them report at once."""
    settings, points, beats = order
    store = Store(settings)
    owner = f"bench:{os.getpid()}:0"
    claims = [c for _ in range(LOGGERS // PROCESSES) if (c := leases.claim(store, owner, 600.0)) is not None]

    def report(claim: Claim) -> list[float]:
        taken = []
        for beat in range(beats):
            batch = Batch(
                events=[Event("progress", {"step": beat})],
                points=[Point(f"metric-{n}", beat, float(n)) for n in range(points)],
                look=Look("train", beat, beats, 0.1, None, 7000, 1.0),
            )
            started = time.perf_counter()
            leases.beat(store, claim, batch, 600.0)
            taken.append(1e3 * (time.perf_counter() - started))
        return taken

    with ThreadPoolExecutor(max(1, len(claims))) as pool:
        found = [ms for each in pool.map(report, claims) for ms in each]
    store.close()
    return found


def dispatch(sizes: Sizes) -> Found:
    """From the end of one job's work to the beginning of the next one's process, everything between included."""
    os.environ[STEP_MS] = "0"
    with host(**CHILD) as running:
        ids = submit(running.store, sizes.dispatches + 1)
        running.start("redis")
        running.start("worker")
        _wait(lambda: all(jobs.get(running.store, job_id).state == State.SUCCEEDED for job_id in ids))
        instants = sorted((_instants(running, job_id) for job_id in ids), key=lambda each: each["begun"])
        between = [1e3 * (after["begun"] - before["done"]) for before, after in pairwise(instants)]
        return {
            "dispatch_mean_ms": fmean(between),
            "dispatch_p95_ms": Sample(tuple(sorted(between)), 1.0).quantile(0.95),
        }


def overhead(sizes: Sizes) -> Found:
    """CPU time of the worker while a job runs, beyond what it uses without one, by that of the job."""
    os.environ[STEP_MS] = str(sizes.step_ms)
    with host(**CHILD) as running:
        running.start("redis")
        worker = running.start("worker")
        _settle(worker)
        began, idle = time.monotonic(), _cpu_seconds(worker)
        time.sleep(sizes.idle_seconds)
        idle_share = (_cpu_seconds(worker) - idle) / (time.monotonic() - began)
        (job_id,) = submit(running.store, 1, sizes.busy_steps)
        _wait(lambda: jobs.get(running.store, job_id).step > 0)
        first, began, used = jobs.get(running.store, job_id).step, time.monotonic(), _cpu_seconds(worker)
        _wait(lambda: jobs.get(running.store, job_id).step > 0.9 * sizes.busy_steps)
        last, used = jobs.get(running.store, job_id).step, _cpu_seconds(worker) - used
        job = (last - first) * sizes.step_ms / 1e3
        more = max(0.0, used - idle_share * (time.monotonic() - began))
        jobs.cancel(running.store, job_id)
    found = {"overhead_percent": 100.0 * more / job, "job_cpu_s": job, "worker_cpu_s": used}
    return found | {"idle_worker_percent": 100.0 * idle_share}


def _cpu_seconds(process: psutil.Process) -> float:
    times = process.cpu_times()
    return times.user + times.system


def recovery(sizes: Sizes) -> Found:
    """From the loss of a worker to the next attempt: one that was killed, and one that only fell silent."""
    os.environ[STEP_MS] = "100"
    found: Found = {}
    for name, number in (("killed", signal.SIGKILL), ("silent", signal.SIGSTOP)):
        with host(**CHILD, lease_seconds=sizes.lease_seconds) as running:
            running.start("redis")
            first = running.start("first", "worker")
            (job_id,) = submit(running.store, 1, 100_000)
            _wait(lambda: jobs.get(running.store, job_id).step > 0)  # noqa: B023  (called at once)
            running.start("second", "worker")
            time.sleep(2.0)
            lost = time.monotonic()
            _signal(first, number)
            _wait(lambda: jobs.get(running.store, job_id).attempt == 2)  # noqa: B023
            found[f"recovery_{name}_s"] = time.monotonic() - lost
            jobs.cancel(running.store, job_id)
            if number == signal.SIGSTOP:
                _signal(first, signal.SIGKILL)
    return found


def _signal(process: psutil.Process, number: int) -> None:
    """To the worker; its jobs' processes are in sessions of their own and go with it, or stop with it."""
    for child in process.children(recursive=True) if number == signal.SIGSTOP else []:
        child.send_signal(number)
    process.send_signal(number)


def _settle(process: psutil.Process) -> None:
    """Until it has started, and does nothing for a second."""
    used = -1.0
    while (now := sum(process.cpu_times()[:2])) - used > 0.02:
        used = now
        time.sleep(1.0)


def _instants(running: Host, job_id: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((running.settings.job_dir(job_id) / INSTANTS).read_text("utf-8"))
    return found


def _wait(look: Callable[[], bool]) -> None:
    deadline = time.monotonic() + WAIT_SECONDS
    while not look():
        if time.monotonic() > deadline:
            raise TimeoutError(f"jobs: expected an end within {WAIT_SECONDS:g} s, got none")
        time.sleep(0.05)
