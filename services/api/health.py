"""For machines: is the process alive, can it serve, what does it count."""

from __future__ import annotations

import os
import shutil

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse, PlainTextResponse
from prometheus_client import generate_latest
from sqlalchemy.exc import SQLAlchemyError

from services import jobs as wake_up
from services.api.access import READ
from services.api.deps import Back, Backend
from services.errors import SchemaError
from services.store import garbage, jobs, schema

LEAST_FREE_BYTES = 256 << 20

router = APIRouter(tags=["health"])


@router.get("/healthz")
def healthz() -> dict[str, str]:
    """The process answers."""
    return {"status": "ok"}


@router.get("/readyz")
def readyz(back: Back) -> JSONResponse:
    """Database at its version, broker reachable, disk writable; 503 with the reason where not."""
    checks = {"database": _database(back), "broker": _broker(back), "disk": _disk(back)}
    ready = all(state == "ok" for state in checks.values())
    return JSONResponse({"status": "ok" if ready else "unavailable", "checks": checks}, 200 if ready else 503)


def _database(back: Backend) -> str:
    try:
        schema.require_head(back.store)
    except SchemaError as error:
        return str(error)
    except SQLAlchemyError:  # its text names hosts and users, and everybody may ask
        return "database: expected an answer, got none"
    return "ok"


def _broker(back: Backend) -> str:
    return "ok" if wake_up.is_reachable(back.broker) else "broker: expected an answer, got none"


def _disk(back: Backend) -> str:
    home = back.settings.home
    if not os.access(home, os.W_OK):
        return f"home: expected a writable directory, got {home}"
    free = shutil.disk_usage(home).free
    return "ok" if free > LEAST_FREE_BYTES else f"disk: expected {LEAST_FREE_BYTES} bytes free, got {free}"


@router.get("/metrics", response_class=PlainTextResponse, dependencies=[READ])
def prometheus(request: Request, back: Back) -> PlainTextResponse:
    """Counts in Prometheus' text format."""
    lines = ["# HELP rsavatar_jobs Jobs by state.", "# TYPE rsavatar_jobs gauge"]
    lines += [f'rsavatar_jobs{{state="{s}"}} {n}' for s, n in jobs.count_by_state(back.store).items()]
    lines += [
        "# HELP rsavatar_oldest_wait_seconds Age of the oldest job that could run and does not.",
        "# TYPE rsavatar_oldest_wait_seconds gauge",
        f"rsavatar_oldest_wait_seconds {jobs.oldest_wait(back.store):.3f}",
    ]
    stored = garbage.totals(back.store)
    lines += [
        "# HELP rsavatar_stored_bytes Bytes under their hashes; named: by an artifact or a checkpoint.",
        "# TYPE rsavatar_stored_bytes gauge",
        f'rsavatar_stored_bytes{{named="yes"}} {stored.bytes - stored.garbage_bytes}',
        f'rsavatar_stored_bytes{{named="no"}} {stored.garbage_bytes}',
        "# HELP rsavatar_stored_blobs Files under their hashes.",
        "# TYPE rsavatar_stored_blobs gauge",
        f"rsavatar_stored_blobs {stored.blobs}",
    ]
    measured = generate_latest(request.app.state.registry).decode()
    return PlainTextResponse("\n".join(lines) + "\n" + measured, media_type="text/plain; version=0.0.4; charset=utf-8")
