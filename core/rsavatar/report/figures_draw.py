"""Figures on paper: PNG, SVG and PDF at a journal's column widths, fonts embedded, provenance in the metadata.

Equal figures give equal bytes on one machine: no date, no random ids. Drawn without a display and without state.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Paper
from matplotlib.font_manager import fontManager

from rsavatar import __version__
from rsavatar.errors import SpecError, expected
from rsavatar.report import figures_charts as charts
from rsavatar.report import figures_pictures as pictures_of
from rsavatar.report.palette import INK, LINE, SOFT
from rsavatar.report.runs import Figure

FORMATS = ("png", "svg", "pdf")
DPI = 300
FAMILIES = ("Arial", "Liberation Sans", "Arimo", "Helvetica", "DejaVu Sans")  # the last comes with matplotlib
STYLE: dict[str, Any] = {
    "font.size": 7.5,
    "axes.titlesize": 8,
    "axes.labelsize": 7.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": SOFT,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.width": 0.4,
    "ytick.minor.width": 0.4,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 1.5,
    "ytick.minor.size": 1.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": LINE,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.2,
    "pdf.fonttype": 42,  # TrueType, whole: editable, and what publishers ask for
    "ps.fonttype": 42,
    "svg.fonttype": "path",
    "svg.hashsalt": "rsavatar",
}
DRAWERS: dict[str, Callable[[Paper, Figure, Mapping[str, Any]], None]] = {
    "per-subject": charts.per_subject,
    "pareto": charts.pareto,
    "curves": charts.curves,
    "ablation": charts.ablation,
    "qualitative": pictures_of.strip,
    "shutter": pictures_of.shutter,
}


def draw(figure: Figure, fmt: str, pictures: Mapping[str, Any]) -> bytes:
    """The figure's file. ``pictures`` are what ``figure.pictures`` asks for, by name (``export.strip``).

    Raises:
        SpecError: if the format is not one of ``FORMATS``, or the figure lacks what it shows.
    """
    if fmt not in FORMATS:
        raise SpecError(expected("format", f"one of {', '.join(FORMATS)}", repr(fmt)))
    if figure.lacking:
        raise SpecError(expected(f"figure {figure.name}", figure.lacking, "none"))
    family = next(name for name in FAMILIES if name in set(fontManager.get_font_names()))
    with mpl.rc_context({**STYLE, "font.family": family}):
        paper = Paper(layout="constrained")
        FigureCanvasAgg(paper)
        DRAWERS[figure.name](paper, figure, pictures)
        return _save(paper, figure, fmt)


def _save(paper: Paper, figure: Figure, fmt: str) -> bytes:
    facts = "; ".join(f"{name}: {', '.join(values)}" for name, values in figure.provenance.items())
    description = f"{figure.caption} [{facts}]"
    creator = f"rsavatar {__version__}"
    metadata: dict[str, dict[str, Any]] = {
        "png": {"Title": figure.title, "Description": description, "Software": creator},
        "svg": {"Title": figure.title, "Description": description, "Creator": creator, "Date": None},
        "pdf": {"Title": figure.title, "Subject": description, "Creator": creator, "CreationDate": None},
    }
    file = io.BytesIO()
    paper.savefig(file, format=fmt, dpi=DPI, metadata=metadata[fmt])
    return file.getvalue()
