"""Errors as problem documents (RFC 9457): every refusal names what was expected and what was got."""

from __future__ import annotations

import logging
import re
from collections.abc import Awaitable, Callable, Mapping, Sequence
from http import HTTPStatus

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from starlette.exceptions import HTTPException

from rsavatar.errors import SpecError
from services.errors import ConflictError, ForbiddenError, NotFoundError, QuotaError, RequestError, ServiceError
from services.store.session import OUTAGES

MEDIA_TYPE = "application/problem+json"
LONGEST_ECHO = 200  # characters of a refused value that are sent back
STATUS: dict[type[ServiceError], int] = {
    ForbiddenError: 403,
    NotFoundError: 404,
    ConflictError: 409,
    RequestError: 422,
    QuotaError: 429,
}
SENTENCE = re.compile(r"^(?P<name>[^:]{1,80}): expected (?P<expected>.+), got (?P<got>.+)$", re.DOTALL)

log = logging.getLogger(__name__)


class Fault(BaseModel):
    """One refused value."""

    name: str
    expected: str
    got: str


class Problem(BaseModel):
    """An error of the API, as every error is sent."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    errors: list[Fault] = []


def problem(
    status: int, detail: str, faults: Sequence[Fault] = (), headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """A response that carries a problem document."""
    body = Problem(title=HTTPStatus(status).phrase, status=status, detail=detail, errors=list(faults))
    return JSONResponse(body.model_dump(), status, headers, media_type=MEDIA_TYPE)


def from_sentences(text: str) -> list[Fault]:
    """The faults in messages of the shape ``name: expected X, got Y``, joined by ``; ``."""
    found = (SENTENCE.match(sentence) for sentence in text.split("; "))
    return [Fault(**{key: value[:LONGEST_ECHO] for key, value in m.groupdict().items()}) for m in found if m]


async def _service(request: Request, error: Exception) -> Response:
    assert isinstance(error, ServiceError)
    status = next((code for kind, code in STATUS.items() if isinstance(error, kind)), 503)
    return problem(status, str(error), [Fault(name=error.name, expected=error.expected, got=error.got[:LONGEST_ECHO])])


async def _spec(request: Request, error: Exception) -> Response:
    return problem(422, str(error), from_sentences(str(error)))


async def _validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    faults = [
        Fault(
            name=".".join(str(part) for part in e["loc"]),
            expected=e["msg"],
            got=repr(e.get("input"))[:LONGEST_ECHO],
        )
        for e in error.errors()
    ]
    detail = "; ".join(f"{f.name}: expected {f.expected}, got {f.got}" for f in faults)
    return problem(422, detail, faults)


async def _http(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return problem(error.status_code, str(error.detail), headers=error.headers)


async def _outage(request: Request, error: Exception) -> Response:
    log.warning("%s %s: the database is away: %s", request.method, request.url.path, str(error).partition("\n")[0])
    detail = "the database does not answer; nothing is lost, try again in a moment"
    return problem(503, detail, headers={"retry-after": "2"})


async def _unexpected(request: Request, error: Exception) -> Response:
    log.error("%s %s", request.method, request.url.path, exc_info=error)
    return problem(500, "an error of the service; its log has the details")


HANDLERS: dict[type[Exception], Callable[[Request, Exception], Awaitable[Response]]] = {
    ServiceError: _service,
    SpecError: _spec,
    RequestValidationError: _validation,
    HTTPException: _http,
    **dict.fromkeys(OUTAGES, _outage),
    Exception: _unexpected,
}


def install(app: FastAPI) -> None:
    """Answer every error of ``app`` with a problem document."""
    for kind, handler in HANDLERS.items():
        app.add_exception_handler(kind, handler)
