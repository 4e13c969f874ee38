"""The work of a build, cut into tasks that processes share: measuring a camera, writing some frames of a camera."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, TypeVar

import cv2
import numpy as np
import torch

from rsavatar.data.base import Array, Bytes
from rsavatar.data.build_motion import displacements
from rsavatar.data.build_plan import Clock
from rsavatar.data.build_rows import Reel, expose
from rsavatar.data.footage import Footage
from rsavatar.data.images import write_png
from rsavatar.data.rolling import name_of
from rsavatar.restore.interpolate import AbstractInterpolator, interpolator

_CHUNK = 4  # output frames in one task
Task = TypeVar("Task")
Done = TypeVar("Done")


@dataclass(frozen=True)
class Work:
    """All that a process must know: it is sent once to each."""

    footage: Footage
    clock: Clock
    mids: tuple[int, ...]
    triggers: Mapping[str, float]  # of the training cameras
    rows: Literal["undistorted", "raw"]
    interpolator: tuple[str, Path | None, int]  # its name, weights and e
    steps: int | None  # instants a source frame; None: every row has its own
    out: Path

    def cameras(self) -> tuple[str, ...]:
        """Those that are built: trained on or held out."""
        return self.footage.train + self.footage.test

    def chunks(self) -> list[tuple[str, range]]:
        """Camera and output frames of each task."""
        count = len(self.mids)
        starts = range(0, count, _CHUNK)
        return [(name, range(lo, min(lo + _CHUNK, count))) for name in self.cameras() for lo in starts]

    def mid(self, camera: str, frame: int) -> float:
        """The mid-row time of an output frame in a camera."""
        return self.mids[frame] + self.triggers.get(camera, 0.0)

    def measure(self, camera: str) -> Array:
        """D [N] of a camera's windows, pixels."""
        height = self.footage.size(camera)[0]
        mids = [self.mid(camera, n) for n in range(len(self.mids))]
        return displacements(lambda frame: self._read(camera, frame), mids, self.clock, height)

    def write(self, chunk: tuple[str, range]) -> int:
        """The pictures of some frames of a camera; those that are there already stay. Returns how many frames."""
        camera, frames = chunk
        reel = Reel(lambda frame: self._read(camera, frame), self.footage.length)
        for n in frames:
            mid = self.mid(camera, n)
            if camera in self.footage.train:
                self._write(camera, n, ("images", "mask"), lambda mid=mid: self._rolling(camera, reel, mid))  # type: ignore[misc] # bound now
            self._write(camera, n, ("gt", "gt_mask"), lambda mid=mid: self._sharp(camera, reel, mid))  # type: ignore[misc]
        return len(frames)

    def _read(self, camera: str, frame: int) -> Bytes:
        return self.footage.read(camera, frame, self.rows == "undistorted")

    def _rolling(self, camera: str, reel: Reel, mid: float) -> Bytes:
        times = self.clock.row_times(mid, self.footage.size(camera)[0], self.steps)
        return self._labelled(expose(reel, np.clip(times, 0, reel.length - 1), _held_interpolator(*self.interpolator)))

    def _sharp(self, camera: str, reel: Reel, mid: float) -> Bytes:
        if mid == int(mid):
            return reel.at(int(mid))
        times = np.full(self.footage.size(camera)[0], mid)
        return self._labelled(expose(reel, times, _held_interpolator(*self.interpolator)))

    def _labelled(self, picture: Bytes) -> Bytes:
        """Half covered by a label is covered, so that masks of labels stay masks of labels."""
        if self.footage.labelled:
            picture[..., 3] = np.where(picture[..., 3] >= 128, 255, 0)
        return picture

    def _write(self, camera: str, n: int, folders: tuple[str, str], make: Callable[[], Bytes]) -> None:
        number = name_of(self.footage.index[camera])
        paths = [self.out / "rs" / folder / number / f"{n:06d}.png" for folder in folders]
        if all(path.is_file() for path in paths):
            return
        picture = make()
        for path, pixels in zip(paths, (picture[..., 2::-1], picture[..., 3]), strict=True):
            write_png(path, pixels)


class Crew:
    """Processes that hold the same work; with one job, this process itself. A context manager."""

    def __init__(self, work: Work, jobs: int) -> None:
        self._work = work
        self._pool: ProcessPoolExecutor | None = None
        if jobs > 1:
            spawn = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(jobs, spawn, initializer=_hold, initargs=(work,))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def each(
        self, what: Callable[[Work, Task], Done], tasks: Sequence[Task], **changed: object
    ) -> Iterator[tuple[Task, Done]]:
        """``what(work, task)`` of every task, as they are done; ``changed`` are fields of the work."""
        if self._pool is None:
            work = replace(self._work, **changed)  # type: ignore[arg-type] # fields of Work
            for task in tasks:
                yield task, what(work, task)
            return
        waiting = {self._pool.submit(_do, what, changed, task): task for task in tasks}
        for done in as_completed(waiting):
            yield waiting[done], done.result()


class _Held:
    work: Work | None = None


def _hold(work: Work) -> None:
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    _Held.work = work


def _do(what: Callable[[Work, Task], Done], changed: Mapping[str, object], task: Task) -> Done:
    assert _Held.work is not None
    return what(replace(_Held.work, **changed), task)  # type: ignore[arg-type] # fields of Work


@lru_cache(maxsize=1)
def _held_interpolator(name: str, weights: Path | None, recursion: int) -> AbstractInterpolator:
    return interpolator(name, weights, recursion)
