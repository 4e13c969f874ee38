"""The charts: per-subject, pareto, curves, ablation. Each takes a clean sheet and a figure's numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure as Paper
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from rsavatar.report.palette import INK, SOFT, label_of, look_of
from rsavatar.report.runs import OURS, Figure

SINGLE, DOUBLE = 3.25, 6.875  # inches: one column, two
ABREAST = 4  # names of a legend beside one another on two columns
BASE = "gauhuman"
Data = Mapping[str, Any]


def mark(method: str, **more: Any) -> dict[str, Any]:
    """Keywords that draw a method's points."""
    look = look_of(method)
    size = 8.0 if look.marker == "*" else 5.5
    known = {"marker": look.marker, "color": look.light, "markersize": size, "markeredgecolor": "white"}
    return {"linestyle": "none", "markeredgewidth": 0.7, **known, **more}


def legend(axes: Paper, methods: Sequence[str], ncols: int) -> None:
    """A legend of methods above the charts, ours in bold."""
    handles = [Line2D([], [], **mark(method), label=label_of(method)) for method in methods]
    made = axes.legend(handles=handles, handletextpad=0.2, columnspacing=1.0, ncols=ncols, loc="outside upper center")
    for method, text in zip(methods, made.get_texts(), strict=True):
        text.set_fontweight("bold" if method == OURS else "normal")


def per_subject(paper: Paper, figure: Figure, pictures: Data) -> None:
    """A row per subject, a mark per method, and the gain of ours."""
    rows = figure.data["rows"]
    methods = list(dict.fromkeys(m["method"] for row in rows for m in row["methods"]))
    paper.set_size_inches(SINGLE, 0.5 + 0.09 * len(methods) + 0.34 * len(rows))
    axes = paper.subplots()
    for y, row in enumerate(rows):
        at = {m["method"]: m for m in row["methods"]}
        if OURS in at and BASE in at:
            _gain(axes, y, at[BASE]["psnr"], at[OURS]["psnr"])
        for method, summary in at.items():
            error = summary["psnr_std"]
            style = mark(method, zorder=4 if method == OURS else 3)
            axes.errorbar(summary["psnr"], y, xerr=error, elinewidth=0.8, capsize=1.5, **style)
    axes.set_yticks(range(len(rows)), [row["subject"] for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="y", visible=False)
    axes.spines["left"].set_visible(False)
    axes.margins(x=0.08)
    axes.set_xlabel("held-out PSNR, dB")
    legend(paper, methods, ncols=2)


def _gain(axes: Axes, y: int, base: float, ours: float) -> None:
    look = look_of(OURS)
    axes.plot([base, ours], [y, y], color=look.light, alpha=0.28, linewidth=4, solid_capstyle="round", zorder=1)
    text = f"{ours - base:+.1f} dB".replace("-", "\N{MINUS SIGN}")
    place = ((base + ours) / 2, y)
    axes.annotate(text, place, (0, 5), textcoords="offset points", ha="center", fontsize=6.5, color=look.light)


def pareto(paper: Paper, figure: Figure, pictures: Data) -> None:
    """Seconds of training against PSNR, and the front."""
    paper.set_size_inches(SINGLE, 2.5)
    axes = paper.subplots()
    for point in figure.data["points"]:
        axes.plot(
            point["seconds"],
            point["psnr"],
            **mark(point["method"], markersize=3.2, markeredgewidth=0, alpha=0.45, zorder=2),
        )
    means = {m["method"]: m for m in figure.data["means"]}
    front = sorted((means[m]["seconds"], means[m]["psnr"]) for m in figure.data["front"])
    if len(front) > 1:
        axes.step(*zip(*front, strict=True), where="post", color=SOFT, linewidth=0.9, linestyle=(0, (4, 2)), zorder=1)
    for method, m in means.items():
        axes.errorbar(
            m["seconds"], m["psnr"], yerr=m["psnr_std"], elinewidth=0.8, capsize=1.5, **mark(method, zorder=4)
        )
    axes.set_xscale("log")
    _log_ticks(axes, [p["seconds"] for p in figure.data["points"]])
    axes.margins(x=0.14, y=0.1)
    axes.set_xlabel("training, s")
    axes.set_ylabel("held-out PSNR, dB")
    legend(paper, list(means), ncols=2)


def _log_ticks(axes: Axes, values: Sequence[float]) -> None:
    """Ticks at 1, 2, 5 of each decade, written out; half an octave of room at both ends."""
    axes.set_xlim(min(values) / 1.3, max(values) * 1.3)
    _plain(axes.xaxis)


def _plain(axis: Axis) -> None:
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


CURVES = {"psnr": ("PSNR on the input, dB", "linear"), "loss": ("loss", "log")}


def curves(paper: Paper, figure: Figure, pictures: Data) -> None:
    """Training curves, a panel per quantity."""
    methods = list(dict.fromkeys(s["method"] for s in figure.data["series"]))
    paper.set_size_inches(DOUBLE, 2.2 + 0.13 * -(-len(methods) // ABREAST))
    keys = [key for key in CURVES if any(s["key"] == key for s in figure.data["series"])]
    panels = paper.subplots(1, len(keys), squeeze=False)[0]
    for axes, key in zip(panels, keys, strict=True):
        for series in (s for s in figure.data["series"] if s["key"] == key):
            look, ours = look_of(series["method"]), series["method"] == OURS
            axes.fill_between(series["steps"], series["low"], series["high"], color=look.light, alpha=0.13, linewidth=0)
            style = {"color": look.light, "linewidth": 1.8 if ours else 1.1, "zorder": 4 if ours else 3}
            every = max(1, len(series["steps"]) // 6)
            size = 5.5 if look.marker == "*" else 3.8
            axes.plot(series["steps"], series["mean"], marker=look.marker, markersize=size, markevery=every, **style)
        title, scale = CURVES[key]
        axes.set_yscale(scale)
        if scale == "log":
            _plain(axes.yaxis)
        axes.set_title(title, loc="left")
        axes.set_xlabel("step")
        axes.margins(x=0.01)
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    legend(paper, methods, ncols=min(len(methods), ABREAST))


MEASURES = {"psnr": "held-out PSNR, dB", "sub_frame_joint_mm": "joints within the readout, mm"}


def ablation(paper: Paper, figure: Figure, pictures: Data) -> None:
    """A row per variant; a panel for PSNR and, where there is a true motion, one for the joints."""
    variants = figure.data["variants"]
    keys = [key for key in MEASURES if all(v[key] is not None for v in variants)]
    paper.set_size_inches(DOUBLE if len(keys) > 1 else SINGLE, 0.6 + 0.27 * len(variants))
    panels = paper.subplots(1, len(keys), squeeze=False, sharey=True)[0]
    look = look_of(OURS)
    for axes, key in zip(panels, keys, strict=True):
        whole = variants[0][key]
        axes.axvline(whole, color=look.light, linewidth=0.9, linestyle=(0, (4, 2)), zorder=1)
        for y, variant in enumerate(variants):
            colour = look.light if not variant["flag"] else SOFT
            axes.plot([whole, variant[key]], [y, y], color=colour, alpha=0.3, linewidth=3, zorder=1)
            style = mark(OURS, color=colour, marker="o" if not variant["flag"] else "D", markersize=5)
            error = variant[f"{key}_std"]
            axes.errorbar(variant[key], y, xerr=error, elinewidth=0.8, capsize=1.5, zorder=4, **style)
            if variant["flag"]:
                _difference(axes, variant[key], y, variant[key] - whole)
        axes.set_title(MEASURES[key], loc="left")
        axes.grid(axis="y", visible=False)
        axes.tick_params(axis="y", length=0)
        axes.margins(x=0.22)
    panels[0].set_yticks(range(len(variants)), [v["label"] for v in variants])
    panels[0].set_ylim(len(variants) - 0.5, -0.5)
    panels[0].get_yticklabels()[0].set_fontweight("bold")


def _difference(axes: Axes, x: float, y: int, change: float) -> None:
    text = f"{change:+.2f}".replace("-", "\N{MINUS SIGN}")
    axes.annotate(text, (x, y), (0, 4), textcoords="offset points", ha="center", fontsize=6.3, color=INK)


def sweep(axes: Axes, data: Data) -> None:
    """PSNR against the number of bands, selecting and averaging; levels for scanlines and the oblivious baseline."""
    finite = [s for s in data["sweep"] if s["bands"] != "scanline"]
    names = sorted({s["bands"] for s in finite}, key=band_order)
    for method in dict.fromkeys(s["method"] for s in finite):
        own = sorted(
            (names.index(s["bands"]), s["psnr"], s["psnr_std"] or 0.0) for s in finite if s["method"] == method
        )
        places, psnr, error = zip(*own, strict=True)
        axes.errorbar(places, psnr, yerr=error, color=look_of(method).light, elinewidth=0.8, capsize=1.5, zorder=3)
        axes.plot(places, psnr, **mark(method, zorder=4))
        verb = "selecting" if method == OURS else "averaging"
        _say(axes, (places[-1], psnr[-1]), f"{label_of(method)}, {verb}", method, (6, 0))
    for summary in (*(s for s in data["sweep"] if s["bands"] == "scanline"), *data["oblivious"]):
        method = summary["method"]
        axes.axhline(summary["psnr"], color=look_of(method).light, linewidth=1.0, linestyle=(0, (4, 2)), zorder=2)
        words = "every row its own instant" if method == OURS else "one instant"
        _say(axes, (-0.3, summary["psnr"]), f"{label_of(method)}, {words}", method, (0, 4))
    axes.set_ylabel("held-out PSNR, dB")
    axes.set_xlabel("T, instants of the model")
    axes.set_xticks(range(len(names)), names)
    axes.set_xlim(-0.4, len(names) - 0.4 + 0.25 * len(names))
    axes.margins(y=0.15)


def band_order(bands: str) -> tuple[int, int]:
    """Numbers first, then multiples of K."""
    return (0, int(bands)) if bands.isdecimal() else (1, int(bands[:-1] or 1))


def _say(axes: Axes, place: tuple[float, float], words: str, method: str, shift: tuple[int, int]) -> None:
    colour, side = look_of(method).light, "center" if shift[0] else "baseline"
    axes.annotate(words, place, shift, textcoords="offset points", fontsize=6.5, color=colour, va=side)
