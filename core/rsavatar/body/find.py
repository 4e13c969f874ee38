"""Which body a job uses: the one it names, the one that lies with the subject, or the free default."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from rsavatar.body.anny import anny_body
from rsavatar.body.base import BodyModel
from rsavatar.body.smpl import load_body

_PATTERNS = ("body*.npz", "SMPL_NEUTRAL.*", "body/body*.npz", "body/SMPL_NEUTRAL.*")
_SUFFIXES = (".npz", ".pkl")


class HasBody(Protocol):
    """What is asked of a subject: where it lies, and the body file that came with it, if any."""

    @property
    def root(self) -> Path:
        """The subject's folder."""
        ...

    @property
    def body(self) -> Path | None:
        """The body model that lies with the data."""
        ...


def find_body(wanted: str, subject: HasBody | None) -> tuple[BodyModel, str]:
    """The body model of a job and a sentence that says which it is and why.

    Args:
        wanted: "anny" for the free default; "auto" for the subject's own, else the file named by the environment
            variable RSAVATAR_BODY, else one found in or beside the subject's folder, else the free default; anything
            else is a path.
        subject: whose body is meant under "auto".

    Raises:
        BodyError: if the chosen file cannot be used.
    """
    if wanted == "anny":
        return anny_body(), "Body: Anny, the free default, as asked."
    if wanted != "auto":
        return load_body(Path(wanted)), f"Body: {wanted}, as asked."
    if subject is not None and subject.body is not None:
        return load_body(subject.body), f"Body: {subject.body}, which lies with the subject."
    named = os.environ.get("RSAVATAR_BODY")
    if named:
        return load_body(Path(named)), f"Body: {named}, named by RSAVATAR_BODY."
    for path in _beside(subject.root) if subject is not None else ():
        return load_body(path), f"Body: {path}, found by the subject's folder."
    return anny_body(), "Body: Anny, the free default, for want of a body file by the subject."


def _beside(root: Path) -> Iterator[Path]:
    """Body files in the subject's folder, its parent and grandparent, and their ``body`` folders, nearest first."""
    start = root.resolve()
    for folder in (start, *start.parents[:2]):
        for pattern in _PATTERNS:
            yield from (path for path in sorted(folder.glob(pattern)) if path.suffix in _SUFFIXES)
