"""Grids: many jobs of one request, accepted, looked at and steered as one.

A cell's job carries ``KEY NUMBER`` as its idempotency key, where KEY is the grid's (its id where the client named none)
and NUMBER is the cell's: so a repeated request finds its grid, and every job its place, without another table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from sqlalchemy import Row, Select, func, insert, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from rsavatar.grids.cells import Cell
from rsavatar.grids.request import GridRequest
from services.errors import NotFoundError, RequestError
from services.store import intake, owners
from services.store.ids import new_id
from services.store.records import State, Submission, fraction_of
from services.store.session import Store, db_now
from services.store.tables import LOCAL, GridRow, JobRow, ResultRow

METRICS = ("psnr", "ssim", "flip", "lpips", "joint_mm", "sub_frame_joint_mm", "train_seconds", "evaluate_seconds")
LOOK = ("id", "state", "stage", "step", "steps", "eta_seconds", "gaussians", "error_kind", "error", "reused_from")


@dataclass(frozen=True)
class Grid:
    """A row of the grids."""

    id: str
    name: str
    base: Mapping[str, Any]
    axes: Mapping[str, Any]
    includes: Sequence[Any]
    excludes: Sequence[Any]
    owner: str
    notes: str
    created_at: float

    def request(self) -> GridRequest:
        """The request that it was made by."""
        parts = {"base": self.base, "axes": self.axes, "includes": self.includes, "excludes": self.excludes}
        return GridRequest.model_validate({"name": self.name, "about": self.notes, **parts})


@dataclass(frozen=True)
class Order:
    """A grid to be. ``contents`` are hashes of spec, data and code by the spec's, where the data are known."""

    request: GridRequest
    cells: Sequence[Cell]
    max_attempts: int
    key: str | None = None
    owner: str = LOCAL
    contents: Mapping[str, str] = field(default_factory=dict)
    forced: bool = False


@dataclass(frozen=True)
class GridJob:
    """A job in its grid: what the matrix shows of it."""

    number: int
    id: str
    state: str
    stage: str | None
    step: int
    steps: int
    eta_seconds: float | None
    gaussians: int | None
    error_kind: str | None
    error: str | None
    reused_from: str | None
    spec: Mapping[str, Any]
    metrics: Mapping[str, float | None]

    @property
    def fraction(self) -> float:
        """How much of it is done."""
        return 1.0 if self.state == State.SUCCEEDED else fraction_of(self.stage, self.step, self.steps)


def to_grid(row: GridRow) -> Grid:
    """The record of a row."""
    names = ("id", "name", "base", "axes", "includes", "excludes", "owner", "notes", "created_at")
    return Grid(**{name: getattr(row, name) for name in names})


def submit(store: Store, order: Order) -> tuple[Grid, bool, list[str]]:
    """Accept a grid and all its jobs in one transaction; whether it is new, and the ids of its jobs that wait.

    Raises:
        RequestError: if the idempotency key was used for another grid.
        QuotaError: if so many more jobs of the owner may not wait.
    """
    try:
        return _submit(store, order)
    except IntegrityError:  # another process took the key since our look; now we see its grid
        return _submit(store, order)


def _submit(store: Store, order: Order) -> tuple[Grid, bool, list[str]]:
    with store.write() as session:
        if (known := _known(session, order)) is not None:
            return known, False, []
        refusal = owners.room(session, store, order.owner).take(len(order.cells))
        if refusal is not None:
            raise refusal
        now = session.scalar(select(db_now())) or 0.0
        asked = order.request.model_dump(mode="json")
        parts = {name: asked[name] for name in ("name", "base", "axes", "includes", "excludes")}
        grid = Grid(id=new_id(), owner=order.owner, notes=asked["about"], created_at=now, **parts)
        session.execute(insert(GridRow).values(asdict(grid)))
        rows = [intake.row_of(_submission(order, grid, cell), now) for cell in order.cells]
        ended = set(intake.add(session, rows))
        return grid, True, [row["id"] for row in rows if row["id"] not in ended]


def _known(session: Session, order: Order) -> Grid | None:
    """The grid that the key has made already."""
    if order.key is None:
        return None
    start = f"{order.key} "
    mine = (JobRow.owner == order.owner) & (func.substr(JobRow.idempotency_key, 1, len(start)) == start)
    row = session.scalar(select(GridRow).join(JobRow, JobRow.grid_id == GridRow.id).where(mine).limit(1))
    if row is None:
        return None
    grid = to_grid(row)
    if grid.request() != order.request:
        raise RequestError("Idempotency-Key", "the grid it was first used for", "another grid")
    return grid


def _submission(order: Order, grid: Grid, cell: Cell) -> Submission:
    sha256 = cell.spec.sha256()
    return Submission(
        cell.spec.model_dump(mode="json", by_alias=True),
        spec_sha256=sha256,
        request_sha256=sha256,
        max_attempts=order.max_attempts,
        idempotency_key=f"{order.key or grid.id} {cell.number}",
        grid_id=grid.id,
        owner=order.owner,
        content_sha256=order.contents.get(sha256),
        forced=order.forced,
    )


def get(store: Store, grid_id: str) -> Grid:
    """One grid.

    Raises:
        NotFoundError: if there is none with this id.
    """
    with store.read() as session:
        return to_grid(_row(session, grid_id))


def _row(session: Session, grid_id: str) -> GridRow:
    row = session.get(GridRow, grid_id)
    if row is None:
        raise NotFoundError("grid", "the id of a grid", grid_id)
    return row


def page(store: Store, before: str | None, limit: int, name: str | None = None) -> list[Grid]:
    """Up to ``limit`` grids older than the id ``before``, newest first."""
    query = select(GridRow).order_by(GridRow.id.desc()).limit(limit)
    if before is not None:
        query = query.where(GridRow.id < before)
    if name is not None:
        query = query.where(GridRow.name == name)
    with store.read() as session:
        return [to_grid(row) for row in session.scalars(query)]


def count_states(store: Store, grid_ids: Sequence[str]) -> dict[str, dict[str, int]]:
    """Number of jobs of every grid in every state that occurs."""
    query = select(JobRow.grid_id, JobRow.state, func.count()).where(JobRow.grid_id.in_(grid_ids))
    counts: dict[str, dict[str, int]] = {grid_id: {} for grid_id in grid_ids}
    with store.read() as session:
        for grid_id, state, count in session.execute(query.group_by(JobRow.grid_id, JobRow.state)):
            counts[str(grid_id)][state] = count
    return counts


def finished(store: Store, contents: Mapping[str, str]) -> dict[str, str]:
    """Jobs whose results would be reused, by the hash of the spec; ``contents`` are hashes with data and code."""
    same = JobRow.content_sha256.in_(set(contents.values()))
    known = same & (JobRow.state == State.SUCCEEDED) & JobRow.reused_from.is_(None)
    query = select(JobRow.content_sha256, func.max(JobRow.id)).where(known).group_by(JobRow.content_sha256)
    with store.read() as session:
        found = {row[0]: row[1] for row in session.execute(query)}
    return {spec: found[content] for spec, content in contents.items() if content in found}


def jobs_of(store: Store, grid_id: str) -> list[GridJob]:
    """Every job of a grid with its result, in the order of the cells.

    Raises:
        NotFoundError: if there is no such grid.
    """
    with store.read() as session:
        _row(session, grid_id)
        found = [_grid_job(row) for row in session.execute(_matrix(grid_id))]
    return sorted(found, key=lambda job: job.number)


def _matrix(grid_id: str) -> Select[Any]:
    columns = (JobRow.idempotency_key, JobRow.spec, *(getattr(JobRow, name) for name in LOOK))
    metrics = (getattr(ResultRow, name).label(f"result_{name}") for name in METRICS)
    joined = select(*columns, *metrics).outerjoin(ResultRow, ResultRow.job_id == JobRow.id)
    return joined.where(JobRow.grid_id == grid_id)


def _grid_job(row: Row[Any]) -> GridJob:
    values = row._mapping
    number = int(str(values["idempotency_key"]).rpartition(" ")[2])
    metrics = {name: values[f"result_{name}"] for name in METRICS}
    return GridJob(number, spec=values["spec"], metrics=metrics, **{name: values[name] for name in LOOK})
