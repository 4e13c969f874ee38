"""The overview: what the project shows, and what is going on."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse

from rsavatar.report.tables import PAPER_MAIN, render
from rsavatar.spec import Preset
from services.api import findings
from services.api.deps import Back, Backend
from services.api.layout import PageRoute, page
from services.api.tables import to_row
from services.api.views import JobView
from services.store import events, jobs, listing, metrics, pictures
from services.store.records import State, TableEntry

NEWEST = 8
LOOKED_AT = 1000  # newest results that the overview is made of; downloads are of all
PAPER = "paper: "  # begins the titles of columns that are the paper's

router = APIRouter(route_class=PageRoute)


@dataclass(frozen=True)
class Grid:
    """A Markdown table taken apart; a cell is its text and whether it is the best of its column."""

    header: tuple[str, ...]
    rows: tuple[tuple[tuple[str, bool], ...], ...]
    notes: tuple[str, ...]

    @property
    def own(self) -> int:
        """How many columns come before the paper's."""
        return next((i for i, title in enumerate(self.header) if title.startswith(PAPER)), len(self.header))

    @property
    def shown(self) -> tuple[int, ...]:
        """Columns in which any row has something."""
        columns = range(len(self.header))
        return tuple(i for i in columns if any(row[i][0] not in {"–", ""} for row in self.rows))


def to_grid(markdown: str) -> Grid:
    """The table of the report module, so that pages and downloads show the same text."""
    lines = [line for line in markdown.splitlines() if line]
    table = [line[2:-2].split(" | ") for line in lines if line.startswith("| ")]
    notes = tuple(line for line in lines if not line.startswith("|"))
    rows = tuple(tuple((c.strip("*"), c.startswith("**")) for c in cells) for cells in table[1:])
    return Grid(tuple(table[0]), rows, notes)


@dataclass(frozen=True)
class Disk:
    """Room where the service keeps things, in bytes."""

    total: int
    free: int
    artifacts: int

    @property
    def used(self) -> float:
        """Share that is taken."""
        return 1.0 - self.free / self.total


@router.get("/", response_class=HTMLResponse)
def index(request: Request, back: Back, preset: Preset | None = None) -> HTMLResponse:
    """The overview of one preset's results: methods can only be compared at one budget."""
    newest = events.newest_id(back.store)  # before everything else, so that the stream misses nothing
    counts = jobs.count_by_state(back.store)
    entries = listing.newest_of_specs(back.store, LOOKED_AT)
    presets = findings.presets_of(entries)
    chosen = preset or (presets[0] if presets else "draft")
    of_preset = [entry for entry in entries if entry.job.spec.get("preset") == chosen]
    found = findings.finding(entries, chosen)
    context = {
        "newest": newest,
        "preset": chosen,
        "presets": presets,
        "finding": found,
        "paper_gain": PAPER_MAIN[findings.OURS]["psnr"] - PAPER_MAIN[findings.BASELINE]["psnr"],
        "pair": _pair(back, found),
        "table": to_grid(render("main", [to_row(entry) for entry in findings.plain(of_preset)], "md")),
        "looked_at": LOOKED_AT if counts[State.SUCCEEDED] > LOOKED_AT else None,
        "results": listing.newest_results(back.store, NEWEST),
        **_state(back, counts),
    }
    return page(request, "home.html", context)


def _state(back: Backend, counts: Mapping[str, int]) -> dict[str, Any]:
    usage = shutil.disk_usage(back.settings.home)
    return {
        "counts": counts,
        "running": [JobView.of(job) for job in listing.running(back.store)],
        "busy": listing.busy_workers(back.store),
        "waits": jobs.oldest_wait(back.store) if counts[State.QUEUED] else 0.0,
        "disk": Disk(usage.total, usage.free, listing.stored_bytes(back.store)),
    }


def _pair(back: Backend, found: findings.Finding) -> dict[str, Any] | None:
    """The two jobs whose pictures answer the question at a glance: the subject with the greatest gain."""
    lanes = [lane for lane in found.lanes if lane.gain is not None]
    for lane in sorted(lanes, key=lambda lane: -(lane.gain or 0.0)):
        ids = {mark.method: mark.job_id for mark in lane.marks}
        ours, theirs = ids[findings.OURS], ids[findings.BASELINE]
        shared = common_view(back, ours, theirs)
        if shared is not None:
            return {"subject": lane.subject, "gain": lane.gain, "ours": ours, "theirs": theirs, **shared}
    return None


def common_view(back: Backend, first: str, second: str) -> dict[str, Any] | None:
    """A held-out camera and the frame in which two jobs differ most, where both have pictures."""
    cameras = [{v.camera for v in pictures.views(back.store, job)} for job in (first, second)]
    scores = [psnr_of(back, job) for job in (first, second)]
    both = [key for key in scores[0].keys() & scores[1].keys() if key[0] in cameras[0] & cameras[1]]
    if not both:
        return None
    camera, frame = max(both, key=lambda key: (scores[0][key] - scores[1][key], key))
    return {"camera": camera, "frame": frame, "scores": (scores[0][camera, frame], scores[1][camera, frame])}


def psnr_of(back: Backend, job_id: str) -> dict[tuple[str, int], float]:
    """PSNR of every held-out view of a succeeded job."""
    found = metrics.outcome_of(back.store, job_id).scores
    return {(s.camera, s.frame): s.value for s in found if s.metric == "psnr" and s.value is not None}


def gain_over(entry: TableEntry, entries: list[TableEntry]) -> float | None:
    """PSNR above the shutter-oblivious result on the same subject and budget."""
    for other in entries:
        same = other.job.subject == entry.job.subject and other.job.spec.get("preset") == entry.job.spec.get("preset")
        if same and other.job.method == findings.BASELINE:
            mine, theirs = entry.means.get("psnr"), other.means.get("psnr")
            return None if mine is None or theirs is None else mine - theirs
    return None
