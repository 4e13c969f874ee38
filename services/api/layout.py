"""What all pages share: templates, navigation, the error page, and a policy that lets charts draw."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any

from fastapi import Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse
from fastapi.routing import APIRoute
from fastapi.templating import Jinja2Templates
from starlette.exceptions import HTTPException

from rsavatar import __version__
from rsavatar.catalog import DESCRIPTIONS
from rsavatar.report.tables import LABELS
from services.api.guard import CONTENT_POLICY
from services.api.problems import STATUS
from services.errors import ServiceError

NAV = (
    ("/", "Overview"),
    ("/jobs", "Jobs"),
    ("/grids", "Grids"),
    ("/figures", "Figures"),
    ("/benchmarks", "Benchmarks"),
    ("/subjects", "Subjects"),
)
CHART_POLICY = CONTENT_POLICY.replace("style-src 'self'", "style-src 'self' 'unsafe-inline'").replace(
    "img-src 'self'", "img-src 'self' data: blob:"
)  # the chart library writes its own style sheet, and saves pictures
MINUTE, HOUR, DAY = 60.0, 3600.0, 86400.0
BINARY = 1024.0

templates = Jinja2Templates(Path(__file__).parent / "templates")
templates.env.trim_blocks = templates.env.lstrip_blocks = True


def duration(seconds: float | None) -> str:
    """Seconds for people: ``8 s``, ``4 min 10 s``, ``2 h 5 min``."""
    if seconds is None or seconds < 0:
        return "–"
    if seconds < MINUTE:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    if seconds < HOUR:
        minutes, rest = divmod(round(seconds), 60)
        return f"{minutes} min {rest} s" if rest else f"{minutes} min"
    if seconds < DAY:
        hours, rest = divmod(round(seconds / MINUTE), 60)
        return f"{hours} h {rest} min" if rest else f"{hours} h"
    return f"{seconds / DAY:.1f} days"


def size(count: float | None) -> str:
    """Bytes for people."""
    if count is None:
        return "–"
    for unit in ("B", "KB", "MB", "GB"):
        if count < BINARY:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 100 else f"{count:.1f} {unit}"
        count /= BINARY
    return f"{count:.1f} TB"


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}"


def whole(value: float | None) -> str:
    """A whole number in groups of three, separated by thin spaces."""
    return "–" if value is None else f"{value:,.0f}".replace(",", "\u202f")


def label(method: str) -> str:
    """What a method is called in tables."""
    return LABELS.get(method, method)


def short(job_id: str) -> str:
    """The end of an id: enough to tell jobs apart, and the part that is random."""
    return job_id[-8:]


FILTERS: dict[str, Callable[..., str]] = {
    "duration": duration,
    "size": size,
    "number": number,
    "whole": whole,
    "label": label,
    "short": short,
    "about": lambda method: DESCRIPTIONS.get(method, ""),
}
templates.env.filters.update(FILTERS)


def page(
    request: Request, name: str, context: Mapping[str, Any], *, charts: bool = False, status: int = 200
) -> HTMLResponse:
    """A page; ``charts`` relaxes its policy as far as the chart library needs."""
    path = request.url.path
    here = next((url for url, _ in reversed(NAV) if path == url or (url != "/" and path.startswith(url))), None)
    caller = getattr(request.state, "caller", None)
    shared = {"nav": NAV, "here": here, "newest": 0, "version": __version__, "csrf": getattr(caller, "csrf", None)}
    whole_context = {**shared, "caller": caller, **context}
    response = templates.TemplateResponse(request, name, whole_context, status_code=status)
    if charts:
        response.headers["content-security-policy"] = CHART_POLICY
    return response


class PageRoute(APIRoute):
    """A route whose refusals are pages too."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler, with errors shown to people."""
        handle = super().get_route_handler()

        async def shown(request: Request) -> Response:
            try:
                return await handle(request)
            except RequestValidationError as error:
                faults = error.errors()
                detail = "; ".join(f"{'.'.join(map(str, f['loc'][1:]))}: {f['msg'].lower()}" for f in faults)
                return error_page(request, 422, detail)
            except ServiceError as error:
                return error_page(
                    request, next((c for k, c in STATUS.items() if isinstance(error, k)), 503), str(error)
                )
            except HTTPException as error:
                if error.status_code in {401, 403} or error.status_code < 400:
                    raise
                return error_page(request, error.status_code, str(error.detail))

        return shown


ADVICE = {
    404: "It may have been removed, or the address was cut off when it was copied. The lists below are complete.",
    409: "The state has changed since the page was drawn. Load it again to see where things stand.",
    422: "Part of the address is not what this page takes. Start again from one of the lists.",
    503: "The service cannot reach its database or broker. /readyz says which; the jobs in the queue are safe.",
}


def error_page(request: Request, status: int, detail: str) -> HTMLResponse:
    """A refusal that says what to do."""
    title = HTTPStatus(status).phrase.capitalize()
    advice = ADVICE.get(status, "Load the page again; if it stays, the service's log has the details.")
    context = {"status": status, "title": title, "detail": detail, "advice": advice}
    return page(request, "error.html", context, status=status)
