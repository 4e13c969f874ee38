"""Restored frames on disk: made once for the same pictures, corrector and weights, by one process at a time."""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from rsavatar.errors import DataError, Interrupted, expected
from rsavatar.restore.base import AbstractCorrector, Picture, Shot

FORMAT = 1  # raise it when what is kept changes: it is part of the key


@dataclass(frozen=True, eq=False)
class Film:
    """The frames of one camera, in time. ``read`` may decode: every frame is asked for twice; None was never taken."""

    read: Callable[[int], Picture | None]
    frames: int
    gamma: float  # readout as a part of the frame period


def restored(
    film: Film,
    corrector: AbstractCorrector,
    root: Path,
    each: Callable[[int], None] = lambda frame: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Path:
    """Folder of the restored frames of ``film`` under ``root``, made if it is not there; read by ``read_restored``.

    Args:
        film: what to restore; at least two frames. A frame whose neighbours were never taken stays as it is.
        corrector: how.
        root: the cache.
        each: hears of every frame that is restored.
        should_stop: asked before every frame.

    Raises:
        DataError: if there is a single frame, a picture cannot be read, or there is no room.
        Interrupted: when ``should_stop`` asked for it; nothing is kept of the film.
    """
    if film.frames < 2:
        raise DataError(expected("frames to restore", "at least 2 of each camera", film.frames))
    folder = root / key(film, corrector)
    root.mkdir(parents=True, exist_ok=True)
    with _locked(folder.with_suffix(".lock")):
        if folder.is_dir():
            return folder
        part = Path(tempfile.mkdtemp(dir=root, prefix=f".{folder.name}-"))
        try:
            _restore(film, corrector, part, each, should_stop)
            part.chmod(0o755)
            part.rename(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return folder


def key(film: Film, corrector: AbstractCorrector) -> str:
    """sha256 over the pictures, the readout and what corrects them."""
    digest = hashlib.sha256(f"{FORMAT}\0{corrector.identity}\0{film.gamma!r}\0{film.frames}".encode())
    for n in range(film.frames):
        for part in film.read(n) or ():
            digest.update(str(part.shape).encode())
            digest.update(np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def read_restored(folder: Path, frame: int) -> Picture:
    """A frame that ``restored`` made.

    Raises:
        DataError: if it cannot be read.
    """
    path = folder / f"{frame:06d}.png"
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if found is None or found.ndim != 3 or found.shape[2] != 4:
        raise DataError(expected(str(path), "a restored frame, colour and coverage", "none"))
    pixels = found.astype(np.uint8)
    return np.ascontiguousarray(pixels[..., 2::-1]), np.ascontiguousarray(pixels[..., 3])


def _restore(
    film: Film,
    corrector: AbstractCorrector,
    folder: Path,
    each: Callable[[int], None],
    should_stop: Callable[[], bool],
) -> None:
    window: list[Picture | None] = [None, film.read(0), film.read(1)]
    for n in range(film.frames):
        if should_stop():
            raise Interrupted(f"stopped while restoring frame {n}")
        before, frame, after = window
        if frame is not None:
            alone = before is None and after is None
            _write(folder, n, frame if alone else corrector.restore(Shot(before, frame, after, film.gamma)))
        window = [frame, after, film.read(n + 2) if n + 2 < film.frames else None]
        each(n)


def _write(folder: Path, frame: int, picture: Picture) -> None:
    path = folder / f"{frame:06d}.png"
    if not cv2.imwrite(str(path), np.dstack([picture[0][..., ::-1], picture[1]])):
        raise DataError(expected(str(path), "room for a picture", "a failed write"))


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Waits until no other process holds the lock file."""
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield
