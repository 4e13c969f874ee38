"""Bearer tokens: 256 random bits, of which only the SHA-256 is kept. A browser's session is a short-lived one."""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from sqlalchemy import delete, func, or_, select, text, update
from sqlalchemy.orm import Session

from services.errors import NotFoundError, RequestError
from services.store.ids import new_id
from services.store.session import Store, db_now
from services.store.tables import TokenRow

SHAPE = re.compile(r"rsa_(?P<prefix>[0-9a-f]{8})_[A-Za-z0-9_-]{43}")
SESSION = "session:"  # name of a session: this and the id of the token that opened it
FIRST_TOKEN_LOCK = 7_261_002  # any number, the same for all that issue the first token
FRESH_SECONDS = 60.0  # how exactly the last use is known; each note of it is a write
DAY = 86_400.0


class Scope(StrEnum):
    """What a token allows. ``admin`` covers ``submit``, which covers ``read``."""

    READ = "read"
    SUBMIT = "submit"
    ADMIN = "admin"


def covered(scopes: Iterable[str]) -> frozenset[Scope]:
    """The scopes that are granted together with ``scopes``."""
    order = list(Scope)
    return frozenset(weaker for scope in scopes for weaker in order[: order.index(Scope(scope)) + 1])


@dataclass(frozen=True)
class Token:
    """A token without its secret. Instants are seconds since 1970."""

    id: str
    name: str
    owner: str
    prefix: str
    scopes: tuple[str, ...]
    created_at: float
    expires_at: float | None
    revoked_at: float | None
    last_used_at: float | None


def issue(
    store: Store, name: str, owner: str, scopes: Sequence[str], lifetime: float | None = None
) -> tuple[Token, str]:
    """A new token and its secret, which is told once and kept nowhere. ``lifetime`` in seconds, none = no end.

    Raises:
        RequestError: if a scope is unknown or none is given.
    """
    if not scopes or not set(scopes) <= set(Scope):
        raise RequestError("scopes", f"some of {', '.join(Scope)}", list(scopes))
    with store.write() as session:
        return _issue(session, name, owner, scopes, lifetime)


def _issue(session: Session, name: str, owner: str, scopes: Sequence[str], lifetime: float | None) -> tuple[Token, str]:
    prefix = secrets.token_hex(4)
    secret = f"rsa_{prefix}_{secrets.token_urlsafe(32)}"
    now = float(session.scalar(select(db_now())) or 0.0)
    row = TokenRow(
        id=new_id(),
        name=name,
        owner=owner,
        sha256=digest(secret),
        prefix=prefix,
        scopes=sorted(set(map(str, scopes))),
        created_at=now,
        expires_at=None if lifetime is None else now + lifetime,
    )
    session.add(row)
    session.flush()
    return _token(row), secret


def open_session(store: Store, parent: Token, lifetime: float) -> tuple[Token, str]:
    """A token for a browser: as able as ``parent``, revoked with it, gone after ``lifetime`` seconds."""
    with store.write() as session:
        now = float(session.scalar(select(db_now())) or 0.0)
        stale = TokenRow.name.startswith(SESSION) & (TokenRow.expires_at < now - DAY)
        session.execute(delete(TokenRow).where(stale))
        left = lifetime if parent.expires_at is None else min(lifetime, parent.expires_at - now)
        return _issue(session, f"{SESSION}{parent.id}", parent.owner, parent.scopes, left)


def find(store: Store, secret: str) -> Token | None:
    """The token of a secret; None if it is unknown, expired or revoked. Notes the use."""
    shape = SHAPE.fullmatch(secret)
    if shape is None:
        return None
    wanted = digest(secret)
    with store.read() as session:
        now = float(session.scalar(select(db_now())) or 0.0)
        rows = session.scalars(select(TokenRow).where(TokenRow.prefix == shape["prefix"])).all()
        tokens = [_token(row) for row in rows if hmac.compare_digest(row.sha256, wanted)]
    token = tokens[0] if tokens else None
    if token is None or token.revoked_at is not None or (token.expires_at is not None and token.expires_at <= now):
        return None
    if token.last_used_at is None or now - token.last_used_at > FRESH_SECONDS:
        with store.write() as session:
            session.execute(update(TokenRow).where(TokenRow.id == token.id).values(last_used_at=now))
    return token


def all_of(store: Store) -> list[Token]:
    """All tokens, newest first; sessions are left out."""
    query = select(TokenRow).where(~TokenRow.name.startswith(SESSION)).order_by(TokenRow.id.desc())
    with store.read() as session:
        return [_token(row) for row in session.scalars(query)]


def revoke(store: Store, token_id: str) -> Token:
    """End a token, and the sessions that it opened, at once. Again changes nothing.

    Raises:
        NotFoundError: if there is none with this id.
    """
    with store.write() as session:
        row = session.get(TokenRow, token_id)
        if row is None:
            raise NotFoundError("token", "the id of a token", token_id)
        family = or_(TokenRow.id == token_id, TokenRow.name == f"{SESSION}{token_id}")
        valid = family & TokenRow.revoked_at.is_(None)
        session.execute(
            update(TokenRow).where(valid).values(revoked_at=db_now()), execution_options={"synchronize_session": False}
        )
        session.refresh(row)
        return _token(row)


def issue_first(store: Store, home: Path) -> Path | None:
    """The first admin token, into a file of ``home`` that its owner alone may read; None if a valid one exists.

    Processes that start at once issue one between them.
    """
    with store.write() as session:
        if session.get_bind().dialect.name == "postgresql":
            session.execute(text("select pg_advisory_xact_lock(:key)"), {"key": FIRST_TOKEN_LOCK})
        valid = TokenRow.revoked_at.is_(None) & or_(TokenRow.expires_at.is_(None), TokenRow.expires_at > db_now())
        rows = session.scalars(select(TokenRow.scopes).where(valid & ~TokenRow.name.startswith(SESSION)))
        if any(Scope.ADMIN in scopes for scopes in rows):
            return None
        _, secret = _issue(session, "first", "admin", [Scope.ADMIN], None)
        path, draft = first_token_file(home), home / f".{new_id()}"
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(secret + "\n")
        draft.replace(path)
    return path


def first_token_file(home: Path) -> Path:
    """Where ``issue_first`` writes."""
    return home / "admin-token"


def count(store: Store) -> int:
    """Number of tokens, sessions included."""
    with store.read() as session:
        return int(session.scalar(select(func.count()).select_from(TokenRow)) or 0)


def digest(secret: str) -> str:
    """What is kept of a secret. No salt and no slowness: 256 random bits are not to be guessed."""
    return hashlib.sha256(secret.encode()).hexdigest()


def _token(row: TokenRow) -> Token:
    instants = (row.created_at, row.expires_at, row.revoked_at, row.last_used_at)
    return Token(row.id, row.name, row.owner, row.prefix, tuple(row.scopes), *instants)
