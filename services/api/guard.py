"""What every request passes first: Host and Origin checks, the size limit; and the headers that every reply carries.

Every reply has an id, which the log and the audit name too; an error that nobody foresaw is a problem document as well.

A page of another site can send a browser here under a name of its own (DNS rebinding), so a loopback address alone is
no protection: the Host header must be a name that we know, and a request that changes something must come from us.
"""

from __future__ import annotations

import logging
import re
import uuid
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from services.api.access import SAFE_METHODS
from services.api.problems import problem
from services.settings import LOOPBACK, Settings

CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "font-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": CONTENT_POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=(), payment=(), usb=()",
}
UPLOAD_PATH = "/api/v1/subjects"
ARCHIVES = {  # media types of what may be large, and only there
    "application/zip": "zip",
    "application/x-zip-compressed": "zip",
    "application/gzip": "tar.gz",
    "application/x-gzip": "tar.gz",
}
REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")  # one that a proxy has given is kept

log = logging.getLogger(__name__)


class Guard:
    """Pure ASGI, because a wrapper that buffers would hold event streams back."""

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app = app
        self._hosts = LOOPBACK | {settings.host} | set(settings.allowed_hosts)
        self._limit = settings.max_body_bytes
        self._upload_limit = settings.max_upload_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse, or pass on with a counted body and guarded reply."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        said = headers.get("x-request-id", "")
        request_id = said if REQUEST_ID.fullmatch(said) else str(uuid.uuid4())
        scope.setdefault("state", {})["request_id"] = request_id
        reply = Reply(send, request_id)
        is_upload = scope["path"] == UPLOAD_PATH and archive_kind(headers) is not None
        limit = self._upload_limit if is_upload else self._limit
        refusal = self._refusal(scope["method"], headers, limit)
        if refusal is not None:
            await problem(*refusal)(scope, receive, reply)
            return
        try:
            await self._app(scope, counted(receive, limit), reply)
        except Exception:
            log.exception("%s %s %s", scope["method"], scope["path"], request_id)
            if reply.started:
                raise
            await problem(500, f"an error of the service; its log has the details of request {request_id}")(
                scope, receive, reply
            )

    def _refusal(self, method: str, headers: Headers, limit: int) -> tuple[int, str] | None:
        host = headers.get("host", "")
        if _name(host) not in self._hosts and "*" not in self._hosts:
            return 421, f"Host: expected one of {', '.join(sorted(self._hosts))}, got {host[:100]!r}"
        origin = headers.get("origin")
        if method not in SAFE_METHODS and origin is not None and urlsplit(origin).netloc != host:
            return 403, f"Origin: expected this site, got {origin[:100]!r}"
        length = headers.get("content-length", "0")
        if length.isdecimal() and int(length) > limit:
            return 413, f"body: expected at most {limit} bytes, got {length[:20]}"
        return None


class Reply:
    """The way back: adds the headers, and knows whether anything has been sent."""

    def __init__(self, send: Send, request_id: str) -> None:
        self._send = send
        self._request_id = request_id
        self.started = False

    async def __call__(self, message: Message) -> None:
        """Send one message."""
        if message["type"] == "http.response.start":
            self.started = True
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
            headers.setdefault("cache-control", "no-store")
            headers["x-request-id"] = self._request_id
        await self._send(message)


def counted(receive: Receive, limit: int) -> Receive:
    """``receive``, refusing a body beyond ``limit`` bytes whatever its headers have promised."""
    seen = 0

    async def next_message() -> Message:
        nonlocal seen
        message = await receive()
        seen += len(message.get("body", b""))
        if seen > limit:
            raise HTTPException(413, f"body: expected at most {limit} bytes, got more")
        return message

    return next_message


def archive_kind(headers: Headers) -> str | None:
    """Which kind of archive the body says it is; none for anything else."""
    return ARCHIVES.get(headers.get("content-type", "").partition(";")[0].strip().lower())


def _name(host: str) -> str:
    """The name in a Host header, without the port and without the brackets of IPv6."""
    return (urlsplit(f"//{host}").hostname or "") if host.isascii() and "@" not in host else ""
