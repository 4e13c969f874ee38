"""What tables are made of: a row for every finished job, the metrics, and the words for people."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

Settings = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Row:
    """What one finished job adds to a table. Metrics are means over frames, then cameras; None is "not computed".

    ``settings`` are the words of the job that decide its result, besides method, subject and seed, as text.
    """

    method: str
    subject: str
    seed: int
    psnr: float | None
    ssim: float | None
    flip: float | None
    lpips: float | None
    joint_mm: float | None
    sub_frame_joint_mm: float | None
    train_seconds: float | None
    gaussians: int | None
    iterations: int
    job_id: str
    commit: str
    data_sha256: str
    protocol: str  # how the metrics were computed: a sentence, or a JSON object
    preset: str = ""
    evaluate_seconds: float | None = None
    renders: float | None = None  # passes of the renderer a step
    paper_renders: float | None = None  # full frames that the paper's way would render a step
    settings: Settings = ()
    restorer: str = ""  # what corrected the pictures first, weights included; empty for one-stage methods

    def word(self, name: str) -> str:
        """One of the settings; empty if it has none of this name."""
        return dict(self.settings).get(name, "")

    @property
    def step_ms(self) -> float | None:
        """Milliseconds of training a step."""
        return None if self.train_seconds is None else 1e3 * self.train_seconds / max(1, self.iterations)


@dataclass(frozen=True)
class Metric:
    """A measured column: attribute of ``Row``, decimals shown, +1 where more is better, -1 where less, 0 for costs."""

    key: str
    title: str
    decimals: int
    better: int


METRICS: tuple[Metric, ...] = (
    Metric("psnr", "PSNR ↑", 2, +1),
    Metric("ssim", "SSIM ↑", 3, +1),
    Metric("flip", "ꟻLIP ↓", 3, -1),
    Metric("lpips", "LPIPS ↓", 3, -1),
    Metric("joint_mm", "joints, mm ↓", 1, -1),
    Metric("sub_frame_joint_mm", "sub-frame joints, mm ↓", 1, -1),
    Metric("train_seconds", "training, s", 0, 0),
    Metric("gaussians", "Gaussians", 0, 0),
    Metric("iterations", "iterations", 0, 0),
)
COSTS: tuple[Metric, ...] = (
    Metric("train_seconds", "training, s ↓", 0, -1),
    Metric("step_ms", "a step, ms ↓", 1, -1),
    Metric("evaluate_seconds", "evaluation, s ↓", 0, -1),
    Metric("renders", "renders a step ↓", 2, -1),
    Metric("paper_renders", "the paper's way", 2, 0),
    Metric("gaussians", "Gaussians", 0, 0),
    Metric("iterations", "iterations", 0, 0),
    Metric("psnr", "PSNR ↑", 2, +1),
)
LABELS: dict[str, str] = {
    "gauhuman": "GauHuman",
    "cvr+gauhuman": "CVR + GauHuman",
    "jamnet+gauhuman": "JAMNet + GauHuman",
    "flow+gauhuman": "flow + GauHuman",
    "mad-avatar": "MAD-Avatar",
    "rs-avatar": "RS-Avatar (ours)",
    "oracle": "true motion (oracle)",
}
FLAGS: dict[str, str] = {  # what an ablation leaves out, in the paper's order
    "no_rs": "w/o RS model",
    "no_spline": "w/o B-spline",
    "no_pose_deformation": "w/o pose deformation",
    "no_lbs_refinement": "w/o LBS refinement",
    "no_reg": "w/o L_reg",
}
TOLD_THE_TRUTH = frozenset({"oracle"})  # never the best of a column
FIRST = ("ablation", "T", "preset", "motion", "K", "P", "lambda", "iterations")  # the words that tell jobs apart best


def distinguish(settings: Iterable[Settings]) -> dict[Settings, str]:
    """For each of several settings as few words as tell it from all others; none where there is only one."""
    known = {each: dict(each) for each in settings}
    names = {name for words in known.values() for name in words}
    chosen: list[str] = []
    kinds = 1
    for name in (*(n for n in FIRST if n in names), *sorted(names.difference(FIRST))):
        count = len({tuple(words.get(n, "") for n in (*chosen, name)) for words in known.values()})
        if count > kinds:
            kinds = count
            chosen.append(name)
    return {
        each: ", ".join(filter(None, (_word(n, words.get(n, "")) for n in chosen))) for each, words in known.items()
    }


def _word(name: str, value: str) -> str:
    if name == "ablation":
        return ", ".join(FLAGS.get(flag, flag) for flag in value.split("+") if flag)
    if name == "T" and value == "scanline":
        return value
    return f"{name}={value}" if value else ""
