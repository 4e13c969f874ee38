"""Processes are killed at bad moments; every job ends once, with the numbers of an undisturbed run."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import httpx
import psutil
import pytest
import redis

from services.demo import free_port
from services.settings import ROOT
from services.store import events as store_events
from services.store import metrics
from tests.services.test_api_events import read
from tests.system.harness import Host


def expected_state(host: Host, **spec: int) -> str:
    job = host.submit(**spec)
    host.wait_for(job, "succeeded")
    return host.state(job)


def test_a_worker_killed_in_the_middle(host: Host) -> None:
    job = host.submit(iterations=150)
    host.wait_for_step(job, 30)
    (child,) = host.children()
    host.kill("worker")
    child.wait(5.0)  # dies with its worker
    assert host.job(job)["state"] == "running"
    host.start("worker")
    view = host.wait_for(job, "succeeded")
    assert view["error"] is None
    reasons = [e.payload.get("reason", "") for e in store_events.after(host.store, 0, job) if e.kind == "state"]
    assert [
        reason for reason in reasons if reason.startswith("the worker died")
    ]  # proven dead: nobody waited for a lease
    assert (view["attempt"], view["failures"]) == (2, 1)
    assert host.notes(job)[-1] != "starting at step 0"
    assert host.state(job) == expected_state(host, iterations=150)
    assert [entry.job.id for entry in metrics.table_entries(host.store)].count(job) <= 1
    assert len(host.client.get(f"/api/v1/jobs/{job}/results").json()["scores"]) == 4


def test_a_worker_told_to_stop_gives_its_job_back(host: Host) -> None:
    job = host.submit(iterations=300, checkpoint_every=300)
    host.wait_for_step(job, 10)
    assert host.stop("worker") == 0
    view = host.job(job)
    assert (view["state"], view["failures"]) == ("queued", 0)
    assert host.children() == []
    host.start("worker")
    host.wait_for(job, "succeeded")
    assert int(host.notes(job)[-1].rsplit(" ", 1)[1]) >= 10


def test_the_api_killed_while_a_job_runs_and_a_stream_is_read(host: Host) -> None:
    job = host.submit(iterations=200)
    url = f"/api/v1/jobs/{job}/events"
    head, _ = read(host.client, url, most=4)
    host.kill("api")
    host.start("api")
    tail, kinds = read(host.client, url, last=head[-1])
    assert kinds[-1] == "state"
    whole, _ = read(host.client, url)
    assert head + tail == whole
    assert host.job(job)["attempt"] == 1


def test_the_broker_loses_everything(host: Host) -> None:
    host.stop("worker")
    jobs = [host.submit(iterations=10, seed=n) for n in range(3)]
    with redis.Redis(unix_socket_path=str(host.settings.socket)) as client:
        client.flushall()
    host.start("worker")
    for job in jobs:
        assert host.wait_for(job, "succeeded")["attempt"] == 1


def test_the_broker_killed_and_started_again(host: Host) -> None:
    running = host.submit(iterations=150)
    host.wait_for_step(running, 5)
    host.kill("redis")
    waiting = host.submit(iterations=10, seed=1)  # accepted without a broker
    host.start("redis")
    assert host.wait_for(running, "succeeded")["attempt"] == 1
    host.wait_for(waiting, "succeeded")


def test_the_stack_starts_dead_parts_again_and_leaves_nothing_behind(tmp_path: Path) -> None:
    host = Host(tmp_path / "home", free_port())
    command = [sys.executable, "-m", "services.up"]
    with subprocess.Popen(command, cwd=ROOT, env=host.env, stdout=subprocess.PIPE, text=True) as up:
        assert up.stdout is not None
        assert any("ready at" in line for line in up.stdout)
        second = subprocess.run(command, cwd=ROOT, env=host.env, capture_output=True, text=True, check=False)
        assert (second.returncode, "nothing runs yet" in second.stderr) == (1, True)
        job = host.submit(iterations=100)
        host.wait_for_step(job, 5)
        (worker,) = (p for p in psutil.Process(up.pid).children() if "services.worker" in p.cmdline())
        worker.kill()
        assert host.wait_for(job, "succeeded")["attempt"] == 2
        up.send_signal(signal.SIGTERM)
        assert up.wait(30.0) == 0
    assert host.children() == []
    with pytest.raises(httpx.TransportError):
        host.client.get("/healthz")
    host.close()
