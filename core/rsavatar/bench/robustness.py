"""``rsavatar bench robustness``: fits twice as wrong, images that are missing, masks that are wrong."""

from __future__ import annotations

from rsavatar.bench.study import Column, Study, Variant

FIT, MISSING, MASKS = {"fit": 2.0}, {"missing": 0.25}, {"masks": 0.15}
ALL = {"disturb": {**FIT, **MISSING, **MASKS}, "doubt": True}

STUDY = Study(
    name="robustness",
    title="Robustness to what is given",
    about="""\
`fit`: the initial fit's error at the mid rows, doubled. `missing`: a quarter of the training images are not there,
at random. `masks`: of 15 % of the training images the mask loses the lower body, takes a grey thing for a part of
the person, or is three frames late; the image is cut by it as any other. Images whose loss is above twice the
median of their camera's are left out (`doubt`); the last column counts them.""",
    variants=(
        Variant("as given", {}),
        Variant("as given, doubted", {"doubt": True}),
        Variant("fits twice as wrong", {"disturb": FIT}),
        Variant("a quarter of the images missing", {"disturb": MISSING}),
        Variant("wrong masks, all believed", {"disturb": MASKS}),
        Variant("wrong masks, doubted", {"disturb": MASKS, "doubt": True}),
        Variant("all three, doubted", ALL),
        Variant("GauHuman, as given", {"method": "gauhuman"}),
        Variant("GauHuman, all three, doubted", {"method": "gauhuman", **ALL}),
    ),
    columns=(
        Column("psnr", "PSNR ↑"),
        Column("ssim", "SSIM ↑", 3),
        Column("joint_mm", "joints, mm ↓", 1),
        Column("sub_frame_joint_mm", "sub-frame joints, mm ↓", 1),
        Column("doubted", "images left out", 1),
    ),
)
