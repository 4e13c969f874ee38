"""How long people wait: for the jobs page, for live numbers, for figures and for novel views."""

from __future__ import annotations

import asyncio
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.webdriver.support.wait import WebDriverWait

from services.bench.browser import open_browser
from services.bench.host import Host
from services.bench.load import Connection, encode
from services.bench.requests import BASE, Found
from services.bench.workers import submit
from services.store import jobs, leases
from services.store.records import Batch, Event, Look, Point, fraction_of

LOOKS = 10
VIEWS = 20
WAIT_SECONDS = 300.0
PATIENCE = 20.0
PAINTED = "return performance.getEntriesByName('first-contentful-paint')[0]?.startTime"
LOADED = """
const all = [...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')];
return all.reduce((sum, entry) => sum + entry.transferSize, 0);
"""
SEEN = "return document.querySelector('[data-field=gaussians]')?.textContent"


@contextmanager
def browser() -> Iterator[webdriver.Chrome | None]:
    """A fresh browser that ends with the block."""
    with tempfile.TemporaryDirectory(prefix="rsavatar-bench-", ignore_cleanup_errors=True) as profile:
        driver = open_browser(Path(profile), "--window-size=1440,900")
        try:
            yield driver
        finally:
            if driver is not None:
                driver.quit()


def first_paint(running: Host) -> Found:
    """The jobs page of a service with very many jobs: until something is seen, and what came over the wire."""
    with browser() as driver:
        if driver is None:
            return {}
        driver.execute_cdp_cmd("Network.setCacheDisabled", {"cacheDisabled": True})
        painted = []
        for _ in range(LOOKS):
            driver.get(f"{running.settings.url}/jobs")
            painted.append(_until(driver, PAINTED))
        loaded = float(driver.execute_script(LOADED))
    return {"first_paint_ms": statistics.median(painted), "loaded_kb": loaded / 1024}


def live(running: Host) -> Found:
    """From the commit of a worker's report to the number on the page of its job."""
    (job_id,) = submit(running.store, 1)
    claim = leases.claim(running.store, "bench:0:0", WAIT_SECONDS)
    if claim is None or claim.job_id != job_id:
        raise RuntimeError(f"claim: expected job {job_id}, got {claim}")
    told: list[float] = []

    def report(step: int) -> None:
        look = Look("train", step, 100 * LOOKS, 0.1, 20.0, step, 1.0)
        payload = {"fraction": fraction_of("train", step, look.steps), **vars(look)}
        batch = Batch(events=[Event("progress", payload)], points=[Point("loss", step, 0.1)], look=look)
        leases.beat(running.store, claim, batch, WAIT_SECONDS)
        told.append(1e3 * time.time())

    report(1)
    report(2)  # so that the page has its curves when it is opened
    with browser() as driver:
        if driver is None:
            return {}
        driver.get(f"{running.settings.url}/jobs/{job_id}")
        delays = []
        for step in range(3, LOOKS + 3):
            report(step)
            _until(driver, SEEN, str(step))
            delays.append(1e3 * time.time() - told[-1])
            time.sleep(0.5 + 0.04 * step)  # at another phase of the stream's looks
    return {"live_p50_ms": statistics.median(delays), "live_worst_ms": max(delays)}


def _until(driver: webdriver.Chrome, script: str, wanted: object = None) -> Any:
    """What a script of the page returns, once that is ``wanted``, or anything at all."""

    def look(driver: webdriver.Chrome) -> Any:
        found = driver.execute_script(script)
        return found if found == wanted or (wanted is None and found) else None

    return WebDriverWait(driver, PATIENCE, 0.01).until(look)


def drawings(running: Host) -> Found:
    """Figures and novel views of a trained job: the first, for which processes start, and others like it."""
    answer = _ask(running, "POST", "/api/v1/jobs", 202, BASE)[1]
    job_id = str(answer.split(b'"id":"')[1][:36], "ascii")
    deadline = time.monotonic() + WAIT_SECONDS
    while jobs.get(running.store, job_id).state != "succeeded":
        if time.monotonic() > deadline:
            raise TimeoutError(f"job {job_id}: expected it to end within {WAIT_SECONDS:g} s")
        time.sleep(0.5)
    figures = [_ask(running, "GET", f"/api/v1/figures/per-subject.{kind}", 200)[0] for kind in ("png", "svg", "pdf")]
    about = f"/api/v1/jobs/{job_id}/render?size=512&azimuth="
    views = [_ask(running, "GET", f"{about}{azimuth}", 200)[0] for azimuth in range(VIEWS)]
    moving = [_ask(running, "GET", f"{about}5&shutter=rolling&time={n / 8}", 200)[0] for n in range(VIEWS)]
    return {
        "figure_first_s": figures[0] / 1e3,
        "figure_s": max(figures[1:]) / 1e3,
        "view_first_ms": views[0],
        "view_p50_ms": statistics.median(views[1:]),
        "rolling_view_p50_ms": statistics.median(moving[1:]),
    }


def _ask(running: Host, method: str, path: str, status: int, body: dict[str, str] | None = None) -> tuple[float, bytes]:
    """Milliseconds and bytes of an answer."""

    async def ask() -> bytes:
        connection = Connection(*await asyncio.open_connection("127.0.0.1", running.settings.port, limit=2**24))
        try:
            return await connection.ask(encode(method, path, body), status)
        finally:
            await connection.close()

    started = time.perf_counter()
    found = asyncio.run(ask())
    return 1e3 * (time.perf_counter() - started), found
