"""What may come out of an archive: how much, and under which names. Bytes are counted while they are inflated."""

from __future__ import annotations

import os
import unicodedata
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import IO, NamedTuple

SUFFIXES = frozenset(
    {".npy", ".npz", ".png", ".jpg", ".jpeg", ".json", ".yml", ".yaml", ".toml", ".csv", ".txt", ".md"}
)
CLUTTER = ("__MACOSX", ".DS_Store")  # what a Mac adds; dropped
RATIO = 100  # inflated to compressed; pictures and arrays stay below 10
RATIO_FROM = 1 << 20  # bytes; a short text of one letter is no bomb
LONGEST_NAME, LONGEST_PART, DEEPEST = 512, 200, 12


class Refused(Exception):
    """The archive is not unpacked: ``name`` was expected to be ``wanted``, and is ``got``."""

    def __init__(self, name: str, wanted: str, got: object) -> None:
        super().__init__(f"{name}: expected {wanted}, got {got}")
        self.fault = {"name": name, "expected": wanted, "got": str(got)[:200]}


@dataclass(frozen=True)
class Order:
    """What to unpack into which folder, which must not exist yet; and the caps, in bytes and files."""

    archive: str
    kind: str  # zip or tar.gz
    into: str
    total: int
    entry: int
    entries: int


class Member(NamedTuple):
    """A file of an archive: its name as it stands there, and its bytes."""

    name: str
    open: IO[bytes]
    compressed: int | None  # bytes that it takes in the archive, where that is known


@dataclass
class Tally:
    """What has come out so far, against the caps."""

    order: Order
    compressed: int
    files: int = 0
    bytes: int = 0
    seen: dict[str, str] = field(default_factory=dict)  # how a name looks to a careless file system, and the name
    folders: set[str] = field(default_factory=set)

    def admit(self, name: str) -> PurePosixPath:
        """The path of the next file.

        Raises:
            Refused: if its name is not plain, has another suffix, or is an earlier one's in disguise.
        """
        self.files += 1
        if self.files > self.order.entries:
            raise Refused("archive", f"at most {self.order.entries} files", "more")
        path = plain_path(name)
        if path.suffix.lower() not in SUFFIXES:
            raise Refused(f"entry {name!r}", f"a file of a subject ({', '.join(sorted(SUFFIXES))})", repr(path.suffix))
        folders = [disguise(parent) for parent in path.parents if parent.name]
        key = disguise(path)
        if (twin := self.seen.get(key)) is not None or key in self.folders or any(f in self.seen for f in folders):
            raise Refused(
                f"entry {name!r}", "a name of its own, capitals apart", f"that of {twin or 'a folder or file'!r}"
            )
        self.seen[key] = name
        self.folders.update(folders)
        return path

    def count(self, name: str, of_entry: int, block: int, compressed: int | None) -> None:
        """Take ``block`` more bytes of an entry that has given ``of_entry`` before.

        Raises:
            Refused: at the first byte beyond a cap.
        """
        self.bytes += block
        if of_entry + block > self.order.entry:
            raise Refused(f"entry {name!r}", f"at most {self.order.entry} bytes", "more")
        if self.bytes > self.order.total:
            raise Refused("archive", f"at most {self.order.total} bytes unpacked", "more")
        whole = self.bytes > max(RATIO_FROM, RATIO * self.compressed)
        part = compressed is not None and of_entry + block > max(RATIO_FROM, RATIO * compressed)
        if whole or part:
            raise Refused(f"entry {name!r}", f"at most {RATIO} times its compressed size", "more: a bomb")


def plain_path(name: str) -> PurePosixPath:
    """The relative path that a name says.

    Raises:
        Refused: unless it stays below the folder that it is put in, on every system.
    """
    parts = name.split("/")
    is_plain = all(part not in {"", ".", ".."} and len(os.fsencode(part)) <= LONGEST_PART for part in parts)
    is_text = name.isprintable() and "\\" not in name and ":" not in name and "\ufffd" not in name
    if not (is_plain and is_text and len(name) <= LONGEST_NAME and len(parts) <= DEEPEST):
        raise Refused("entry", "a plain relative name without .., drives or backslashes", repr(name[:LONGEST_NAME]))
    if any(part != part.strip() or part.endswith(".") for part in parts):
        raise Refused("entry", "names without spaces or dots at their ends", repr(name))
    return PurePosixPath(name)


def disguise(path: PurePosixPath) -> str:
    """What a file system that ignores capitals and accents' spelling takes a path for."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFD", str(path)).casefold())


def is_clutter(name: str) -> bool:
    """Whether an entry is dropped without a word."""
    parts = name.rstrip("/").split("/")
    return parts[0] == CLUTTER[0] or parts[-1] == CLUTTER[1]
