"""The folder for what is expensive to build and cheap to keep."""

from __future__ import annotations

import os
from pathlib import Path


def cache_dir() -> Path:
    """The environment variable RSAVATAR_CACHE, else ~/.cache/rsavatar. Made on demand."""
    folder = Path(os.environ.get("RSAVATAR_CACHE") or Path.home() / ".cache" / "rsavatar")
    folder.mkdir(parents=True, exist_ok=True)
    return folder
