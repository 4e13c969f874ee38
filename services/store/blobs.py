"""Bytes under their SHA-256: on this machine's disk, or in a bucket that speaks S3 with the disk as a cache before it.

Whoever reads gets a path on this machine; what lies in a bucket is fetched first and checked against its hash.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from services.errors import SettingsError
from services.settings import Settings

BLOCK = 1 << 20
INCOMING = "incoming-"  # how the names of files that are being written begin


@dataclass(frozen=True)
class Blob:
    """Stored bytes; ``modified`` in seconds since 1970, by the clock of where they lie."""

    sha256: str
    size: int
    modified: float


class AbstractBlobs(ABC):
    """A place for bytes, named by their hash.

    ``root`` is a folder of this machine on the file system that ``keep`` takes files from.

    **Contract**: ``keep`` is durable and atomic: a reader sees all bytes or none; the same bytes again change nothing.
    ``path`` gives a file with exactly these bytes, or None. ``remove`` of what is not there is no error.
    """

    root: Path

    @abstractmethod
    def keep(self, sha256: str, file: Path) -> None:
        """Take over ``file``, whose bytes have this hash; it is gone afterwards."""

    @abstractmethod
    def path(self, sha256: str) -> Path | None:
        """A file of this machine with these bytes."""

    @abstractmethod
    def remove(self, sha256: str) -> None:
        """Forget these bytes."""

    @abstractmethod
    def all(self) -> Iterator[Blob]:
        """Everything that is stored."""

    @abstractmethod
    def strays(self) -> Iterator[Path]:
        """Files of this machine that a writer has left behind, or is writing."""


class DiskBlobs(AbstractBlobs):
    """Files ``root/ab/cdef...``."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def keep(self, sha256: str, file: Path) -> None:
        """By rename: ``file`` must lie on the same file system."""
        target = path_of(self.root, sha256)
        target.parent.mkdir(parents=True, exist_ok=True)
        file.replace(target)

    def path(self, sha256: str) -> Path | None:
        """Where they lie."""
        path = path_of(self.root, sha256)
        return path if path.is_file() else None

    def remove(self, sha256: str) -> None:
        """Unlink."""
        path_of(self.root, sha256).unlink(missing_ok=True)

    def all(self) -> Iterator[Blob]:
        """Walks the folders."""
        for path in sorted(self.root.glob("??/*")):
            stat = path.stat()
            yield Blob(path.parent.name + path.name, stat.st_size, stat.st_mtime)

    def strays(self) -> Iterator[Path]:
        """Files that have no name yet."""
        yield from self.root.glob(f"{INCOMING}*")


class BucketBlobs(AbstractBlobs):
    """Objects ``prefix/ab/cdef...`` of a bucket; files that were read or written here stay in ``cache``.

    Credentials, region and endpoint come from the usual variables (``AWS_ACCESS_KEY_ID``, ``AWS_ENDPOINT_URL``, ...).
    """

    def __init__(self, url: str, cache: DiskBlobs) -> None:
        """``url`` is s3://BUCKET/PREFIX.

        Raises:
            SettingsError: if it is not, or obstore is not installed.
        """
        try:
            import obstore
            from obstore.store import S3Store
        except ImportError:
            raise SettingsError("RSAVATAR_ARTIFACTS_URL", "obstore installed (pip install rsavatar[s3])", url) from None
        parts = urlsplit(url)
        if not parts.netloc:
            raise SettingsError("RSAVATAR_ARTIFACTS_URL", "s3://BUCKET/PREFIX", url)
        plain = os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")
        options: Any = {"allow_http": True} if plain else {}
        self._obstore: Any = obstore
        self._bucket = S3Store(parts.netloc, prefix=parts.path.strip("/") or None, client_options=options)
        self._cache = cache
        self.root = cache.root

    def keep(self, sha256: str, file: Path) -> None:
        """Into the bucket first: what only the cache has would be lost with this machine."""
        with file.open("rb") as reader:
            self._obstore.put(self._bucket, _key(sha256), reader)
        self._cache.keep(sha256, file)

    def path(self, sha256: str) -> Path | None:
        """From the cache, else fetched into it."""
        known = self._cache.path(sha256)
        if known is not None:
            return known
        incoming = new_incoming(self._cache.root)
        try:
            found = self._obstore.get(self._bucket, _key(sha256)).stream(min_chunk_size=BLOCK)
            digest = write_hashed(incoming, (bytes(block) for block in found))[0]
            if digest != sha256:
                return None  # damaged where it lies: as good as gone
            self._cache.keep(sha256, incoming)
        except FileNotFoundError:
            return None
        finally:
            incoming.unlink(missing_ok=True)
        return self._cache.path(sha256)

    def remove(self, sha256: str) -> None:
        """From the bucket, then from the cache."""
        with contextlib.suppress(FileNotFoundError):
            self._obstore.delete(self._bucket, _key(sha256))
        self._cache.remove(sha256)

    def all(self) -> Iterator[Blob]:
        """Pages through the bucket."""
        for page in self._obstore.list(self._bucket):
            for found in page:
                name = str(found["path"]).replace("/", "")[-64:]
                yield Blob(name, int(found["size"]), found["last_modified"].timestamp())

    def strays(self) -> Iterator[Path]:
        """Of the cache."""
        yield from self._cache.strays()


def open_blobs(settings: Settings) -> AbstractBlobs:
    """The place that the settings name: nothing = the home, file:///DIR = a shared disk, s3://BUCKET/PREFIX.

    Raises:
        SettingsError: if it is none of these.
    """
    url, home = settings.artifacts_url, settings.home / "artifacts"
    if not url:
        return DiskBlobs(home)
    parts = urlsplit(url)
    if parts.scheme == "file" and not parts.netloc and parts.path:
        return DiskBlobs(Path(parts.path))
    if parts.scheme == "s3":
        return BucketBlobs(url, DiskBlobs(home))
    raise SettingsError("RSAVATAR_ARTIFACTS_URL", "nothing, file:///DIR or s3://BUCKET/PREFIX", url)


def path_of(root: Path, sha256: str) -> Path:
    """Where the bytes with this hash lie on a disk: ``root/ab/cdef...``."""
    return root / sha256[:2] / sha256[2:]


def _key(sha256: str) -> str:
    return f"{sha256[:2]}/{sha256[2:]}"


def new_incoming(root: Path) -> Path:
    """A name below ``root`` that nobody else uses."""
    root.mkdir(parents=True, exist_ok=True)
    return root / f"{INCOMING}{os.getpid()}-{secrets.token_hex(4)}"


def write_hashed(target: Path, blocks: Iterator[bytes]) -> tuple[str, int]:
    """Write ``blocks`` to a new file, durably; returns their sha256 and how many bytes they are."""
    digest, size = hashlib.sha256(), 0
    with target.open("xb") as writer:
        for block in blocks:
            digest.update(block)
            writer.write(block)
            size += len(block)
        writer.flush()
        os.fsync(writer.fileno())
    return digest.hexdigest(), size


def copy_verified(source: Path, target: Path, sha256: str) -> bool:
    """Copy by rename, so that ``target`` is whole or not there; False, and nothing copied, where the hash differs."""
    part = target.with_name(target.name + ".part")
    try:
        shutil.copyfile(source, part)
        with part.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != sha256:
                return False
        part.replace(target)
        return True
    finally:
        part.unlink(missing_ok=True)
