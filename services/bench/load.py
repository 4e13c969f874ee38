"""Clients that cost little: requests written as bytes on kept connections, one coroutine each.

A closed loop sends the next request when the last one is answered, so it finds the most that the service can do. An
open one sends at a fixed pace whatever the answers take, and counts latency from the instant at which a request was
due: a service that falls behind cannot hide it.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

Request = Callable[[int], bytes]
CLIENTS = 20


@dataclass(frozen=True)
class Sample:
    """Latencies in milliseconds, in rising order, and the time that all took together."""

    latencies_ms: tuple[float, ...]
    seconds: float

    @property
    def per_second(self) -> float:
        """Requests answered in a second."""
        return len(self.latencies_ms) / self.seconds

    def quantile(self, share: float) -> float:
        """The latency that ``share`` of the requests did not exceed, nearest rank."""
        return self.latencies_ms[max(0, -(-int(share * len(self.latencies_ms) * 1000) // 1000) - 1)]


class Connection:
    """One kept HTTP/1.1 connection."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer

    async def ask(self, request: bytes, status: int) -> bytes:
        """Send a request and read its answer.

        Raises:
            RuntimeError: if the answer has another status.
        """
        self._writer.write(request)
        head = await self._reader.readuntil(b"\r\n\r\n")
        length = next(int(line[15:]) for line in head.split(b"\r\n") if line.lower().startswith(b"content-length:"))
        body = await self._reader.readexactly(length)
        if head[9:12] != str(status).encode():
            raise RuntimeError(f"answer: expected {status}, got {head[9:12].decode()}: {body[:300].decode()}")
        return body

    async def close(self) -> None:
        """Hang up."""
        self._writer.close()
        await self._writer.wait_closed()


def encode(method: str, path: str, body: Mapping[str, Any] | None = None) -> bytes:
    """A request as it goes over the wire."""
    data = b"" if body is None else json.dumps(body).encode()
    kind = "" if body is None else "content-type: application/json\r\n"
    head = f"{method} {path} HTTP/1.1\r\nhost: 127.0.0.1\r\n{kind}content-length: {len(data)}\r\n\r\n"
    return head.encode() + data


def closed_loop(port: int, requests: int, request: Request, status: int, clients: int = CLIENTS) -> Sample:
    """Send ``requests`` from ``clients`` at once, each as fast as it is answered."""
    numbers = iter(range(requests))

    async def client(connection: Connection) -> list[float]:
        return [await _timed(connection, request(n), status, time.perf_counter()) for n in numbers]

    return asyncio.run(_run(port, clients, client))


def open_loop(port: int, requests: int, request: Request, status: int, per_second: float) -> Sample:
    """Send ``requests`` at ``per_second`` from ``CLIENTS``, each as soon as it is due and its connection free."""
    numbers = iter(range(requests))
    start: list[float] = []

    async def client(connection: Connection) -> list[float]:
        start.append(time.perf_counter())
        found = []
        for n in numbers:
            due = start[0] + n / per_second
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            found.append(await _timed(connection, request(n), status, due))
        return found

    return asyncio.run(_run(port, CLIENTS, client))


async def _timed(connection: Connection, request: bytes, status: int, since: float) -> float:
    await connection.ask(request, status)
    return 1e3 * (time.perf_counter() - since)


async def _run(port: int, clients: int, client: Callable[[Connection], Awaitable[list[float]]]) -> Sample:
    connections = [Connection(*await asyncio.open_connection("127.0.0.1", port)) for _ in range(clients)]
    started = time.perf_counter()
    try:
        found = await asyncio.gather(*map(client, connections))
    finally:
        seconds = time.perf_counter() - started
        for connection in connections:
            await connection.close()
    return Sample(tuple(sorted(_flat(found))), seconds)


def _flat(lists: list[list[float]]) -> Iterator[float]:
    for each in lists:
        yield from each
