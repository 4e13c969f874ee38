"""What must hold when the fire is out: sentences about what does not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy import select

from services.api.tables import rows_of
from services.store import garbage
from services.store.records import Filters
from services.store.tables import ArtifactRow, CheckpointRow, JobRow, ResultRow
from tests.system.harness import Host
from tests.system.lives import Life

LEFT_OVER = ("*.tmp", "*.part", "incoming-*")
NOT_OF_NUMBERS = "checkpoint_every"  # an axis that moves no number
Json = Mapping[str, Any]
Place = tuple[tuple[str, str], ...]


def place_of(cell: Json) -> Place:
    """What decides the numbers of a cell."""
    return tuple(item for item in cell["place"].items() if item[0] != NOT_OF_NUMBERS)


def numbers(host: Host, job: str) -> Json:
    """What a job found, without what depends on the clock."""
    found = host.client.get(f"/api/v1/jobs/{job}/results").json()
    return {name: found[name] for name in ("means", "per_camera", "scores", "gaussians")}


def of_grid(host: Host, grid: Json) -> Iterator[str]:
    """The grid tells of every job once, all have succeeded, and its tables have a row of each."""
    cells, count = grid["cells"], grid["jobs"]
    told = {state: jobs for state, jobs in grid["counts"].items() if jobs}
    if not grid["terminal"] or told != {"succeeded": count}:
        yield f"the grid tells of {told}"
    places = Counter(tuple(cell["place"].items()) for cell in cells)
    ids = {cell["job_id"] for cell in cells}
    if {len(cells), len(places), len(ids)} != {count}:
        yield f"the grid has {len(cells)} cells of {len(ids)} jobs in {len(places)} places, not {count}"
    rows = [row.job_id for row in rows_of(host.store, filters=Filters(grid=grid["id"]))]
    if sorted(rows) != sorted(ids):
        yield f"the table is of {len(rows)} rows and {len(set(rows))} jobs, not of {len(ids)}"


def of_jobs(host: Host, cells: Sequence[Json], lives: Sequence[Life], expected: Mapping[Place, Json]) -> Iterator[str]:
    """Every job has ended once, and, where those are known, with the numbers of its peaceful run."""
    for cell, life in zip(cells, lives, strict=True):
        if life.endings != ["succeeded"]:
            yield f"job {cell['job_id']} has ended {len(life.endings)} times: {life.endings}"
        elif expected and numbers(host, cell["job_id"]) != expected[place_of(cell)]:
            yield f"job {cell['job_id']} has other numbers than its peaceful run"


def left_over(host: Host) -> list[str]:
    """Processes, files and rows that belong to nothing."""
    wrong = [f"process {child.pid} still runs" for child in host.children()]
    garbage.collect(host.store, host.settings.home / "jobs", -1.0, dry_run=False)
    wrong += [f"file {path}" for pattern in LEFT_OVER for path in host.settings.home.rglob(pattern)]
    with host.store.read() as session:
        named = set(session.scalars(select(ArtifactRow.sha256)))
        ids = set(session.scalars(select(JobRow.id)))
        results = session.scalars(select(ResultRow.job_id)).all()
        checkpoints = session.scalars(select(CheckpointRow.job_id)).all()
    stored = {blob.sha256 for blob in host.store.blobs.all()}
    wrong += [f"blob {sha256} is {word}" for word, some in (("unnamed", stored - named), ("lost", named - stored))
              for sha256 in some]  # fmt: skip
    wrong += [f"folder {path}" for path in (host.settings.home / "jobs").iterdir() if path.name not in ids]
    wrong += [f"{len(results)} results of {len(ids)} jobs"] if sorted(results) != sorted(ids) else []
    return wrong + [f"checkpoint row of {job}" for job in checkpoints]
