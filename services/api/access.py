"""Who asks, and what they may: every route stands behind a scope, and the application does not start otherwise.

``BY_VERB`` (on the API's and the pages' routers) asks ``read`` of GET and ``submit`` of everything else; a route for
administrators adds ``dependencies=[ADMIN]``. What needs no token at all is in ``PUBLIC``, and nowhere else.
Everybody with ``read`` sees all jobs of the team; steering one takes its owner or an administrator.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated, Any
from urllib.parse import parse_qs

from fastapi import Depends, FastAPI, Request, Security
from fastapi.routing import iter_route_contexts
from fastapi.security import HTTPBearer
from starlette.exceptions import HTTPException

from services.errors import ForbiddenError
from services.store.tables import LOCAL
from services.store.tokens import Scope, covered

PUBLIC = frozenset({"/healthz", "/readyz", "/login", "/palette.css"})
PUBLIC_FOLDER = "/static/"  # styles and scripts, which the login page needs
SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
FORM = "application/x-www-form-urlencoded"
CHALLENGE = {"www-authenticate": "Bearer"}


@dataclass(frozen=True)
class Caller:
    """Somebody who was let in. ``csrf`` is what a change must repeat when a cookie vouches for the caller."""

    owner: str
    scopes: frozenset[Scope]
    token_id: str | None = None
    csrf: str | None = field(default=None, repr=False)

    def may(self, scope: Scope) -> bool:
        """Whether the caller has ``scope``."""
        return scope in self.scopes

    def require_owner(self, what: str, owner: str) -> None:
        """Refuse to change what belongs to somebody else.

        Raises:
            ForbiddenError: unless ``owner`` is the caller, or the caller is an administrator.
        """
        if self.owner != owner and not self.may(Scope.ADMIN):
            raise ForbiddenError(what, f"one of your own ({self.owner}), or scope admin", f"one of {owner}")


EVERYTHING = covered([Scope.ADMIN])
ON_THIS_MACHINE = Caller(LOCAL, EVERYTHING)  # without tokens, whoever reaches loopback is the operator


def csrf_of(secret: str) -> str:
    """What forms of a session repeat: our pages show it, and a cookie that a browser was made to send does not."""
    return hmac.new(secret.encode(), b"csrf", hashlib.sha256).hexdigest()


def caller_of(request: Request) -> Caller:
    """The caller, as the gate has found it.

    Raises:
        HTTPException: 401, if nobody has been let in.
    """
    caller = getattr(request.state, "caller", None)
    if not isinstance(caller, Caller):
        raise HTTPException(401, "token: expected a bearer token or a login, got none", CHALLENGE)
    return caller


async def known_caller(request: Request) -> Caller:
    """``caller_of`` as a dependency: a plain function would cost a thread for every request."""
    return caller_of(request)


Who = Annotated[Caller, Depends(known_caller)]


Shown = Annotated[object, Security(HTTPBearer(auto_error=False, description="rsavatar token create"))]  # in OpenAPI


@dataclass(frozen=True)
class Needs:
    """A dependency that lets in who has a scope: ``looking`` to change nothing, ``changing`` for all else."""

    looking: Scope
    changing: Scope

    async def __call__(self, request: Request, bearer: Shown) -> None:
        """Let the caller pass.

        Raises:
            HTTPException: 401 if nobody has been let in.
            ForbiddenError: if the scope, or the proof that a form is ours, is missing.
        """
        is_safe = request.method in SAFE_METHODS
        if is_safe and is_public(request.url.path):
            return
        caller = caller_of(request)
        wanted = self.looking if is_safe else self.changing
        if not caller.may(wanted):
            raise ForbiddenError("token", f"scope {wanted}", ", ".join(sorted(caller.scopes)) or "none")
        if not is_safe and caller.csrf is not None and not await _repeats(request, caller.csrf):
            raise ForbiddenError("X-CSRF-Token", "the value on the page that was sent to you", "another or none")


BY_VERB = Depends(Needs(Scope.READ, Scope.SUBMIT))
READ = Depends(Needs(Scope.READ, Scope.READ))
ADMIN = Depends(Needs(Scope.ADMIN, Scope.ADMIN))


async def _repeats(request: Request, csrf: str) -> bool:
    said = request.headers.get("x-csrf-token", "")
    if not said and request.headers.get("content-type", "").startswith(FORM):
        said = (await read_form(request)).get("csrf", "")
    return hmac.compare_digest(said.encode(), csrf.encode())


async def read_form(request: Request) -> dict[str, str]:
    """Fields of a plain form, each by its last value; what is no text counts as none."""
    text = (await request.body()).decode("utf-8", "replace")
    return {key: values[-1] for key, values in parse_qs(text, keep_blank_values=True, max_num_fields=100).items()}


def is_public(path: str) -> bool:
    """Whether a path is served to everybody."""
    return path in PUBLIC or path.startswith(PUBLIC_FOLDER)


def scopes_of(dependant: Any) -> set[Scope]:
    """Scopes that the dependencies of a route ask for."""
    found: set[Scope] = set()
    for each in dependant.dependencies:
        if isinstance(each.call, Needs):
            found |= {each.call.looking, each.call.changing}
        found |= scopes_of(each)
    return found


def unguarded(app: FastAPI) -> Iterable[str]:
    """Paths that have no scope and are not public."""
    for route in iter_route_contexts(app.routes):
        path, dependant = str(route.path), getattr(route, "dependant", None)
        if is_public(f"{path}/" if path == PUBLIC_FOLDER.rstrip("/") else path):
            continue
        if dependant is None or not scopes_of(dependant):
            yield path


def require_scopes(app: FastAPI) -> None:
    """Refuse to serve a route that nobody has given a scope.

    Raises:
        RuntimeError: naming the paths.
    """
    if paths := sorted(unguarded(app)):
        raise RuntimeError(f"routes: expected a scope (see services/api/access.py), got none for {', '.join(paths)}")
