"""Figures made of pictures: the qualitative strip with enlargements and error maps; one body under four shutters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Paper
from matplotlib.gridspec import GridSpec
from matplotlib.patches import Rectangle

from rsavatar.report.figures_charts import DOUBLE, sweep
from rsavatar.report.palette import ERROR_MAP, INK, LINE, OTHER, SHUTTERS, SOFT, look_of
from rsavatar.report.runs import OURS, Figure

Picture = npt.NDArray[Any]
Data = Mapping[str, Any]
LARGEST_ERROR = 0.3  # of the range of a byte: the top of the error maps' scale
ZOOM = "#ffb000"  # frame of what is enlarged: seen on skin, cloth and white alike
SHUTTER_WORDS = {
    "global": ("Global", "one instant"),
    "blur": ("Blur", "mean over the readout"),
    "bands": ("Bands", "T = 4, seams"),
    "rolling": ("Rolling", "every row its own"),
}


def strip(paper: Paper, figure: Figure, pictures: Data) -> None:
    """Input, methods and truth side by side; enlarged below; errors below that."""
    columns: Sequence[Data] = figure.pictures["columns"]
    tiles = [("input", "RS input", OTHER.light), *((c["job"], c["label"], look_of(c["method"]).light) for c in columns)]
    tiles.append(("truth", "Ground truth", INK))
    height, width = pictures["truth"].shape[:2]
    box = pictures["box"]
    column = DOUBLE / len(tiles)
    heights = [column * height / width, column, column * height / width]
    paper.set_size_inches(DOUBLE, sum(heights) + 0.28)
    paper.get_layout_engine().set(w_pad=0.012, h_pad=0.012, wspace=0.0, hspace=0.0)  # type: ignore[union-attr]
    grid = GridSpec(3, len(tiles), figure=paper, height_ratios=heights)
    for i, (key, title, colour) in enumerate(tiles):
        top = _picture(paper, grid[0, i], pictures[key])
        bold = key in {c["job"] for c in columns if c["method"] == OURS}
        top.set_title(title, color=colour, fontsize=7.5, fontweight="bold" if bold else "normal", pad=3)
        if key == "input":
            _row_clock(top)
            continue
        _frame(top, box, ZOOM)
        x0, y0, x1, y1 = box
        zoomed = _picture(paper, grid[1, i], pictures[key][y0:y1, x0:x1])
        for spine in zoomed.spines.values():
            spine.set(visible=True, edgecolor=ZOOM, linewidth=1.1)
        if key != "truth":
            error = paper.add_subplot(grid[2, i])
            shown = error.imshow(pictures[f"error:{key}"], cmap=ERROR_MAP, vmin=0, vmax=LARGEST_ERROR)
            _bare(error)
            error.set_xlabel(f"{pictures[f'psnr:{key}']:.1f} dB", fontsize=7, labelpad=2, color=colour)
    _scale(paper, grid[2, len(tiles) - 1], shown)


def _picture(paper: Paper, place: Any, pixels: Picture) -> Axes:
    axes = paper.add_subplot(place)
    axes.imshow(pixels, interpolation="lanczos" if pixels.shape[0] < 600 else "antialiased")
    _bare(axes)
    return axes


def _bare(axes: Axes) -> None:
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set(visible=True, edgecolor=LINE, linewidth=0.5)


def _frame(axes: Axes, box: Sequence[int], colour: str) -> None:
    x0, y0, x1, y1 = box
    axes.add_patch(Rectangle((x0 - 0.5, y0 - 0.5), x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=1.1))


def _row_clock(axes: Axes) -> None:
    """An arrow down the left edge: rows are read from the top, one after another."""
    arrow = {"arrowstyle": "-|>", "color": SOFT, "linewidth": 0.8, "mutation_scale": 6}
    axes.annotate("", (0.07, 0.05), (0.07, 0.95), xycoords="axes fraction", arrowprops=arrow)
    place = {"rotation": 90, "ha": "left", "va": "center", "fontsize": 6, "color": SOFT, "transform": axes.transAxes}
    axes.text(0.09, 0.5, "rows are read", **place)


def _scale(paper: Paper, place: Any, shown: Any) -> None:
    """The colour scale of the error maps, in the cell under the truth."""
    cell = paper.add_subplot(place)
    cell.set_axis_off()
    inside = cell.inset_axes((0.18, 0.25, 0.12, 0.5))
    bar = paper.colorbar(shown, cax=inside)
    bar.outline.set_linewidth(0.4)
    bar.set_ticks([0, LARGEST_ERROR / 2, LARGEST_ERROR], labels=["0", "15 %", "30 %"])
    bar.ax.tick_params(labelsize=6.5, length=2)
    cell.text(0.18, 0.8, "mean |error|", fontsize=6.5, transform=cell.transAxes)


def shutter(paper: Paper, figure: Figure, pictures: Data) -> None:
    """Four exposures of one body with the clock of their rows; below, the sweep over T where there is one."""
    finite = {s["bands"] for s in figure.data["sweep"]}
    charted = len(finite) > 1
    names = list(SHUTTER_WORDS)
    height, width = pictures["global"].shape[:2]
    column = DOUBLE / (len(names) + 0.2)
    rows = [column * height / width, column * 0.9, *([1.9] if charted else [])]
    paper.set_size_inches(DOUBLE, sum(rows) + 0.5 + (0.3 if charted else 0))
    paper.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)  # type: ignore[union-attr]
    grid = GridSpec(len(rows), len(names), figure=paper, height_ratios=rows)
    for i, name in enumerate(names):
        axes = _picture(paper, grid[0, i], pictures[name])
        title, words = SHUTTER_WORDS[name]
        axes.set_title(f"{title}: {words}", color=SHUTTERS[name].light, fontsize=7.5, pad=3)
        _frame(axes, pictures["box"], ZOOM)
        _clock(axes, name)
        x0, y0, x1, y1 = pictures["box"]
        zoomed = _picture(paper, grid[1, i], pictures[name][y0:y1, x0:x1])
        for spine in zoomed.spines.values():
            spine.set(visible=True, edgecolor=ZOOM, linewidth=1.1)
    if charted:
        sweep(paper.add_subplot(grid[2, :]), figure.data)


def _clock(axes: Axes, name: str) -> None:
    """When each row is exposed, as a bar of colour at the left: early is violet, late is yellow, a mixture is grey."""
    clock = axes.inset_axes((0.03, 0.04, 0.035, 0.92))
    share = np.linspace(0, 1, 256)
    times = {"global": np.full(256, 0.5), "bands": (np.floor(share * 4).clip(max=3) + 0.5) / 4, "rolling": share}
    if name == "blur":
        clock.imshow(np.linspace(0, 1, 64)[None], aspect="auto", cmap="plasma", vmin=0, vmax=1)
    else:
        clock.imshow(times[name][:, None], aspect="auto", cmap=mpl.colormaps["plasma"], vmin=0, vmax=1)
    _bare(clock)
