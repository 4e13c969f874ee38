"""Result tables by name: a table is a function of rows, and equal rows give equal bytes.

``main`` has one line per method, ``per-subject`` one per subject and method, ``ablation`` one per component removed,
``shutter`` one per way to combine renderings and number of them, ``cost`` what each method takes. Where a method ran
with several settings each has its line, named by the words that differ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from rsavatar.errors import SpecError, expected
from rsavatar.report.cells import Line, cell_of, columns_of, lines_of, measured, words
from rsavatar.report.formats import Cell, Column, write
from rsavatar.report.paper import COLUMNS as PAPER_COLUMNS
from rsavatar.report.paper import paper_table
from rsavatar.report.rows import COSTS, LABELS, METRICS, TOLD_THE_TRUTH, Metric, Row, distinguish
from rsavatar.report.stamp import Title, stamped
from rsavatar.report.variants import render_ablation, render_shutter

__all__ = ["LABELS", "METRICS", "PAPER_MAIN", "TABLES", "TOLD_THE_TRUTH", "Metric", "Row", "render"]

PAPER_MAIN = paper_table("main").rows
PSNR = METRICS[0]
COUNTS = (Column("subjects", "subjects"), Column("seeds", "seeds"))
METHOD = Column("method", "method", words=True)
GAP = Column("gap", "recovered gap")
GAP_NOTE = "Recovered gap: (PSNR - GauHuman) / (oracle - GauHuman), on equal subjects."


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
    lines = lines_of(rows, lambda row: (row.method, row.settings))
    cells, notes = _with_method(lines, METRICS)
    body = [
        (*own, gap, cell_of(len(line.subjects), 0), cell_of(line.seeds, 0), *paper_table("main").cells(line.method))
        for line, own, gap in zip(lines, cells, gaps(lines), strict=True)
    ]
    if any(line[-6].value is not None for line in body):
        notes.append(GAP_NOTE)
    if body:
        notes.append(paper_table("main").note())
    columns = (METHOD, *columns_of(METRICS), GAP, *COUNTS, *PAPER_COLUMNS)
    return write(stamped(Title("main", "Novel-view synthesis."), columns, body, lines, notes), fmt)


def render_per_subject(rows: Iterable[Row], fmt: str) -> str:
    """One line per subject and method, the mean over seeds; the best of a column is of one subject.

    Raises:
        SpecError: if the format is unknown.
    """
    rows = list(rows)
    every, body = [], []
    for subject in sorted({row.subject for row in rows}):
        lines = lines_of((row for row in rows if row.subject == subject), lambda row: (row.method, row.settings))
        cells, _ = _with_method(lines, METRICS)
        for line, own, gap in zip(lines, cells, gaps(lines), strict=True):
            body.append((words(subject), *own, gap, cell_of(line.seeds, 0)))
        every += lines
    columns = (Column("subject", "subject", words=True), METHOD, *columns_of(METRICS), GAP, COUNTS[1])
    notes = [GAP_NOTE] if any(line[-2].value is not None for line in body) else []
    return write(stamped(Title("per-subject", "Results by subject."), columns, body, every, notes), fmt)


def render_cost(rows: Iterable[Row], fmt: str) -> str:
    """What every method takes: seconds, renders a step, Gaussians; beside the renders of the paper's way.

    Raises:
        SpecError: if the format is unknown.
    """
    lines = lines_of(rows, lambda row: (row.method, row.settings))
    cells, notes = _with_method(lines, COSTS)
    body = [
        (*own, cell_of(len(line.subjects), 0), cell_of(line.seeds, 0)) for line, own in zip(lines, cells, strict=True)
    ]
    if body:
        notes.append("Renders a step: passes over the rows that hold the body; the paper's way renders T whole frames.")
        notes.append("Seconds are of the machines that ran the jobs, whatever else they did.")
    columns = (METHOD, *columns_of(COSTS), *COUNTS)
    return write(stamped(Title("cost", "Cost."), columns, body, lines, notes), fmt)


TABLES: dict[str, Callable[[Iterable[Row], str], str]] = {
    "main": render_main,
    "ablation": render_ablation,
    "per-subject": render_per_subject,
    "shutter": render_shutter,
    "cost": render_cost,
}


def _with_method(lines: Sequence[Line], metrics: Sequence[Metric]) -> tuple[list[tuple[Cell, ...]], list[str]]:
    """Method and metrics of every line, and notes on those that lack subjects."""
    everyone = frozenset(subject for line in lines for subject in line.subjects)
    complete = [line.subjects == everyone for line in lines]
    names = _names(lines)
    cells: list[tuple[Cell, ...]] = []
    lack: dict[str, list[str]] = {}
    for line, name, whole, own in zip(lines, names, complete, measured(lines, metrics, complete), strict=True):
        cells.append((words(name + ("" if whole else " †"), line.method), *own))
        if not whole:
            lacking = ", ".join(sorted(everyone - line.subjects))
            mean = f"mean over {len(line.subjects)} of {len(everyone)} subjects"
            lack.setdefault(f"{mean}, without {lacking}.", []).append(name)
    return cells, [f"† {'; '.join(names)}: {said}" for said, names in lack.items()]


def _names(lines: Sequence[Line]) -> list[str]:
    """Methods as people call them, with what tells their settings apart."""
    by_method: dict[str, set[tuple[tuple[str, str], ...]]] = {}
    for line in lines:
        by_method.setdefault(line.method, set()).add(line.rows[0].settings)
    differing = {method: distinguish(sorted(settings)) for method, settings in by_method.items()}
    names = []
    for line in lines:
        apart = differing[line.method][line.rows[0].settings]
        names.append(LABELS.get(line.method, line.method) + (f", {apart}" if apart else ""))
    return names


def gaps(lines: Sequence[Line]) -> list[Cell]:
    """How much of the way from the shutter-oblivious baseline to the true motion each line goes, in PSNR.

    Only where one line of each of the two has the preset and the subjects of the line.
    """
    means = [measured([line], [PSNR], [True])[0][0].value for line in lines]
    found = []
    for line, own in zip(lines, means, strict=True):
        rivals = [
            [
                value
                for other, value in zip(lines, means, strict=True)
                if isinstance(value, float) and _is_rival(line, other, method)
            ]
            for method in ("gauhuman", "oracle")
        ]
        if not isinstance(own, float) or any(len(values) != 1 for values in rivals) or rivals[0][0] >= rivals[1][0]:
            found.append(cell_of(None, 2))
        else:
            found.append(cell_of((own - rivals[0][0]) / (rivals[1][0] - rivals[0][0]), 2))
    return found


def _is_rival(line: Line, other: Line, method: str) -> bool:
    same = other.subjects == line.subjects and other.rows[0].preset == line.rows[0].preset
    return same and other.method == method
