"""The studio's sharp source frames, 120 a second, as footage for the rolling-shutter builder (see ``footage``)."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

from rsavatar.body.smpl import save_body
from rsavatar.data.base import Array
from rsavatar.data.footage import DESCRIPTION
from rsavatar.data.images import write_png
from rsavatar.data.rolling import name_of
from rsavatar.data.studio_motion import biased_noisy_fit
from rsavatar.data.studio_stage import HELD_OUT, TRAINING, Stage
from rsavatar.events import Progress, Report


def write_source(root: Path, stage: Stage, length: int, seed: int, report: Report) -> None:
    """``length`` sharp frames of every camera, with fits that err as those of a fitter do, and the body.

    Args:
        root: a new folder.
        stage: who and what is seen.
        length: F, source frames, from 0.
        seed: of the fits' errors.
        report: hears of each finished frame.
    """
    begun, size = time.monotonic(), stage.cameras[0].height
    for frame in range(length):
        pictures = stage.pictures(list(stage.cameras), np.full(size, float(frame)))
        for camera, (rgb, coverage) in enumerate(pictures):
            write_png(root / "images" / name_of(camera) / f"{frame:06d}.png", rgb[..., ::-1])
            write_png(root / "masks" / name_of(camera) / f"{frame:06d}.png", coverage)
        report(Progress("source", frame + 1, length, time.monotonic() - begun))
    times: Array = np.arange(length, dtype=np.float64)
    seen = [stage.motion.at(np.full(24, time)) for time in times]
    fit = biased_noisy_fit(stage.body, stage.motion.at(times), seen, np.random.default_rng([seed, 29]))
    np.savez(root / "fits.npz", poses=fit.poses, Rh=fit.Rh, Th=fit.Th, shapes=fit.shapes)
    save_body(root / "body.npz", stage.body)
    (root / DESCRIPTION).write_text(json.dumps(_description(stage), indent=1) + "\n", encoding="utf-8")


def _description(stage: Stage) -> dict[str, object]:
    cameras = {
        name_of(index): {
            "K": [[each.fx, 0.0, each.cx], [0.0, each.fy, each.cy], [0.0, 0.0, 1.0]],
            "R": each.rotation.tolist(),
            "T": each.translation.tolist(),
        }
        for index, each in enumerate(stage.cameras)
    }
    train, test = ([name_of(c) for c in group] for group in (TRAINING, HELD_OUT))
    return {
        "units": "metres",
        "pixel_centre": 0.5,
        "licence": "CC0 1.0",
        "train": train,
        "test": test,
        "cameras": cameras,
    }
