"""The audit log, for administrators."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Query
from pydantic import BaseModel

from services.api.access import ADMIN
from services.api.deps import Back
from services.api.views import instant
from services.store import audit

LARGEST_ID = 2**63 - 1

router = APIRouter(prefix="/audit", tags=["audit"], dependencies=[ADMIN])


class RecordView(BaseModel):
    """One request that wanted to change something."""

    id: int
    at: datetime | None
    actor: str
    token_id: str | None
    verb: str
    object: str
    outcome: str
    status: int | None
    ip: str | None
    request_id: str | None
    detail: dict[str, Any]
    previous_sha256: str
    sha256: str

    @classmethod
    def of(cls, record: audit.Record) -> RecordView:
        """The view of a record."""
        chain = {"previous_sha256": record.previous_sha256, "sha256": record.sha256}
        return cls(id=record.id, at=instant(record.at), **vars(record.entry), **chain)


class AuditPage(BaseModel):
    """Records, newest first; ``next_cursor`` is none on the last page."""

    items: list[RecordView]
    next_cursor: int | None


class VerdictView(BaseModel):
    """Whether the chain is whole; ``broken_at`` is the first record that does not fit. Keep ``head`` elsewhere."""

    whole: bool
    rows: int
    head: str
    broken_at: int | None


@router.get("")
def list_records(
    back: Back,
    cursor: Annotated[int | None, Query(ge=1, le=LARGEST_ID, description="next_cursor of the page before")] = None,
    actor: Annotated[str | None, Query(max_length=64)] = None,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
) -> AuditPage:
    """Who wanted to change what, and what became of it; newest first."""
    found = audit.page(back.store, cursor, limit + 1, actor)
    shown = found[:limit]
    more = len(found) > limit
    return AuditPage(items=[RecordView.of(r) for r in shown], next_cursor=shown[-1].id if more else None)


@router.get("/verify")
def verify(back: Back) -> VerdictView:
    """Walk the hash chain from its beginning."""
    verdict = audit.verify(back.store)
    return VerdictView(whole=verdict.broken_at is None, **vars(verdict))
