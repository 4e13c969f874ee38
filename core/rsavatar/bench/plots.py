"""Plots of the results, as PNG and SVG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rsavatar.bench.results import Curve, GrowthResult, RenderResult, WayFigures
from rsavatar.bench.tables import AXES, MEASURES

INK, GREY, BLUE, ORANGE, GREEN = "#222222", "#8a8a8a", "#2f6db3", "#d9772b", "#2c8f5c"
COLOURS = {"bands": BLUE, "in use": BLUE, "the paper's way": GREEN, "scanline, 1 thread": GREY}  # others: scanlines
STEPS: dict[str, tuple[str, tuple[int, int], str]] = {  # of own time: label, its shift in points, its alignment
    "own-time": ("own time", (-6, 0), "right"),
    "own-time+shear": ("+ shear", (-6, 0), "right"),
    "scanline": ("scanline", (-6, 0), "right"),
    "scanline-row": ("strips of one row", (7, 2), "left"),
}


def error_against_time(result: RenderResult, folder: Path) -> str:
    """Run time against error, a panel for each motion; writes NAME.png and NAME.svg, returns NAME."""
    plt = _pyplot()
    motions = sorted({f.motion_px for f in result.ways})
    figure, panels = plt.subplots(1, len(motions), figsize=(4.0 * len(motions), 4.2), sharey=True, squeeze=False)
    for panel, motion in zip(panels[0], motions, strict=True):
        _error_panel(panel, [f for f in result.ways if f.motion_px == motion])
        panel.set_title(f"{motion:g} px of motion", loc="left", fontsize=10, color=INK)
        panel.set_xlabel("forward and backward, ms")
    panels[0][0].set_ylabel("root mean squared error in the foreground")
    return _save(figure, folder, "render-error-against-time")


def _error_panel(panel: Any, figures: Sequence[WayFigures]) -> None:
    at = {f.way: f for f in figures}
    bands = [f for f in figures if f.bands]
    own = [at[name] for name in STEPS]
    panel.plot(*_places(bands), "o-", color=BLUE, markersize=4, linewidth=1.2)
    panel.plot(*_places(own), "s-", color=ORANGE, markersize=4, linewidth=1.2)
    panel.plot(*_places([at["paper"]]), "D", color=GREEN, markersize=6)
    _say(panel, at["paper"], "the paper's way", GREEN, (0, 9), "center")
    for f in bands:
        _say(panel, f, f"T = {f.bands}", BLUE, (5, 3), "left")
    for f, (text, shift, side) in zip(own, STEPS.values(), strict=True):
        _say(panel, f, text, ORANGE, shift, side)
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.margins(x=0.35, y=0.08)


def _places(figures: Sequence[WayFigures]) -> tuple[list[float], list[float]]:
    return [f.total_ms for f in figures], [_rms(f) for f in figures]


def _rms(figures: WayFigures) -> float:
    return float(10 ** (-figures.accuracy.psnr_db / 20))


def _say(panel: Any, f: WayFigures, text: str, colour: str, shift: tuple[int, int], side: str) -> None:
    place = (f.total_ms, _rms(f))
    panel.annotate(text, place, shift, textcoords="offset points", fontsize=7.5, color=colour, ha=side)


def convergence(result: RenderResult, folder: Path) -> str:
    """Error of bands by T, with the fitted order; writes NAME.png and NAME.svg, returns NAME."""
    figure, panel = _pyplot().subplots(figsize=(5.2, 4.0))
    shades = ("#9cc0e7", "#5f97d3", BLUE, "#173f6d")
    for order, shade in zip(result.orders, shades, strict=False):
        panel.loglog(order.bands, order.rms_error, "o-", color=shade, markersize=4, linewidth=1.2)
        text = f"{order.motion_px:g} px, order {order.order:.2f}"
        place = (order.bands[-1], order.rms_error[-1])
        panel.annotate(text, place, (5, -3), textcoords="offset points", fontsize=8, color=shade)
    panel.margins(x=0.3)
    panel.set_xlabel("T, bands")
    panel.set_ylabel("root mean squared error")
    return _save(figure, folder, "render-convergence")


def growth(result: GrowthResult, folder: Path) -> list[str]:
    """One plot for each axis; writes NAME.png and NAME.svg of each, returns the names."""
    axes = list(dict.fromkeys(curve.axis for curve in result.curves))
    return [_growth(axis, [c for c in result.curves if c.axis == axis], folder) for axis in axes]


def _growth(axis: str, curves: Sequence[Curve], folder: Path) -> str:
    figure, panel = _pyplot().subplots(figsize=(5.2, 4.0))
    for curve in curves:
        colour = COLOURS.get(curve.name, ORANGE)
        for key, style in (("total_ms", "o-"), ("step_ms", "s--"), ("memory_mb", "o-")):
            known = [(p.x, getattr(p, key)) for p in curve.points if getattr(p, key) is not None]
            if known:
                label = f"{curve.name}: {MEASURES[key].rsplit(' ', 1)[0]}"
                panel.loglog(*zip(*known, strict=True), style, color=colour, markersize=4, linewidth=1.2, label=label)
    places = sorted({p.x for curve in curves for p in curve.points})
    panel.set_xticks(places, [f"{x:g}" for x in places], fontsize=7.5)
    panel.xaxis.minorticks_off()
    low, high = panel.get_ylim()
    if high < 10 * low:  # a decade at least, so that what is nearly flat looks so
        panel.set_ylim(low / 2, high * 10 / (high / low))
    panel.legend(fontsize=7.5, frameon=False)
    panel.set_xlabel(AXES[axis])
    panel.set_ylabel("MB" if axis in ("memory", "steps") else "ms")
    panel.set_title(curves[0].fixed, loc="left", fontsize=9, color=INK)
    return _save(figure, folder, f"growth-{axis}")


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    plt.rcParams |= {
        "svg.hashsalt": "rsavatar",  # the same figures give the same file
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.color": "#e6e6e6",
        "font.size": 9,
    }
    return plt


def _save(figure: Any, folder: Path, name: str) -> str:
    figure.tight_layout()
    figure.savefig(folder / f"{name}.png", dpi=110)
    figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    _pyplot().close(figure)
    return name
