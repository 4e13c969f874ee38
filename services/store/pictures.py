"""Pictures of a job, one at a time, out of the archives that it left among its artifacts.

A picture is named by camera, frame and kind. Names are looked up in an archive's own list and never touch a path.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from services.errors import NotFoundError
from services.store import artifacts
from services.store.records import Artifact
from services.store.session import Store

ARCHIVE_OF = {"result": "pictures", "exposed": "pictures", "truth": "references", "input": "references"}
LARGEST = 64 << 20  # bytes of one picture


@dataclass(frozen=True)
class View:
    """A camera of a job: its frames, and the kinds of picture that it has of them."""

    camera: str
    frames: tuple[int, ...]
    kinds: tuple[str, ...]


def views(store: Store, job_id: str) -> list[View]:
    """All pictures of a job; empty where it kept none.

    Raises:
        NotFoundError: if there is no such job.
    """
    found: dict[str, tuple[set[int], set[str]]] = {}
    for artifact in _archives(store, job_id).values():
        with _open(store, artifact) as archive:
            for name in archive.namelist():
                camera, frame, file = name.split("/")
                frames, kinds = found.setdefault(camera, (set(), set()))
                frames.add(int(frame))
                kinds.add(file.removesuffix(".png"))
    return [
        View(camera, tuple(sorted(frames)), tuple(k for k in ("input", "exposed", "result", "truth") if k in kinds))
        for camera, (frames, kinds) in sorted(found.items())
    ]


def read(store: Store, job_id: str, camera: str, frame: int, kind: str) -> tuple[bytes, str]:
    """The bytes of a PNG, and a tag that changes when they do.

    Raises:
        NotFoundError: if there is no such job or picture.
    """
    artifact = _archives(store, job_id).get(ARCHIVE_OF[kind])
    if artifact is not None:
        with _open(store, artifact) as archive:
            try:
                member = archive.getinfo(f"{camera}/{frame:06d}/{kind}.png")
            except KeyError:
                member = None
            if member is not None and member.file_size <= LARGEST:
                return archive.read(member), f"{member.CRC:08x}-{member.file_size:x}"
    raise NotFoundError("picture", "a camera, frame and kind of this job", f"{camera}/{frame}/{kind}")


def _archives(store: Store, job_id: str) -> dict[str, Artifact]:
    wanted = set(ARCHIVE_OF.values())
    return {a.name: a for a in artifacts.of_job(store, job_id) if a.name in wanted}


@contextmanager
def _open(store: Store, artifact: Artifact) -> Iterator[zipfile.ZipFile]:
    _, path = artifacts.find(store, artifact.sha256)
    with zipfile.ZipFile(path) as archive:
        yield archive
