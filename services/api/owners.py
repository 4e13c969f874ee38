"""Owners: how many of their jobs may wait and run, and their share of the workers. For administrators."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path
from pydantic import BaseModel, ConfigDict, Field

from services.api.access import ADMIN
from services.api.deps import Back
from services.api.tokens import NAME
from services.store import owners

MOST = 1_000_000  # jobs
Limit = Annotated[int, Field(ge=0, le=MOST)]

router = APIRouter(prefix="/owners", tags=["owners"], dependencies=[ADMIN])
OwnerName = Annotated[str, Path(min_length=1, max_length=64, pattern=NAME, description="as tokens name it")]


class Allowance(BaseModel):
    """What an owner may have. Null = the service's own limit, 0 = no limit."""

    model_config = ConfigDict(extra="forbid")

    max_running: Limit | None = Field(None, description="jobs that run at a time")
    max_queued: Limit | None = Field(None, description="jobs that wait")
    share: float = Field(1.0, gt=0, le=1000, description="of the workers, while others have work too")


class OwnerView(Allowance):
    """An owner."""

    name: str


@router.get("")
def list_owners(back: Back) -> list[OwnerView]:
    """Everybody who has ever submitted a job or been given limits."""
    return [OwnerView(**vars(owner)) for owner in owners.all_of(back.store)]


@router.put("/{name}")
def put_owner(name: OwnerName, allowance: Allowance, back: Back) -> OwnerView:
    """Set an owner's limits and share; they hold from the next submission and the next claim on."""
    owner = owners.Owner(name, **allowance.model_dump())
    owners.put(back.store, owner)
    return OwnerView(**vars(owner))
