"""``python -m tests.system.recovery``: how long each fault keeps a job from going on, with a deployment's settings.

Every figure is from the fault to the instant, on the database's clock, at which the job runs again (or has gone on).
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import redis

from services.demo import free_port
from services.settings import Settings
from services.store import events
from tests import postgresql
from tests.system.harness import Host, until

DEPLOYED = ("lease_seconds", "heartbeat_seconds", "sweep_seconds", "unclaimed_seconds", "backoff_seconds")
LONG = 100_000  # steps: the job outlives its fault
LIMIT = 180.0


class Bench:
    """One host on PostgreSQL, and a fault after the other."""

    def __init__(self, host: Host, server: postgresql.Server) -> None:
        self.host = host
        self.server = server
        self.job = ""

    def measure(self, fault: Callable[[], None], recovered: Callable[[], bool]) -> float:
        """Seconds from the beginning of ``fault`` until ``recovered``, of a job that runs."""
        self.job = self.host.submit(iterations=LONG, checkpoint_every=100)
        self.host.wait_for_step(self.job, 50)
        begun = time.monotonic()
        fault()
        until(recovered, LIMIT)
        seconds = time.monotonic() - begun
        self.host.client.post(f"/api/v1/jobs/{self.job}/cancel")
        self.host.wait_for(self.job, "cancelled")
        return round(seconds, 1)

    def runs_again(self) -> bool:
        """Whether the second attempt has said something."""
        told = events.after(self.host.store, 0, self.job)
        starts = [n for n, e in enumerate(told) if e.payload.get("state") == "running"]
        return len(starts) == 2 and any(e.kind == "note" for e in told[starts[1] :])

    def later(self) -> bool:
        """Whether the job is further than when it was submitted; for faults that end nothing."""
        return bool(self.host.job(self.job)["progress"]["step"] >= 200)

    def kill_child(self) -> None:
        self.host.children()[0].send_signal(signal.SIGKILL)

    def kill_worker(self) -> None:
        self.host.kill("worker")
        self.host.start("worker")

    def silence_worker(self) -> None:
        self.host.start("worker-2")
        self.host.signal("worker", signal.SIGSTOP)

    def kill_api(self) -> None:
        self.host.kill("api")
        self.host.start("api")

    def kill_broker(self) -> None:
        with redis.Redis(unix_socket_path=str(self.host.settings.socket)) as client:
            client.flushall()
        self.host.kill("redis")
        self.host.start("redis")

    def kill_database(self) -> None:
        self.server.kill()
        self.server.start()

    def lost_wake_up(self) -> float:
        """Seconds until a job runs whose only message the broker has lost."""
        self.host.stop("worker")
        job = self.host.submit(iterations=10)
        with redis.Redis(unix_socket_path=str(self.host.settings.socket)) as client:
            client.flushall()
        begun = time.monotonic()
        self.host.start("worker")
        self.host.wait_for(job, "succeeded")
        return round(time.monotonic() - begun, 1)

    def all(self) -> dict[str, float]:
        """Every fault; the silent worker last, because it stays so."""
        found = {
            "child killed": self.measure(self.kill_child, self.runs_again),
            "worker killed": self.measure(self.kill_worker, self.runs_again),
            "api killed": self.measure(self.kill_api, self.later),
            "redis killed, FLUSHALL": self.measure(self.kill_broker, self.later),
            "postgresql killed": self.measure(self.kill_database, self.later),
            "wake-up lost": self.lost_wake_up(),
        }
        return found | {"worker silent": self.measure(self.silence_worker, self.runs_again)}


def main() -> int:
    """Measure and print as JSON."""
    words = argparse.ArgumentParser("tests.system.recovery", description=__doc__.partition("\n\n")[0])
    words.add_argument("--json", type=Path, help="write it there as well")
    options = words.parse_args()
    deployed = {name: Settings.model_fields[name].default for name in DEPLOYED}
    with tempfile.TemporaryDirectory(prefix="rsavatar-recovery-") as folder, postgresql.running() as server:
        assert server is not None, "no PostgreSQL here"
        host = Host(Path(folder) / "home", free_port(), database_url=server.migrated(), **deployed)
        try:
            for name in ("redis", "api", "worker"):
                host.start(name)
            text = json.dumps({"settings": deployed, "seconds": Bench(host, server).all()}, indent=1) + "\n"
        finally:
            host.close()
    print(text, end="")
    if options.json:
        options.json.write_text(text, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
