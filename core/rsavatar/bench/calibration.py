"""``rsavatar bench calibration``: a schedule that is only approximately known, taken as given and calibrated."""

from __future__ import annotations

from rsavatar.bench.study import Column, Study, Variant

READOUT, TRIGGER = {"readout": 0.2}, {"trigger": 0.25}
BOTH = {**READOUT, **TRIGGER}


def _variants(group: str, wrong: dict[str, float], unknown: tuple[str, ...]) -> tuple[Variant, ...]:
    return (
        Variant(f"known exactly ({group})", {}, group),
        Variant(f"taken as given ({group})", {"disturb": wrong}, group),
        Variant(f"calibrated ({group})", {"disturb": wrong, "calibrate": unknown}, group),
        Variant(f"known exactly, calibrated all the same ({group})", {"calibrate": unknown}, group),
    )


STUDY = Study(
    name="calibration",
    title="Self-calibration of the schedule",
    about="""\
The paper's last limitation: a real sensor's schedule is only approximately known. The readout is taken to be 20 %
longer than it is, or triggers a quarter of a frame late and early by turns, or both; `calibrate` makes readout and
trigger of every camera parameters. Errors are means over the training cameras, triggers after their common part is
taken off, which no image can tell (`docs/decisions`).""",
    variants=(
        *_variants("readout 20 % off", READOUT, ("readout",)),
        *_variants("triggers a quarter of a frame off", TRIGGER, ("trigger",)),
        *_variants("both off", BOTH, ("readout", "trigger")),
    ),
    columns=(
        Column("psnr", "PSNR ↑"),
        Column("joint_mm", "joints, mm ↓", 1),
        Column("sub_frame_joint_mm", "sub-frame joints, mm ↓", 1),
        Column("readout_error_frames", "readout error, source frames ↓", 3),
        Column("readout_error_ms", "ms", 2),
        Column("trigger_error_frames", "trigger error, source frames ↓", 3),
        Column("trigger_error_ms", "ms", 2),
    ),
)
