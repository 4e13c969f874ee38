"""The gate: finds out who asks, before any route. Nobody passes without a token, unless the path is public.

Plain ASGI around the whole application, so that a mount or a route that somebody adds beside the routers is behind it
too. What a caller may do is asked by the routes (``services.api.access``).
"""

from __future__ import annotations

import math
from http.cookies import CookieError, SimpleCookie
from typing import NamedTuple
from urllib.parse import quote

import anyio
from starlette.datastructures import Headers
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from services.api.access import CHALLENGE, ON_THIS_MACHINE, Caller, csrf_of, is_public
from services.api.limits import Limiter, Pace
from services.api.problems import problem
from services.settings import Settings
from services.store import tokens
from services.store.session import Store

COOKIE = "rsavatar_session"
STRANGERS = Pace(rate=0.5, burst=20)  # wrong tokens of one address


class Credential(NamedTuple):
    """A secret that came with a request, and whether a browser sent it by itself."""

    secret: str
    by_cookie: bool


class Gate:
    """Puts the caller into the request's state, or refuses."""

    def __init__(self, app: ASGIApp, settings: Settings, store: Store) -> None:
        self._app = app
        self._settings = settings
        self._store = store
        self._limiter = Limiter(settings)
        self._pace = Pace(settings.requests_per_second, settings.request_burst)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let in or refuse."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # nothing here speaks WebSocket; leaving without an answer refuses it
        headers = Headers(scope=scope)
        credential = credential_of(headers)
        if credential is None and not self._settings.needs_token:
            scope.setdefault("state", {})["caller"] = ON_THIS_MACHINE
            await self._app(scope, receive, send)
            return
        address = scope["client"][0] if scope.get("client") else "unknown"
        found = await anyio.to_thread.run_sync(self._judge, credential, address, is_public(scope["path"]))
        if isinstance(found, Caller):
            scope.setdefault("state", {})["caller"] = found
        elif found is not None:
            refusal = (found.status_code == 401 and to_login(scope, headers)) or found
            await refusal(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _judge(self, credential: Credential | None, address: str, public: bool) -> Caller | Response | None:
        """The caller, a refusal, or nobody where nobody is needed. Runs in a thread: it asks the database."""
        token = None if credential is None else tokens.find(self._store, credential.secret)
        if credential is not None and token is not None:
            if self._settings.needs_token and (wait := self._limiter.wait(f"token:{token.id}", self._pace)):
                return too_many(wait)
            csrf = csrf_of(credential.secret) if credential.by_cookie else None
            return Caller(token.owner, tokens.covered(token.scopes), token.id, csrf)
        if credential is not None and credential.by_cookie and not self._settings.needs_token:
            return ON_THIS_MACHINE  # a session of former days
        if public:
            return None
        if wait := self._limiter.wait(f"address:{address}", STRANGERS):
            return too_many(wait)
        got = "none" if credential is None else "one that is unknown, expired or revoked"
        return problem(401, f"token: expected a bearer token or a login, got {got}", headers=CHALLENGE)


def credential_of(headers: Headers) -> Credential | None:
    """The bearer token, else the session cookie, else nothing."""
    kind, _, secret = headers.get("authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return Credential(secret.strip(), by_cookie=False)
    cookies = headers.get("cookie", "")
    if COOKIE not in cookies:
        return None
    try:
        cookie = SimpleCookie(cookies).get(COOKIE)
    except CookieError:
        return None
    return None if cookie is None else Credential(cookie.value, by_cookie=True)


def to_login(scope: Scope, headers: Headers) -> Response | None:
    """Where a browser that asks for a page is sent."""
    is_page = scope["method"] == "GET" and not scope["path"].startswith("/api/")
    if not is_page or "text/html" not in headers.get("accept", ""):
        return None
    return RedirectResponse(f"/login?next={quote(scope['path'], safe='/')}", 303)


def too_many(wait: float) -> Response:
    """The refusal of a caller who asks too often."""
    after = {"retry-after": str(math.ceil(wait))}
    return problem(429, f"requests: expected a pause of {wait:.1f} s, got one more", headers=after)
