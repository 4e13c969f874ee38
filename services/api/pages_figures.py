"""The gallery of figures: each with its caption, where it comes from, and all its formats."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse

from rsavatar.errors import SpecError
from rsavatar.report.figures import FIGURES
from rsavatar.report.palette import stylesheet
from rsavatar.report.runs import Figure
from services.api.deps import Back, Backend
from services.api.figures import FigureQuery, figure_of
from services.api.layout import PageRoute, page
from services.store import metrics

FORMATS = ("png", "svg", "pdf", "json")

router = APIRouter(route_class=PageRoute)


@dataclass(frozen=True)
class Card:
    """A figure on the page: its address in every format, or what it lacks and how one gets it."""

    figure: Figure
    urls: Mapping[str, str]
    recipe: str
    refused: str = ""


@router.get("/palette.css", response_class=Response)
def palette() -> Response:
    """The colours of methods and shutters, those of the figures."""
    return Response(stylesheet(), media_type="text/css", headers={"cache-control": "private, max-age=3600"})


@router.get("/figures", response_class=HTMLResponse)
def gallery(request: Request, back: Back, query: Annotated[FigureQuery, Query()]) -> HTMLResponse:
    """All figures."""
    cards = [_card(back, name, query) for name in FIGURES]
    context = {"cards": cards, "query": query, "choices": _choices(back, query), "formats": FORMATS}
    return page(request, "figures.html", context)


def _card(back: Backend, name: str, query: FigureQuery) -> Card:
    chosen = query.model_dump(exclude_none=True)
    text = f"?{urlencode(chosen)}" if chosen else ""
    urls = {fmt: f"/api/v1/figures/{name}.{fmt}{text}" for fmt in FORMATS}
    recipe = FIGURES[name].recipe
    try:
        return Card(figure_of(back, name, query.wish()), urls, recipe)
    except SpecError as error:
        return Card(Figure(name, name.replace("-", " ").capitalize()), urls, recipe, str(error))


def _choices(back: Backend, query: FigureQuery) -> dict[str, list[Any]]:
    """What the form offers: presets and subjects with results, cameras and frames of the subject that is shown."""
    entries = metrics.table_entries(back.store)
    subjects = sorted({entry.job.subject for entry in entries})
    own = [entry for entry in entries if entry.job.subject == query.subject]
    scores = metrics.outcome_of(back.store, own[-1].job.id).scores if own else ()
    return {
        "preset": sorted({str(entry.job.spec.get("preset")) for entry in entries}),
        "subject": subjects,
        "camera": sorted({score.camera for score in scores}),
        "frame": sorted({score.frame for score in scores}),
    }
