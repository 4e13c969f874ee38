"""Files of a zip."""

from __future__ import annotations

import os
import stat
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path

from services.unpack.caps import Member, Refused, Tally, is_clutter, plain_path

LARGEST_DIRECTORY = 32 << 20  # bytes; it is read at once


def members(archive: Path, tally: Tally) -> Iterator[Member]:
    """Files of a zip; its entries may not share bytes with each other, as those of the densest bombs do."""
    require_small_directory(archive)
    with zipfile.ZipFile(archive) as held:
        entries = held.infolist()
        if len(entries) > 2 * tally.order.entries:
            raise Refused("archive", f"at most {tally.order.entries} files", len(entries))
        if sum(entry.compress_size for entry in entries) > tally.compressed:
            raise Refused("archive", "entries with bytes of their own", "entries that overlap: a bomb")
        for entry in entries:
            kind = stat.S_IFMT(entry.external_attr >> 16)
            if is_clutter(entry.filename):
                continue
            if entry.is_dir():
                plain_path(entry.filename.rstrip("/"))
                continue
            if kind not in {0, stat.S_IFREG}:
                raise Refused(
                    f"entry {entry.filename!r}", "a plain file or a folder", f"mode {kind:o}: a link or device"
                )
            if entry.flag_bits & 1 or entry.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
                raise Refused(f"entry {entry.filename!r}", "stored or deflated bytes", "encrypted or another method")
            yield Member(entry.orig_filename, held.open(entry), entry.compress_size)


def require_small_directory(archive: Path) -> None:
    """Look at the end of a zip before the library reads its whole directory.

    Raises:
        Refused: if the directory is larger than any honest one.
    """
    with archive.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - (1 << 16) - 22 - 76))
        tail = file.read()
    wide, plain = tail.rfind(b"PK\6\6"), tail.rfind(b"PK\5\6")
    if plain < 0 or len(tail) < plain + 22:
        raise Refused("archive", "a whole zip", "no directory at its end")
    length = struct.unpack_from("<I", tail, plain + 12)[0]
    if length == 0xFFFFFFFF and wide >= 0:
        length = struct.unpack_from("<Q", tail, wide + 40)[0]
    if length > LARGEST_DIRECTORY:
        raise Refused("archive", f"a directory of at most {LARGEST_DIRECTORY} bytes", length)
