"""A real service with two replicas of the API behind one address, and a real browser before it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack

import httpx
import pytest
from selenium import webdriver

from services.bench.browser import HOW_TO_GET_ONE, open_browser
from services.demo import free_port
from services.process import stop, terminate_with_parent
from services.settings import ROOT
from tests.browser.front import Front
from tests.core.subject_files import write_rolling
from tests.system.harness import Host, until

REAL = (sys.executable, "-m", "services.worker.child")
SUBJECT = "figure"


class Site:
    """The address, and what stands behind it."""

    def __init__(self, host: Host, front: Front) -> None:
        self.host = host
        self.front = front
        self.url = front.url
        self.client = httpx.Client(base_url=front.url, timeout=20.0, trust_env=False)

    def run(self, *methods: str) -> dict[str, str]:
        """Finished jobs of a few steps, by method."""
        spec = {"subject": SUBJECT, "preset": "smoke", "iterations": 20}
        found = {m: str(self.client.post("/api/v1/jobs", json={**spec, "method": m}).json()["id"]) for m in methods}
        for job in found.values():
            until(lambda job=job: self.client.get(f"/api/v1/jobs/{job}").json()["terminal"], 120.0)
        return found


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory, driver: webdriver.Chrome) -> Iterator[Site]:
    files = write_rolling(tmp_path_factory.mktemp("subjects") / SUBJECT)
    with ExitStack() as stack:
        changes = {"child_command": REAL, "threads_per_job": 1, "worker_concurrency": 2}
        host = Host(tmp_path_factory.mktemp("site"), free_port(), **changes)
        stack.callback(host.close)
        for name in ("redis", "api", "worker"):
            host.start(name)
        second = free_port()
        env = host.env | {"RSAVATAR_PORT": str(second)}
        command = [sys.executable, "-m", "services.api"]
        replica = subprocess.Popen(command, cwd=ROOT, env=env, preexec_fn=terminate_with_parent)  # noqa: PLW1509
        stack.callback(stop, replica, 10.0)
        front = Front([host.settings.port, second])
        stack.callback(front.close)
        found = Site(host, front)
        stack.callback(found.client.close)
        until(lambda: all(answers(found) for _ in range(4)))
        place = {"name": SUBJECT, "path": str(files.root)}
        assert found.client.post("/api/v1/subjects", json=place).status_code == 201
        yield found


def answers(site: Site) -> bool:
    """Whether the replica whose turn it is serves."""
    try:
        return site.client.get("/healthz", headers={"connection": "close"}).is_success
    except httpx.TransportError:
        return False


@pytest.fixture(scope="session")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[webdriver.Chrome]:
    """A fresh Chromium; tests that need it say so where there is none."""
    found = open_browser(tmp_path_factory.mktemp("profile"), "--window-size=1280,1000")
    if found is None:
        pytest.skip(f"no browser here: {HOW_TO_GET_ONE}")
    yield found
    found.quit()


@pytest.fixture(scope="session")
def jobs(site: Site) -> dict[str, str]:
    """A finished job of each of two methods."""
    return site.run("gauhuman", "rs-avatar")
