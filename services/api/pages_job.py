"""One job: how it goes, what it found, where it is good, how it moved, and everything to take away."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from services.api.deps import Back, Backend, JobId
from services.api.layout import PageRoute, page
from services.api.pages_jobs import flat, text_of
from services.api.views import ArtifactView, JobDetail
from services.store import artifacts, events, jobs, listing, metrics, pictures
from services.store.records import Filters, Job, Outcome, Score, State, TableEntry

SHADES = 10  # steps of the heat map's colour scale
LESS_IS_BETTER = frozenset({"flip", "lpips"})
DIGITS = {"psnr": 1}
MEANS = (  # key, title, digits, unit
    ("psnr", "PSNR", 2, "dB"),
    ("ssim", "SSIM", 3, ""),
    ("flip", "ꟻLIP", 3, ""),
    ("lpips", "LPIPS", 3, ""),
    ("joint_mm", "Joints", 1, "mm"),
    ("sub_frame_joint_mm", "Sub-frame joints", 1, "mm"),
)
RIVALS = 60  # newest results on the same subject that are looked through

router = APIRouter(route_class=PageRoute, prefix="/jobs")


@dataclass(frozen=True)
class Cell:
    """One held-out image: its value and its shade, 0 the worst of the map."""

    camera: str
    frame: int
    value: float | None
    shade: int


@dataclass(frozen=True)
class HeatMap:
    """A metric over cameras (rows) and frames (columns)."""

    metric: str
    metrics: tuple[str, ...]
    frames: tuple[int, ...]
    rows: tuple[tuple[str, tuple[Cell, ...]], ...]
    low: float
    high: float

    @property
    def digits(self) -> int:
        """Decimals that a cell shows."""
        return DIGITS.get(self.metric, 3)


@router.get("/{job_id}", response_class=HTMLResponse)
def job_page(
    request: Request, job_id: JobId, back: Back, metric: Annotated[str, Query(pattern=r"^[a-z_]{1,32}$")] = "psnr"
) -> HTMLResponse:
    """One job."""
    newest = events.newest_id(back.store)
    job = jobs.get(back.store, job_id)
    outcome = metrics.outcome_of(back.store, _source(job)) if job.state == State.SUCCEEDED else None
    files = [ArtifactView.of(artifact) for artifact in artifacts.of_job(back.store, _source(job))]
    views = pictures.views(back.store, _source(job))
    heat = heat_map(outcome.scores, metric) if outcome is not None else None
    context = {
        "newest": newest,
        "job": JobDetail.of(job),
        "source": _source(job),
        "spec": {name: text_of(value) for name, value in flat(job.spec).items()},
        "outcome": outcome,
        "means": MEANS,
        "rivals": _rivals(back, job),
        "heat": heat,
        "views": views,
        "start": _start(views, heat),
        "previews": [file for file in files if file.mime == "image/png"],
        "files": files,
        "paths": next((file.url for file in files if file.name == "paths"), None),
        "saved": saved(outcome),
    }
    return page(request, "job.html", context)


def _source(job: Job) -> str:
    """The job whose results these are: an identical earlier one, where this one was answered from it."""
    return getattr(job, "reused_from", None) or job.id


def heat_map(scores: Sequence[Score], metric: str) -> HeatMap | None:
    """The map of a metric, shaded between its own 2nd and 98th percentile; bright is good."""
    order = {key: i for i, (key, *_) in enumerate(MEANS)}
    names = tuple(sorted({score.metric for score in scores}, key=lambda name: (order.get(name, len(order)), name)))
    metric = metric if metric in names else "psnr"
    values = {(s.camera, s.frame): s.value for s in scores if s.metric == metric}
    known = sorted(v for v in values.values() if v is not None)
    if not known:
        return None
    low, high = known[round(0.02 * (len(known) - 1))], known[round(0.98 * (len(known) - 1))]
    frames = tuple(sorted({frame for _, frame in values}))

    def cell(camera: str, frame: int) -> Cell:
        value = values.get((camera, frame))
        part = 0.0 if value is None or high == low else min(max((value - low) / (high - low), 0.0), 1.0)
        part = 1.0 - part if metric in LESS_IS_BETTER else part
        return Cell(camera, frame, value, min(SHADES - 1, int(part * SHADES)))

    cameras = sorted({camera for camera, _ in values})
    rows = tuple((camera, tuple(cell(camera, frame) for frame in frames)) for camera in cameras)
    return HeatMap(metric, names, frames, rows, low, high)


def _start(views: Sequence[pictures.View], heat: HeatMap | None) -> tuple[str, int] | None:
    """The picture that a page opens with: the held-out view of median value, else a training camera's middle."""
    held_out = {view.camera for view in views if "input" not in view.kinds}
    cells = [c for _, row in heat.rows for c in row if c.value is not None and c.camera in held_out] if heat else []
    if cells:
        middle = sorted(cells, key=lambda cell: (cell.value, cell.camera, cell.frame))[len(cells) // 2]
        return middle.camera, middle.frame
    return (views[0].camera, views[0].frames[len(views[0].frames) // 2]) if views else None


def _rivals(back: Backend, job: Job) -> list[TableEntry]:
    """The newest result of every other method on this subject, at this budget and seed."""
    found: dict[str, TableEntry] = {}
    for entry in listing.newest_results(back.store, RIVALS, Filters(subject=job.subject)):
        same = all(entry.job.spec.get(word) == job.spec.get(word) for word in ("preset", "iterations", "seed"))
        whole = not any((entry.job.spec.get("ablation") or {}).values())
        if same and whole and entry.job.method != job.method:
            found.setdefault(entry.job.method, entry)
    return sorted(found.values(), key=lambda entry: -(entry.means.get("psnr") or 0.0))


@dataclass(frozen=True)
class Saved:
    """What the plan left out. Factors compare with the paper's way: whole frames, once for each of T bands."""

    images: int
    without_body: int
    bands: int
    passes: float  # per image
    pixels: float  # how many times fewer
    body_share: float


def saved(outcome: Outcome | None) -> Saved | None:
    """The counts of ``provenance.work`` in words; none for results of a version that did not count."""
    work: Mapping[str, Any] = (outcome.provenance.get("work") or {}) if outcome is not None else {}
    if not work or not work["images"] or not work["drawn_pixels"]:
        return None
    return Saved(
        images=work["images"],
        without_body=work["images_without_body"],
        bands=work["paper_bands"],
        passes=work["drawn_passes"] / work["images"],
        pixels=work["paper_pixels"] / work["drawn_pixels"],
        body_share=work["body_pixels"] / work["full_pixels"],
    )
