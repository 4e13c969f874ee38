"""Figures made of pictures: the qualitative strip with enlargements and error maps; one body under four shutters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Paper
from matplotlib.patches import Rectangle

from rsavatar.report.figures_charts import DOUBLE, sweep
from rsavatar.report.palette import ERROR_MAP, INK, LINE, OTHER, SHUTTERS, SOFT, look_of
from rsavatar.report.runs import OURS, Figure

Picture = npt.NDArray[Any]
Data = Mapping[str, Any]
LARGEST_ERROR = 0.3  # of the range of a byte: the top of the error maps' scale
ZOOM = "#ffb000"  # frame of what is enlarged: seen on skin, cloth and white alike
TITLE, GAP, FOOT = 0.19, 0.035, 0.2  # inches: above a column, between cells, below error maps
LINE_HEIGHT = 0.12  # inches that a second line of a title adds
MOST_ON_ONE_LINE = 4  # methods whose names fit beside one another without folding
EDGE = 0.01  # inches: half a frame's line, so that none is cut
CHART = 1.9  # inches of the sweep's height
WIDE = DOUBLE - 2 * EDGE
FINE = 300  # pixels an inch that pictures are enlarged to
SHUTTER_WORDS = {
    "global": "Global: one instant",
    "blur": "Blur: mean over the readout",
    "bands": "Bands: T = 4, with seams",
    "rolling": "Rolling: every row its own",
}


@dataclass(frozen=True)
class Sheet:
    """A paper that is laid out in inches from its top left corner; ``width`` and ``height`` leave an edge around."""

    paper: Paper
    width: float
    height: float

    @classmethod
    def of(cls, paper: Paper, width: float, height: float) -> Sheet:
        """Give the paper its size; nothing is moved afterwards."""
        paper.set_layout_engine("none")
        paper.set_size_inches(width + 2 * EDGE, height + 2 * EDGE)
        return cls(paper, width, height)

    def cell(self, left: float, top: float, width: float, height: float) -> Axes:
        """Axes there."""
        x, y = self.share(left, top + height)
        corner = self.share(left + width, top)
        return self.paper.add_axes((x, y, corner[0] - x, corner[1] - y))

    def share(self, left: float, top: float) -> tuple[float, float]:
        """A place as shares of the paper, from its bottom left corner."""
        return (left + EDGE) / (self.width + 2 * EDGE), 1 - (top + EDGE) / (self.height + 2 * EDGE)

    def picture(self, place: tuple[float, float, float, float], pixels: Picture, **more: Any) -> Axes:
        """A picture that fills a cell, its pixels enlarged smoothly. Places on it are shares of its sides."""
        axes = self.cell(*place)
        size = (round(place[2] * FINE), round(place[3] * FINE))
        smooth = cv2.INTER_CUBIC if size[0] > pixels.shape[1] else cv2.INTER_AREA
        fine = cv2.resize(pixels, size, interpolation=smooth)
        axes.imshow(fine, extent=(0, 1, 1, 0), aspect="auto", interpolation="nearest", **more)
        bare(axes)
        return axes


def bare(axes: Axes, colour: str = LINE, width: float = 0.5) -> None:
    """A frame and nothing else."""
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set(visible=True, edgecolor=colour, linewidth=width)


def outline(axes: Axes, box: Sequence[int], shape: tuple[int, ...]) -> None:
    """Frame the part (x0, y0, x1, y1) of a picture of ``shape``."""
    x0, y0, x1, y1 = box
    height, width = shape[:2]
    corner, sides = (x0 / width, y0 / height), ((x1 - x0) / width, (y1 - y0) / height)
    axes.add_patch(Rectangle(corner, *sides, fill=False, edgecolor=ZOOM, linewidth=1.1))


def strip(paper: Paper, figure: Figure, pictures: Data) -> None:
    """Input, methods and truth side by side; below, enlarged; below that, the error of what is enlarged."""
    columns: Sequence[Data] = figure.pictures["columns"]
    shape = pictures["truth"].shape
    width = (WIDE - GAP * (len(columns) + 1)) / (len(columns) + 2)
    tall = width * shape[0] / shape[1]
    folds = len(columns) > MOST_ON_ONE_LINE
    head = TITLE + LINE_HEIGHT * folds
    second, third = head + tall + GAP, head + tall + width + 2 * GAP
    sheet = Sheet.of(paper, WIDE, third + width + FOOT)
    seen = sheet.picture((0, head, width, tall), pictures["input"])
    seen.set_title("RS input", color=OTHER.light, fontsize=7.5, pad=3)
    _row_clock(seen)
    x0, y0, x1, y1 = pictures["box"]
    cut = np.s_[y0:y1, x0:x1]
    for i, (key, title, colour, weight) in enumerate(_titles(columns), 1):
        left = i * (width + GAP)
        top = sheet.picture((left, head, width, tall), pictures[key])
        top.set_title(_folded(title) if folds else title, color=colour, fontsize=7.5, fontweight=weight, pad=3)
        outline(top, pictures["box"], shape)
        bare(sheet.picture((left, second, width, width), pictures[key][cut]), ZOOM, 1.1)
        if key != "truth":
            scale = {"cmap": ERROR_MAP, "vmin": 0, "vmax": LARGEST_ERROR}
            error = sheet.picture((left, third, width, width), pictures[f"error:{key}"][cut], **scale)
            error.set_xlabel(f"{pictures[f'psnr:{key}']:.2f} dB", fontsize=7, labelpad=2.5, color=colour, weight=weight)
    for place, words in ((second, "enlarged"), (third, "error")):
        _aside(sheet, place, width, words)
    _scale(sheet, (WIDE - width, third), min(0.75, width - 0.2), error)


def _titles(columns: Sequence[Data]) -> list[tuple[str, str, str, str]]:
    """Key, title, colour and weight of every column but the input."""
    named = [
        (c["job"], c["label"], look_of(c["method"]).light, "bold" if c["method"] == OURS else "normal") for c in columns
    ]
    return [*named, ("truth", "Ground truth", INK, "normal")]


def _folded(title: str) -> str:
    """A method's name on two lines."""
    return title.replace(" + ", " +\n").replace(" (", "\n(")


def _aside(sheet: Sheet, top: float, width: float, words: str) -> None:
    """A row's name, in a cell without a picture."""
    sheet.paper.text(
        *sheet.share(width - 2 * GAP, top + width / 2), words, ha="right", va="center", fontsize=7, color=SOFT
    )


def _row_clock(axes: Axes) -> None:
    """An arrow down the left edge: rows are read from the top, one after another."""
    arrow = {"arrowstyle": "-|>", "color": SOFT, "linewidth": 0.8, "mutation_scale": 6}
    axes.annotate("", (0.06, 0.95), (0.06, 0.05), xycoords="data", arrowprops=arrow)
    axes.text(0.08, 0.5, "rows are read", rotation=90, ha="left", va="center", fontsize=6, color=SOFT)


def _scale(sheet: Sheet, place: tuple[float, float], height: float, error: Axes) -> None:
    """The colour scale of the error maps, under the truth."""
    bar = sheet.paper.colorbar(error.images[0], cax=sheet.cell(place[0] + 0.1, place[1] + 0.2, 0.1, height))
    bar.outline.set_linewidth(0.4)
    bar.set_ticks([0, LARGEST_ERROR / 2, LARGEST_ERROR], labels=["0", "15 %", "30 %"])
    bar.ax.tick_params(labelsize=6.5, length=2)
    bar.ax.set_title("mean |error|", fontsize=6.5, loc="left", pad=8)


def shutter(paper: Paper, figure: Figure, pictures: Data) -> None:
    """Four exposures of one body with the clock of their rows; below, the sweep over T where there is one."""
    charted = len({s["bands"] for s in figure.data["sweep"]} - {"scanline"}) > 1
    shape = pictures["global"].shape
    width = (WIDE - 3 * GAP) / 4
    tall = width * shape[0] / shape[1]
    second = TITLE + tall + GAP
    sheet = Sheet.of(paper, WIDE, second + width + 0.02 + (CHART + 0.6 if charted else 0))
    x0, y0, x1, y1 = pictures["box"]
    for i, (name, title) in enumerate(SHUTTER_WORDS.items()):
        left = i * (width + GAP)
        axes = sheet.picture((left, TITLE, width, tall), pictures[name])
        axes.set_title(title, color=SHUTTERS[name].light, fontsize=7.5, pad=3)
        outline(axes, pictures["box"], shape)
        _clock(sheet, (left + 0.05, TITLE + 0.08, 0.06, tall - 0.16), name)
        bare(sheet.picture((left, second, width, width), pictures[name][y0:y1, x0:x1]), ZOOM, 1.1)
    if charted:
        sweep(sheet.cell(0.45, second + width + 0.2, WIDE - 0.5, CHART), figure.data)


def _clock(sheet: Sheet, place: tuple[float, float, float, float], name: str) -> None:
    """When each row is exposed, as a bar of colour: early is violet, late is yellow, a row that is averaged has all."""
    share = np.linspace(0, 1, 256)[:, None]
    times = {
        "global": np.full((256, 1), 0.5),
        "blur": np.linspace(0, 1, 64)[None],
        "bands": (np.floor(share * 4).clip(max=3) + 0.5) / 4,
        "rolling": share,
    }
    axes = sheet.cell(*place)
    axes.imshow(times[name], aspect="auto", cmap="plasma", vmin=0, vmax=1, interpolation="nearest")
    bare(axes)
