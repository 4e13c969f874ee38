"""The small files of a built subject: calibration, fits, ``meta.json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rsavatar.data.base import BodyFit
from rsavatar.data.build_work import Work
from rsavatar.data.rolling import name_of


def write_annots(work: Work) -> None:
    """``rs/annots.npy``: all calibrated cameras, T in millimetres; no distortion where the pictures have none left."""
    footage = work.footage
    raw = work.rows == "raw"
    cameras = {
        "K": [each.matrix for each in footage.calibrations],
        "R": [each.rotation for each in footage.calibrations],
        "T": [1000.0 * each.translation.reshape(3, 1) for each in footage.calibrations],
        "D": [each.distortion.reshape(5, 1) * raw for each in footage.calibrations],
    }
    names = [f"images/{name_of(c)}" for c in range(len(footage.calibrations))]
    frames = [{"ims": [f"{name}/{n:06d}.png" for name in names]} for n in range(len(work.mids))]
    np.save(work.out / "rs" / "annots.npy", np.array({"cams": cameras, "ims": frames}, dtype=object), allow_pickle=True)


def write_fits(folder: Path, fit: BodyFit) -> None:
    """``<n>.npy`` for every state, as ZJU-MoCap has them."""
    folder.mkdir(parents=True, exist_ok=True)
    for n in range(len(fit.poses)):
        row = slice(n, n + 1)
        state = {"poses": fit.poses[row], "Rh": fit.Rh[row], "Th": fit.Th[row], "shapes": fit.shapes[None]}
        single = {name: value.astype(np.float32) for name, value in state.items()}
        np.save(folder / f"{n}.npy", np.array(single, dtype=object), allow_pickle=True)


def write_meta(work: Work, motion: Mapping[str, Any]) -> None:
    """``meta.json``, which the loader of rolling-shutter subjects reads."""
    footage, clock = work.footage, work.clock
    index = footage.index
    offsets = [0.0] * len(footage.calibrations)
    for name, value in work.triggers.items():
        offsets[index[name]] = value
    listed = {index[name] for name in work.cameras()}
    meta = {
        "source": f"built by rsavatar data build-rs from {footage.name} ({footage.layout})",
        "licence": footage.licence,
        "K": clock.period,
        "gamma": clock.gamma,
        "frames": len(work.mids),
        "source_frames": footage.length,
        "mid": list(work.mids),
        "train": [index[name] for name in footage.train],
        "test": [index[name] for name in footage.test],
        "excluded": [c for c in range(len(footage.calibrations)) if c not in listed],
        "camera_names": {name_of(index[name]): name for name in work.cameras()},
        "delta": offsets,
        "row_time": "t(v) = mid + delta_c + gamma*K*(v/H - 1/2), v = 0..H-1, source-frame units",
        "rows": work.rows,
        "pixel_centre": footage.pixel_centre,
        "displacement_px": {"max": motion["D"]},
    }
    (work.out / "meta.json").write_text(json.dumps(meta, indent=1) + "\n", encoding="utf-8")
