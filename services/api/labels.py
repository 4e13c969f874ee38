"""Labels of jobs: notes, tags, priority; and what a list can be filtered and sorted by."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from services.api.access import Who
from services.api.deps import Back, JobId
from services.api.views import JobDetail
from services.store import filters, jobs, labels, listing
from services.store.labels import Change

Tag = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]

router = APIRouter(tags=["jobs"])


class LabelRequest(BaseModel):
    """What to write on a job; what is not named stays as it is. ``tags`` replaces all tags."""

    model_config = ConfigDict(extra="forbid")

    notes: str | None = Field(None, max_length=10_000)
    tags: list[Tag] | None = Field(None, max_length=50)
    priority: int | None = Field(None, ge=-10, le=10, description="of a job that has not ended")


class FieldView(BaseModel):
    """A field of the filter language."""

    name: str
    about: str


class FilterHelp(BaseModel):
    """What ``q`` and ``sort`` of a job list understand."""

    fields: list[FieldView]
    sorts: list[str]
    example: str


@router.patch("/jobs/{job_id}")
def label(job_id: JobId, request: LabelRequest, back: Back, who: Who) -> JobDetail:
    """Write notes, tags or another priority on a job of one's own."""
    who.require_owner("job", jobs.get(back.store, job_id).owner)
    job = labels.change(back.store, job_id, Change(request.notes, request.tags, request.priority))
    return JobDetail.of(job, labels.tags_of_job(back.store, job_id))


@router.get("/tags")
def list_tags(back: Back) -> dict[str, int]:
    """Tags and on how many jobs they are, the commonest first."""
    return labels.all_tags(back.store)


@router.get("/filters")
def explain() -> FilterHelp:
    """The words of ``GET /jobs?q=...&sort=...``."""
    fields = [FieldView(name=name, about=field.about) for name, field in filters.FIELDS.items()]
    example = 'state:failed,dead method:rs-avatar (psnr>25 or not tag:paper) created<2d notes:"*blur*"'
    return FilterHelp(
        fields=fields, sorts=[f"{sign}{key}" for key in listing.SORTS for sign in ("", "-")], example=example
    )
