"""What the figures show, as plain numbers: torch-free and free of any drawing. ``figures_draw`` puts them on paper.

A figure is made from runs alone (``Run``: a finished job as the database knows it), so it can be made again at any
time; what it was made from goes with it, into the file's metadata and the JSON beside it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from rsavatar.errors import SpecError, expected
from rsavatar.report.palette import label_of
from rsavatar.report.runs import (
    OURS,
    Figure,
    Run,
    Wish,
    by_method,
    groups,
    in_order,
    mean_curve,
    mean_of,
    of_preset,
    stamp,
    standard,
    summary,
)
from rsavatar.report.tables import LABELS, TOLD_THE_TRUTH

VARIANTS: dict[str, str] = {  # ablation flags, in the order of the paper's table
    "": "full method",
    "no_rs": "without rolling shutter",
    "no_spline": "without intra-frame spline",
    "no_pose_deformation": "without pose deformation",
    "no_lbs_refinement": "without LBS refinement",
    "no_reg": "without continuity",
}


def build(name: str, runs: Sequence[Run], wish: Wish | None = None) -> Figure:
    """The figure ``name`` of ``FIGURES``.

    Raises:
        SpecError: if there is no such figure, or ``wish`` names what no run has.
    """
    if name not in FIGURES:
        raise SpecError(expected("figure", f"one of {', '.join(FIGURES)}", repr(name)))
    wish = wish or Wish()
    chosen = of_preset(runs, wish.preset)
    return FIGURES[name].make(in_order(chosen), wish)


def _per_subject(runs: Sequence[Run], wish: Wish) -> Figure:
    used = [run for run in standard(runs) if run.means.get("psnr") is not None]
    subjects = sorted({run.subject for run in used})
    rows = [
        {"subject": s, "methods": [summary(group) for group in by_method([r for r in used if r.subject == s])]}
        for s in subjects
    ]
    caption = (
        "Held-out PSNR of every method on every subject, at the mid-row instant, inside the dilated body mask. "
        "The bar joins the shutter-oblivious baseline and ours; its label is the difference."
    )
    lacking = "" if used else "a succeeded job"
    return Figure("per-subject", "Per subject", caption, {"rows": rows}, {}, stamp(used), lacking)


def _pareto(runs: Sequence[Run], wish: Wish) -> Figure:
    used = [run for run in standard(runs) if run.means.get("psnr") is not None and run.train_seconds > 0]
    points = [
        {"method": r.method, "subject": r.subject, "seed": r.seed, "seconds": r.train_seconds, "psnr": r.means["psnr"]}
        for r in used
    ]
    means = [{**summary(group), "seconds": fmean(r.train_seconds for r in group)} for group in by_method(used)]
    honest = [m for m in means if m["method"] not in TOLD_THE_TRUTH]
    front = [
        m["method"]
        for m in honest
        if not any(o["seconds"] <= m["seconds"] and o["psnr"] >= m["psnr"] and o is not m for o in honest)
    ]
    caption = (
        "What a method costs and what it gives: time of training against held-out PSNR, small marks for the runs and "
        "large ones for the means of methods. The line joins the methods that none beats in both."
    )
    lacking = "" if used else "a succeeded job"
    data = {"points": points, "means": means, "front": front}
    return Figure("pareto", "Cost and quality", caption, data, {}, stamp(used), lacking)


def _curves(runs: Sequence[Run], wish: Wish) -> Figure:
    used = [run for run in standard(runs) if any(len(points) > 1 for points in run.curves.values())]
    series = []
    for group in by_method(used):
        for key in ("psnr", "loss"):
            lines = [run.curves[key] for run in group if len(run.curves.get(key, ())) > 1]
            if lines:
                series.append({"method": group[0].method, "key": key, **mean_curve(lines)})
    caption = (
        "Training: PSNR on the rolling-shutter input and loss, the mean over subjects and seeds; bands reach from the "
        "least to the greatest run. A method that cannot explain the input levels off below the others."
    )
    lacking = "" if series else "a succeeded job with training curves"
    return Figure("curves", "Training curves", caption, {"series": series}, {}, stamp(used), lacking)


def _ablation(runs: Sequence[Run], wish: Wish) -> Figure:
    own = [run for run in runs if run.method == OURS and len(run.ablation) <= 1]
    flagged = [run for run in own if run.ablation]
    model = Counter((run.bands, run.motion) for run in flagged).most_common(1)
    own = [run for run in own if [(run.bands, run.motion)] == [known for known, _ in model]]
    subjects = {run.subject for run in own if run.ablation} & {run.subject for run in own if not run.ablation}
    used = [run for run in own if run.subject in subjects]
    variants = []
    for flag, label in VARIANTS.items():
        own = [run for run in used if ",".join(run.ablation) == flag]
        if own:
            each = {s: mean_of(own, s, "psnr") for s in sorted({run.subject for run in own})}
            variants.append({"flag": flag, "label": label, "subjects": each, **summary(own)})
    caption = (
        "Each component taken away on its own: held-out PSNR and error of the joints within the readout, mean over "
        "subjects. The vertical line is the full method of the same motion and bands; error bars: deviation of seeds."
    )
    lacking = (
        "" if len(variants) > 1 else "succeeded jobs of rs-avatar on one subject, with and without an ablation flag"
    )
    return Figure("ablation", "Ablations", caption, {"variants": variants}, {}, stamp(used), lacking)


def _shutter(runs: Sequence[Run], wish: Wish) -> Figure:
    whole = [run for run in runs if not run.ablation and run.means.get("psnr") is not None]
    swept = [run for run in whole if run.method == OURS and run.bands != "scanline"]
    if swept:  # means of equal subjects, and of one model of motion
        subjects, motions = {run.subject for run in swept}, {run.motion for run in swept}
        whole = [r for r in whole if r.subject in subjects and (r.method != OURS or r.motion in motions)]
    modelled = [run for run in whole if run.method in {OURS, "mad-avatar"}]
    sweep = []
    for group in groups(modelled, lambda r: (r.method, r.bands)):
        sweep.append({"bands": group[0].bands, **summary(group)})
    oblivious = [summary(group) for group in by_method([r for r in whole if r.method == "gauhuman"])]
    shown = _shown(runs, wish)
    caption = (
        "One body, four exposures. Global: one instant. Blur: the mean over the readout. Bands: the rows of each band "
        "from one instant, with a seam between bands. Rolling: every row at its own instant. Enlarged where global and "
        "rolling differ most."
    )
    if len({s["bands"] for s in sweep} - {"scanline"}) > 1:
        caption += " Below, the same choice as a model of the sensor, against the number T of its instants."
    lacking = "" if shown else "a succeeded job of rs-avatar"
    pictures = {"kind": "shutter", "job": shown.job_id, "subject": shown.subject, "frame": wish.frame} if shown else {}
    used = [*modelled, *([shown] if shown else [])]
    data = {"sweep": sweep, "oblivious": oblivious}
    return Figure("shutter", "What a shutter does", caption, data, pictures, stamp(used), lacking)


def _shown(runs: Sequence[Run], wish: Wish) -> Run | None:
    own = [r for r in standard(runs) if r.method == OURS and wish.subject in (None, r.subject)]
    return max(own, key=lambda r: r.job_id, default=None)


def _qualitative(runs: Sequence[Run], wish: Wish) -> Figure:
    whole = standard(runs)
    subjects = sorted({run.subject for run in whole})
    if wish.subject is not None and wish.subject not in subjects:
        raise SpecError(
            expected("subject", f"one with a finished job ({', '.join(subjects) or 'none'})", repr(wish.subject))
        )
    subject = wish.subject or min(subjects, key=lambda s: (-_extent(whole, s), s), default="")
    own = {run.method: run for run in whole if run.subject == subject}  # the greatest seed of each method
    ordered = [
        own[m]
        for m in sorted(
            own, key=lambda m: (m in TOLD_THE_TRUTH, m == OURS, list(LABELS).index(m) if m in LABELS else 99)
        )
    ]
    columns = [{"job": r.job_id, "method": r.method, "label": label_of(r.method)} for r in ordered]
    camera, frame = _typical(own, wish) if own else ("", 0)
    pictures = {"kind": "strip", "subject": subject, "camera": camera, "frame": frame, "columns": columns}
    caption = (
        f"Novel views of {subject}, camera {camera}, frame {frame}: the rolling-shutter input of the nearest training "
        "camera, the reconstructions at the mid-row instant, and the truth; enlarged where ours gains most; "
        "the error there, and PSNR inside the dilated body mask."
    )
    if None in (wish.camera, wish.frame):
        caption += " The view is the one of median gain over the shutter-oblivious baseline."
    lacking = "" if own else "a succeeded job"
    data = {"subject": subject, "camera": camera, "frame": frame}
    return Figure("qualitative", "Novel views", caption, data, pictures if own else {}, stamp(ordered), lacking)


def _extent(runs: Sequence[Run], subject: str) -> int:
    return len({run.method for run in runs if run.subject == subject})


def _typical(own: Mapping[str, Run], wish: Wish) -> tuple[str, int]:
    """The held-out view whose gain of ours over the baseline is the median one, among those that were not ruled out.

    Raises:
        SpecError: if a camera or frame is asked for that was not scored.
    """
    ours = own.get(OURS) or next(iter(own.values()))
    base = own.get("gauhuman", ours).scores
    fit = [v for v in ours.scores if wish.camera in (None, v[0]) and wish.frame in (None, v[1])]
    if not fit:
        cameras = ", ".join(sorted({camera for camera, _ in ours.scores})) or "none"
        raise SpecError(expected("camera and frame", f"a held-out view (cameras {cameras})", (wish.camera, wish.frame)))
    ranked = sorted(fit, key=lambda v: (ours.scores[v] - base.get(v, 0.0), v))
    return ranked[len(ranked) // 2]


@dataclass(frozen=True)
class Kind:
    """A figure that can be made: its maker, and how one gets the runs for it."""

    make: Callable[[Sequence[Run], Wish], Figure]
    recipe: str


SUBMIT = "rsavatar submit draft --set method=rs-avatar --set subject=studio"
FIGURES: dict[str, Kind] = {
    "qualitative": Kind(_qualitative, SUBMIT),
    "per-subject": Kind(_per_subject, SUBMIT),
    "shutter": Kind(_shutter, SUBMIT),
    "pareto": Kind(_pareto, SUBMIT),
    "curves": Kind(_curves, SUBMIT),
    "ablation": Kind(_ablation, f"{SUBMIT} --set ablation.no_rs=true"),
}
