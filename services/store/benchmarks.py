"""Stored results of benchmarks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import select

from services.store.ids import new_id
from services.store.session import Store, db_now
from services.store.tables import BenchmarkRow

MOST = 200
LARGEST = 8 << 20  # bytes of a result that is read


@dataclass(frozen=True)
class Benchmark:
    """What was measured, where and on which commit."""

    id: str
    name: str
    commit: str
    machine: Mapping[str, Any]
    payload: Mapping[str, Any]
    created_at: float


def discover(store: Store, folder: Path) -> None:
    """Keep the results that ``rsavatar bench --json`` has written to ``folder``, each once.

    Those of a later code stand beside those of an earlier one, which its files have replaced. What is no result is
    left out; NaN, which is not JSON, becomes null.
    """
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else []:
        if path.stat().st_size > LARGEST:
            continue
        try:
            payload = json.loads(path.read_text(encoding="utf-8"), parse_constant=lambda word: None)
        except ValueError:
            continue
        if isinstance(payload, dict) and isinstance(payload.get("machine"), dict):
            add(store, str(payload.get("name") or payload.get("kind") or path.stem), payload)


def add(store: Store, name: str, payload: Mapping[str, Any]) -> str:
    """Keep a result; returns its id, or that of the same measurement if it has been kept before."""
    machine = dict(payload.get("machine") or {})
    commit = str(machine.get("commit", "unknown"))
    same = (BenchmarkRow.name == name) & (BenchmarkRow.commit == commit)
    with store.write() as session:
        for row in session.scalars(select(BenchmarkRow).where(same)):
            if row.payload == payload:
                return row.id
        row = BenchmarkRow(id=new_id(), name=name, commit=commit, machine=machine)
        row.payload, row.created_at = dict(payload), session.scalar(select(db_now())) or 0.0
        session.add(row)
        return row.id


def newest(store: Store, limit: int = MOST) -> list[Benchmark]:
    """The newest results, oldest first."""
    query = select(BenchmarkRow).order_by(BenchmarkRow.id.desc()).limit(limit)
    with store.read() as session:
        rows = [Benchmark(r.id, r.name, r.commit, r.machine, r.payload, r.created_at) for r in session.scalars(query)]
    return rows[::-1]
