"""Subjects: list them, register a directory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response
from pydantic import ValidationError

from services.api.deps import Back
from services.api.requests import SubjectRequest
from services.api.views import SubjectView
from services.errors import ConflictError, RequestError
from services.settings import LOOPBACK, Settings
from services.store import subjects
from services.store.records import Subject
from services.store.session import Store

router = APIRouter(prefix="/subjects", tags=["subjects"])


@router.get("")
def list_subjects(back: Back) -> list[SubjectView]:
    """Registered subjects; ``studio`` is always there."""
    return [SubjectView.of(subject) for subject in subjects.all_of(back.store)]


@router.post("", status_code=201, responses={200: {"model": SubjectView, "description": "known already"}})
def register(body: SubjectRequest, request: Request, response: Response, back: Back) -> SubjectView:
    """Register a directory under an allowed root; on this machine, an operator may name any directory."""
    is_operator = request.client is not None and request.client.host in LOOPBACK and not back.settings.needs_token
    path = allowed_path(back.settings, body.path, is_operator=is_operator)
    kind, info = inspect(path)
    subject, is_new = subjects.add(back.store, Subject(body.name, str(path), kind, info))
    response.status_code = 201 if is_new else 200
    return SubjectView.of(subject)


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


def inspect(path: Path) -> tuple[str, dict[str, Any]]:
    """Layout of a subject by its names alone: what the files hold is checked when a job loads them.

    Raises:
        RequestError: if neither layout is there.
    """
    if (path / "rs" / "annots.npy").is_file():
        return "rolling", {"truth": (path / "truth" / "motion.npz").is_file()}
    if (path / "annots.npy").is_file():
        return "zju", {}
    raise RequestError("path", "a subject: rs/annots.npy (rolling shutter) or annots.npy (ZJU-MoCap-refine)", str(path))
