"""Subjects: list them, register a directory, take an archive, forget one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Query, Request, Response
from fastapi import Path as PathPart
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError

from services.api import uploads
from services.api.access import Who
from services.api.deps import Back, Backend
from services.api.recognise import inspect
from services.api.requests import SUBJECT_NAME, SubjectRequest
from services.api.threads import waiters
from services.api.views import SubjectView
from services.errors import ConflictError, RequestError
from services.settings import LOOPBACK, Settings
from services.store import subjects
from services.store.session import Store
from services.store.subject_records import Subject

ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"model": SubjectView, "description": "known already"},
    202: {"model": SubjectView, "description": "unpacked; a worker checks it"},
}
BINARY = {"schema": {"type": "string", "format": "binary"}}
BODIES = {
    "required": True,
    "content": {
        "application/json": {"schema": SubjectRequest.model_json_schema()},
        "application/zip": BINARY,
        "application/gzip": BINARY,
    },
}

router = APIRouter(prefix="/subjects", tags=["subjects"])
Name = Annotated[str, PathPart(max_length=128, pattern=SUBJECT_NAME, description="name of a subject")]
UploadName = Annotated[
    str | None, Query(max_length=128, pattern=SUBJECT_NAME, description="name of the subject in an archive")
]


@router.get("")
def list_subjects(back: Back) -> list[SubjectView]:
    """Registered subjects; ``studio`` is always there."""
    return [SubjectView.of(subject) for subject in subjects.all_of(back.store)]


@router.get("/{name}")
def get_subject(name: Name, back: Back) -> SubjectView:
    """One subject; ``info.report`` says what the check of an uploaded one has found."""
    return SubjectView.of(subjects.look(back.store, name))


@router.post("", status_code=201, responses=ANSWERS, openapi_extra={"requestBody": BODIES})
async def create(request: Request, response: Response, back: Back, who: Who, name: UploadName = None) -> SubjectView:
    """A directory under an allowed root (JSON), or an archive of one (zip, tar.gz; its name in the query).

    On this machine an operator may name any directory. An archive is taken apart and answered with 202; a worker checks
    it before jobs may name it.
    """
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() == "application/json":
        is_operator = not back.settings.needs_token and request.client is not None and request.client.host in LOOPBACK
        body = parse(await request.body())
        subject, is_new = await anyio.to_thread.run_sync(
            register, back, body, who.owner, is_operator, limiter=waiters()
        )
        response.status_code = 201 if is_new else 200
    else:
        if name is None:
            raise RequestError("name", "the subject's name in the query", "none")
        subject = await uploads.receive(request, name, who.owner, back.settings, back.store)
        response.status_code = 202
    response.headers["location"] = f"/api/v1/subjects/{subject.name}"
    return SubjectView.of(subject)


@router.delete("/{name}", status_code=204)
def delete(name: Name, back: Back, who: Who) -> None:
    """Forget a subject that no open job names. The files of an uploaded one are removed; a directory's stay."""
    who.require_owner("subject", subjects.look(back.store, name).owner)
    uploads.discard(subjects.remove(back.store, name), back.settings)


def parse(body: bytes) -> SubjectRequest:
    """The JSON that names a directory.

    Raises:
        RequestValidationError: saying what is wrong with it.
    """
    try:
        return SubjectRequest.model_validate_json(body)
    except ValidationError as error:
        faults = [{**fault, "loc": ("body", *fault["loc"])} for fault in error.errors(include_url=False)]
        raise RequestValidationError(faults) from None


def register(back: Backend, body: SubjectRequest, owner: str, is_operator: bool) -> tuple[Subject, bool]:
    """Make a directory known; the second value says whether it is new."""
    path = allowed_path(back.settings, body.path, is_operator=is_operator)
    kind, info = inspect(path)
    return subjects.add(back.store, Subject(body.name, str(path), kind, info, owner=owner))


def allowed_path(settings: Settings, text: str, *, is_operator: bool) -> Path:
    """The real path of a directory that the caller may register; whether another path exists is not told.

    Raises:
        RequestError: if it is not absolute, not a directory, or outside of the allowed roots.
    """
    roots = tuple(root.resolve() for root in settings.subject_roots)
    wanted = "an absolute path of a directory" if is_operator else "a directory under one of the subject roots"
    if "\0" in text or not Path(text).is_absolute():
        raise RequestError("path", wanted, repr(text))
    path = Path(text).resolve()
    inside = any(path.is_relative_to(root) for root in roots)
    if not (inside or is_operator) or not path.is_dir():
        raise RequestError("path", wanted, repr(text))
    return path


def discover(store: Store, roots: tuple[Path, ...]) -> None:
    """Register every subject that lies directly in a root, by its folder's name; a name that is taken stays."""
    for folder in sorted(path for root in roots if root.is_dir() for path in root.resolve().iterdir()):
        try:
            body = SubjectRequest(name=folder.name, path=str(folder))
            kind, info = inspect(folder)
            subjects.add(store, Subject(body.name, body.path, kind, info))
        except (ValidationError, RequestError, ConflictError):
            continue  # not a subject, not a name, or another's name
