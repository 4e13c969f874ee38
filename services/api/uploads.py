"""Subjects that come as archives: streamed to disk, unpacked by a process of its own, checked by a worker.

Nothing of a refused archive stays. What an API that was killed leaves behind is removed at the next start.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import asdict
from pathlib import Path

import anyio
from fastapi import Request
from starlette.exceptions import HTTPException

from services.api.guard import archive_kind
from services.api.health import LEAST_FREE_BYTES
from services.api.recognise import inspect
from services.api.threads import waiters
from services.errors import ConflictError, NotFoundError, RequestError
from services.settings import ROOT, Settings
from services.store import subjects
from services.store.ids import new_id
from services.store.session import Store
from services.store.subject_records import Subject, SubjectState
from services.unpack.caps import Order

WRITE_BYTES = 1 << 20
AT_ONCE = 4  # uploads that one process takes
SECONDS = 3600.0  # that sending one may take
STALE_SECONDS = 2 * SECONDS

_under_way = anyio.CapacityLimiter(AT_ONCE)


async def receive(request: Request, name: str, owner: str, settings: Settings, store: Store) -> Subject:
    """Take a subject from the body of ``request``; it is ``uploaded`` then, and a worker looks at it.

    Raises:
        HTTPException: 415 for another kind of body, 429 for too many at once, 507 for a full disk.
        RequestError: if the archive is damaged, too large, or holds what no subject does.
        ConflictError: if the name is taken.
    """
    kind = archive_kind(request.headers)
    if kind is None:
        got = request.headers.get("content-type", "none")[:100]
        raise HTTPException(
            415, f"content-type: expected application/json, application/zip or application/gzip, got {got}"
        )
    await anyio.to_thread.run_sync(require_free_name, store, name)
    async with _turn(), _workspace(settings) as folder:
        room = room_for(settings)
        archive = folder / "archive"
        with anyio.fail_after(SECONDS):
            await save(request, archive)
        order = Order(
            str(archive),
            kind,
            str(folder / "content"),
            min(settings.max_subject_bytes, room),
            settings.max_entry_bytes,
            settings.max_entries,
        )
        size = await unpack(order)
        content = folder / "content"
        return await anyio.to_thread.run_sync(settle, content, name, owner, size, settings, store, limiter=waiters())


@asynccontextmanager
async def _turn() -> AsyncIterator[None]:
    try:
        _under_way.acquire_nowait()
    except anyio.WouldBlock:
        raise HTTPException(
            429, f"uploads: expected at most {AT_ONCE} at once, got more", {"retry-after": "10"}
        ) from None
    try:
        yield
    finally:
        _under_way.release()


@asynccontextmanager
async def _workspace(settings: Settings) -> AsyncIterator[Path]:
    folder = settings.home / "uploads" / new_id()
    folder.mkdir(mode=0o700, parents=True)
    try:
        yield folder
    finally:
        with anyio.CancelScope(shield=True):
            await anyio.to_thread.run_sync(lambda: shutil.rmtree(folder, ignore_errors=True))


def require_free_name(store: Store, name: str) -> None:
    """Refuse a name that is taken, before gigabytes are sent under it.

    Raises:
        ConflictError: if it is.
    """
    try:
        taken = subjects.look(store, name)
    except NotFoundError:
        return
    raise ConflictError("name", "one that no subject has", f"{name!r}, {taken.state}")


def room_for(settings: Settings) -> int:
    """Bytes that a subject may take now.

    Raises:
        HTTPException: 507 if the disk is nearly full.
    """
    room = shutil.disk_usage(settings.home).free - LEAST_FREE_BYTES
    if room <= 0:
        raise HTTPException(507, f"disk: expected more than {LEAST_FREE_BYTES} bytes free, got less")
    return room


async def save(request: Request, path: Path) -> None:
    """Write the body into a file as it comes; its length has been limited on the way."""
    held = bytearray()
    with path.open("xb") as file:
        async for chunk in request.stream():
            held += chunk
            if len(held) >= WRITE_BYTES:
                await anyio.to_thread.run_sync(file.write, bytes(held))
                held.clear()
        await anyio.to_thread.run_sync(file.write, bytes(held))


async def unpack(order: Order) -> int:
    """Take the archive apart in another process; returns the bytes that came out.

    Raises:
        RequestError: naming the entry that was refused.
    """
    command = [sys.executable, "-m", "services.unpack"]
    done = await anyio.run_process(command, input=json.dumps(asdict(order)).encode() + b"\n", cwd=ROOT, check=False)
    try:
        answer = json.loads(done.stdout)
    except ValueError:  # killed by one of its limits
        answer = {"name": "archive", "expected": "one that can be unpacked within the limits", "got": "another"}
    if done.returncode != 0:
        raise RequestError(answer["name"], answer["expected"], answer["got"])
    return int(answer["bytes"])


def settle(content: Path, name: str, owner: str, size: int, settings: Settings, store: Store) -> Subject:
    """Move what was unpacked to its place and make it known.

    Raises:
        RequestError: if there is no subject in it.
        ConflictError: if the name has been taken meanwhile.
    """
    root = top_of(content)
    try:
        kind, info = inspect(root)
    except RequestError as error:
        raise RequestError(
            "archive", error.expected, f"{', '.join(sorted(p.name for p in root.iterdir())[:8])}"
        ) from None
    place = settings.home / "subjects" / new_id()
    place.mkdir(mode=0o700, parents=True)
    try:
        root.rename(place / name)
        wanted = Subject(
            name, str(place / name), kind, {**info, "uploaded": True}, 0.0, owner, SubjectState.UPLOADED, size
        )
        subject, _ = subjects.add(store, wanted)
    except BaseException:
        shutil.rmtree(place, ignore_errors=True)
        raise
    return subject


def top_of(content: Path) -> Path:
    """The folder that holds the subject: the archive's own top, or the one folder in it."""
    inside = list(content.iterdir())
    return inside[0] if len(inside) == 1 and inside[0].is_dir() and inside[0].name != "rs" else content


def discard(subject: Subject, settings: Settings) -> None:
    """Remove the files of an uploaded subject that nobody knows any more; those of others are not ours."""
    home = settings.home / "subjects"
    if subject.path is not None and Path(subject.path).parent.parent == home:
        shutil.rmtree(Path(subject.path).parent, ignore_errors=True)


def remove_leftovers(settings: Settings, store: Store) -> None:
    """Remove what uploads have left that were cut off by the end of their process."""
    known = {subject.path for subject in subjects.all_of(store)}
    for folder in _old(settings.home / "uploads"):
        shutil.rmtree(folder, ignore_errors=True)
    for folder in _old(settings.home / "subjects"):
        if not any(str(inside) in known for inside in folder.iterdir()):
            shutil.rmtree(folder, ignore_errors=True)


def _old(folder: Path) -> Iterator[Path]:
    for inside in folder.iterdir() if folder.is_dir() else ():
        if time.time() - inside.stat().st_mtime > STALE_SECONDS:
            yield inside
