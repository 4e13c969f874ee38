"""Two plain pages: all jobs with the main table, and one job. Complete without scripts; a module keeps them fresh."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse
from fastapi.templating import Jinja2Templates

from rsavatar.report.tables import render
from services.api.deps import Back, Backend, JobId
from services.api.tables import rows_of
from services.api.views import ArtifactView, JobDetail, JobView
from services.store import artifacts, events, jobs, metrics
from services.store.records import Filters, State

SHOWN_JOBS = 50
SPARK = (640, 160)  # size of a curve's drawing, in its own units

router = APIRouter(include_in_schema=False)
templates = Jinja2Templates(Path(__file__).parent / "templates")


@dataclass(frozen=True)
class Grid:
    """A Markdown table taken apart; a cell is its text and whether it is the best of its column."""

    header: tuple[str, ...]
    rows: tuple[tuple[tuple[str, bool], ...], ...]
    notes: tuple[str, ...]


def to_grid(markdown: str) -> Grid:
    """The table of the report module, so that pages and downloads show the same text."""
    lines = [line for line in markdown.splitlines() if line]
    table = [line[2:-2].split(" | ") for line in lines if line.startswith("| ")]
    notes = tuple(line for line in lines if not line.startswith("|"))
    rows = tuple(tuple((c.strip("*"), c.startswith("**")) for c in cells) for cells in table[1:])
    return Grid(tuple(table[0]), rows, notes)


@router.get("/", response_class=HTMLResponse)
def index(request: Request, back: Back) -> HTMLResponse:
    """All jobs and the main table."""
    newest = events.newest_id(back.store)  # before the jobs, so that the stream misses nothing
    found = jobs.page(back.store, Filters(), None, SHOWN_JOBS)
    context = {
        "jobs": [JobView.of(job) for job in found],
        "counts": jobs.count_by_state(back.store),
        "table": to_grid(render("main", rows_of(back.store), "md")),
        "newest": newest,
        "place": _place(back),
    }
    return templates.TemplateResponse(request, "index.html", context)


@router.get("/jobs/{job_id}", response_class=HTMLResponse)
def job_page(request: Request, job_id: JobId, back: Back) -> HTMLResponse:
    """One job: progress, curves, pictures, files."""
    newest = events.newest_id(back.store)
    job = jobs.get(back.store, job_id)
    files = [ArtifactView.of(artifact) for artifact in artifacts.of_job(back.store, job_id)]
    curves = {key: polyline(points) for key, points in metrics.curves(back.store, job_id).items()}
    context = {
        "job": JobDetail.of(job),
        "means": metrics.outcome_of(back.store, job_id).means if job.state == State.SUCCEEDED else {},
        "pictures": [file for file in files if file.mime == "image/png"],
        "files": files,
        "curves": curves,
        "newest": newest,
        "place": _place(back),
    }
    return templates.TemplateResponse(request, "job.html", context)


def _place(back: Backend) -> str:
    return str(back.store.engine.url.render_as_string(hide_password=True))


def polyline(points: Sequence[tuple[int, float]]) -> str:
    """Points of an SVG polyline that fills ``SPARK``; empty for fewer than two points."""
    if len(points) < 2:
        return ""
    width, height = SPARK
    low, high = min(v for _, v in points), max(v for _, v in points)
    first, span = points[0][0], points[-1][0] - points[0][0]
    scale = (height - 8) / ((high - low) or 1.0)
    return " ".join(f"{(s - first) / span * width:.1f},{height - 4 - (v - low) * scale:.1f}" for s, v in points)
