"""Lists of jobs, the form that submits one, and jobs side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse
from pydantic import BaseModel, ConfigDict, Field

from rsavatar.spec import Preset
from services.api.deps import UUID, Back, Backend
from services.api.form import fields_of_spec
from services.api.layout import PageRoute, page
from services.api.pages_home import common_view
from services.api.views import JobView
from services.errors import RequestError
from services.store import events, jobs, listing, subjects
from services.store.query import LONGEST
from services.store.records import Filters, Job, State, TableEntry

SHOWN = 50
MOST_COMPARED = 6
COMPARED_METRICS = {
    "psnr": "PSNR, dB",
    "ssim": "SSIM",
    "flip": "ꟻLIP",
    "lpips": "LPIPS",
    "joint_mm": "joints, mm",
    "joint_deg": "joints, degrees",
    "sub_frame_joint_mm": "sub-frame joints, mm",
}
SortKey = Literal["submitted", "method", "subject", "state", "psnr", "gaussians", "seconds"]
COLUMNS: tuple[tuple[str, SortKey | None, bool], ...] = (  # title, sort key, whether it holds numbers
    ("Job", "submitted", False),
    ("Method", "method", False),
    ("Subject", "subject", False),
    ("State", "state", False),
    ("Progress", None, False),
    ("PSNR, dB", "psnr", True),
    ("Gaussians", "gaussians", True),
    ("Time", "seconds", True),
)

router = APIRouter(route_class=PageRoute, prefix="/jobs")


class ListQuery(BaseModel):
    """What the list shows; the address holds all of it, so a view can be kept and sent."""

    model_config = ConfigDict(extra="ignore")

    state: State | Literal[""] | None = None
    method: str | None = Field(None, max_length=64)
    subject: str | None = Field(None, max_length=128)
    grid: str | None = Field(None, pattern=UUID)
    q: str | None = Field(None, max_length=LONGEST)
    sort: SortKey = "submitted"
    order: Literal["asc", "desc"] = "desc"
    after: str | None = Field(None, pattern=UUID)

    def filters(self) -> Filters:
        """The filters; an empty choice is none."""
        return Filters(self.state or None, self.method or None, self.subject or None, self.grid or None, self.q or None)

    def address(self, **changes: object) -> str:
        """The list's address with some of it changed; what has its default is left out."""
        values = self.model_dump(exclude={"after"}) | changes
        kept = {k: str(v) for k, v in values.items() if v and v != type(self).model_fields[k].default}
        return "/jobs" + (f"?{urlencode(kept)}" if kept else "")


@router.get("", response_class=HTMLResponse)
def list_page(request: Request, back: Back, query: Annotated[ListQuery, Query()]) -> HTMLResponse:
    """Jobs, filtered and sorted by the address."""
    newest = events.newest_id(back.store)
    order = listing.Order(query.sort, query.order == "desc")
    found = listing.page(back.store, query.filters(), order, query.after, SHOWN + 1)
    shown = found[:SHOWN]
    context = {
        "newest": newest,
        "query": query,
        "columns": COLUMNS,
        "jobs": [JobView.of(job) for job in shown],
        "names": listing.names(back.store),
        "counts": jobs.count_by_state(back.store),
        "next": query.address(after=shown[-1].id) if len(found) > SHOWN else None,
    }
    return page(request, "jobs.html", context)


@router.get("/new", response_class=HTMLResponse)
def form_page(
    request: Request,
    back: Back,
    source: Annotated[str | None, Query(alias="from", pattern=UUID)] = None,
    preset: Preset = "draft",
) -> HTMLResponse:
    """The form, with a preset chosen or filled with another job's spec."""
    given: Mapping[str, Any] = {"preset": preset} if source is None else jobs.get(back.store, source).spec
    context = {"form": fields_of_spec(given), "given": given, "source": source, "subjects": subjects.all_of(back.store)}
    return page(request, "new.html", context)


@router.get("/compare", response_class=HTMLResponse)
def compare_page(request: Request, back: Back, id: Annotated[list[str], Query(max_length=40)]) -> HTMLResponse:
    """Two to six jobs side by side: what differs in their specs, what they found, their curves and pictures."""
    ids = list(dict.fromkeys(id))
    if not 2 <= len(ids) <= MOST_COMPARED:
        raise RequestError("id", f"2 to {MOST_COMPARED} different jobs", f"{len(ids)}")
    chosen = [jobs.get(back.store, job_id) for job_id in ids]
    results = listing.results_of(back.store, ids)
    context = {
        "jobs": chosen,
        "results": results,
        "differences": differences(chosen),
        "titles": COMPARED_METRICS,
        "metrics": [row for name in COMPARED_METRICS if (row := _metric(name, chosen, results))],
        "pair": _pair(back, chosen, results),
    }
    return page(request, "compare.html", context)


def differences(chosen: list[Job]) -> list[tuple[str, list[str]]]:
    """Words of the specs that are not the same in all jobs."""
    specs = [flat(job.spec) for job in chosen]
    names = dict.fromkeys(name for spec in specs for name in spec)
    rows = [(name, [text_of(spec.get(name)) for spec in specs]) for name in names]
    return [(name, values) for name, values in rows if len(set(values)) > 1]


def flat(spec: Mapping[str, Any]) -> dict[str, Any]:
    """A spec without nesting: ``ablation.no_rs``."""
    found: dict[str, Any] = {}
    for name, value in spec.items():
        if isinstance(value, Mapping):
            found |= {f"{name}.{inner}": v for inner, v in value.items()}
        else:
            found[name] = value
    return found


def text_of(value: object) -> str:
    """A value of a spec as people write it."""
    if value is None:
        return "–"
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def _metric(name: str, chosen: list[Job], results: Mapping[str, TableEntry]) -> tuple[str, list[float | None]] | None:
    values = [results[job.id].means.get(name) if job.id in results else None for job in chosen]
    return (name, values) if any(value is not None for value in values) else None


def _pair(back: Backend, chosen: list[Job], results: Mapping[str, TableEntry]) -> dict[str, Any] | None:
    """A view that the first two finished jobs of one subject share."""
    ended = [job for job in chosen if job.id in results]
    for first in ended:
        for second in ended:
            if first.id < second.id and first.subject == second.subject:
                shared = common_view(back, second.id, first.id)
                if shared is not None:
                    return {"ours": second.id, "theirs": first.id, "subject": first.subject, **shared}
    return None
