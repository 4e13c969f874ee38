"""Grids: plan, submit, list, look at, steer."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import APIRouter, BackgroundTasks, Depends, Header, Path, Query, Response

from rsavatar.grids.cells import Cell, expand, read_axes
from rsavatar.grids.request import GridRequest, grid_names, read_grid
from services import jobs as wake_up
from services.api.access import Who
from services.api.deps import UUID, Back, Backend
from services.api.grid_views import GridDetail, GridPage, GridPlan, GridView, detail, plan
from services.api.requests import checked_key
from services.errors import NotFoundError, RequestError
from services.store import content, estimates, grids, steering, subjects
from services.store.session import Store
from services.store.subject_records import Subject

LONGEST_KEY = 200  # the jobs' own keys are longer
GridId = Annotated[str, Path(pattern=UUID, description="id of a grid")]
Verb = Literal["cancel", "pause", "resume", "retry"]
VERBS: dict[str, Callable[[Store, str], list[str]]] = {
    "cancel": steering.cancel,
    "pause": steering.pause,
    "resume": steering.resume,
    "retry": steering.retry,
}
WAKING = frozenset({"resume", "retry"})

router = APIRouter(prefix="/grids", tags=["grids"])


@dataclass(frozen=True)
class Options:
    """How a grid is submitted: only planned, run although results are known, repeated safely."""

    dry_run: bool
    force: bool
    key: str | None


def options(
    dry_run: Annotated[bool, Query(description="only say what would happen")] = False,
    force: Annotated[bool, Query(description="run jobs even if their results are known")] = False,
    idempotency_key: Annotated[str | None, Header(description="repeat it to repeat a request safely")] = None,
) -> Options:
    """The options of a request.

    Raises:
        RequestError: if the key is no key, or too long to have the cells' numbers behind it.
    """
    key = checked_key(idempotency_key)
    if key is not None and len(key) > LONGEST_KEY:
        raise RequestError("Idempotency-Key", f"at most {LONGEST_KEY} characters for a grid", f"{len(key)}")
    return Options(dry_run, force, key)


@router.post("", status_code=202, responses={200: {"description": "a plan, or the key's earlier grid"}})
def submit(
    request: GridRequest,
    asked: Annotated[Options, Depends(options)],
    response: Response,
    back: Back,
    who: Who,
    tasks: BackgroundTasks,
) -> GridDetail | GridPlan:
    """Accept a grid: all its jobs or none, 202 and its place. With ``dry_run``: its jobs, reused results and time."""
    cells = expand(request, back.settings.max_grid_jobs)
    contents = _contents(back.store, cells)
    if asked.dry_run:
        response.status_code = 200
        return _plan(back, request, cells, {} if asked.force else contents)
    order = grids.Order(request, cells, back.settings.max_attempts, asked.key, who.owner, contents, asked.force)
    grid, is_new, waiting = grids.submit(back.store, order)
    tasks.add_task(wake_up.enqueue_many, back.broker, waiting)
    response.status_code = 202 if is_new else 200
    response.headers["location"] = f"/api/v1/grids/{grid.id}"
    return _detail(back, grid.id)


def _contents(store: Store, cells: Sequence[Cell]) -> dict[str, str]:
    """Hashes of spec, data and code by the spec's. Every subject is looked at once."""
    known: dict[str, Subject] = {}
    for name in dict.fromkeys(cell.spec.subject for cell in cells):
        try:
            known[name] = subjects.get(store, name)
        except NotFoundError as error:
            raise RequestError("axes.subject", error.expected, error.got) from None
    return {cell.spec.sha256(): content.content_sha256(store, cell.spec, known[cell.spec.subject]) for cell in cells}


def _plan(back: Backend, request: GridRequest, cells: Sequence[Cell], contents: Mapping[str, str]) -> GridPlan:
    known = grids.finished(back.store, contents)
    found = plan(request.name, read_axes(request), cells, estimates.measure(back.store), known)
    parallel = _parallel(back)
    return found.model_copy(update={"parallel": parallel, "eta_seconds": found.seconds / min(parallel, found.jobs)})


def _parallel(back: Backend) -> int:
    """Jobs that run side by side: as many as do now, or as one worker of these settings would."""
    return max(back.settings.worker_concurrency, estimates.running(back.store))


@router.get("")
def list_grids(
    back: Back,
    cursor: Annotated[str | None, Query(pattern=UUID, description="next_cursor of the page before")] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    name: Annotated[str | None, Query(max_length=128)] = None,
) -> GridPage:
    """Grids, newest first, with their jobs counted by state."""
    found = grids.page(back.store, cursor, limit + 1, name)
    shown = found[:limit]
    counts = grids.count_states(back.store, [grid.id for grid in shown])
    items = [GridView.of(grid, counts[grid.id]) for grid in shown]
    return GridPage(items=items, next_cursor=shown[-1].id if len(found) > limit else None)


@router.get("/built-in")
def list_built_in() -> list[GridRequest]:
    """Grids that come with the program, as bodies to be changed and submitted."""
    return [read_grid(name) for name in grid_names()]


@router.get("/{grid_id}")
def get_grid(grid_id: GridId, back: Back) -> GridDetail:
    """A grid as it is now: counts, progress, remaining time, and the matrix of its cells."""
    return _detail(back, grid_id)


@router.post("/{grid_id}/{verb}", status_code=202)
def steer(grid_id: GridId, verb: Verb, back: Back, who: Who, tasks: BackgroundTasks) -> GridDetail:
    """Cancel, pause, resume or retry all jobs of a grid of one's own to which the verb applies."""
    who.require_owner("grid", grids.get(back.store, grid_id).owner)
    reached = VERBS[verb](back.store, grid_id)
    if verb in WAKING:
        tasks.add_task(wake_up.enqueue_many, back.broker, reached)
    return _detail(back, grid_id)


def _detail(back: Backend, grid_id: str) -> GridDetail:
    grid, found = grids.get(back.store, grid_id), grids.jobs_of(back.store, grid_id)
    return detail(grid, found, estimates.measure(back.store), _parallel(back))
