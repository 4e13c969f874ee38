"""Jobs: submit, list, look at, steer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

from fastapi import APIRouter, Header, Query, Response
from fastapi.responses import PlainTextResponse

from services import jobs as wake_up
from services.api.access import Who
from services.api.deps import Back, JobId
from services.api.intake import Wish
from services.api.lines import page_of
from services.api.requests import JobQuery, JobRequest, checked_key
from services.api.views import ArtifactView, JobDetail, JobPage, ResultView
from services.store import artifacts, jobs, labels, listing, metrics
from services.store.records import Filters, Job, State
from services.store.session import Store

LOG_BYTES = 65_536
Verb = Literal["cancel", "pause", "resume", "retry"]
VERBS: dict[str, Callable[[Store, str], Job]] = {
    "cancel": jobs.cancel,
    "pause": jobs.pause,
    "resume": jobs.resume,
    "retry": jobs.retry,
}

router = APIRouter(prefix="/jobs", tags=["jobs"])


KNOWN = {"model": JobDetail, "description": "the key's earlier job, or a known result"}


@router.post("", status_code=202, responses={200: KNOWN})
async def submit(
    request: JobRequest,
    response: Response,
    back: Back,
    who: Who,
    force: Annotated[bool, Query(description="run it even if a job of the same spec, data and code has")] = False,
    idempotency_key: Annotated[str | None, Header(description="repeat it to repeat a request safely")] = None,
) -> JobDetail:
    """Accept a job: 202 and its place. A repeated Idempotency-Key gives the first job back, 200; so does a result
    that is known: the new job has ended with it, and ``reused_from`` says whose it is.
    """
    key = checked_key(idempotency_key)
    wish = Wish(request.resolve(), request.sha256(), who.owner, key, force)
    job, is_new = await back.intake.submit(wish)
    response.status_code = 202 if is_new and job.state == State.QUEUED else 200
    response.headers["location"] = f"/api/v1/jobs/{job.id}"
    return JobDetail.of(job)


@router.get("", response_model=JobPage)
def list_jobs(query: Annotated[JobQuery, Query()], back: Back) -> Response:
    """Jobs, newest first unless sorted otherwise; ``q`` is explained by ``GET /filters``."""
    filters = Filters(query.state, query.method, query.subject, query.grid, query.q)
    order = listing.Order(query.sort.removeprefix("-"), query.sort.startswith("-"))
    found = listing.lines(back.store, filters, order, query.cursor, query.limit + 1)
    shown = found[: query.limit]
    next_cursor = None if len(found) <= query.limit else str(shown[-1]["id"])
    return Response(page_of(shown, next_cursor), media_type="application/json")


@router.get("/{job_id}")
def get_job(job_id: JobId, back: Back) -> JobDetail:
    """One job with its complete spec."""
    return JobDetail.of(jobs.get(back.store, job_id), labels.tags_of_job(back.store, job_id))


@router.post("/{job_id}/{verb}", status_code=202)
def steer(job_id: JobId, verb: Verb, back: Back, who: Who) -> JobDetail:
    """Cancel, pause, resume or retry a job of one's own. A running one is asked, and leaves a checkpoint."""
    who.require_owner("job", jobs.get(back.store, job_id).owner)
    job = VERBS[verb](back.store, job_id)
    if job.state == State.QUEUED:
        wake_up.enqueue(back.broker, job.id)
    return JobDetail.of(job)


@router.get("/{job_id}/results")
def get_results(job_id: JobId, back: Back) -> ResultView:
    """What a succeeded job found; 409 for any other."""
    return ResultView.of(metrics.outcome_of(back.store, job_id))


@router.get("/{job_id}/artifacts")
def get_artifacts(job_id: JobId, back: Back) -> list[ArtifactView]:
    """Files of a job."""
    return [ArtifactView.of(artifact) for artifact in artifacts.of_job(back.store, job_id)]


@router.get("/{job_id}/log", response_class=PlainTextResponse)
def get_log(
    job_id: JobId,
    back: Back,
    offset: Annotated[int | None, Query(ge=0, description="byte to read from; none = the end")] = None,
) -> PlainTextResponse:
    """Up to 64 KiB of the log; ``X-Next-Offset`` says where to go on."""
    jobs.get(back.store, job_id)
    path = back.settings.job_dir(job_id) / "log.txt"
    if not path.is_file():
        return PlainTextResponse("", headers={"x-next-offset": "0"})
    with path.open("rb") as file:
        size = file.seek(0, 2)
        start = max(0, size - LOG_BYTES) if offset is None else min(offset, size)
        file.seek(start)
        block = file.read(LOG_BYTES)
    text = block.decode("utf-8", "replace")
    return PlainTextResponse(text, headers={"x-next-offset": str(start + len(block))})
