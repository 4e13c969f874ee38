"""Event streams (server-sent events): the database's events as they come, resumed by ``Last-Event-ID``."""

from __future__ import annotations

import json
import time
from collections.abc import AsyncIterator
from typing import Annotated

import anyio
from fastapi import APIRouter, Header, Query
from fastapi.responses import Response, StreamingResponse

from services.api.deps import Back, Backend, JobId
from services.store import events, jobs
from services.store.records import TERMINAL, Event

RETRY = "retry: 1000\n\n"
PING = ": ping\n\n"
STREAM_HEADERS = {"cache-control": "no-cache", "x-accel-buffering": "no"}
NOTHING_LEFT = 204  # tells a browser's EventSource not to connect again

router = APIRouter(tags=["events"])
LastId = Annotated[str | None, Header(alias="Last-Event-ID")]
After = Annotated[int | None, Query(ge=0, description="like Last-Event-ID, for clients that cannot set headers")]


def start_of(last_event_id: str | None, after: int | None) -> int | None:
    """Where to resume; None for "from the start". A header that is no number counts as none."""
    if last_event_id is not None and last_event_id.isdecimal():
        return int(last_event_id[:18])
    return after


def to_sse(event: Event) -> str:
    """One event in the wire format; the data is JSON on one line."""
    data = {"id": event.id, "job_id": event.job_id, "kind": event.kind, "at": event.created_at, **event.payload}
    return f"id: {event.id}\nevent: {event.kind}\ndata: {json.dumps(data)}\n\n"


@router.get("/jobs/{job_id}/events", response_class=StreamingResponse)
def stream_job(job_id: JobId, back: Back, last_event_id: LastId = None, after: After = None) -> Response:
    """Events of one job. The stream ends after its last event; resumed after that, it is empty (204)."""
    last = start_of(last_event_id, after) or 0
    job = jobs.get(back.store, job_id)
    if job.state in TERMINAL and last and not events.after(back.store, last, job_id, 1):
        return Response(status_code=NOTHING_LEFT)
    return StreamingResponse(follow(back, last, job_id), media_type="text/event-stream", headers=STREAM_HEADERS)


@router.get("/events", response_class=StreamingResponse)
def stream_all(back: Back, last_event_id: LastId = None, after: After = None) -> Response:
    """Events of all jobs, from now on unless it is resumed. One stream serves a whole page."""
    start = start_of(last_event_id, after)
    last = events.newest_id(back.store) if start is None else start
    return StreamingResponse(follow(back, last, None), media_type="text/event-stream", headers=STREAM_HEADERS)


async def follow(back: Backend, last: int, job_id: str | None) -> AsyncIterator[str]:
    """Text of a stream: what is there, then what comes, with comments in the silence."""
    yield RETRY
    spoke = time.monotonic()
    while True:
        # The state is read before the events, so that a terminal one has its event in the batch that follows.
        ended = job_id is not None and await anyio.to_thread.run_sync(_has_ended, back, job_id)
        batch = await anyio.to_thread.run_sync(events.after, back.store, last, job_id)
        for event in batch:
            last = event.id
            yield to_sse(event)
        if batch:
            spoke = time.monotonic()
            continue
        if ended:
            return
        if time.monotonic() - spoke > back.settings.ping_seconds:
            spoke = time.monotonic()
            yield PING
        await anyio.sleep(back.settings.poll_seconds)


def _has_ended(back: Backend, job_id: str) -> bool:
    return jobs.get(back.store, job_id).state in TERMINAL
