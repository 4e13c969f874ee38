"""The service from Python: a thin, blocking client of ``/api/v1``. JSON in, JSON out, problems as ``ClientError``."""

from __future__ import annotations

import ipaddress
import json
import os
import time
import uuid
from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

import httpx

from rsavatar.credentials import token_for
from rsavatar.errors import ClientError

DEFAULT_URL = "http://127.0.0.1:8000"
URL_VARIABLE = "RSAVATAR_URL"
TERMINAL = frozenset({"succeeded", "failed", "dead", "cancelled"})  # states that a job leaves only by a retry
SILENCE_SECONDS = 60.0  # an event stream says at least a comment more often than this
PATIENCE_SECONDS = 120.0  # how long ``events`` looks for a service that went away
DRAWING_SECONDS = 300.0  # the first drawing starts a process and opens the subject; a video takes longer still
PAUSE_SECONDS = 1.0  # between two looks, unless the stream asked for another pause

Json = dict[str, Any]


@dataclass(frozen=True)
class ServerEvent:
    """One event of a stream: ``id`` grows, ``kind`` is the event's name, ``data`` its JSON."""

    id: str
    kind: str
    data: Json


class Client:
    """A connection to one service. Use as a context manager, or ``close`` it.

    ``token`` is the one that was given, else what ``rsavatar.credentials`` finds for the address.
    Every method raises ``ClientError`` when the service refuses (its problem's title and detail) or cannot be reached.
    """

    def __init__(self, base_url: str | None = None, timeout_s: float = 30.0, token: str | None = None) -> None:
        self.url = (base_url or os.environ.get(URL_VARIABLE) or DEFAULT_URL).rstrip("/")
        try:
            url = httpx.URL(self.url)
        except httpx.InvalidURL as error:
            raise ClientError(f"not an address: {self.url!r}", str(error)) from None
        if url.scheme not in {"http", "https"} or not url.host:
            raise ClientError(f"not an address: {self.url!r}", "expected http://HOST:PORT")
        direct = _is_loopback(url.host)  # a proxy cannot reach this machine's loopback
        known = token or token_for(self.url)
        proof = {"authorization": f"Bearer {known}"} if known else {}
        self._http = httpx.Client(base_url=f"{self.url}/api/v1", timeout=timeout_s, trust_env=not direct, headers=proof)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Give the connections back."""
        self._http.close()

    def submit(self, request: Mapping[str, Any], idempotency_key: str | None = None, force: bool = False) -> Json:
        """Queue a job; the same key and request give the same job. Returns the job.

        With ``force`` it runs even where its result is known.
        """
        return self._queue("/jobs", request, idempotency_key, force)

    def job(self, job_id: str) -> Json:
        """One job."""
        job: Json = self._json("GET", _path("jobs", job_id))
        return job

    def jobs(self, **filters: str) -> Iterator[Json]:
        """Jobs, newest first, page after page; ``filters`` are state, method, subject, grid, limit (a page)."""
        parameters = dict(filters)
        while True:
            page = self._json("GET", "/jobs", params=parameters)
            yield from page["items"]
            if not page.get("next_cursor"):
                return
            parameters["cursor"] = page["next_cursor"]

    def cancel(self, job_id: str) -> Json:
        """Ask a job to stop. Returns the job."""
        job: Json = self._json("POST", _path("jobs", job_id, "cancel"))
        return job

    def retry(self, job_id: str) -> Json:
        """Queue a finished, failed or cancelled job again; it goes on from its checkpoint. Returns the job."""
        job: Json = self._json("POST", _path("jobs", job_id, "retry"))
        return job

    def results(self, job_id: str) -> Json:
        """What a succeeded job found: means, per camera, protocol, provenance."""
        results: Json = self._json("GET", _path("jobs", job_id, "results"))
        return results

    def table(self, name: str, fmt: str = "md", **filters: str | list[str]) -> str:
        """A result table as text in json, csv, md or tex; ``filters`` are grid, preset, tag, seed, q."""
        return self._request("GET", _path("tables", f"{name}.{fmt}"), params=filters).text

    def figure(self, name: str, fmt: str = "pdf", **choices: Any) -> bytes:
        """A figure's file in png, svg, pdf or json; ``choices`` are preset, subject, camera, frame."""
        return self._request("GET", _path("figures", f"{name}.{fmt}"), params=choices, timeout=DRAWING_SECONDS).content

    def view(self, job_id: str, **look: Any) -> bytes:
        """A picture of a job's avatar; ``look`` is camera, time, shutter, readout, azimuth, elevation, size, format."""
        return self._request("GET", _path("jobs", job_id, "render"), params=look, timeout=DRAWING_SECONDS).content

    def export(self, job_id: str, kind: str, **options: Any) -> bytes:
        """A file of a job's avatar: ``ply`` or ``turntable``."""
        place = _path("jobs", job_id, "export", kind)
        return self._request("GET", place, params=options, timeout=DRAWING_SECONDS).content

    def submit_grid(self, request: Mapping[str, Any], idempotency_key: str | None = None, force: bool = False) -> Json:
        """Queue all jobs of a grid; the same key and request give the same grid. Returns the grid.

        With ``force`` jobs run even where their results are known.
        """
        return self._queue("/grids", request, idempotency_key, force)

    def plan_grid(self, request: Mapping[str, Any]) -> Json:
        """What a grid would do: its jobs, known results, time. Nothing is queued."""
        plan: Json = self._json("POST", "/grids", json=dict(request), params={"dry_run": "true"})
        return plan

    def grid(self, grid_id: str) -> Json:
        """A grid as it is now, with all its cells."""
        found: Json = self._json("GET", _path("grids", grid_id))
        return found

    def grids(self) -> Iterator[Json]:
        """Grids, newest first, page after page."""
        parameters: dict[str, str] = {}
        while True:
            page = self._json("GET", "/grids", params=parameters)
            yield from page["items"]
            if not page.get("next_cursor"):
                return
            parameters["cursor"] = page["next_cursor"]

    def steer_grid(self, grid_id: str, verb: str) -> Json:
        """Cancel, pause, resume or retry all jobs of a grid. Returns the grid."""
        found: Json = self._json("POST", _path("grids", grid_id, verb))
        return found

    def subjects(self) -> list[Json]:
        """The subjects that jobs may name."""
        return list(self._json("GET", "/subjects"))

    def register_subject(self, name: str, path: str) -> Json:
        """Make a folder on the service's machine known as a subject. Returns the subject."""
        subject: Json = self._json("POST", "/subjects", json={"name": name, "path": path})
        return subject

    def upload_subject(self, name: str, archive: Path) -> Json:
        """Send a .zip or .tar.gz of a subject's folder. Returns the subject, which a worker checks before its use."""
        kind = "application/zip" if archive.suffix.lower() == ".zip" else "application/gzip"
        try:
            with archive.open("rb") as content:
                sent = self._json(
                    "POST",
                    "/subjects",
                    params={"name": name},
                    content=content,
                    headers={"content-type": kind, "content-length": str(archive.stat().st_size)},
                    timeout=None,
                )
        except OSError as error:
            raise ClientError(f"cannot read {archive}", str(error.strerror)) from None
        subject: Json = sent
        return subject

    def remove_subject(self, name: str) -> None:
        """Make a subject unknown; the files of an uploaded one are removed."""
        self._request("DELETE", _path("subjects", name))

    def whoami(self) -> Json:
        """Owner and scopes that the service sees in this connection."""
        me: Json = self._json("GET", "/tokens/me")
        return me

    def tokens(self) -> list[Json]:
        """All tokens, newest first, without their secrets."""
        return list(self._json("GET", "/tokens"))

    def issue_token(self, name: str, owner: str, scope: str, days: float | None) -> Json:
        """A new token; its ``secret`` is told this once."""
        body = {"name": name, "owner": owner, "scopes": [scope], "days": days}
        token: Json = self._json("POST", "/tokens", json=body)
        return token

    def revoke_token(self, token_id: str) -> Json:
        """End a token at once. Returns it."""
        token: Json = self._json("DELETE", _path("tokens", token_id))
        return token

    def owners(self) -> list[Json]:
        """Everybody who has jobs or limits, with the limits."""
        return list(self._json("GET", "/owners"))

    def put_owner(self, name: str, max_queued: int | None, max_running: int | None, share: float) -> Json:
        """Set an owner's limits (none: the service's; 0: no limit) and share of the workers. Returns the owner."""
        body = {"max_queued": max_queued, "max_running": max_running, "share": share}
        owner: Json = self._json("PUT", _path("owners", name), json=body)
        return owner

    def events(self, job_id: str, last_event_id: str | None = None) -> Generator[ServerEvent, None, None]:
        """Events of a job, from the beginning or after ``last_event_id``, until the job has ended.

        A broken connection is taken up again after the last event seen, for ``PATIENCE_SECONDS`` of trying.
        """
        since, ended = time.monotonic(), False
        while True:
            try:
                idle = True
                for event in self._stream(job_id, last_event_id):
                    last_event_id, since, idle = event.id or last_event_id, time.monotonic(), False
                    ended = event.kind == "state" and event.data.get("state") in TERMINAL
                    yield event
                if ended or (idle and self.job(job_id)["terminal"]):
                    return
            except (httpx.TransportError, ClientError) as error:
                refused = isinstance(error, ClientError) and error.status is not None and error.status < 500
                if refused or time.monotonic() - since > PATIENCE_SECONDS:
                    raise error if isinstance(error, ClientError) else self._unreachable(error) from None
            time.sleep(PAUSE_SECONDS)

    def _stream(self, job_id: str, last_event_id: str | None) -> Iterator[ServerEvent]:
        headers = {"Accept": "text/event-stream"} | ({"Last-Event-ID": last_event_id} if last_event_id else {})
        timeout = httpx.Timeout(self._http.timeout.connect, read=SILENCE_SECONDS)
        with self._http.stream("GET", _path("jobs", job_id, "events"), headers=headers, timeout=timeout) as response:
            if response.is_error:
                response.read()
                raise _problem(response)
            try:
                yield from parse_events(response.iter_lines())
            except ValueError as error:
                raise self._stranger(f"events that are not JSON: {error}", 200) from None

    def _queue(self, path: str, request: Mapping[str, Any], key: str | None, force: bool) -> Json:
        headers, asked = {"Idempotency-Key": key or str(uuid.uuid4())}, {"force": "true"} if force else {}
        found: Json = self._json("POST", path, json=dict(request), headers=headers, params=asked)
        return found

    def _json(self, method: str, path: str, **options: Any) -> Any:
        response = self._request(method, path, **options)
        try:
            return response.json()
        except ValueError:
            raise self._stranger(f"{method} {path} gave no JSON", response.status_code) from None

    def _request(self, method: str, path: str, **options: Any) -> httpx.Response:
        try:
            response = self._http.request(method, path, **options)
        except httpx.TransportError as error:
            raise self._unreachable(error) from None
        if not response.is_success:
            raise _problem(response)
        return response

    def _stranger(self, detail: str, status: int) -> ClientError:
        return ClientError(f"{self.url} does not answer like this service", detail, status)

    def _unreachable(self, error: Exception) -> ClientError:
        return ClientError(f"cannot reach {self.url}: is `make up` running?", str(error))


def parse_events(lines: Iterable[str]) -> Iterator[ServerEvent]:
    """The events of a ``text/event-stream`` (HTML standard, section 9.2.6); comments and cut events are dropped."""
    last_id, kind = "", "message"
    data: list[str] = []
    for line in lines:
        field, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if not line:
            if data:
                yield ServerEvent(last_id, kind, json.loads("\n".join(data)))
            kind, data = "message", []
        elif field == "id":
            last_id = value
        elif field == "event":
            kind = value
        elif field == "data":
            data.append(value)


def _path(*parts: str) -> str:
    return "".join("/" + quote(part, safe="") for part in parts)


def _problem(response: httpx.Response) -> ClientError:
    """A problem+json answer as an error; anything else by its status."""
    try:
        problem = response.json()
    except ValueError:
        problem = None
    if not isinstance(problem, dict):
        problem = {}
    title = str(problem.get("title") or f"HTTP {response.status_code} {response.reason_phrase}".strip())
    return ClientError(title, str(problem.get("detail") or ""), response.status_code)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
