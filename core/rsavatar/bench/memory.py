"""Peak memory of a forward and backward render, in a process of its own: ``python -m rsavatar.bench.memory``."""

from __future__ import annotations

import ctypes
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from rsavatar import kernels
from rsavatar.bench.scene import Size, build
from rsavatar.bench.ways import Exposure, in_bands, scan
from rsavatar.optimization import BLOCK

MB = 1e6


def render_mb(size: Size, bands: int | None) -> float:
    """MB by which the process's resident memory grows at its peak, over what the scene itself takes.

    ``bands`` None is the scanline. Each call starts a process: memory that an allocator keeps would hide the next peak.
    """
    arguments = [str(size.gaussians), str(size.pixels), str(bands or 0)]
    command = [sys.executable, "-m", __name__, *arguments]
    return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@dataclass(frozen=True)
class Held:
    """MB of a process: resident, and in use, which is what its allocator has handed out."""

    resident: float
    in_use: float


def training_mb(size: Size, steps: Sequence[int]) -> list[Held]:
    """Memory of a process that trains, after each number of ``steps`` (rising)."""
    arguments = [str(size.gaussians), str(size.pixels), "train", *map(str, steps)]
    command = [sys.executable, "-m", __name__, *arguments]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return [Held(*map(float, line.split())) for line in told.splitlines()]


class _MallocInfo(ctypes.Structure):
    """glibc's ``struct mallinfo2``: bytes in use are at 4 (mapped) and 7 (of the heap)."""

    _fields_ = (("sizes", ctypes.c_size_t * 10),)


def _in_use() -> float:
    """Bytes handed out by malloc; not a number where the C library is not glibc 2.33 or newer."""
    ask = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if ask is None:
        return math.nan
    ask.restype = _MallocInfo
    sizes = ask().sizes
    return float(sizes[4] + sizes[7])


def _train(size: Size, steps: Sequence[int]) -> None:
    from rsavatar.bench.training import Training  # it imports much that a render does without

    torch.set_num_threads(1)
    kernels.keep_memory()
    training = Training(size, scan(size.pixels))
    for step in range(1, max(steps) + 1):
        training.step()
        if step % BLOCK == 0:
            training.refresh()
        if step in steps:
            print(_status("VmRSS") / MB, _in_use() / MB)


def _measure(size: Size, bands: int) -> float:
    torch.set_num_threads(1)
    body, pixels = build(size), size.pixels
    small = build(Size(200, 64))  # loads the libraries and whatever they allocate once
    ones = torch.ones(3, pixels, pixels), torch.ones(pixels, pixels)
    Exposure(small, scan(64), (torch.ones(3, 64, 64), torch.ones(64, 64))).total()
    shot = Exposure(body, in_bands(pixels, bands) if bands else scan(pixels), ones)
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = _status("VmRSS")
    for _ in range(3):
        shot.total()
    return (_status("VmHWM") - before) / MB


def _status(name: str) -> float:
    """Bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024.0 * int(line.split()[1]) for line in lines if line.startswith(name))


if __name__ == "__main__":
    of, what = Size(int(sys.argv[1]), int(sys.argv[2])), sys.argv[3]
    _train(of, [int(n) for n in sys.argv[4:]]) if what == "train" else print(_measure(of, int(what)))
