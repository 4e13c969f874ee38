"""The avatar's page: the Gaussians in the browser, the same body under every shutter, files to take away."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import urlencode

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from services.api.deps import Back, JobId
from services.api.guard import CONTENT_POLICY
from services.api.layout import PageRoute, page
from services.api.render import Look
from services.api.sources import has_source
from services.api.views import JobDetail
from services.store import jobs

POLICY = f"{CONTENT_POLICY}; media-src 'self'"  # the turntable
SHUTTERS = (
    ("global", "Global", "all rows at one instant"),
    ("blur", "Blur", "the mean over the readout"),
    ("rolling", "Rolling", "every row at its own instant"),
)
SHOWN = 448  # pixels of the pictures that the page starts with

router = APIRouter(route_class=PageRoute)


@router.get("/jobs/{job_id}/viewer", response_class=HTMLResponse)
def viewer_page(request: Request, job_id: JobId, back: Back, query: Annotated[Look, Query()]) -> HTMLResponse:
    """The avatar of one job. Without scripts it is a form and three pictures."""
    job = jobs.get(back.store, job_id)
    base = f"/api/v1/jobs/{job_id}"
    shown = query.model_dump(exclude_defaults=True, exclude={"background"}) | {"size": SHOWN}
    pictures = [
        {"name": name, "title": title, "words": words, "url": f"{base}/render?{urlencode({**shown, 'shutter': name})}"}
        for name, title, words in SHUTTERS
    ]
    context = {
        "job": JobDetail.of(job),
        "ready": has_source(back, job),
        "look": query,
        "pictures": pictures,
        "base": base,
    }
    response = page(request, "viewer.html", context)
    response.headers["content-security-policy"] = POLICY
    return response
