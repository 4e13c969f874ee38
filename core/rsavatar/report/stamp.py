"""What stands below a table: notes that qualify its numbers, and the jobs, code, data and protocol they come from."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from rsavatar.report.cells import Line
from rsavatar.report.formats import Cell, Column, Table
from rsavatar.report.rows import LABELS, Row

OF_THE_SUBJECT = frozenset({"cameras", "frames"})  # words of a protocol that differ between subjects by nature

Stamp = tuple[tuple[str, tuple[str, ...]], ...]


class Title(NamedTuple):
    """Name for programs and sentence for people."""

    name: str
    sentence: str


def stamped(
    title: Title,
    columns: tuple[Column, ...],
    body: Sequence[tuple[Cell, ...]],
    lines: Iterable[Line],
    notes: Sequence[str],
) -> Table:
    """The table of ``body`` with its own notes, those that its rows call for, and their provenance."""
    rows = [row for line in lines for row in line.rows]
    return Table(title.name, columns, tuple(body), (*notes, *notes_on(rows, body)), stamp_of(rows), title.sentence)


def notes_on(rows: Sequence[Row], lines: Iterable[Sequence[Cell]]) -> list[str]:
    """What a reader must know before comparing numbers of these jobs."""
    if not rows:
        return ["No finished jobs."]
    absent = sum(row.lpips is None for row in rows)
    budgets = sorted({row.iterations for row in rows})
    notes = [f"LPIPS: weights absent in {absent} of {len(rows)} jobs."] if absent else []
    if len(budgets) > 1:
        notes.append(f"Iterations differ between jobs: {', '.join(map(str, budgets))}.")
    if len({protocol_of(row) for row in rows}) > 1:
        notes.append("Metric protocols differ between jobs; see the provenance.")
    for method, restorer in sorted({(row.method, row.restorer) for row in rows if row.restorer}):
        notes.append(f"{LABELS.get(method, method)}: pictures corrected by {restorer}.")
    if any(cell.std is not None for line in lines for cell in line):
        notes.append("± is the sample standard deviation over seeds.")
    return notes


def protocol_of(row: Row) -> str:
    """A row's protocol for readers; one in JSON without what is a subject's own, so that equal protocols are equal."""
    try:
        stated = json.loads(row.protocol)
    except ValueError:
        stated = None
    if not isinstance(stated, dict):
        return row.protocol
    return "; ".join(f"{key} {value}" for key, value in sorted(stated.items()) if key not in OF_THE_SUBJECT)


def stamp_of(rows: Iterable[Row]) -> Stamp:
    """Jobs, commits, data and protocols, each once."""
    rows = list(rows)
    parts = {
        "jobs": {row.job_id for row in rows},
        "commits": {row.commit for row in rows},
        "data": {f"{row.subject} sha256 {row.data_sha256[:12]}" for row in rows},
        "protocol": {protocol_of(row) for row in rows},
    }
    return tuple((name, tuple(sorted(values))) for name, values in parts.items() if values)
