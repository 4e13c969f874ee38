"""Grids: plan, submit, list, look at, steer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Literal

from fastapi import APIRouter, BackgroundTasks, Header, Path, Query, Response

from rsavatar.grids.cells import Cell, expand, read_axes
from rsavatar.grids.request import GridRequest, grid_names, read_grid
from services import jobs as wake_up
from services.api.deps import UUID, Back, Backend
from services.api.grid_views import GridDetail, GridPage, GridPlan, GridView, detail, plan
from services.api.requests import checked_key
from services.errors import NotFoundError, RequestError
from services.store import estimates, grids, steering, subjects
from services.store.session import Store

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


@router.post("", status_code=202, responses={200: {"description": "a plan, or the key's earlier grid"}})
def submit(
    request: GridRequest,
    response: Response,
    back: Back,
    tasks: BackgroundTasks,
    dry_run: Annotated[bool, Query(description="only say what would happen")] = False,
    idempotency_key: Annotated[str | None, Header(description="repeat it to repeat a request safely")] = None,
) -> GridDetail | GridPlan:
    """Accept a grid: all its jobs or none, 202 and its place. With ``dry_run``: its jobs, reused results and time."""
    key = checked_key(idempotency_key)
    if key is not None and len(key) > LONGEST_KEY:
        raise RequestError("Idempotency-Key", f"at most {LONGEST_KEY} characters for a grid", f"{len(key)}")
    cells = expand(request, back.settings.max_grid_jobs)
    _require_subjects(back.store, cells)
    if dry_run:
        response.status_code = 200
        return _plan(back, request, cells)
    order = grids.Order(request, cells, back.settings.max_attempts, key)
    grid, waiting = grids.submit(back.store, order)
    tasks.add_task(wake_up.enqueue_many, back.broker, waiting)
    response.status_code = 202 if waiting else 200
    response.headers["location"] = f"/api/v1/grids/{grid.id}"
    return _detail(back, grid.id)


def _require_subjects(store: Store, cells: Sequence[Cell]) -> None:
    for name in dict.fromkeys(cell.spec.subject for cell in cells):
        try:
            subjects.get(store, name)
        except NotFoundError as error:
            raise RequestError("axes.subject", error.expected, error.got) from None


def _plan(back: Backend, request: GridRequest, cells: Sequence[Cell]) -> GridPlan:
    known = grids.finished(back.store, [cell.spec.sha256() for cell in cells])
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
def steer(grid_id: GridId, verb: Verb, back: Back, tasks: BackgroundTasks) -> GridDetail:
    """Cancel, pause, resume or retry all jobs of a grid to which the verb applies."""
    reached = VERBS[verb](back.store, grid_id)
    if verb in WAKING:
        tasks.add_task(wake_up.enqueue_many, back.broker, reached)
    return _detail(back, grid_id)


def _detail(back: Backend, grid_id: str) -> GridDetail:
    grid, found = grids.get(back.store, grid_id), grids.jobs_of(back.store, grid_id)
    return detail(grid, found, estimates.measure(back.store), _parallel(back))
