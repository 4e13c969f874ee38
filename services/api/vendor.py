"""Plotly's script from its own package, compressed once. Its address carries its version, so it is kept for ever."""

from __future__ import annotations

import gzip
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

from fastapi import APIRouter, Request, Response

from services.errors import NotFoundError

CACHE = "public, max-age=31536000, immutable"

router = APIRouter(prefix="/static/vendor", include_in_schema=False)


@cache
def script() -> Path | None:
    """Where the installed package keeps its script; none where it is not installed."""
    found = find_spec("plotly")
    folders = [] if found is None else (found.submodule_search_locations or [])
    return next((p for p in (Path(f) / "package_data" / "plotly.min.js" for f in folders) if p.is_file()), None)


@cache
def address() -> str | None:
    """The script's address; none where pages must do without charts."""
    try:
        return f"/static/vendor/plotly-{version('plotly')}.min.js" if script() else None
    except PackageNotFoundError:
        return None


@cache
def compressed() -> bytes:
    """The script in gzip; the same bytes from every replica."""
    path = script()
    assert path is not None
    return gzip.compress(path.read_bytes(), 6, mtime=0)


@router.get("/plotly-{number}.min.js", response_class=Response)
def plotly(number: str, request: Request) -> Response:
    """The chart library, compressed for whoever takes it so."""
    if request.url.path != address():
        raise NotFoundError("script", address() or "plotly, which is not installed", request.url.path)
    if "gzip" in request.headers.get("accept-encoding", ""):
        return _script(compressed(), {"content-encoding": "gzip"})
    return _script(gzip.decompress(compressed()), {})


def _script(data: bytes, headers: dict[str, str]) -> Response:
    headers |= {"cache-control": CACHE, "vary": "accept-encoding"}
    return Response(data, media_type="text/javascript", headers=headers)
