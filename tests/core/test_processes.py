"""The kernels in other processes, in several Python threads, and short of memory: the same bits, or an error."""

from __future__ import annotations

import multiprocessing
import resource
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch

from rsavatar import kernels
from rsavatar.errors import KernelError
from rsavatar.render import native
from rsavatar.render.base import Gaussians
from tests.core import scenes
from tests.core.test_native import gradients

pytestmark = pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
PATIENCE = 60  # seconds; what hangs, hangs for good


@pytest.fixture(autouse=True)
def _two_threads() -> Iterator[None]:
    before = kernels.threads()
    kernels.use_threads(2)
    yield
    kernels.use_threads(before)


def picture(kind: str = "scanline", seed: int = 0) -> bytes:
    image, found = gradients(native.render, scenes.scene(kind, count=400, seed=seed, dtype=torch.float32))
    tensors = [image.rgb, image.transmittance, *found.values()]
    return b"".join(t.detach().numpy().tobytes() for t in tensors)


def more_threads() -> str:
    try:
        kernels.use_threads(2)
    except KernelError as error:
        return str(error)
    return ""


def starve() -> set[str]:
    """Every end that a large render comes to as memory grows from none to enough, 10 MiB at a time."""
    kernels.use_threads(2)
    small = scenes.scene("blur", count=1, dtype=torch.float32)
    count = 300_000
    tensors = {f.name: getattr(small.gaussians, f.name).repeat_interleave(count, -1) for f in fields(Gaussians)}
    large = replace(small, gaussians=Gaussians(**{**tensors, "log_scales": torch.full((3, count), 2.0)}))
    native.render(small)
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    ends = set()
    for spare in range(0, 1000, 10):
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + spare * 2**20, resource.RLIM_INFINITY))
        try:
            native.render(large)
        except (KernelError, RuntimeError) as error:  # torch's own allocations fail with RuntimeError
            ends.add(str(error) if isinstance(error, KernelError) else "torch")
        else:
            return {*ends, "rendered"}
    return ends


def _send(queue: Any, work: Callable[[], Any]) -> None:
    queue.put(work())


def run(method: str, work: Callable[[], Any]) -> Any:
    context: Any = multiprocessing.get_context(method)
    queue = context.Queue()
    process = context.Process(target=_send, args=(queue, work))
    process.start()
    try:
        return queue.get(timeout=PATIENCE)
    finally:
        process.kill()
        process.join()


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_a_child_of_a_process_that_rendered_renders_the_same(method: str) -> None:
    here = picture()
    assert run(method, picture) == here


def test_a_forked_child_keeps_to_one_thread_and_says_why() -> None:
    picture()
    assert "forked" in run("fork", more_threads)
    assert run("spawn", more_threads) == ""


def test_python_threads_render_at_once_without_disturbing_each_other() -> None:
    jobs = [(kind, seed) for seed in range(3) for kind in scenes.KINDS]
    alone = [picture(*job) for job in jobs]
    with ThreadPoolExecutor(6) as pool:
        assert list(pool.map(lambda job: picture(*job), jobs)) == alone


@pytest.mark.skipif(sys.platform != "linux", reason="address space is limited by Linux's means")
def test_memory_that_runs_out_within_a_parallel_region_is_an_error() -> None:
    ends = run("spawn", starve)
    assert "rendered" in ends
    assert any("out of memory" in end for end in ends)
