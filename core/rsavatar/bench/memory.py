"""Peak memory of a forward and backward render, in a process of its own: ``python -m rsavatar.bench.memory``."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
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


def training_mb(size: Size, steps: Sequence[int]) -> list[float]:
    """MB of resident memory of a process that trains, after each number of ``steps`` (rising)."""
    arguments = [str(size.gaussians), str(size.pixels), "train", *map(str, steps)]
    command = [sys.executable, "-m", __name__, *arguments]
    return [float(x) for x in subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()]


def _train(size: Size, steps: Sequence[int]) -> list[float]:
    from rsavatar.bench.training import Training  # it imports much that a render does without

    torch.set_num_threads(1)
    kernels.keep_memory()
    training, found = Training(size, scan(size.pixels)), []
    for step in range(1, max(steps) + 1):
        training.step()
        if step % BLOCK == 0:
            training.refresh()
        if step in steps:
            found.append(_status("VmRSS") / MB)
    return found


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
    print(*_train(of, [int(n) for n in sys.argv[4:]])) if what == "train" else print(_measure(of, int(what)))
