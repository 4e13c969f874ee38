"""The application: routes, guard and error replies around one backend."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import APIRouter, FastAPI
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry
from starlette.middleware.gzip import GZipMiddleware

from rsavatar import __version__
from services import jobs as wake_up
from services.api import (
    artifacts,
    audit,
    catalogue,
    curves,
    events,
    figures,
    frames,
    grids,
    health,
    jobs,
    labels,
    login,
    owners,
    pages,
    problems,
    render,
    subjects,
    tables,
    threads,
    tokens,
    uploads,
    vendor,
)
from services.api.access import BY_VERB, require_scopes
from services.api.deps import Backend
from services.api.drawings import Drawings
from services.api.gate import Gate
from services.api.guard import Guard
from services.api.intake import Intake
from services.api.trail import Trail, latencies, routes_by_endpoint
from services.settings import ROOT, Settings
from services.store import benchmarks, schema
from services.store.session import Store

PREFIX = "/api/v1"
STATIC = Path(__file__).parent / "static"
SHIPPED = ROOT / "docs" / "benchmarks"
NOUNS = (
    jobs,
    labels,
    curves,
    frames,
    grids,
    events,
    artifacts,
    catalogue,
    subjects,
    tables,
    tokens,
    owners,
    audit,
    render,
    figures,
)
PROBLEM = {"model": problems.Problem, "content": {problems.MEDIA_TYPE: {}}, "description": "refused"}


def create_app(settings: Settings) -> FastAPI:
    """The service over HTTP.

    Raises:
        SchemaError: if the database is not at the version of this code.
    """
    store = Store(settings)
    schema.require_head(store)
    subjects.discover(store, settings.subject_roots)
    benchmarks.discover(store, SHIPPED)
    uploads.remove_leftovers(settings, store)

    drawings = Drawings(settings)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        threads.limit()
        yield
        drawings.close()
        store.close()

    app = FastAPI(
        title="rsavatar",
        version=__version__,
        openapi_url=None,  # a route of its own, which stands behind a scope like the others
        docs_url=None,  # its page loads scripts from elsewhere
        redoc_url=None,
        lifespan=lifespan,
    )
    broker = wake_up.make_app(settings)
    intake = Intake(store, broker, settings.max_attempts)
    app.state.backend = Backend(settings, store, broker, drawings, intake)
    app.state.registry = CollectorRegistry()
    _add_routes(app)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    problems.install(app)
    require_scopes(app)
    app.add_middleware(GZipMiddleware, minimum_size=2048, compresslevel=6)  # pictures and streams are left alone
    app.add_middleware(Gate, settings=settings, store=store)  # the last added is the outermost
    app.add_middleware(Trail, store=store, histogram=latencies(app.state.registry), routes=routes_by_endpoint(app))
    app.add_middleware(Guard, settings=settings)
    return app


def _add_routes(app: FastAPI) -> None:
    """Every router, each behind its scope."""
    api = APIRouter(prefix=PREFIX, responses=dict.fromkeys((401, 403, 422, 429), PROBLEM), dependencies=[BY_VERB])
    for noun in NOUNS:
        api.include_router(noun.router)

    @api.get("/openapi.json", include_in_schema=False)
    def openapi() -> JSONResponse:
        """What this interface takes and gives, as OpenAPI."""
        return JSONResponse(app.openapi())

    app.include_router(api)
    app.include_router(pages.router, dependencies=[BY_VERB])
    for router in (health.router, login.router, vendor.router):
        app.include_router(router)
