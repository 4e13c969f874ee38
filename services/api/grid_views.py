"""Shapes of grids: what a plan, a list and the live matrix show."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

from pydantic import BaseModel

from rsavatar.grids.cells import Axis, Cell, place_of, read_axes
from services.api.views import ErrorView, instant
from services.store.estimates import Estimate, Paces
from services.store.grids import Grid, GridJob
from services.store.records import TERMINAL, State


class AxisView(BaseModel):
    """An axis and what its values are called."""

    name: str
    values: list[str]

    @classmethod
    def of(cls, axis: Axis) -> AxisView:
        """The view of an axis."""
        return cls(name=axis.name, values=[value.label for value in axis.values])


class EstimateView(BaseModel):
    """What jobs of one kind will take, and how that is known."""

    method: str
    subject: str
    preset: str
    iterations: int
    jobs: int
    seconds: float
    basis: str


class PlannedCell(BaseModel):
    """A job that a grid would have; ``reuses`` is the finished job whose result it would take."""

    number: int
    place: dict[str, str]
    spec_sha256: str
    seconds: float
    reuses: str | None


class GridPlan(BaseModel):
    """What submitting a grid would do. ``seconds`` is of all its jobs, ``eta_seconds`` of waiting for them."""

    name: str
    jobs: int
    reused: int
    seconds: float
    parallel: int
    eta_seconds: float
    estimates: list[EstimateView]
    axes: list[AxisView]
    cells: list[PlannedCell]


class CellView(BaseModel):
    """A cell of the matrix: its place, its job, and what that has found. Metrics are none until it has succeeded."""

    number: int
    place: dict[str, str]
    job_id: str
    method: str
    subject: str
    seed: int
    state: str
    fraction: float
    eta_seconds: float | None
    reused_from: str | None
    gaussians: int | None
    metrics: dict[str, float | None]
    error: ErrorView | None


class GridView(BaseModel):
    """A grid as lists show it; ``eta_seconds`` is none when nothing is left to wait for."""

    id: str
    name: str
    about: str
    owner: str
    jobs: int
    counts: dict[str, int]
    terminal: bool
    fraction: float
    created_at: datetime | None

    @classmethod
    def of(cls, grid: Grid, counts: Mapping[str, int], fraction: float | None = None) -> GridView:
        """The view of a grid; without a ``fraction`` whole jobs are counted."""
        return cls(**cls.fields_of(grid, counts, fraction))

    @classmethod
    def fields_of(cls, grid: Grid, counts: Mapping[str, int], fraction: float | None) -> dict[str, Any]:
        """Values of the fields that lists and single grids share."""
        total = sum(counts.values())
        ended = sum(count for state, count in counts.items() if state in TERMINAL)
        return {
            "id": grid.id,
            "name": grid.name,
            "about": grid.notes,
            "owner": grid.owner,
            "jobs": total,
            "counts": {str(state): counts.get(state, 0) for state in State},
            "terminal": ended == total,
            "fraction": (ended / total if total else 0.0) if fraction is None else fraction,
            "created_at": instant(grid.created_at),
        }


class GridDetail(GridView):
    """A grid with its request and its matrix."""

    eta_seconds: float | None
    base: dict[str, Any]
    includes: list[dict[str, Any]]
    excludes: list[dict[str, Any]]
    axes: list[AxisView]
    cells: list[CellView]


class GridPage(BaseModel):
    """Grids, newest first; ``next_cursor`` is none on the last page."""

    items: list[GridView]
    next_cursor: str | None


def plan(name: str, axes: Sequence[Axis], cells: Sequence[Cell], paces: Paces, known: Mapping[str, str]) -> GridPlan:
    """What a grid would do, one job at a time. ``known`` are finished jobs by the hash of their specs."""
    specs = [cell.spec.model_dump(mode="json", by_alias=True) for cell in cells]
    guesses = [paces.of(spec) for spec in specs]
    planned = []
    for cell, guess in zip(cells, guesses, strict=True):
        sha256 = cell.spec.sha256()
        reuses = known.get(sha256)
        seconds = 0.0 if reuses else guess.seconds
        place = dict(cell.place)
        planned.append(PlannedCell(number=cell.number, place=place, spec_sha256=sha256, seconds=seconds, reuses=reuses))
    seconds = sum(cell.seconds for cell in planned)
    return GridPlan(
        name=name,
        jobs=len(planned),
        reused=sum(cell.reuses is not None for cell in planned),
        seconds=seconds,
        parallel=1,
        eta_seconds=seconds,
        estimates=estimates(zip(specs, guesses, strict=True)),
        axes=[AxisView.of(axis) for axis in axes],
        cells=planned,
    )


def estimates(guesses: Iterable[tuple[Mapping[str, Any], Estimate]]) -> list[EstimateView]:
    """One line per kind of job."""
    kinds: dict[tuple[Any, ...], EstimateView] = {}
    for spec, guess in guesses:
        words = {name: spec[name] for name in ("method", "subject", "preset", "iterations")}
        view = EstimateView(**words, jobs=0, seconds=guess.seconds, basis=guess.basis)
        kinds.setdefault(tuple(words.values()), view).jobs += 1
    return list(kinds.values())


def detail(grid: Grid, jobs: Sequence[GridJob], paces: Paces, parallel: int) -> GridDetail:
    """The live state of a grid."""
    request = grid.request()
    axes = read_axes(request)
    counts: dict[str, int] = {}
    for job in jobs:
        counts[job.state] = counts.get(job.state, 0) + 1
    done = sum(1.0 if job.state in TERMINAL else job.fraction for job in jobs)
    left = sum(_seconds_left(job, paces) for job in jobs if job.state not in TERMINAL)
    active = sum(job.state not in TERMINAL for job in jobs)
    return GridDetail(
        **GridView.fields_of(grid, counts, done / len(jobs) if jobs else 0.0),
        eta_seconds=left / max(1, min(parallel, active)) if active else None,
        base=dict(grid.base),
        includes=list(grid.includes),
        excludes=list(grid.excludes),
        axes=[AxisView.of(axis) for axis in axes],
        cells=[_cell(job, place_of(request, axes, job.number) or {}) for job in jobs],
    )


def _seconds_left(job: GridJob, paces: Paces) -> float:
    """What the job says itself once it moves, else what jobs like it took."""
    guess = paces.of(job.spec).seconds
    if job.state == State.RUNNING and job.eta_seconds is not None and job.stage == "train" and job.step:
        return job.eta_seconds + guess * 0.1
    return guess * (1.0 - job.fraction)


def _cell(job: GridJob, place: dict[str, str]) -> CellView:
    error = None if job.error is None else ErrorView(kind=job.error_kind or "", message=job.error)
    return CellView(
        number=job.number,
        place=place,
        job_id=job.id,
        method=str(job.spec.get("method", "")),
        subject=str(job.spec.get("subject", "")),
        seed=int(job.spec.get("seed", 0)),
        state=job.state,
        fraction=job.fraction,
        eta_seconds=job.eta_seconds if job.state == State.RUNNING else None,
        reused_from=job.reused_from,
        gaussians=job.gaussians,
        metrics=dict(job.metrics),
        error=error,
    )
