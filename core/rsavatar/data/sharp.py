"""Our minimal folder as a subject to train on: sharp, global shutter (see ``footage``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rsavatar.data.base import Image, Subject, Timing
from rsavatar.data.footage import Footage, read_own
from rsavatar.data.rolling import name_of


def load(root: Path) -> Subject:
    """The footage in ``root`` as a global-shutter subject: readout 0, period 1; ``truth`` is ``observe``.

    **Convention**: cameras are called by their place in ``footage.json``, two digits.

    Raises:
        DataError: naming what is missing, damaged or in the wrong unit.
    """
    return subject_of(read_own(root))


def subject_of(footage: Footage) -> Subject:
    """Footage of any layout as a global-shutter subject."""
    names = {name_of(footage.index[name]): name for name in (*footage.train, *footage.test)}

    def read(camera: str, frame: int) -> Image:
        picture = footage.read(names[camera], frame, undistorted=True)
        coverage = picture[..., 3]
        return np.where(coverage[..., None] != 0, picture[..., :3], 0).astype(np.uint8), coverage

    return Subject(
        name=footage.name,
        root=footage.root,
        cameras={
            number: footage.calibrations[footage.index[name]].camera(footage.size(name), footage.pixel_centre)
            for number, name in names.items()
        },
        training=tuple(name_of(footage.index[name]) for name in footage.train),
        held_out=tuple(name_of(footage.index[name]) for name in footage.test),
        fit=footage.fit,
        timing=Timing(np.arange(footage.length, dtype=np.float64), readout_frames=0.0, period_frames=1.0),
        observe=read,
        truth=read,
        fingerprint=footage.fingerprint([*footage.train, *footage.test]),
        body=footage.body,
    )
