"""Real processes of the service: the programs of a deployment, started one by one and killed at will."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import httpx
import psutil

from services import redis_server
from services.process import stop, terminate_with_parent
from services.settings import ROOT, Settings, make_home
from services.store import schema
from services.store.session import Store

Found = TypeVar("Found")
PATIENCE = 120.0
COMMANDS = {name: [sys.executable, "-m", f"services.{name}"] for name in ("api", "worker")}
QUICK: dict[str, Any] = {  # the service's protocol in fractions of a second
    "lease_seconds": 30.0,
    "heartbeat_seconds": 0.1,
    "sweep_seconds": 0.3,
    "unclaimed_seconds": 0.5,
    "backoff_seconds": 0.0,
    "grace_seconds": 5.0,
    "stall_seconds": 30.0,
    "poll_seconds": 0.05,
    "child_command": (sys.executable, "-m", "tests.system.quick_child"),
}


def until(look: Callable[[], Found], seconds: float = PATIENCE) -> Found:
    """Wait for ``look`` to give something true."""
    deadline = time.monotonic() + seconds
    while not (found := look()):
        assert time.monotonic() < deadline, f"waited {seconds} s"
        time.sleep(0.1)
    return found


class Host:
    """A home, its private broker, and the processes that work in it."""

    def __init__(self, home: Path, port: int, **changes: Any) -> None:
        given = {"home": home, "port": port, **QUICK, **changes}
        self.settings = Settings(**given)
        self._given = set(given)
        make_home(self.settings)
        self.store = Store(self.settings)
        schema.migrate(self.store)
        self.client = httpx.Client(base_url=self.settings.url, timeout=20.0, trust_env=False)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def env(self) -> dict[str, str]:
        """The settings as a deployment would give them; those of the environment stay as they are there."""
        env = dict(os.environ)
        for name, value in self.settings.model_dump(include=self._given, exclude_defaults=True, mode="json").items():
            env[f"RSAVATAR_{name.upper()}"] = json.dumps(value) if isinstance(value, list) else str(value)
        return env

    def start(self, name: str, **env: str) -> subprocess.Popen[bytes]:
        """Start ``redis``, ``api`` or ``worker`` (also ``worker-2``, ...) and wait until it serves."""
        command = redis_server.command(self.settings) if name == "redis" else COMMANDS[name.partition("-")[0]]
        with (self.settings.home / "logs" / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                command,
                cwd=ROOT,
                env=self.env | env,
                stdout=log,
                stderr=log,
                preexec_fn=terminate_with_parent,  # noqa: PLW1509  (nothing in these tests forks in a thread)
            )
        self._processes[name] = process
        if name == "redis":
            redis_server.wait_until_ready(self.settings, 10.0)
        if name == "api":
            until(self._answers)
        return process

    def _answers(self) -> bool:
        try:
            return self.client.get("/healthz").status_code == 200
        except httpx.TransportError:
            return False

    def kill(self, name: str) -> None:
        """SIGKILL, as the kernel does it when memory runs out."""
        process = self._processes.pop(name)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def name_of(self, pid: int) -> str:
        """Which of our processes has this pid."""
        return next(name for name, process in self._processes.items() if process.pid == pid)

    def signal(self, name: str, signum: int) -> None:
        """Send a signal."""
        self._processes[name].send_signal(signum)

    def stop(self, name: str) -> int:
        """SIGTERM; returns the exit status."""
        process = self._processes.pop(name)
        stop(process, 20.0)
        return process.returncode

    def close(self) -> None:
        """End everything."""
        for process in self._processes.values():
            process.send_signal(signal.SIGCONT)
        for name in list(self._processes)[::-1]:
            self.stop(name)
        self.client.close()
        self.store.close()

    def submit(self, **changes: Any) -> str:
        """Submit a job over HTTP and return its id."""
        spec = {"method": "gauhuman", "subject": "studio", "preset": "smoke", "iterations": 60, "checkpoint_every": 10}
        reply = self.client.post("/api/v1/jobs", params={"force": True}, json={**spec, **changes})
        assert reply.status_code == 202, reply.text
        return str(reply.json()["id"])

    def job(self, job_id: str) -> dict[str, Any]:
        """The job's view."""
        view: dict[str, Any] = self.client.get(f"/api/v1/jobs/{job_id}").json()
        return view

    def wait_for(self, job_id: str, *states: str, seconds: float = PATIENCE) -> dict[str, Any]:
        """Wait until the job is in one of ``states``."""
        return until(lambda: view if (view := self.job(job_id))["state"] in states else {}, seconds)

    def wait_for_step(self, job_id: str, step: int, seconds: float = PATIENCE) -> None:
        """Wait until the job has got so far."""
        until(lambda: self.job(job_id)["progress"]["step"] >= step, seconds)

    def state(self, job_id: str) -> str:
        """What the quick child computed: depends on every step."""
        artifacts = {a["name"]: a["url"] for a in self.client.get(f"/api/v1/jobs/{job_id}/artifacts").json()}
        return str(self.client.get(artifacts["final"]).json()["state"])

    def notes(self, job_id: str) -> list[str]:
        """Notes of an ended job."""
        lines = self.client.get(f"/api/v1/jobs/{job_id}/events").text.splitlines()
        events = (json.loads(line[6:]) for line in lines if line.startswith("data: "))
        return [event["text"] for event in events if event["kind"] == "note"]

    def children(self) -> list[psutil.Process]:
        """Processes that train in this home, orphans included."""
        found = []
        for process in psutil.process_iter(["cmdline", "environ"]):
            command, env = process.info["cmdline"] or [], process.info["environ"] or {}
            if {"tests.system.quick_child", "services.worker.child"} & set(command) and env.get("RSAVATAR_HOME") == str(
                self.settings.home
            ):
                found.append(process)
        return found
