"""Names to places. Plain dictionaries of strings, imported by nobody's side effect: ``load`` imports on demand."""

from __future__ import annotations

import importlib
from typing import Any

METHODS: dict[str, str] = {
    "rs-avatar": "rsavatar.methods.rolling:RollingShutterAvatar",
    "gauhuman": "rsavatar.methods.oblivious:ShutterObliviousAvatar",
    "cvr+gauhuman": "rsavatar.methods.two_stage:CVRThenAvatar",
    "jamnet+gauhuman": "rsavatar.methods.two_stage:JAMNetThenAvatar",
    "flow+gauhuman": "rsavatar.methods.two_stage:FlowThenAvatar",
    "mad-avatar": "rsavatar.methods.blur:BlurAvatar",
    "oracle": "rsavatar.methods.oracle:Oracle",
}

MOTIONS: dict[str, str] = {
    "sequence-spline": "rsavatar.motion.sequence:SequenceSpline",
    "frame-spline": "rsavatar.motion.spline:FrameSpline",
    "still": "rsavatar.motion.still:StillPose",
}

DATASETS: dict[str, str] = {
    "rolling": "rsavatar.data.rolling:load",
    "zju": "rsavatar.data.zju:load",
    "footage": "rsavatar.data.sharp:load",
}

STUDIO_NAME = r"studio(?:-(?P<seed>0|[1-9][0-9]{0,8}))?"  # built-in subjects; "studio" is that of seed 0

METRICS: dict[str, str] = {
    "psnr": "rsavatar.metrics.image:psnr",
    "ssim": "rsavatar.metrics.image:ssim",
    "flip": "rsavatar.metrics.image:flip",
    "lpips": "rsavatar.metrics.image:lpips",
}

STUDIES: dict[str, str] = {  # rsavatar bench NAME: many jobs, one table
    "ablation": "rsavatar.bench.ablation",
    "calibration": "rsavatar.bench.calibration",
    "exposure": "rsavatar.bench.exposure",
    "losses": "rsavatar.bench.losses",
    "restore": "rsavatar.bench.restore",
    "robustness": "rsavatar.bench.robustness",
    "skips": "rsavatar.bench.skips",
    "superres": "rsavatar.bench.superres",
}

DESCRIPTIONS: dict[str, str] = {
    "rs-avatar": "rolling-shutter model: every row rendered at its own instant (ours)",
    "gauhuman": "shutter-oblivious: one pose per frame, as if the frame were instantaneous",
    "cvr+gauhuman": "two-stage: every view corrected by CVR, then gauhuman on what comes out",
    "jamnet+gauhuman": "two-stage: every view corrected by JAMNet, then gauhuman on what comes out",
    "flow+gauhuman": "two-stage: every view corrected by dense optical flow, no weights, then gauhuman",
    "mad-avatar": "blur model: the same spline and the same T renders, averaged instead of selected",
    "oracle": "the ceiling: trained with the true motion; needs a subject that has one",
}


def load(table: dict[str, str], name: str) -> Any:
    """Import the object that ``table`` names.

    Raises:
        KeyError: if ``name`` is not in ``table``; specs and requests are validated long before.
    """
    module, _, attribute = table[name].partition(":")
    return getattr(importlib.import_module(module), attribute)
