"""Files of a tar.gz."""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterator
from gzip import GzipFile
from pathlib import Path

from services.unpack.caps import RATIO, RATIO_FROM, Member, Refused, Tally, is_clutter, plain_path

BLOCK = 1 << 16
LARGEST_HEADER = 1 << 20  # bytes of long names and attributes, which are read at once
HEADERS = 1536  # bytes that a tar spends on a file beside its contents


class ShortReads(io.FileIO):
    """A tar on disk, whose reader asks for long headers in one piece; such pieces stay small."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read.

        Raises:
            Refused: if more is asked for than a header may have.
        """
        if size is None or not 0 <= size <= LARGEST_HEADER:
            raise Refused("archive", f"headers of at most {LARGEST_HEADER} bytes", "a larger one")
        return super().read(size) or b""


def members(archive: Path, tally: Tally) -> Iterator[Member]:
    """Files of a tar.gz. It is inflated beside the archive first, counted, so that its reader meets a plain file."""
    plain = archive.with_suffix(".tar")
    inflate(archive, plain, tally)
    with ShortReads(plain) as file, tarfile.open(fileobj=file, mode="r:", errors="strict") as held:
        for number, entry in enumerate(held):
            if number >= 2 * tally.order.entries:
                raise Refused("archive", f"at most {tally.order.entries} files", "more")
            name = entry.name.removeprefix("./")
            if is_clutter(name):
                continue
            if entry.isdir():
                if name not in {"", "."}:
                    plain_path(name)
                continue
            source = held.extractfile(entry) if entry.isreg() and not entry.issparse() else None
            if source is None:
                raise Refused(f"entry {name!r}", "a plain file or a folder", f"type {entry.type!r}: a link or device")
            yield Member(name, source, None)


def inflate(archive: Path, plain: Path, tally: Tally) -> None:
    """Inflate a gzip within the caps. Headers of a tar come on top of its files, a kilobyte and a half each."""
    most = min(tally.order.total, max(RATIO_FROM, RATIO * tally.compressed)) + HEADERS * tally.order.entries
    size = 0
    with GzipFile(archive) as source, plain.open("xb") as file:
        while block := source.read(BLOCK):
            size += len(block)
            if size > most:
                raise Refused("archive", f"at most {tally.order.total} bytes unpacked, {RATIO} times its size", "more")
            file.write(block)
