"""The words that figures are made of, and how runs are chosen, grouped and averaged. Torch-free."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from statistics import fmean, stdev
from typing import Any

from rsavatar.report.tables import LABELS

OURS = "rs-avatar"
PRESETS = ("paper", "draft", "smoke")  # the one with the most careful runs first
GRID = 60  # steps at which mean curves are drawn


@dataclass(frozen=True)
class Run:
    """A finished job. ``means`` are over frames, then cameras; ``curves`` are (step, value) pairs by key."""

    job_id: str
    method: str
    subject: str
    seed: int
    preset: str
    bands: str  # T: a number, K, or scanline
    motion: str  # its model: per-frame splines, one spline, ...
    ablation: tuple[str, ...]
    is_standard: bool  # its spec is what the preset says for this method, subject and seed
    iterations: int
    train_seconds: float
    gaussians: int
    commit: str
    data_sha256: str
    means: Mapping[str, float | None]
    curves: Mapping[str, Sequence[tuple[int, float]]] = field(default_factory=dict)
    scores: Mapping[tuple[str, int], float] = field(default_factory=dict)  # PSNR of (camera, frame)


@dataclass(frozen=True)
class Wish:
    """What may be chosen; None is for the figure to decide."""

    preset: str | None = None
    subject: str | None = None
    camera: str | None = None
    frame: int | None = None


@dataclass(frozen=True)
class Figure:
    """``data`` is what is drawn, ``pictures`` what must be rendered for it; ``lacking`` says what is missing for it."""

    name: str
    title: str
    caption: str = ""
    data: Mapping[str, Any] = field(default_factory=dict)
    pictures: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Sequence[str]] = field(default_factory=dict)
    lacking: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return asdict(self)

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> Figure:
        """The inverse of ``to_json``."""
        return cls(**value)


def of_preset(runs: Sequence[Run], preset: str | None) -> list[Run]:
    """Runs of one preset: the one asked for, else the one that most methods and subjects were run with."""
    if preset is None:
        rank = {name: -i for i, name in enumerate(PRESETS)}
        extent = {p: len({(r.method, r.subject) for r in runs if r.preset == p}) for p in {r.preset for r in runs}}
        preset = max(extent, key=lambda p: (extent[p], rank.get(p, -9)), default=None)
    return [run for run in runs if run.preset == preset]


def standard(runs: Sequence[Run]) -> list[Run]:
    """One run for each method, subject and seed: the standard one, else the newest whose method is whole."""
    best: dict[tuple[str, str, int], Run] = {}
    for run in runs:
        key = (run.method, run.subject, run.seed)
        rival = best.get(key)
        if not run.ablation and (rival is None or (run.is_standard, run.job_id) > (rival.is_standard, rival.job_id)):
            best[key] = run
    return list(best.values())


def in_order(runs: Sequence[Run]) -> list[Run]:
    """Runs by method in the paper's order, then subject, seed and id."""
    rank = {method: i for i, method in enumerate(LABELS)}
    return sorted(runs, key=lambda r: (rank.get(r.method, 99), r.method, r.subject, r.seed, r.job_id))


def mean_curve(lines: Sequence[Sequence[tuple[int, float]]]) -> dict[str, list[float]]:
    """Mean, least and greatest of curves at common steps, each interpolated linearly between its own."""
    first, last = max(line[0][0] for line in lines), min(line[-1][0] for line in lines)
    steps = [first + (last - first) * i / (GRID - 1) for i in range(GRID)]
    values = [[interpolate(line, step) for line in lines] for step in steps]
    return {
        "steps": steps,
        "mean": [fmean(v) for v in values],
        "low": list(map(min, values)),
        "high": list(map(max, values)),
    }


def interpolate(line: Sequence[tuple[int, float]], step: float) -> float:
    """Value of a curve between its points; beyond them, that of the nearest."""
    before = [p for p in line if p[0] <= step]
    after = [p for p in line if p[0] >= step]
    if not before or not after:
        return (after or before)[0 if after else -1][1]
    (x0, y0), (x1, y1) = before[-1], after[0]
    return y0 if x1 == x0 else y0 + (y1 - y0) * (step - x0) / (x1 - x0)


def by_method(runs: Sequence[Run]) -> list[list[Run]]:
    """Runs of one method together, in the order they came in."""
    return groups(runs, lambda run: (run.method,))


def groups(runs: Sequence[Run], key: Callable[[Run], tuple[str, ...]]) -> list[list[Run]]:
    """Runs with equal keys together, in the order they came in."""
    found: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        found.setdefault(key(run), []).append(run)
    return list(found.values())


def summary(group: Sequence[Run]) -> dict[str, Any]:
    """Means over seeds, then subjects, and the deviation over the seeds that ran on all subjects."""
    subjects = sorted({run.subject for run in group})
    found: dict[str, Any] = {"method": group[0].method, "runs": len(group), "count": len(subjects)}
    for key in ("psnr", "sub_frame_joint_mm"):
        values = [v for s in subjects if (v := mean_of(group, s, key)) is not None]
        found[key] = fmean(values) if values else None
        found[f"{key}_std"] = deviation(group, subjects, key)
    return found


def mean_of(runs: Sequence[Run], subject: str, key: str) -> float | None:
    """Mean over the runs on a subject; None where none has the metric."""
    values = [v for run in runs if run.subject == subject and (v := run.means.get(key)) is not None]
    return fmean(values) if values else None


def deviation(group: Sequence[Run], subjects: Sequence[str], key: str) -> float | None:
    """Sample standard deviation of the mean over ``subjects``, over the seeds that have them all."""
    seeds: dict[int, dict[str, float]] = {}
    for run in group:
        value = run.means.get(key)
        if value is not None:
            seeds.setdefault(run.seed, {})[run.subject] = value
    whole = [fmean(values.values()) for values in seeds.values() if len(values) == len(subjects)]
    return stdev(whole) if len(whole) > 1 else None


def stamp(runs: Sequence[Run]) -> dict[str, list[str]]:
    """What a figure comes from: jobs, commits, data."""
    parts = {
        "jobs": {run.job_id for run in runs},
        "commits": {run.commit for run in runs},
        "data": {f"{run.subject} sha256 {run.data_sha256[:12]}" for run in runs},
        "preset": {run.preset for run in runs},
    }
    return {name: sorted(values) for name, values in parts.items() if values}
