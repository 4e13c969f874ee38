"""``rsavatar bench ablation``: one component removed at a time, beside the paper's figures (table "Ablations")."""

from __future__ import annotations

from typing import Any

from rsavatar.bench.study import Column, Study, Variant

PAPERS = {"motion": "frame-spline", "T": "K", "continuity": "aligned"}  # the paper's own model, with our step sizes
A, B, C = "The paper's model, T = K", "Ours: one spline over the sequence, scanline", "How much of it"

_PAPER_ROWS: tuple[tuple[str, dict[str, Any], str], ...] = (
    ("full", {}, "24.65"),
    ("no_rs", {"ablation": {"no_rs": True}}, "23.08 (−1.57)"),
    ("no_spline", {"ablation": {"no_spline": True}}, "21.41 (−3.24)"),
    ("no_pose_deformation", {"ablation": {"no_pose_deformation": True}}, "24.00 (−0.65)"),
    ("no_lbs_refinement", {"ablation": {"no_lbs_refinement": True}}, "24.57 (−0.08)"),
    ("no_reg", {"ablation": {"no_reg": True}}, "23.26 (−1.39)"),
    ("T=2K", {"T": "2K"}, "24.59 (−0.06)"),
    ("T=4K", {"T": "4K"}, "24.54 (−0.11)"),
    ("T=scanline", {"T": "scanline"}, ""),
    ("L_reg as in the paper's formula", {"continuity": "paper"}, ""),
)
_OWN_ROWS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("ours", {}),
    ("ours, no_rs", {"ablation": {"no_rs": True}}),
    ("ours, no_spline", {"ablation": {"no_spline": True}}),
    ("ours, no_pose_deformation", {"ablation": {"no_pose_deformation": True}}),
    ("ours, no_lbs_refinement", {"ablation": {"no_lbs_refinement": True}}),
    ("ours, T=K", {"T": "K"}),
    ("ours, a spline per frame + L_reg", {"motion": "frame-spline"}),
    ("ours, two knots a frame", {"knots": 2}),
    ("ours, residual added as in the paper", {"residual": "additive"}),
    ("ours, the authors' step sizes", {"regime": "authors"}),
)
_AMOUNTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("P=4, lambda=1", {}),
    ("P=2", {"P": 2}),
    ("P=3", {"P": 3}),
    ("P=6", {"P": 6}),
    ("lambda=0.01", {"lambda": 0.01}),
    ("lambda=0.1", {"lambda": 0.1}),
    ("lambda=10", {"lambda": 10.0}),
)

STUDY = Study(
    name="ablation",
    title="Ablations",
    about="""\
Every flag removes its component and nothing else (`tests/contracts/test_methods.py`). The first table is the
paper's own model under our step sizes and budget; the paper's figures are of its subject 377, so differences
compare and levels do not. `Δ PSNR` is the mean of paired differences (same subject, same seed) with its standard
error.""",
    variants=(
        *(Variant(name, {**PAPERS, **words}, A, reported) for name, words, reported in _PAPER_ROWS),
        *(Variant(name, {"T": "scanline", **words}, B) for name, words in _OWN_ROWS),
        *(Variant(name, {**PAPERS, **words}, C) for name, words in _AMOUNTS),
    ),
    columns=(
        Column("psnr", "PSNR ↑"),
        Column("ssim", "SSIM ↑", 3),
        Column("joint_mm", "joints, mm ↓", 1),
        Column("sub_frame_joint_mm", "sub-frame joints, mm ↓", 1),
    ),
    reported="paper, PSNR",
)
