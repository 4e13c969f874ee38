"""From rows to cells: jobs with something in common in one line, means and deviations, the best of a column."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from rsavatar.report.formats import NOTHING, Cell, Column
from rsavatar.report.rows import LABELS, TOLD_THE_TRUTH, Metric, Row

RANK = {method: place for place, method in enumerate(LABELS)}


@dataclass(frozen=True)
class Line:
    """Jobs of one line: the same method with the same settings."""

    rows: tuple[Row, ...]

    @property
    def method(self) -> str:
        """Of all rows."""
        return self.rows[0].method

    @property
    def subjects(self) -> frozenset[str]:
        """That it is a mean over."""
        return frozenset(row.subject for row in self.rows)

    @property
    def seeds(self) -> int:
        """How many seeds ran."""
        return len({row.seed for row in self.rows})


def lines_of(rows: Iterable[Row], key: Callable[[Row], Hashable]) -> list[Line]:
    """Rows with equal keys together, methods in the paper's order, whatever order they came in."""
    groups: dict[Hashable, list[Row]] = {}
    for row in sorted(rows, key=place_of):
        groups.setdefault(key(row), []).append(row)
    return [Line(tuple(group)) for group in groups.values()]


def place_of(row: Row) -> tuple[object, ...]:
    """Where a row stands among all."""
    own = (RANK.get(row.method, len(RANK)), row.method)
    return *own, row.settings, row.subject, row.seed, row.job_id, repr(row)


def measured(lines: Sequence[Line], metrics: Sequence[Metric], candidates: Sequence[bool]) -> list[list[Cell]]:
    """Cells of every line for every metric, the best of each column found among ``candidates``."""
    fit = [c and line.method not in TOLD_THE_TRUTH for line, c in zip(lines, candidates, strict=True)]
    columns = [_marked([mean_cell(line, metric) for line in lines], metric, fit) for metric in metrics]
    return [list(cells) for cells in zip(*columns, strict=True)]


def _marked(cells: Sequence[Cell], metric: Metric, fit: Sequence[bool]) -> list[Cell]:
    """Equal as shown is equally best; alone, nobody is."""
    shown = [
        round(float(cell.value), metric.decimals) if is_fit and isinstance(cell.value, int | float) else None
        for cell, is_fit in zip(cells, fit, strict=True)
    ]
    rivals = [metric.better * value for value in shown if value is not None]
    best = max(rivals) if metric.better and len(rivals) > 1 else None
    return [
        dataclasses.replace(cell, best=best is not None and value is not None and metric.better * value == best)
        for cell, value in zip(cells, shown, strict=True)
    ]


def mean_cell(line: Line, metric: Metric) -> Cell:
    """Mean over seeds, then subjects. One missing number leaves no mean: it would be of fewer subjects than it says."""
    values: dict[str, dict[int, list[float]]] = {}  # subject -> seed -> values
    for row in line.rows:
        value = getattr(row, metric.key)
        if value is None:
            return Cell("weights absent" if metric.key == "lpips" else NOTHING)
        values.setdefault(row.subject, {}).setdefault(row.seed, []).append(float(value))
    by_seed = {subject: {seed: fmean(v) for seed, v in seeds.items()} for subject, seeds in values.items()}
    common = set.intersection(*(set(seeds) for seeds in by_seed.values()))
    means = [fmean(seeds[seed] for seeds in by_seed.values()) for seed in sorted(common)]
    spread = stdev(means) if len(means) > 1 and metric.better else None
    return cell_of(fmean(fmean(seeds.values()) for seeds in by_seed.values()), metric.decimals, spread)


def cell_of(value: float | None, decimals: int, std: float | None = None, sign: str = "") -> Cell:
    """A number as a cell; None is a dash."""
    if value is None:
        return Cell(NOTHING)
    value = int(value) if decimals == 0 and float(value).is_integer() else value
    return Cell(f"{value:{sign}.{decimals}f}" + ("" if std is None else f" ± {std:.{decimals}f}"), value, std)


def columns_of(metrics: Iterable[Metric]) -> tuple[Column, ...]:
    """The columns of metrics."""
    return tuple(Column(metric.key, metric.title) for metric in metrics)


def words(text: str, value: str | None = None) -> Cell:
    """A cell of text; for programs its ``value``."""
    return Cell(text, text if value is None else value)
