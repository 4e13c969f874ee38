"""The application: routes, guard and error replies around one backend."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import APIRouter, FastAPI
from fastapi.staticfiles import StaticFiles

from rsavatar import __version__
from services import jobs as wake_up
from services.api import artifacts, catalogue, events, health, jobs, pages, problems, subjects, tables
from services.api.deps import Backend
from services.api.guard import Guard
from services.settings import Settings
from services.store import schema
from services.store.session import Store

PREFIX = "/api/v1"
STATIC = Path(__file__).parent / "static"
NOUNS = (jobs, events, artifacts, catalogue, subjects, tables)
PROBLEM = {"model": problems.Problem, "content": {problems.MEDIA_TYPE: {}}, "description": "refused"}


def create_app(settings: Settings) -> FastAPI:
    """The service over HTTP.

    Raises:
        SchemaError: if the database is not at the version of this code.
    """
    store = Store(settings)
    schema.require_head(store)
    subjects.discover(store, settings.subject_roots)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        store.close()

    app = FastAPI(
        title="rsavatar",
        version=__version__,
        openapi_url=f"{PREFIX}/openapi.json",
        docs_url=None,  # its page loads scripts from elsewhere
        redoc_url=None,
        lifespan=lifespan,
    )
    app.state.backend = Backend(settings, store, wake_up.make_app(settings))
    api = APIRouter(prefix=PREFIX, responses={422: PROBLEM})
    for noun in NOUNS:
        api.include_router(noun.router)
    for router in (api, health.router, pages.router):
        app.include_router(router)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")
    problems.install(app)
    app.add_middleware(Guard, settings=settings)
    return app
