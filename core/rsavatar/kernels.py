"""The native library: which build fits this machine, and the types of its functions (core/native/layout.h)."""

from __future__ import annotations

import ctypes
import os
from functools import cache
from pathlib import Path
from typing import Any

import torch

from rsavatar.errors import KernelError, expected

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # malloc.h
_LARGEST_KEPT, _MOST_KEPT = 32 << 20, 1 << 30  # bytes: a block, glibc's own maximum; and at the heap's end


class _Threads:
    count = 1
    forked = False  # from a process whose OpenMP may have had threads: they are not here, and waiting for them hangs


def use_threads(count: int) -> None:
    """Let the kernels use ``count`` threads from now on. Results do not depend on it.

    Raises:
        KernelError: if ``count`` is above 1 in a forked process whose parent had loaded the kernels.
    """
    if _Threads.forked and count > 1:
        wanted = "1 in a process forked from one that uses the kernels (spawn it instead to have more)"
        raise KernelError(expected("kernel threads", wanted, count))
    _Threads.count = max(count, 1)


def _after_fork() -> None:
    """In the child: one thread, which needs nobody's company."""
    if library.cache_info().currsize:
        _Threads.forked, _Threads.count = True, 1


os.register_at_fork(after_in_child=_after_fork)


def keep_memory() -> None:
    """Let this process keep what it frees: each step's images go where the last step's were.

    Otherwise glibc gives blocks of their size back to the kernel, which clears new pages for the next step: a sixth of
    a step's time. Does nothing where the C library has no ``mallopt``.
    """
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(_M_MMAP_THRESHOLD, _LARGEST_KEPT)
        libc.mallopt(_M_TRIM_THRESHOLD, _MOST_KEPT)


def threads() -> int:
    """Threads that the kernels use; torch's own number does not matter to them."""
    return _Threads.count


def targets() -> list[str]:
    """Instruction sets that this machine has, best first."""
    capability = torch.backends.cpu.get_cpu_capability()
    return {"AVX512": ["avx512", "avx2"], "AVX2": ["avx2"]}.get(capability, ["generic"])


@cache
def library() -> Any:
    """The kernels built for this machine.

    Raises:
        KernelError: if none was built, or none that this processor can run.
    """
    folder = Path(__file__).parent / "render"
    found = [folder / f"_kernels_{t}.so" for t in targets() if (folder / f"_kernels_{t}.so").exists()]
    if not found:
        there = ", ".join(sorted(p.name for p in folder.glob("_kernels_*.so"))) or "no kernel library"
        wanted = f"a library for {' or '.join(targets())} in {folder.name}/ (pip install . builds it)"
        raise KernelError(expected("native kernels", wanted, there))
    lib = ctypes.CDLL(str(found[0]))
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    lib.rs_frame_create.restype = pointer
    lib.rs_frame_destroy.argtypes = [pointer]
    lib.rs_render.argtypes = [pointer, pointer, pointer, integer, integer, *[pointer] * 6]
    lib.rs_render_backward.argtypes = [pointer] * 8
    lib.rs_l1.restype = ctypes.c_double
    float_ = ctypes.c_float
    lib.rs_l1.argtypes = [pointer] * 3 + [integer] * 3 + [pointer] * 2
    lib.rs_render_l1.argtypes = [pointer, pointer, pointer, integer, integer, *[pointer] * 7]
    lib.rs_render_l1_backward.argtypes = [pointer, pointer, pointer, float_, pointer]
    lib.rs_pose.argtypes = [pointer, integer, pointer]
    lib.rs_pose_backward.argtypes = [pointer, integer, *[pointer] * 6]
    lib.rs_continuity.restype = ctypes.c_double
    lib.rs_continuity.argtypes = [pointer, integer, integer, pointer, pointer, integer, integer, pointer]
    lib.rs_adam.argtypes = [pointer, integer, float_, float_, float_, integer]
    lib.rs_pose.restype = lib.rs_pose_backward.restype = None
    return lib


class Target(ctypes.Structure):
    """What an image is compared with: bytes [3, H, W], a mask [H, W], and how (``RsTarget``)."""

    _fields_ = (
        ("rgb", ctypes.c_void_p),
        ("mask", ctypes.c_void_p),
        ("background", ctypes.c_float),
        ("mask_weight", ctypes.c_float),
    )


def available() -> bool:
    """Whether the kernels can be used on this machine."""
    try:
        library()
    except KernelError:
        return False
    return True
