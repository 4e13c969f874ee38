"""Drawings on disk, by a key that says all that they depend on; the least recently used go when there are too many."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import secrets
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fastapi import Response
from fastapi.responses import FileResponse

from services.api.renderer import Lane, Renderer
from services.settings import Settings
from services.store.content import code_sha256

KEPT_SHARE = 0.8  # of the limit that stays after a clean-up


def key_of(order: Mapping[str, Any]) -> str:
    """SHA-256 of an order and of the code that draws it; equal keys are equal drawings."""
    whole = {"order": order, "code": code_sha256()}
    return hashlib.sha256(json.dumps(whole, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


class Drawings:
    """What has been drawn, and who draws what has not."""

    def __init__(self, settings: Settings) -> None:
        self._cache = DrawingCache(settings.home / "drawings", settings.drawings_mb << 20)
        self._renderer = Renderer(settings)

    def reply(
        self, lane: Lane, order: Mapping[str, Any], mime: str, tag: str | None, headers: Mapping[str, str]
    ) -> Response:
        """The drawing of an order, or 304 where the caller's ``tag`` (If-None-Match) says that it has it.

        Raises:
            SpecError, ConflictError, RenderError: as ``Renderer.draw``.
        """
        key = key_of(order)
        known = {"etag": f'"{key[:32]}"', "cache-control": "private, no-cache", **headers}
        if tag is not None and known["etag"] in tag:
            return Response(status_code=304, headers=known)
        path = self._cache.find(key) or self._cache.put(key, self._renderer.draw(lane, order).data)
        return FileResponse(path, media_type=mime, headers=known)

    def close(self) -> None:
        """End the processes that draw."""
        self._renderer.close()


class DrawingCache:
    """A folder of files named by key. Several processes may share it; a file is whole or not there."""

    def __init__(self, folder: Path, limit_bytes: int) -> None:
        self._folder = folder
        self._limit = limit_bytes
        self._written = limit_bytes  # so that the first write looks what is there
        self._lock = threading.Lock()

    def find(self, key: str) -> Path | None:
        """The file of a key, marked as used; None where there is none."""
        path = self._folder / key
        with contextlib.suppress(OSError):
            os.utime(path, (time.time(), path.stat().st_mtime))  # Last-Modified must not move under a player
            return path
        return None

    def put(self, key: str, data: bytes) -> Path:
        """Keep a drawing."""
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        temporary = self._folder / f".{key[:16]}-{secrets.token_hex(4)}"
        temporary.write_bytes(data)
        path = temporary.replace(self._folder / key)
        with self._lock:
            self._written += len(data)
            if self._written >= self._limit * (1 - KEPT_SHARE):
                self._written = 0
                self._clean(keep=path)
        return path

    def _clean(self, keep: Path) -> None:
        """Remove the least recently used files until the folder is within its limit."""
        found = []
        for entry in os.scandir(self._folder):
            with contextlib.suppress(OSError):
                about = entry.stat()
                found.append((about.st_atime, about.st_size, Path(entry.path)))
        total = sum(size for _, size, _ in found)
        if total <= self._limit:
            return
        for _, size, path in sorted(found):
            if total <= self._limit * KEPT_SHARE:
                return
            if path != keep:
                path.unlink(missing_ok=True)
                total -= size
