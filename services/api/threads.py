"""Threads that answer. The interpreter runs one at a time, and hands over at every row that a query reads.

Forty threads gave 84 pages a second to twenty clients, four 116 (docs/benchmarks/service.md).

Routes that are plain functions share ``QUICK`` threads, which is all that a process can use. A route that waits for
another process (a drawing) is ``waiting``, so that it keeps nobody else from an answer.
"""

from __future__ import annotations

import functools
from collections.abc import Awaitable, Callable
from typing import ParamSpec, TypeVar

import anyio
import anyio.to_thread

QUICK = 4
WAITING = 16  # at once; more stand in line

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")


def limit() -> None:
    """Bound the threads of plain routes, within the application's event loop."""
    anyio.to_thread.current_default_thread_limiter().total_tokens = QUICK


@functools.cache
def waiters() -> anyio.CapacityLimiter:
    """Whom routes that wait, or work for seconds, take their threads from."""
    return anyio.CapacityLimiter(WAITING)


def waiting(route: Callable[Arguments, Answer]) -> Callable[Arguments, Awaitable[Answer]]:
    """``route`` as one that waits: in a thread of its own kind."""

    @functools.wraps(route)
    async def run(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Answer:
        call = functools.partial(route, *args, **kwargs)
        return await anyio.to_thread.run_sync(call, limiter=waiters())

    return run
