"""Torch's work on the kernels' threads, one piece a thread, so that no bit depends on their number."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

from rsavatar import kernels

Item = TypeVar("Item")
Result = TypeVar("Result")


def spread(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """``work`` of every item, in their order; several at a time, each on one of torch's threads.

    Torch's results depend on the number of its own threads, but not on who else works beside them.
    """
    items, grad = list(items), torch.is_grad_enabled()

    def one(item: Item) -> Result:
        with torch.set_grad_enabled(grad):  # a thread starts with gradients
            return work(item)

    workers = min(kernels.threads(), len(items))
    if workers < 2:
        return [work(item) for item in items]
    with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        return list(pool.map(one, items))
