"""``python -m services.unpack``: one order on stdin, one answer on stdout.

In:   a line of JSON, the fields of ``Order``
Out:  {"files": n, "bytes": n} and exit 0, or {"name", "expected", "got"} and exit 1
Only plain files with plain names and the suffixes of a subject's files come out, into a fresh folder.
"""

from __future__ import annotations

import json
import os
import resource
import struct
import sys
import tarfile
import zipfile
import zlib
from contextlib import closing
from gzip import BadGzipFile
from pathlib import Path

from services.unpack import tars, zips
from services.unpack.caps import Member, Order, Refused, Tally

KINDS = {"zip": zips.members, "tar.gz": tars.members}
DAMAGED = (zipfile.BadZipFile, tarfile.TarError, zlib.error, BadGzipFile, EOFError, OSError, ValueError, struct.error)
BLOCK = 1 << 16
MEMORY, SECONDS = 1 << 30, 600  # of this process


def unpack(order: Order) -> Tally:
    """Take an archive apart.

    Raises:
        Refused: naming the entry. What has come out until then is the caller's to remove.
    """
    archive, into = Path(order.archive), Path(order.into)
    into.mkdir(mode=0o700)
    tally = Tally(order, archive.stat().st_size)
    try:
        for member in KINDS[order.kind](archive, tally):
            write(into / tally.admit(member.name), member, tally)
    except DAMAGED as error:
        raise Refused("archive", f"a whole {order.kind}", f"{type(error).__name__}: {error}") from error
    if tally.files == 0:
        raise Refused("archive", "files of a subject", "none")
    return tally


def write(path: Path, member: Member, tally: Tally) -> None:
    """Copy one member, counting."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    target = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    with closing(member.open) as source, os.fdopen(target, "wb") as file:
        size = 0
        while block := source.read(BLOCK):
            tally.count(member.name, size, len(block), member.compressed)
            size += len(block)
            file.write(block)


def spend_little(order: Order) -> None:
    """Limits of this process: what gets past our counting meets the kernel's."""
    file_size = order.total + tars.HEADERS * order.entries
    limits = {
        resource.RLIMIT_AS: MEMORY,
        resource.RLIMIT_CPU: SECONDS,
        resource.RLIMIT_FSIZE: file_size,
        resource.RLIMIT_NOFILE: 64,
        resource.RLIMIT_CORE: 0,
    }
    for what, most in limits.items():
        _, hard = resource.getrlimit(what)
        value = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(what, (value, value))


def main() -> int:
    """Follow the order on stdin; 0 when the archive has been unpacked."""
    order = Order(**json.loads(sys.stdin.readline()))
    spend_little(order)
    try:
        tally = unpack(order)
    except Refused as error:
        print(json.dumps(error.fault))
        return 1
    except MemoryError:
        print(json.dumps(Refused("archive", f"one that {MEMORY >> 20} MiB suffice for", "a larger one").fault))
        return 1
    print(json.dumps({"files": tally.files, "bytes": tally.bytes}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
