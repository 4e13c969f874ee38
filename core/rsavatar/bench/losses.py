"""``rsavatar bench losses``: which terms beside the L1 of colours pay."""

from __future__ import annotations

from rsavatar.bench.study import Column, Study, Variant

STUDY = Study(
    name="losses",
    title="Losses beside L1",
    about="""\
The paper minimises the L1 of colours and L_reg. `mask` is the weight of the L1 between opacity and body mask,
`ssim` that of 1 - SSIM (11-pixel Gaussian window). The first row is the default.""",
    variants=(
        Variant("mask 0.5 (default)", {}),
        Variant("mask 0", {"mask_weight": 0.0}),
        Variant("mask 0.1", {"mask_weight": 0.1}),
        Variant("mask 1", {"mask_weight": 1.0}),
        Variant("mask 0.5, ssim 0.01", {"ssim_weight": 0.01}),
        Variant("mask 0.5, ssim 0.05", {"ssim_weight": 0.05}),
        Variant("mask 0.5, ssim 0.2", {"ssim_weight": 0.2}),
        Variant("mask 0.5, constant colours (degree 0)", {"sh_degree": 0}),
    ),
    columns=(
        Column("psnr", "PSNR ↑"),
        Column("ssim", "SSIM ↑", 3),
        Column("flip", "ꟻLIP ↓", 3),
        Column("joint_mm", "joints, mm ↓", 1),
        Column("train_s", "training, s", 0),
    ),
    subjects=("studio-0", "studio-1", "studio-2"),
)
