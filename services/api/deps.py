"""What the routes stand on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, cast

from celery import Celery
from fastapi import Depends, Path, Request

from services.api.drawings import Drawings
from services.api.intake import Intake
from services.settings import Settings
from services.store.session import Store

UUID = r"^[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}$"


@dataclass(frozen=True)
class Backend:
    """Settings, database, broker, drawings and intake of one application."""

    settings: Settings
    store: Store
    broker: Celery
    drawings: Drawings
    intake: Intake


async def backend(request: Request) -> Backend:
    """The application's backend. No plain function: that would cost a thread for every request."""
    return cast(Backend, request.app.state.backend)


Back = Annotated[Backend, Depends(backend)]
JobId = Annotated[str, Path(pattern=UUID, description="id of a job")]
