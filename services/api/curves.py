"""Curves of one job or of several, side by side; thinned in the store."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from services.api.deps import UUID, Back, JobId
from services.errors import RequestError
from services.store import curves

MOST_JOBS = 20
KEY = r"^[A-Za-z][A-Za-z0-9_.-]{0,63}$"
Keys = Annotated[
    list[Annotated[str, Query(pattern=KEY)]],
    Query(default_factory=list, max_length=16, description="names of curves; none = all"),
]
Points = Annotated[int, Query(ge=curves.LEAST, le=5000, description="most points of one curve")]
JobIds = Annotated[
    list[Annotated[str, Query(pattern=UUID)]], Query(min_length=1, max_length=MOST_JOBS, description="repeat it")
]

router = APIRouter(tags=["metrics"])


@router.get("/jobs/{job_id}/metrics")
def get_metrics(
    job_id: JobId,
    back: Back,
    key: Keys,
    points: Points = curves.POINTS,
) -> dict[str, list[tuple[int, float]]]:
    """Training curves by name: [step, value] pairs, of which every spike is kept."""
    return curves.of_jobs(back.store, [job_id], key, points)[job_id]


@router.get("/compare")
def compare(
    job: JobIds,
    back: Back,
    key: Keys,
    points: Points = 500,
) -> dict[str, dict[str, list[tuple[int, float]]]]:
    """Curves of several jobs by job and name, to be drawn over each other."""
    if len(set(job)) != len(job):
        raise RequestError("job", "every job once", "one of them twice")
    return curves.of_jobs(back.store, job, key, points)
