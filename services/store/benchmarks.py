"""Stored results of benchmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select

from services.store.ids import new_id
from services.store.session import Store, db_now
from services.store.tables import BenchmarkRow

MOST = 200


@dataclass(frozen=True)
class Benchmark:
    """What was measured, where and on which commit."""

    id: str
    name: str
    commit: str
    machine: Mapping[str, Any]
    payload: Mapping[str, Any]
    created_at: float


def add(store: Store, name: str, payload: Mapping[str, Any]) -> str:
    """Keep a result as ``rsavatar bench --json`` writes it; returns its id."""
    machine = dict(payload.get("machine") or {})
    with store.write() as session:
        row = BenchmarkRow(id=new_id(), name=name, commit=str(machine.get("commit", "unknown")), machine=machine)
        row.payload, row.created_at = dict(payload), session.scalar(select(db_now())) or 0.0
        session.add(row)
        return row.id


def newest(store: Store, limit: int = MOST) -> list[Benchmark]:
    """The newest results, oldest first."""
    query = select(BenchmarkRow).order_by(BenchmarkRow.id.desc()).limit(limit)
    with store.read() as session:
        rows = [Benchmark(r.id, r.name, r.commit, r.machine, r.payload, r.created_at) for r in session.scalars(query)]
    return rows[::-1]
