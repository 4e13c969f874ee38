"""A job that was really run, in seconds: the drawn figure of ``subject_files``, a few steps of a method."""

from __future__ import annotations

import shutil
from pathlib import Path

from rsavatar import experiment
from rsavatar.export.replay import Source
from rsavatar.spec import resolve
from tests.core.subject_files import write_rolling


def run_figure(folder: Path, method: str = "rs-avatar", **request: object) -> Source:
    """Write the subject into ``folder`` (once), run, and say where everything lies."""
    subject = folder / "figure"
    if not subject.exists():
        files = write_rolling(subject)
        if files.body.parent != files.root:
            shutil.copy(files.body, files.root / "body.npz")
    spec = resolve({"method": method, "subject": "figure", "preset": "smoke", "iterations": 60, **request})
    out = folder / "runs" / spec.sha256()[:8]
    experiment.run(spec, out, subject)
    return Source(spec, out / "checkpoint.safetensors", subject)
