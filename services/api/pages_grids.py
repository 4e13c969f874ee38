"""Grids: what was varied, and what came of it, filling in while the jobs run."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import HTMLResponse

from services.api import vendor
from services.api.deps import UUID, Back
from services.api.layout import PageRoute, page
from services.api.pages_job import LESS_IS_BETTER, SHADES
from services.api.pages_jobs import flat, text_of
from services.store import events, grids
from services.store.records import TERMINAL, State

SHOWN = 50
METRICS = {
    "psnr": "PSNR, dB",
    "ssim": "SSIM",
    "flip": "ꟻLIP",
    "lpips": "LPIPS",
    "joint_mm": "joints, mm",
    "sub_frame_joint_mm": "sub-frame joints, mm",
    "train_seconds": "training, s",
}
WORSE_WHEN_MORE = LESS_IS_BETTER | {"joint_mm", "sub_frame_joint_mm", "train_seconds"}

router = APIRouter(route_class=PageRoute, prefix="/grids")
GridId = Annotated[str, Path(pattern=UUID, description="id of a grid")]


@dataclass(frozen=True)
class Cell:
    """The jobs at one place of the matrix: seeds, mostly. ``mean`` and ``deviation`` are over those that ended."""

    jobs: tuple[grids.GridJob, ...]
    mean: float | None
    deviation: float | None
    fraction: float
    state: str
    shade: int = 0


@dataclass(frozen=True)
class Matrix:
    """Two words of the specs against each other."""

    rows: str
    columns: str
    row_labels: tuple[str, ...]
    column_labels: tuple[str, ...]
    cells: tuple[tuple[Cell | None, ...], ...]


@router.get("", response_class=HTMLResponse)
def list_page(request: Request, back: Back, after: Annotated[str | None, Query(pattern=UUID)] = None) -> HTMLResponse:
    """All grids, newest first."""
    newest = events.newest_id(back.store)
    found = grids.page(back.store, after, SHOWN + 1)
    counts = grids.count_states(back.store, [grid.id for grid in found])
    context = {
        "newest": newest,
        "grids": [(grid, counts[grid.id], sum(counts[grid.id].values())) for grid in found[:SHOWN]],
        "next": found[SHOWN - 1].id if len(found) > SHOWN else None,
    }
    return page(request, "grids.html", context)


@router.get("/{grid_id}", response_class=HTMLResponse)
def grid_page(
    request: Request,
    grid_id: GridId,
    back: Back,
    metric: Annotated[str, Query(pattern=r"^[a-z_]{1,32}$")] = "psnr",
    rows: Annotated[str | None, Query(max_length=64)] = None,
    columns: Annotated[str | None, Query(max_length=64)] = None,
) -> HTMLResponse:
    """One grid; ``metric``, ``rows`` and ``columns`` choose what the matrix shows."""
    newest = events.newest_id(back.store)
    grid = grids.get(back.store, grid_id)
    found = grids.jobs_of(back.store, grid_id)
    words = varied(found)
    metric = metric if metric in METRICS else "psnr"
    pair = _axes(words, rows, columns)
    counts = {state: sum(job.state == state for job in found) for state in State}
    context = {
        "newest": newest,
        "grid": grid,
        "jobs": found,
        "words": list(words),
        "metric": metric,
        "metrics": METRICS,
        "counts": {state: count for state, count in counts.items() if count},
        "done": sum(job.fraction for job in found) / len(found) if found else 0.0,
        "ended": all(job.state in TERMINAL for job in found),
        "matrix": matrix(found, pair, metric),
        "rows": pair[0],
        "columns": pair[1],
        "data": json.dumps(_data(found, words)),
        "plotly": vendor.address(),
    }
    return page(request, "grid.html", context, charts=True)


def varied(found: Sequence[grids.GridJob]) -> dict[str, list[str]]:
    """Words whose values differ between the jobs, in the order of the spec; an ablation is one word."""
    specs = [words_of(job.spec) for job in found]
    names = dict.fromkeys(name for spec in specs for name in spec)
    values = {name: list(dict.fromkeys(spec.get(name, "–") for spec in specs)) for name in names}
    return {name: found for name, found in values.items() if len(found) > 1}


def words_of(spec: Mapping[str, Any]) -> dict[str, str]:
    """A spec as people write it; flags of an ablation together, ``full`` where nothing is removed."""
    flags = [name for name, is_set in (spec.get("ablation") or {}).items() if is_set]
    words = {name: text_of(value) for name, value in flat({k: v for k, v in spec.items() if k != "ablation"}).items()}
    return words | {"ablation": ", ".join(flags) or "full"}


def _axes(words: Mapping[str, list[str]], rows: str | None, columns: str | None) -> tuple[str | None, str | None]:
    """What the matrix opposes: as asked, else the two words with the most values, subjects across."""
    names = [n for n in words if n != "seed"] or list(words)
    ranked = sorted(names, key=lambda n: (n == "subject", -len(words[n])))
    down = rows if rows in words else (ranked[0] if ranked else None)
    others = [n for n in names if n != down]
    across = columns if columns in words and columns != down else None
    return down, across or (("subject" if "subject" in others else others[0]) if others else None)


def matrix(found: Sequence[grids.GridJob], pair: tuple[str | None, str | None], metric: str) -> Matrix | None:
    """The jobs by two words, shaded by their means; jobs that differ in other words share a cell."""
    if pair[0] is None:
        return None
    down, across = pair
    places: dict[tuple[str, str], list[grids.GridJob]] = {}
    for job in found:
        words = words_of(job.spec)
        places.setdefault((words.get(down or "", "–"), words.get(across, "–") if across else ""), []).append(job)
    labels = [list(dict.fromkeys(place[i] for place in places)) for i in (0, 1)]
    cells = {place: _cell(tuple(group), metric) for place, group in places.items()}
    shaded = _shaded(cells, metric)
    table = tuple(tuple(shaded.get((row, column)) for column in labels[1]) for row in labels[0])
    return Matrix(down or "", across or "", tuple(labels[0]), tuple(labels[1]), table)


def _cell(group: tuple[grids.GridJob, ...], metric: str) -> Cell:
    values = [float(v) for job in group if (v := job.metrics.get(metric)) is not None]
    order = (State.RUNNING, State.DEAD, State.FAILED, State.CANCELLED, State.PAUSED, State.QUEUED, State.SUCCEEDED)
    state = next(state for state in order if any(job.state == state for job in group))
    deviation = stdev(values) if len(values) > 1 else None
    done = fmean(job.fraction for job in group)
    return Cell(group, fmean(values) if values else None, deviation, done, str(state))


def _shaded(cells: Mapping[tuple[str, str], Cell], metric: str) -> dict[tuple[str, str], Cell]:
    means = [cell.mean for cell in cells.values() if cell.mean is not None]
    low, span = (min(means), max(means) - min(means)) if means else (0.0, 0.0)

    def shade(cell: Cell) -> int:
        part = (cell.mean - low) / span if cell.mean is not None and span else 0.5
        return min(SHADES - 1, int((1.0 - part if metric in WORSE_WHEN_MORE else part) * SHADES))

    return {place: Cell(c.jobs, c.mean, c.deviation, c.fraction, c.state, shade(c)) for place, c in cells.items()}


def _data(found: Sequence[grids.GridJob], words: Mapping[str, list[str]]) -> dict[str, Any]:
    """What the charts draw: every job's varied words and metrics."""
    jobs = [
        {
            "id": job.id,
            "state": job.state,
            "method": job.spec.get("method"),
            "words": {name: words_of(job.spec).get(name, "–") for name in words},
            "metrics": dict(job.metrics),
        }
        for job in found
    ]
    return {"words": dict(words), "metrics": METRICS, "jobs": jobs}
