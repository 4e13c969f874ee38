"""Calls that go together: those that come while a batch is being written make up the next one.

Alone, a call waits for nothing but its own work; under load a commit is shared by all that wait for it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import anyio

MOST = 64  # calls in one batch, so that nobody waits for a very long one

Item = TypeVar("Item")
Answer = TypeVar("Answer")


class Batches(Generic[Item, Answer]):
    """``work`` gets all waiting items at once, in a thread, and answers each; an exception as answer is raised there.

    Of one event loop: the application's.
    """

    def __init__(self, work: Callable[[Sequence[Item]], Sequence[Answer | Exception]]) -> None:
        self._work = work
        self._waiting: list[tuple[Item, asyncio.Future[Answer]]] = []
        self._writer: asyncio.Task[None] | None = None

    async def ask(self, item: Item) -> Answer:
        """Hand in an item and wait for its answer.

        Raises:
            Exception: what ``work`` answered for this item, or what it raised.
        """
        future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self._waiting.append((item, future))
        if self._writer is None or self._writer.done():
            self._writer = asyncio.create_task(self._write())
        return await future

    async def _write(self) -> None:
        while self._waiting:
            batch, self._waiting = self._waiting[:MOST], self._waiting[MOST:]
            items = [item for item, _ in batch]
            try:
                answers = await anyio.to_thread.run_sync(self._work, items)
            except Exception as error:
                answers = [error] * len(batch)
            for (_, future), answer in zip(batch, answers, strict=True):
                if future.done():  # its client has gone
                    continue
                if isinstance(answer, Exception):
                    future.set_exception(answer)
                else:
                    future.set_result(answer)
