"""``rsavatar bench restore``: what correcting the pictures first gains, in the pictures and in the avatar."""

from __future__ import annotations

from rsavatar.bench.study import Column, Study, Variant
from rsavatar.restore.weights import which

STUDY = Study(
    name="restore",
    title="Correct first, reconstruct second",
    about=f"""\
A 2D rolling-shutter corrector on every training view, then GauHuman on what comes out, against GauHuman on the frames
as they are and against the shutter in the image formation. "2D gain" is the PSNR of the corrected training views minus
that of the rolling ones against the sharp ones, in the dilated body mask and over the whole frame (all of which is
black around the person here), before any avatar is trained; PSNR is of the avatar, in held-out views.

Weights: CVR: {which("cvr")}. JAMNet: {which("jamnet")}. The flow corrector has none. The paper's figures are of the
authors' weights on another benchmark, whose frames have a background.""",
    variants=(
        Variant("GauHuman", {"method": "gauhuman"}, reported="23.69 dB"),
        Variant("flow + GauHuman", {"method": "flow+gauhuman"}),
        Variant("CVR + GauHuman", {"method": "cvr+gauhuman"}, reported="2D +0.84 / -4.0, avatar +0.30"),
        Variant("JAMNet + GauHuman", {"method": "jamnet+gauhuman"}, reported="2D +0.97 / +0.2, avatar +0.27"),
        Variant("RS-Avatar", {"method": "rs-avatar"}, reported="avatar +0.99"),
    ),
    columns=(
        Column("restore_gain_body_db", "2D gain, body"),
        Column("restore_gain_full_db", "2D gain, frame"),
        Column("psnr", "PSNR ↑"),
        Column("ssim", "SSIM ↑", 3),
        Column("joint_mm", "joints, mm ↓", 1),
    ),
    reported="paper",
    subjects=("studio-0", "studio-1", "studio-2"),
)
