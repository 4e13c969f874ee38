"""Archives for tests: honest ones, and ones that should be refused."""

from __future__ import annotations

import gzip
import io
import stat
import struct
import tarfile
import zipfile
from collections.abc import Mapping
from pathlib import Path


def zip_of(files: Mapping[str, bytes], mode: int = 0, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip; ``mode`` is the Unix mode of every entry."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as held:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name)
            entry.compress_type = method
            entry.external_attr = mode << 16
            held.writestr(entry, content)
    return out.getvalue()


def tar_of(files: Mapping[str, bytes], kind: bytes = tarfile.REGTYPE, link: str = "") -> bytes:
    """A tar.gz; ``kind`` is the type of every entry."""
    out = io.BytesIO()
    with tarfile.open(fileobj=out, mode="w:gz") as held:
        for name, content in files.items():
            entry = tarfile.TarInfo(name)
            entry.type, entry.linkname = kind, link
            entry.size = len(content) if kind == tarfile.REGTYPE else 0
            held.addfile(entry, io.BytesIO(content) if entry.size else None)
    return out.getvalue()


def folder_as(kind: str, root: Path, top: str = "") -> bytes:
    """All files of a folder, under ``top`` where one is named."""
    files = {
        f"{top}/{path.relative_to(root)}".removeprefix("/"): path.read_bytes()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }
    return zip_of(files) if kind == "zip" else tar_of(files)


def bomb() -> bytes:
    """64 MB of nothing in some kilobytes."""
    return zip_of({"annots.npy": bytes(64 << 20)})


def gzip_bomb() -> bytes:
    """The same as tar.gz."""
    return tar_of({"annots.npy": bytes(64 << 20)})


def overlapping() -> bytes:
    """A zip of which many names share the bytes of one, as the densest bombs do."""
    whole = zip_of({"a.txt": b"x" * 5000}, method=zipfile.ZIP_STORED)
    start = whole.rfind(b"PK\1\2")
    entry, end = whole[start : whole.rfind(b"PK\5\6")], whole[whole.rfind(b"PK\5\6") :]
    others = b"".join(entry.replace(b"a.txt", f"{n}.txt".encode()) for n in "bcdefgh")
    directory = entry + others
    counts = struct.pack("<HHI", 8, 8, len(directory))
    return whole[:start] + directory + end[:8] + counts + end[16:]


def huge_header() -> bytes:
    """A tar.gz whose first header says that a name of 3 GB follows."""
    entry = tarfile.TarInfo("././@LongLink")
    entry.type, entry.size = tarfile.GNUTYPE_LONGNAME, 3 << 30
    return gzip.compress(entry.tobuf(tarfile.GNU_FORMAT) + bytes(4 << 20))


REFUSED: dict[str, tuple[str, bytes, str]] = {  # what is wrong: kind, archive, words of the refusal
    "absolute": ("zip", zip_of({"/etc/x.txt": b"x"}), "plain relative name"),
    "dots": ("zip", zip_of({"rs/../../x.txt": b"x"}), "plain relative name"),
    "dots in a tar": ("tar.gz", tar_of({"../x.txt": b"x"}), "plain relative name"),
    "drive": ("zip", zip_of({"C:/x.txt": b"x"}), "plain relative name"),
    "backslash": ("zip", zip_of({"..\\x.txt": b"x"}), "plain relative name"),
    "control": ("zip", zip_of({"a\nb.txt": b"x"}), "plain relative name"),
    "deep": ("zip", zip_of({"/".join("a" * 20) + ".txt": b"x"}), "plain relative name"),
    "trailing dot": ("zip", zip_of({"a./x.txt": b"x"}), "dots at their ends"),
    "link": ("zip", zip_of({"x.txt": b"/etc/passwd"}, stat.S_IFLNK | 0o777), "link or device"),
    "device": ("zip", zip_of({"x.txt": b""}, stat.S_IFCHR | 0o666), "link or device"),
    "symlink in a tar": ("tar.gz", tar_of({"x.txt": b""}, tarfile.SYMTYPE, "/etc/passwd"), "link or device"),
    "hardlink in a tar": ("tar.gz", tar_of({"x.txt": b""}, tarfile.LNKTYPE, "y.txt"), "link or device"),
    "fifo in a tar": ("tar.gz", tar_of({"x.txt": b""}, tarfile.FIFOTYPE), "link or device"),
    "device in a tar": ("tar.gz", tar_of({"x.txt": b""}, tarfile.BLKTYPE), "link or device"),
    "capitals": ("zip", zip_of({"rs/a.txt": b"1", "RS/A.TXT": b"2"}), "capitals apart"),
    "accents": ("zip", zip_of({"\u00e9.txt": b"1", "e\u0301.txt": b"2"}), "capitals apart"),
    "file and folder": ("tar.gz", tar_of({"a.txt": b"1", "a.txt/b.txt": b"2"}), "capitals apart"),
    "nested": ("zip", zip_of({"inner.zip": zip_of({"a.txt": b"1"})}), "a file of a subject"),
    "program": ("zip", zip_of({"run.sh": b"rm -rf /"}), "a file of a subject"),
    "pickle": ("zip", zip_of({"fit.pkl": b"\x80\x04."}), "a file of a subject"),
    "bomb": ("zip", bomb(), "times its compressed size"),
    "bomb in a tar": ("tar.gz", gzip_bomb(), "times its compressed size"),
    "overlap": ("zip", overlapping(), "bytes of their own"),
    "bzip2": ("zip", zip_of({"a.txt": b"x" * 99}, method=zipfile.ZIP_BZIP2), "stored or deflated"),
    "huge header": ("tar.gz", huge_header(), "headers of at most"),
    "no zip": ("zip", b"this is not a zip", "a whole zip"),
    "no gzip": ("tar.gz", b"this is not a gzip", "a whole tar.gz"),
    "nothing": ("zip", b"", "a whole zip"),
    "empty": ("zip", zip_of({}), "files of a subject"),
    "cut": ("tar.gz", tar_of({f"{n}.txt": bytes(range(256)) * 40 for n in range(9)})[:-200], "a whole tar.gz"),
    "other things": ("zip", zip_of({"notes/a.txt": b"x"}), "a subject: rs/annots.npy"),
}
