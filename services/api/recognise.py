"""Which layout a subject's folder has, by names alone: what the files hold is for the check, which may load them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from services.errors import RequestError


def inspect(path: Path) -> tuple[str, dict[str, Any]]:
    """Layout of a subject by its names alone: what the files hold is checked when a job loads them.

    Raises:
        RequestError: if neither layout is there.
    """
    if (path / "rs" / "annots.npy").is_file():
        return "rolling", {"truth": (path / "truth" / "motion.npz").is_file()}
    if (path / "annots.npy").is_file():
        return "zju", {}
    raise RequestError("path", "a subject: rs/annots.npy (rolling shutter) or annots.npy (ZJU-MoCap-refine)", str(path))
