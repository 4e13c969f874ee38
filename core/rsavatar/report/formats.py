"""A finished table as text. Numbers are decided before; here is only layout and escaping."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from dataclasses import dataclass

from rsavatar.errors import SpecError, expected


@dataclass(frozen=True)
class Column:
    """``key`` names it for programs, ``title`` for people; ``words`` are set to the left, numbers to the right."""

    key: str
    title: str
    words: bool = False


@dataclass(frozen=True)
class Cell:
    """``value`` (and ``std``) at full precision for programs, ``text`` rounded for people; ``best`` of its column."""

    text: str
    value: str | float | int | None = None
    std: float | None = None
    best: bool = False


@dataclass(frozen=True)
class Table:
    """``notes`` qualify the numbers for readers; ``stamp`` says which jobs, code and data they come from."""

    name: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...]
    stamp: tuple[tuple[str, tuple[str, ...]], ...]
    title: str = ""


def write(table: Table, fmt: str) -> str:
    """The table in one of ``FORMATS``.

    Raises:
        SpecError: if the format is unknown.
    """
    if fmt not in FORMATS:
        raise SpecError(expected("format", f"one of {', '.join(FORMATS)}", repr(fmt)))
    return FORMATS[fmt](table)


def _json(table: Table) -> str:
    rows = []
    for cells in table.rows:
        row: dict[str, object] = {"best": [c.key for c, cell in zip(table.columns, cells, strict=True) if cell.best]}
        for column, cell in zip(table.columns, cells, strict=True):
            row[column.key] = cell.value
            if cell.std is not None:
                row[f"{column.key}_std"] = cell.std
        rows.append(row)
    columns = [{"key": c.key, "title": c.title} for c in table.columns]
    whole = {
        "table": table.name,
        "title": table.title,
        "columns": columns,
        "rows": rows,
        "notes": table.notes,
        "provenance": dict(table.stamp),
    }
    return json.dumps(whole, indent=2, ensure_ascii=False, sort_keys=True) + "\n"


def _csv(table: Table) -> str:
    """Values at full precision, a ``_std`` column where a deviation exists; notes and stamp as ``#`` lines below."""
    deviating = {c.key for i, c in enumerate(table.columns) if any(cells[i].std is not None for cells in table.rows)}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(key for c in table.columns for key in ([c.key, f"{c.key}_std"] if c.key in deviating else [c.key]))
    for cells in table.rows:
        line: list[object] = []
        for column, cell in zip(table.columns, cells, strict=True):
            line.append(cell.text if cell.value is None and cell.text != NOTHING else cell.value)
            line += [cell.std] if column.key in deviating else []
        writer.writerow("" if item is None else item for item in line)
    return text.getvalue() + "".join(f"# {line}\n" for line in _footer(table))


def _md(table: Table) -> str:
    def line(texts: list[str]) -> str:
        return "| " + " | ".join(_one_line(t).replace("|", "\\|") for t in texts) + " |\n"

    rule = "".join("|---" if c.words else "|---:" for c in table.columns)
    head = line([c.title for c in table.columns]) + f"{rule}|\n"
    body = "".join(line([f"**{c.text}**" if c.best else c.text for c in cells]) for cells in table.rows)
    return head + body + "".join(f"\n{text}\n" for text in _footer(table))


def _tex(table: Table) -> str:
    """A booktabs ``table`` without the columns that say nothing; notes in the caption, the stamp in comments."""

    def line(texts: list[str]) -> str:
        return "    " + " & ".join(texts) + r" \\" + "\n"

    shown = [i for i, c in enumerate(table.columns) if c.words or any(cells[i].text != NOTHING for cells in table.rows)]
    columns = [table.columns[i] for i in shown]
    picked = [[cells[i] for i in shown] for cells in table.rows]
    body = [[rf"\textbf{{{_escape(c.text)}}}" if c.best else _escape(c.text) for c in cells] for cells in picked]
    comments = "".join(f"% {_one_line(name)}: {', '.join(map(_one_line, values))}\n" for name, values in table.stamp)
    caption = " ".join(filter(None, (rf"\textbf{{{_escape(table.title)}}}", *map(_escape, table.notes))))
    return (
        f"{comments}\\begin{{table}}[t]\n  \\centering\\footnotesize\n  \\setlength{{\\tabcolsep}}{{3.5pt}}\n"
        f"  \\begin{{tabular}}{{{''.join('l' if c.words else 'r' for c in columns)}}}\n    \\toprule\n"
        f"{line([_escape(c.title) for c in columns])}    \\midrule\n"
        f"{''.join(map(line, body))}    \\bottomrule\n  \\end{{tabular}}\n"
        f"  \\caption{{{caption}}}\n  \\label{{tab:{table.name}}}\n\\end{{table}}\n"
    )


def _footer(table: Table) -> list[str]:
    stamp = [f"{name}: {', '.join(values)}" for name, values in table.stamp]
    return [_one_line(text) for text in (*table.notes, *stamp)]


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _escape(text: str) -> str:
    return "".join(LATEX.get(letter, letter) for letter in _one_line(text))


NOTHING = "–"  # a cell for which there is no number and nothing to say

LATEX = {letter: rf"\{letter}" for letter in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "†": r"$^\dagger$",
    "–": "--",
    "ꟻ": "F",
}

FORMATS: dict[str, Callable[[Table], str]] = {"json": _json, "csv": _csv, "md": _md, "tex": _tex}
