from __future__ import annotations

import threading
import time

import httpx

from services.store import jobs
from services.store.session import Store
from tests.services.test_api_jobs import finish, post


def read(client: httpx.Client, url: str, last: str | None = None, most: int = 100) -> tuple[list[str], list[str]]:
    """Ids and kinds of a stream, to its end or to ``most`` events."""
    ids: list[str] = []
    kinds: list[str] = []
    with client.stream("GET", url, headers={"Last-Event-ID": last} if last else {}) as reply:
        for line in reply.iter_lines():
            if line.startswith("id: "):
                ids.append(line[4:])
            if line.startswith("event: "):
                kinds.append(line[7:])
            if line.startswith("data: ") and len(ids) >= most:
                break
    return ids, kinds


def test_a_finished_job_is_told_from_the_start_to_the_end(client: httpx.Client, store: Store) -> None:
    job = post(client).json()["id"]
    finish(store)
    ids, kinds = read(client, f"/api/v1/jobs/{job}/events")
    assert kinds == ["state", "state", "note", "state"]
    assert ids == sorted(ids, key=int)


def test_a_stream_is_taken_up_where_it_broke(client: httpx.Client, store: Store) -> None:
    job = post(client).json()["id"]
    finish(store)
    url = f"/api/v1/jobs/{job}/events"
    whole, _ = read(client, url)
    head, _ = read(client, url, most=2)
    tail, _ = read(client, url, last=head[-1])
    assert head + tail == whole
    assert client.get(url, headers={"Last-Event-ID": whole[-1]}).status_code == 204
    assert read(client, url, last="nonsense")[0] == whole


def test_events_arrive_while_the_job_runs(client: httpx.Client, store: Store) -> None:
    job = post(client).json()["id"]
    threading.Timer(0.3, jobs.cancel, (store, job)).start()
    started = time.monotonic()
    _, kinds = read(client, f"/api/v1/jobs/{job}/events")
    assert kinds == ["state", "state"]
    assert 0.2 < time.monotonic() - started < 5.0


def test_silence_is_filled_with_comments(client: httpx.Client) -> None:
    job = post(client).json()["id"]
    with client.stream("GET", f"/api/v1/jobs/{job}/events") as reply:
        assert reply.headers["content-type"].startswith("text/event-stream")
        assert any(line == ": ping" for line in reply.iter_lines())


def test_one_stream_serves_all_jobs(client: httpx.Client, store: Store) -> None:
    first = post(client).json()["id"]
    second = post(client, seed=1).json()["id"]
    ids, _ = read(client, "/api/v1/events?after=0", most=2)
    assert len(ids) == 2
    with client.stream("GET", "/api/v1/events?after=0") as reply:
        text = ""
        for piece in reply.iter_text():
            text += piece
            if first in text and second in text:
                break
