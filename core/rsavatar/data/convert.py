"""Any footage as our minimal folder (see ``footage``): pictures are linked where they can be, else copied."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from rsavatar.data.footage import DESCRIPTION, Footage
from rsavatar.errors import DataError, expected


def convert(footage: Footage, out: Path) -> Path:
    """Writes ``footage`` to ``out``, whole or not at all.

    Raises:
        DataError: if something is there already.
    """
    if out.exists():
        raise DataError(expected(str(out), "nothing there", "something"))
    out.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}-"))
    try:
        for camera in (*footage.train, *footage.test):
            for n, frame in enumerate(footage.frames[camera], footage.first):
                _place(frame.image, part / "images" / camera / f"{n:06d}{frame.image.suffix.lower()}")
                _place(frame.mask, part / "masks" / camera / f"{n:06d}{frame.mask.suffix.lower()}")
        _describe(footage, part)
        if footage.body is not None:
            shutil.copyfile(footage.body, part / "body.npz")
        part.chmod(0o755)
        part.rename(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return out


def _place(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source.resolve(), target)
    except OSError:  # another file system, or one without links
        shutil.copyfile(source, target)


def _describe(footage: Footage, root: Path) -> None:
    fit = footage.fit
    frames = np.arange(footage.first, footage.first + footage.length)
    np.savez(root / "fits.npz", poses=fit.poses, Rh=fit.Rh, Th=fit.Th, shapes=fit.shapes, frames=frames)
    listed = (*footage.train, *footage.test)
    calibrations = {name: footage.calibrations[footage.index[name]] for name in listed}
    description = {
        "units": "metres",
        "pixel_centre": footage.pixel_centre,
        "licence": footage.licence,
        "train": list(footage.train),
        "test": list(footage.test),
        "cameras": {
            name: {
                "K": each.matrix.tolist(),
                "R": each.rotation.tolist(),
                "T": each.translation.tolist(),
                "D": each.distortion.tolist(),
            }
            for name, each in calibrations.items()
        },
    }
    (root / DESCRIPTION).write_text(json.dumps(description, indent=1) + "\n", encoding="utf-8")
