"""Tables of one method against itself: components removed, row bands, ways to combine renderings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from rsavatar.report.cells import Line, cell_of, columns_of, lines_of, measured, words
from rsavatar.report.formats import Cell, Column, write
from rsavatar.report.paper import COLUMNS as PAPER_COLUMNS
from rsavatar.report.paper import paper_table
from rsavatar.report.rows import FLAGS, LABELS, METRICS, Metric, Row, Settings, distinguish
from rsavatar.report.stamp import Title, stamped

OURS = "rs-avatar"
VARIED = frozenset({"ablation", "T"})
COUNTS = (Column("subjects", "subjects"), Column("seeds", "seeds"))
OPERATORS = {
    "mad-avatar": "averaging",
    "rs-avatar": "selection",
    "oracle": "selection",
}  # others take frames as instants
INSTANT = "identity"
RENDERS = Metric("renders", "renders a step", 2, 0)


def rest_of(row: Row) -> Settings:
    """Settings other than those that the ablation varies."""
    return tuple((name, value) for name, value in row.settings if name not in VARIED)


def bands_of(row: Row) -> str:
    """T as it was asked for; K where nothing was."""
    return row.word("T") or "K"


def usual_bands(rows: Iterable[Row]) -> str:
    """T of the rows in which a component is removed, for the full model has the same; K where there are none."""
    counts = Counter(bands_of(row) for row in rows if row.word("ablation"))
    return min(counts, key=lambda bands: (-counts[bands], bands)) if counts else "K"


def variant_of(row: Row, usual: str) -> str:
    """What a row varies: flags joined by ``+``, ``full``, ``scanline``, or ``T=...``."""
    bands = bands_of(row)
    other = "" if bands == usual else bands if bands == "scanline" else f"T={bands}"
    return "+".join(filter(None, (row.word("ablation"), other))) or "full"


def render_ablation(rows: Iterable[Row], fmt: str) -> str:
    """One line per component removed and per number of bands, the full model first, beside the paper's figures.

    Raises:
        SpecError: if the format is unknown.
    """
    own = [row for row in rows if row.method == OURS]
    usual = usual_bands(own)
    lines = sorted(
        lines_of(own, lambda row: (variant_of(row, usual), rest_of(row))),
        key=lambda line: (rest_of(line.rows[0]), _place(variant_of(line.rows[0], usual))),
    )
    everyone = frozenset(row.subject for row in own)
    complete = [line.subjects == everyone for line in lines]
    cells = measured(lines, METRICS, complete)
    apart = distinguish(sorted({rest_of(line.rows[0]) for line in lines}))
    body = []
    for line, own_cells in zip(lines, cells, strict=True):
        variant, rest = variant_of(line.rows[0], usual), rest_of(line.rows[0])
        label = ", ".join(filter(None, (_label(variant, usual), apart[rest])))
        label += "" if line.subjects == everyone else " †"
        counts = (cell_of(len(line.subjects), 0), cell_of(line.seeds, 0))
        change = _change(line, lines, cells, usual)
        body.append((words(label, variant), *own_cells, change, *counts, *paper_table("ablation").cells(variant)))
    change_column = Column("delta_psnr", "PSNR - full")
    columns = (Column("variant", "variant", words=True), *columns_of(METRICS), change_column, *COUNTS, *PAPER_COLUMNS)
    notes = [f"All rows are {LABELS[OURS]}; the full model has T = {usual}.", paper_table("ablation").note()]
    notes += [] if all(complete) else [f"† Not all of the {len(everyone)} subjects."]
    return write(stamped(Title("ablation", "Ablations."), columns, body, lines, notes if body else []), fmt)


def _place(variant: str) -> tuple[object, ...]:
    """The paper's order: full, one component after the other, several, then bands from few to many."""
    if variant in ("full", *FLAGS):
        return 0, ("full", *FLAGS).index(variant), ""
    return (1, 0, variant) if variant.startswith("no_") else (2, *bands_place(variant.removeprefix("T=")))


def bands_place(bands: str) -> tuple[float, str]:
    """Numbers first, then multiples of K, then scanline."""
    if bands.isdecimal():
        return float(bands), bands
    multiple = bands.removesuffix("K")
    return (1e6 * (float(multiple) if multiple.isdecimal() else 1.0), bands) if bands != "scanline" else (1e12, bands)


def _label(variant: str, usual: str) -> str:
    if variant == "full":
        return f"full model (T = {usual})"
    return ", ".join(FLAGS.get(part, part) for part in variant.split("+"))


def _change(line: Line, lines: Sequence[Line], cells: Sequence[Sequence[Cell]], usual: str) -> Cell:
    """PSNR against the full model with the same other settings on the same subjects."""
    own = next(row[0].value for other, row in zip(lines, cells, strict=True) if other is line)
    for other, row in zip(lines, cells, strict=True):
        is_full = variant_of(other.rows[0], usual) == "full" and rest_of(other.rows[0]) == rest_of(line.rows[0])
        full = row[0].value
        if (
            is_full
            and other is not line
            and other.subjects == line.subjects
            and isinstance(own, float)
            and isinstance(full, float)
        ):
            return cell_of(own - full, 2, sign="+")
    return cell_of(None, 2)


def render_shutter(rows: Iterable[Row], fmt: str) -> str:
    """One line per way to combine sub-frame renderings and number of them: identity, averaging, selection by row.

    Raises:
        SpecError: if the format is unknown.
    """
    whole = [row for row in rows if row.word("ablation") in ("", "no_rs")]
    lines = sorted(
        lines_of(whole, lambda row: (operator_of(row), row.method, shown_bands(row), rest_of(row))),
        key=lambda line: (_operator_place(line.rows[0]), bands_place(shown_bands(line.rows[0]))),
    )
    everyone = frozenset(row.subject for row in whole)
    metrics = (*METRICS[:6], RENDERS, *METRICS[6:])
    cells = measured(lines, metrics, [line.subjects == everyone for line in lines])
    apart = {
        method: distinguish(sorted({rest_of(line.rows[0]) for line in lines if line.method == method}))
        for method in {line.method for line in lines}
    }
    body = []
    for line, own in zip(lines, cells, strict=True):
        row = line.rows[0]
        name = ", ".join(filter(None, (_method(row), apart[line.method][rest_of(row)])))
        name += "" if line.subjects == everyone else " †"
        operator, bands = operator_of(row), shown_bands(row)
        key = f"T={bands}" if bands != "K" else "full"
        paper = paper_table("ablation").cells(key if line.method == OURS and operator == "selection" else "")
        counts = (cell_of(len(line.subjects), 0), cell_of(line.seeds, 0))
        body.append((words(operator), words(bands), words(name, line.method), *own, *counts, *paper))
    names = (
        Column("operator", "operator", words=True),
        Column("T", "T", words=True),
        Column("method", "method", words=True),
    )
    columns = (*names, *columns_of(metrics), *COUNTS, *PAPER_COLUMNS)
    notes = [paper_table("ablation").note()] if body else []
    notes += [f"† Not all of the {len(everyone)} subjects."] if any(line.subjects != everyone for line in lines) else []
    return write(stamped(Title("shutter", "Shutter operators and row bands."), columns, body, lines, notes), fmt)


def operator_of(row: Row) -> str:
    """How a method combines what it renders within a frame (paper, table "Shutter regimes")."""
    return INSTANT if row.word("ablation") == "no_rs" else OPERATORS.get(row.method, INSTANT)


def shown_bands(row: Row) -> str:
    """How many renderings are combined; one where frames are instants."""
    return "1" if operator_of(row) == INSTANT else bands_of(row)


def _operator_place(row: Row) -> tuple[object, ...]:
    order = (INSTANT, "averaging", "selection")
    methods = list(LABELS)
    rank = methods.index(row.method) if row.method in methods else len(methods)
    return order.index(operator_of(row)), rank, row.method, row.word("ablation")


def _method(row: Row) -> str:
    return ", ".join(filter(None, (LABELS.get(row.method, row.method), FLAGS.get(row.word("ablation"), ""))))
