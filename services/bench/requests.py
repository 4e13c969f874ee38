"""How fast the interface answers: submissions, pages of long lists, grids, curves; and what its process weighs."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path
from typing import Any

import psutil

from rsavatar.spec import resolve
from services import jobs as wake_up
from services.bench.host import Host
from services.bench.load import Connection, Sample, closed_loop, encode, open_loop
from services.bench.sizes import Sizes
from services.store import intake, jobs, listing, metrics
from services.store.records import Filters, Point, Submission

BASE = {"method": "rs-avatar", "subject": "studio", "preset": "smoke"}
STATES = ("succeeded", "succeeded", "succeeded", "failed", "queued", "cancelled", "dead")
METHODS = ("rs-avatar", "gauhuman", "mad-avatar", "oracle")
SEEDS_APART = 1_000_000  # between the seeds of one measurement and of the next: no result is known

Found = dict[str, float]


def submissions(host: Host, sizes: Sizes) -> Found:
    """POST /jobs: as many as can be, and at a steady pace."""

    def request(first: int) -> Any:
        return lambda n: encode("POST", "/api/v1/jobs", {**BASE, "seed": first + n})

    port = host.settings.port
    closed_loop(port, sizes.warm_up, request(0), 202)
    most = closed_loop(port, sizes.requests, request(SEEDS_APART), 202)
    paced = open_loop(port, sizes.requests, request(2 * SEEDS_APART), 202, sizes.submissions_per_second)
    return {"per_second": most.per_second, **_latencies("closed", most), **_latencies("paced", paced)}


def fill(host: Host, count: int) -> None:
    """Jobs in all states and of all methods, as years would leave them."""
    specs = [resolve({**BASE, "method": method}).model_dump(mode="json", by_alias=True) for method in METHODS]
    now = host.store.now()
    for start in range(0, count, 5000):
        rows = []
        for n in range(start, min(start + 5000, count)):
            spec = {**specs[n % len(specs)], "seed": 5 * SEEDS_APART + n}
            row = intake.row_of(Submission(spec, f"{n:064x}", f"{n:064x}", 3), now - (count - n))
            row |= {"state": STATES[n % len(STATES)], "psnr": 20.0 + n % 100 / 20, "stage": "train"}
            rows.append(row | {"step": 300, "steps": 300, "loss": 0.1, "gaussians": 7000})
        with host.store.write() as session:
            intake.add(session, rows)


def pages(host: Host, sizes: Sizes) -> Found:
    """GET /jobs of 50 among very many: the newest, one from the middle, filtered ones, by turns."""
    middle = listing.page(host.store, Filters(), listing.Order("submitted", False), None, 1)[0]
    paths = [
        "/api/v1/jobs?limit=50",
        f"/api/v1/jobs?limit=50&cursor={middle.id[:8]}-{'f' * 4}-7fff-bfff-{'f' * 12}",
        "/api/v1/jobs?limit=50&state=failed",
        "/api/v1/jobs?limit=50&method=oracle",
        "/api/v1/jobs?limit=50&q=state%3Afailed+psnr%3E22",
    ]

    def request(n: int) -> bytes:
        return encode("GET", paths[n % len(paths)])

    port = host.settings.port
    closed_loop(port, sizes.warm_up, request, 200)
    most = closed_loop(port, sizes.requests, request, 200)
    paced = open_loop(port, sizes.requests, request, 200, sizes.pages_per_second)
    alone = closed_loop(port, sizes.requests // 4, request, 200, clients=1)
    found = {"per_second": most.per_second, **_latencies("closed", most), **_latencies("paced", paced)}
    return found | _latencies("alone", alone)


def grid(host: Host, sizes: Sizes) -> Found:
    """POST /grids of very many jobs: until the answer, and until every wake-up is with the broker."""
    app = wake_up.make_app(host.settings)
    before = wake_up.backlog(app)
    axes = {"method": ["rs-avatar", "gauhuman"], "seed": [3 * SEEDS_APART + n for n in range(sizes.grid_jobs // 2)]}
    base = {name: BASE[name] for name in ("subject", "preset")}
    body = {"name": "bench", "base": base, "axes": axes}
    started = time.perf_counter()
    answer = json.loads(_once(host, encode("POST", "/api/v1/grids", body), 202))
    answered = time.perf_counter() - started
    while wake_up.backlog(app) < before + answer["jobs"]:
        time.sleep(0.01)
    queued = time.perf_counter() - started
    planned = time.perf_counter()
    _once(host, encode("POST", "/api/v1/grids?dry_run=true", body), 200)
    return {"answered_s": answered, "queued_s": queued, "planned_s": time.perf_counter() - planned}


def curves(host: Host, sizes: Sizes) -> Found:
    """GET /compare of ten jobs with long curves."""
    ids = [job.id for job in jobs.page(host.store, Filters(), None, 10)]
    with host.store.write() as session:
        for job_id in ids:
            points = [Point("loss", step, 1.0 / (step + 1)) for step in range(sizes.curve_points)]
            metrics.put_points(session, job_id, points)
    request = encode("GET", "/api/v1/compare?key=loss&points=500&" + "&".join(f"job={job_id}" for job_id in ids))
    return _latencies("compare", closed_loop(host.settings.port, 20, lambda n: request, 200, clients=1))


def weight(host: Host) -> Found:
    """Resident memory of the interface's process after all this, and whether torch is in it."""
    process = psutil.Process(host.processes["api"].pid)
    members = [process, *process.children(recursive=True)]
    maps = "".join(Path(f"/proc/{member.pid}/maps").read_text("utf-8", "replace") for member in members)
    return {"rss_mb": max(m.memory_info().rss for m in members) / 2**20, "torch": float("libtorch" in maps)}


def _latencies(name: str, sample: Sample) -> Found:
    return {f"{name}_p50_ms": sample.quantile(0.5), f"{name}_p95_ms": sample.quantile(0.95)}


def _once(host: Host, request: bytes, status: int) -> bytes:
    async def ask() -> bytes:
        connection = Connection(*await asyncio.open_connection("127.0.0.1", host.settings.port, limit=2**24))
        try:
            return await connection.ask(request, status)
        finally:
            await connection.close()

    return asyncio.run(ask())
