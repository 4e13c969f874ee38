"""Result tables: ``main`` (one line per method) and ``per-subject`` (one line per subject and method)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from rsavatar.errors import SpecError, expected
from rsavatar.report.formats import NOTHING, Cell, Column, Table, write


@dataclass(frozen=True)
class Row:
    """What one finished job adds to a table. Metrics are means over frames, then cameras; None is "not computed"."""

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


# Paper, table "Novel-view synthesis": K = 11, 18 held-out cameras, mean over six subjects of ZJU-MoCap.
PAPER_MAIN: dict[str, dict[str, float]] = {
    "gauhuman": {"psnr": 23.69, "ssim": 0.803, "lpips": 0.153},
    "cvr+gauhuman": {"psnr": 23.99, "ssim": 0.809, "lpips": 0.153},
    "jamnet+gauhuman": {"psnr": 23.96, "ssim": 0.808, "lpips": 0.155},
    "mad-avatar": {"psnr": 22.99, "ssim": 0.789, "lpips": 0.170},
    "rs-avatar": {"psnr": 24.68, "ssim": 0.819, "lpips": 0.138},
}

LABELS: dict[str, str] = {
    "gauhuman": "GauHuman",
    "cvr+gauhuman": "CVR + GauHuman",
    "jamnet+gauhuman": "JAMNet + GauHuman",
    "mad-avatar": "MAD-Avatar",
    "rs-avatar": "RS-Avatar (ours)",
    "flow+gauhuman": "flow + GauHuman",
    "oracle": "true motion (oracle)",
}
OF_THE_SUBJECT = frozenset({"cameras", "frames"})  # words of a protocol that differ between subjects by nature
TOLD_THE_TRUTH = frozenset({"oracle"})  # never the best of a column


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
PAPER_COLUMNS = (Column("psnr", "paper: PSNR"), Column("ssim", "paper: SSIM"), Column("lpips", "paper: LPIPS"))


def render(name: str, rows: Iterable[Row], fmt: str) -> str:
    """The table ``name`` of ``TABLES`` in json, csv, md or tex.

    Raises:
        SpecError: if the table or the format is unknown.
    """
    if name not in TABLES:
        raise SpecError(expected("table", f"one of {', '.join(TABLES)}", repr(name)))
    return TABLES[name](rows, fmt)


def render_main(rows: Iterable[Row], fmt: str) -> str:
    """One line per method, the mean over seeds, then over subjects, beside the paper's figures, in the paper's order.

    A deviation is the sample standard deviation, over the seeds that ran on all subjects of a method, of the mean over
    subjects. A method that lacks subjects of the others is marked, and is not a candidate for the best of a column.

    Raises:
        SpecError: if the format is unknown.
    """
    groups = _groups(rows, lambda row: (row.method,))
    everyone = {row.subject for group in groups for row in group}
    complete = [{row.subject for row in group} == everyone for group in groups]
    measured = _measured(groups, complete)
    lines, notes = [], []
    for group, whole, cells in zip(groups, complete, measured, strict=True):
        subjects, method = sorted({row.subject for row in group}), group[0].method
        label = LABELS.get(method, method) + ("" if whole else " †")
        paper = [_cell(PAPER_MAIN.get(method, {}).get(c.key), 2 if c.key == "psnr" else 3) for c in PAPER_COLUMNS]
        counts = [_cell(len(subjects), 0), _cell(len({row.seed for row in group}), 0)]
        lines.append((Cell(label, method), *cells, *counts, *paper))
        if not whole:
            lacking = ", ".join(sorted(everyone.difference(subjects)))
            notes.append(f"† {label[:-2]}: mean over {len(subjects)} of {len(everyone)} subjects, without {lacking}.")
    columns = (
        Column("method", "method", words=True),
        *_columns(),
        Column("subjects", "subjects"),
        Column("seeds", "seeds"),
    )
    paper_columns = (Column(f"paper_{c.key}", c.title) for c in PAPER_COLUMNS)
    if lines:
        notes.append(
            "The paper's figures are of other data (six ZJU-MoCap subjects, K = 11): compare differences only."
        )
    return write(_table("main", (*columns, *paper_columns), lines, notes, groups), fmt)


def render_per_subject(rows: Iterable[Row], fmt: str) -> str:
    """One line per subject and method, the mean over seeds; the best of a column is of one subject.

    Raises:
        SpecError: if the format is unknown.
    """
    groups = _groups(rows, lambda row: (row.subject, row.method))
    lines = []
    for subject in dict.fromkeys(group[0].subject for group in groups):
        own = [group for group in groups if group[0].subject == subject]
        for group, cells in zip(own, _measured(own, [True] * len(own)), strict=True):
            method = group[0].method
            seeds = _cell(len({row.seed for row in group}), 0)
            lines.append((Cell(subject, subject), Cell(LABELS.get(method, method), method), *cells, seeds))
    columns = (
        Column("subject", "subject", words=True),
        Column("method", "method", words=True),
        *_columns(),
        Column("seeds", "seeds"),
    )
    return write(_table("per-subject", columns, lines, [], groups), fmt)


TABLES: dict[str, Callable[[Iterable[Row], str], str]] = {"main": render_main, "per-subject": render_per_subject}


def _groups(rows: Iterable[Row], key: Callable[[Row], tuple[str, ...]]) -> list[list[Row]]:
    """Rows with equal keys together, methods in the paper's order, whatever order they came in."""
    rank = {method: i for i, method in enumerate(LABELS)}

    def place(row: Row) -> tuple[object, ...]:
        return tuple((rank.get(k, len(rank)), k) for k in key(row))

    ordered = sorted(rows, key=lambda r: (place(r), r.subject, r.seed, r.job_id, repr(r)))
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in ordered:
        groups.setdefault(key(row), []).append(row)
    return list(groups.values())


def _measured(groups: Sequence[list[Row]], candidates: Sequence[bool]) -> list[list[Cell]]:
    """Cells of every group for every metric, the best of each column found among ``candidates``."""
    columns = []
    for metric in METRICS:
        cells = [_mean_cell(group, metric) for group in groups]
        shown = [
            round(float(cell.value), metric.decimals) if fit and isinstance(cell.value, int | float) else None
            for cell, fit in zip(cells, _fit(groups, candidates), strict=True)
        ]
        rivals = [metric.better * value for value in shown if value is not None]
        best = max(rivals) if metric.better and len(rivals) > 1 else None
        columns.append(
            [
                dataclasses.replace(cell, best=best is not None and value is not None and metric.better * value == best)
                for cell, value in zip(cells, shown, strict=True)
            ]
        )
    return [list(cells) for cells in zip(*columns, strict=True)]


def _fit(groups: Sequence[list[Row]], candidates: Sequence[bool]) -> list[bool]:
    return [c and g[0].method not in TOLD_THE_TRUTH for g, c in zip(groups, candidates, strict=True)]


def _mean_cell(group: list[Row], metric: Metric) -> Cell:
    """Mean over seeds, then subjects. One missing number leaves no mean: it would be of fewer subjects than it says."""
    values: dict[str, dict[int, list[float]]] = {}  # subject -> seed -> values
    for row in group:
        value = getattr(row, metric.key)
        if value is None:
            return Cell("weights absent" if metric.key == "lpips" else NOTHING)
        values.setdefault(row.subject, {}).setdefault(row.seed, []).append(float(value))
    by_seed = {subject: {seed: fmean(v) for seed, v in seeds.items()} for subject, seeds in values.items()}
    common = set.intersection(*(set(seeds) for seeds in by_seed.values()))
    means = [fmean(seeds[seed] for seeds in by_seed.values()) for seed in sorted(common)]
    spread = stdev(means) if len(means) > 1 and metric.better else None
    return _cell(fmean(fmean(seeds.values()) for seeds in by_seed.values()), metric.decimals, spread)


def _cell(value: float | None, decimals: int, std: float | None = None) -> Cell:
    if value is None:
        return Cell(NOTHING)
    value = int(value) if decimals == 0 and float(value).is_integer() else value
    return Cell(f"{value:.{decimals}f}" + ("" if std is None else f" ± {std:.{decimals}f}"), value, std)


def _columns() -> tuple[Column, ...]:
    return tuple(Column(metric.key, metric.title) for metric in METRICS)


def _table(
    name: str, columns: tuple[Column, ...], lines: list[tuple[Cell, ...]], notes: list[str], groups: list[list[Row]]
) -> Table:
    rows = [row for group in groups for row in group]
    return Table(name, columns, tuple(lines), (*notes, *_notes(rows, lines)), _stamp(rows))


def _notes(rows: list[Row], lines: list[tuple[Cell, ...]]) -> list[str]:
    """What a reader must know before comparing numbers of these jobs."""
    if not rows:
        return ["No finished jobs."]
    absent = sum(row.lpips is None for row in rows)
    budgets = sorted({row.iterations for row in rows})
    notes = [f"LPIPS: weights absent in {absent} of {len(rows)} jobs."] if absent else []
    if len(budgets) > 1:
        notes.append(f"Iterations differ between jobs: {', '.join(map(str, budgets))}.")
    if len({_protocol(row) for row in rows}) > 1:
        notes.append("Metric protocols differ between jobs; see the provenance.")
    if any(cell.std is not None for line in lines for cell in line):
        notes.append("± is the sample standard deviation over seeds.")
    return notes


def _protocol(row: Row) -> str:
    """A row's protocol for readers; one in JSON without what is a subject's own, so that equal protocols are equal."""
    try:
        stated = json.loads(row.protocol)
    except ValueError:
        stated = None
    if not isinstance(stated, dict):
        return row.protocol
    return "; ".join(f"{key} {value}" for key, value in sorted(stated.items()) if key not in OF_THE_SUBJECT)


def _stamp(rows: list[Row]) -> tuple[tuple[str, tuple[str, ...]], ...]:
    parts = {
        "jobs": {row.job_id for row in rows},
        "commits": {row.commit for row in rows},
        "data": {f"{row.subject} sha256 {row.data_sha256[:12]}" for row in rows},
        "protocol": {_protocol(row) for row in rows},
    }
    return tuple((name, tuple(sorted(values))) for name, values in parts.items() if values)
