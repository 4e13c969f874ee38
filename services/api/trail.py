"""What is kept of requests: every one that wants to change something in the audit log, all of them as latencies.

The log is written when the answer is known and before it is sent: who sees an answer finds it in the log.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any

from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from prometheus_client import CollectorRegistry, Histogram
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.api.access import SAFE_METHODS, Caller
from services.api.batches import Batches
from services.store import audit
from services.store.session import Store

BUCKETS = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.25, 1.0, 5.0, float("inf"))
UNKNOWN = "anonymous"

log = logging.getLogger(__name__)


def latencies(registry: CollectorRegistry) -> Histogram:
    """Seconds until an answer begins, by verb, route and class of status."""
    labels = ("method", "route", "status")
    return Histogram(
        "rsavatar_http_request_seconds", "Seconds to an answer.", labels, buckets=BUCKETS, registry=registry
    )


class Trail:
    """Notes each answer as it begins."""

    def __init__(self, app: ASGIApp, store: Store, histogram: Histogram, routes: Mapping[Any, str]) -> None:
        self._app = app
        self._log: Batches[audit.Entry, audit.Record] = Batches(lambda entries: audit.append_many(store, entries))
        self._histogram = histogram
        self._routes = routes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, and note."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        begun, noted = time.perf_counter(), False

        async def noting(message: Message) -> None:
            nonlocal noted
            if message["type"] == "http.response.start":
                noted = True
                await self._note(scope, message["status"], dict(message["headers"]), time.perf_counter() - begun)
            await send(message)

        try:
            await self._app(scope, receive, noting)
        except Exception:
            if not noted:
                await self._note(scope, 500, {}, time.perf_counter() - begun)
            raise

    async def _note(self, scope: Scope, status: int, headers: dict[bytes, bytes], seconds: float) -> None:
        route = self._routes.get(scope.get("endpoint"), "none")  # not the path: the number of series stays small
        self._histogram.labels(scope["method"], route, f"{status // 100}xx").observe(seconds)
        if scope["method"] in SAFE_METHODS:
            return
        entry = entry_of(scope, status, headers.get(b"location", b"").decode("latin1"))
        try:
            await self._log.ask(entry)
        except Exception:  # what was done is done: the log file is the second place to find it
            log.exception("not in the audit log: %s", entry)


def entry_of(scope: Scope, status: int, location: str) -> audit.Entry:
    """A request and its answer, without its body: secrets and data stay out."""
    state: dict[str, Any] = scope.get("state", {})
    caller = state.get("caller")
    known = caller if isinstance(caller, Caller) else None
    return audit.Entry(
        actor=UNKNOWN if known is None else known.owner,
        token_id=None if known is None else known.token_id,
        verb=scope["method"],
        object=scope["path"],
        outcome="done" if status < 400 else "refused" if status < 500 else "failed",
        status=status,
        ip=scope["client"][0] if scope.get("client") else None,
        request_id=state.get("request_id"),
        detail={"location": location} if location else {},
    )


def routes_by_endpoint(app: FastAPI) -> dict[Any, str]:
    """The whole path of every route, by the function that answers it."""
    return {route.endpoint: str(route.path) for route in iter_route_contexts(app.routes)}
