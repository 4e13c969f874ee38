"""Which subject a name and a folder mean."""

from __future__ import annotations

import re
from pathlib import Path

from rsavatar.catalog import DATASETS, STUDIO_NAME
from rsavatar.catalog import load as load_named
from rsavatar.data.base import Subject
from rsavatar.errors import DataError, expected

STUDIO = "studio"
_LAYOUTS = "meta.json with rs/ (rolling), footage.json (footage), or annots.npy with images/ or Camera_B1.. (zju)"


def open_subject(name: str, directory: Path | None) -> Subject:
    """The subject in ``directory``; without one, ``name`` must be built in, and is built when absent.

    Built in are "studio" and, for every seed N, "studio-N".

    Raises:
        DataError: if there is no folder, it has no known layout, or the subject cannot be read.
    """
    if directory is None:
        seed = studio_seed(name)
        if seed is None:
            wanted = f"a folder, or the built-in {STUDIO!r} or '{STUDIO}-N'"
            raise DataError(expected(f"subject {name!r}", wanted, "no folder"))
        from rsavatar.data.studio import studio_subject_dir

        directory = studio_subject_dir(seed)
    subject: Subject = load_named(DATASETS, layout_of(directory))(directory)
    return subject


def studio_seed(name: str) -> int | None:
    """The seed of a built-in subject's name; None for all other names."""
    match = re.fullmatch(STUDIO_NAME, name)
    return int(match["seed"] or 0) if match else None


def layout_of(directory: Path) -> str:
    """The name in ``catalog.DATASETS`` of the layout that ``directory`` has.

    Raises:
        DataError: saying what was looked for and what is there.
    """
    if not directory.is_dir():
        raise DataError(expected(str(directory), "a subject's folder", "nothing there"))
    if (directory / "meta.json").is_file() and (directory / "rs").is_dir():
        return "rolling"
    if (directory / "footage.json").is_file():
        return "footage"
    pictures = (directory / "images").is_dir() or any(directory.glob("Camera*"))
    if (directory / "annots.npy").is_file() and pictures:
        return "zju"
    there = ", ".join(sorted(path.name for path in directory.iterdir())[:12]) or "an empty folder"
    raise DataError(expected(str(directory), _LAYOUTS, there))
