"""The tables of owners, of access and of benchmarks. Instants are as in ``services.store.tables``."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Index, String
from sqlalchemy.orm import Mapped, mapped_column

from services.store.base import Base, RowId


class OwnerRow(Base):
    """Somebody who submits jobs, known from the first one. Limits that are none are the settings'."""

    __tablename__ = "owners"

    name: Mapped[str] = mapped_column(String(64), primary_key=True)
    max_running: Mapped[int | None]
    max_queued: Mapped[int | None]
    share: Mapped[float] = mapped_column(default=1.0)
    served_at: Mapped[float] = mapped_column(default=0.0)  # when a job of theirs was last claimed
    created_at: Mapped[float]


class TokenRow(Base):
    """A bearer token, of which only the hash is kept; ``prefix`` shows people which one it is."""

    __tablename__ = "tokens"

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    name: Mapped[str] = mapped_column(String(128))
    owner: Mapped[str] = mapped_column(String(64), index=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    prefix: Mapped[str] = mapped_column(String(16))
    scopes: Mapped[list[Any]]
    created_at: Mapped[float]
    expires_at: Mapped[float | None]
    revoked_at: Mapped[float | None]
    last_used_at: Mapped[float | None]


class AuditRow(Base):
    """Who did what, appended only; every row names the hash of the one before."""

    __tablename__ = "audit"
    __table_args__ = ({"sqlite_autoincrement": True},)

    id: Mapped[int] = mapped_column(RowId, primary_key=True, autoincrement=True)
    at: Mapped[float] = mapped_column(index=True)
    actor: Mapped[str] = mapped_column(String(64), index=True)
    token_id: Mapped[str | None] = mapped_column(String(36))
    verb: Mapped[str] = mapped_column(String(64))
    object: Mapped[str] = mapped_column(String(255), index=True)
    outcome: Mapped[str] = mapped_column(String(32))
    status: Mapped[int | None]
    ip: Mapped[str | None] = mapped_column(String(64))
    request_id: Mapped[str | None] = mapped_column(String(64))
    detail: Mapped[dict[str, Any]]
    previous_sha256: Mapped[str] = mapped_column(String(64))
    sha256: Mapped[str] = mapped_column(String(64), unique=True)


class BenchmarkRow(Base):
    """What a benchmark measured, where and on which commit."""

    __tablename__ = "benchmarks"
    __table_args__ = (Index("ix_benchmarks_name_id", "name", "id"),)

    id: Mapped[str] = mapped_column(String(36), primary_key=True)
    name: Mapped[str] = mapped_column(String(64))
    commit: Mapped[str] = mapped_column(String(64))
    machine: Mapped[dict[str, Any]]
    payload: Mapped[dict[str, Any]]
    created_at: Mapped[float]
