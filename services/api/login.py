"""Browsers log in with a token and get a session: a cookie that scripts cannot read and other sites cannot use."""

from __future__ import annotations

from urllib.parse import urlsplit

import anyio
from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse

from services.api.access import READ, Caller, Who, read_form
from services.api.deps import Back
from services.api.gate import COOKIE
from services.api.layout import page
from services.store import tokens

HOUR = 3600

router = APIRouter(include_in_schema=False)


def safe_next(target: str) -> str:
    """A path of this site, whatever the address bar said."""
    parts = urlsplit(target)
    is_ours = target.startswith("/") and not target.startswith(("//", "/\\")) and not parts.netloc
    return target if is_ours and target.isprintable() and "\\" not in target else "/"


@router.get("/login", response_class=HTMLResponse)
def show_login(request: Request) -> HTMLResponse:
    """The page that asks for a token."""
    return ask(request, safe_next(request.query_params.get("next", "/")))


def ask(request: Request, target: str, *, wrong: bool = False) -> HTMLResponse:
    """The form, again where the token was wrong. It leads nowhere else before somebody is let in."""
    context = {"next": target, "wrong": wrong, "nav": None}
    return page(request, "login.html", context, status=401 if wrong else 200)


@router.post("/login", response_class=HTMLResponse)
async def log_in(request: Request, back: Back) -> Response:
    """Open a session for a valid token, and go where the browser wanted to."""
    form = await read_form(request)
    target, secret = safe_next(form.get("next", "/")), form.get("token", "").strip()
    token = await anyio.to_thread.run_sync(tokens.find, back.store, secret)
    if token is None or token.name.startswith(tokens.SESSION):
        return ask(request, target, wrong=True)
    request.state.caller = Caller(token.owner, tokens.covered(token.scopes), token.id)  # for the audit log
    seconds = back.settings.session_hours * HOUR
    _, session = await anyio.to_thread.run_sync(tokens.open_session, back.store, token, seconds)
    reply = RedirectResponse(target, 303)
    reply.set_cookie(
        COOKIE, session, int(seconds), httponly=True, samesite="strict", secure=request.url.scheme == "https"
    )
    return reply


@router.post("/logout", response_class=RedirectResponse, dependencies=[READ])
def log_out(who: Who, back: Back) -> Response:
    """End the session at once."""
    if who.csrf is not None and who.token_id is not None:
        tokens.revoke(back.store, who.token_id)
    reply = RedirectResponse("/login", 303)
    reply.delete_cookie(COOKIE, httponly=True, samesite="strict")
    return reply
