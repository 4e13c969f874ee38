"""Where the avatar of a job lies, in the words of the process that draws."""

from __future__ import annotations

from typing import Any

from services.api.deps import Backend
from services.errors import ConflictError, NotFoundError
from services.store import artifacts, jobs, subjects
from services.store.records import Job

CHECKPOINT = "checkpoint"


def source_of(back: Backend, job_id: str) -> dict[str, Any]:
    """Spec, checkpoint and subject of a job; of one that still trains, its newest checkpoint.

    Raises:
        NotFoundError: if there is no such job, or its checkpoint's bytes are gone.
        ConflictError: if it has no checkpoint yet.
    """
    job = jobs.get(back.store, job_id)
    trained = job.reused_from or job.id
    kept = next((file for file in artifacts.of_job(back.store, trained) if file.name == CHECKPOINT), None)
    path = back.settings.job_dir(trained) / "checkpoint.safetensors"
    if kept is not None:
        _, path = artifacts.find(back.store, kept.sha256)
    if not path.is_file():
        raise ConflictError("state", "a job that has written a checkpoint", job.state)
    return {
        "spec": dict(job.spec),
        "checkpoint": str(path),
        "subject_dir": subjects.get(back.store, job.subject).path,
        "written": kept.sha256 if kept is not None else path.stat().st_mtime_ns,
    }


def has_source(back: Backend, job: Job) -> bool:
    """Whether the job has an avatar to look at."""
    try:
        source_of(back, job.id)
    except (ConflictError, NotFoundError):
        return False
    return True
