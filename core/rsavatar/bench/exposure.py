"""``rsavatar bench exposure``: rows that are exposed for half a frame; the combined operator against its parts."""

from __future__ import annotations

from rsavatar.bench.study import Column, Study, Variant

STUDY = Study(
    name="exposure",
    title="Rolling shutter with exposure",
    about="""\
The rows of these subjects are read one after another and each is exposed for half a frame period: blur and scan
together. The combined operator is the mean of scans, each shifted a little (one slot a scan); scan alone is our
model with the exposure ignored; blur alone is MAD-Avatar's operator. Held-out truth is sharp.""",
    variants=(
        Variant("scan and blur, 4 scans", {}),
        Variant("scan and blur, 2 scans", {"exposure_samples": 2}),
        Variant("scan and blur, 8 scans", {"exposure_samples": 8}),
        Variant("scan alone", {"exposure_frames": 0.0}),
        Variant("blur alone (MAD-Avatar)", {"method": "mad-avatar"}),
        Variant("neither (GauHuman)", {"method": "gauhuman"}),
        Variant("true motion given", {"method": "oracle"}),
    ),
    columns=(
        Column("psnr", "PSNR ↑"),
        Column("ssim", "SSIM ↑", 3),
        Column("joint_mm", "joints, mm ↓", 1),
        Column("sub_frame_joint_mm", "sub-frame joints, mm ↓", 1),
        Column("train_s", "training, s", 0),
    ),
    subjects=("studio-0-exposed", "studio-1-exposed", "studio-2-exposed"),
)
