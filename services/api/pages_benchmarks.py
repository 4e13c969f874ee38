"""Benchmarks: what was measured, on which commit and machine, shipped with the code or stored by the service."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse

from services.api import vendor
from services.api.deps import Back
from services.api.layout import PageRoute, page
from services.settings import ROOT
from services.store import benchmarks
from services.store.session import Store

SHIPPED = ROOT / "docs" / "benchmarks"
ORDER = ("render", "growth", "train", "stability")
TITLES = {
    "render": "Run time against error",
    "growth": "Growth",
    "train": "Quality against time",
    "stability": "Stability",
}
LARGEST = 8 << 20  # bytes of a result that is read

router = APIRouter(route_class=PageRoute, prefix="/benchmarks")


@dataclass(frozen=True)
class Measurement:
    """One run of a benchmark. ``stored`` is its id in the database, none for one that came with the code."""

    kind: str
    commit: str
    machine: Mapping[str, Any]
    payload: Mapping[str, Any]
    stored: str | None = None

    @property
    def title(self) -> str:
        """What it shows."""
        return TITLES.get(self.kind, self.kind)

    @property
    def is_loaded(self) -> bool:
        """Whether the machine was busy with something else."""
        return float(self.machine.get("load", 0.0)) > 2.0 * float(self.machine.get("cores", 1)) / 2


@router.get("", response_class=HTMLResponse)
def benchmarks_page(
    request: Request, back: Back, commit: Annotated[str | None, Query(pattern=r"^[0-9a-z-]{0,64}$")] = None
) -> HTMLResponse:
    """The newest run of every benchmark, or those of a commit; earlier runs show whether something got slower."""
    everything = [*shipped(), *stored(back.store)]
    commits = list(dict.fromkeys(m.commit for m in reversed(everything)))
    wanted = [m for m in everything if not commit or m.commit == commit]
    chosen = {m.kind: m for m in wanted}  # the newest of a kind comes last
    rank = {kind: i for i, kind in enumerate(ORDER)}
    shown = sorted(chosen.values(), key=lambda m: (rank.get(m.kind, len(rank)), m.kind))
    context = {
        "shown": shown,
        "commits": commits,
        "commit": commit,
        "history": history(everything),
        "data": json.dumps({m.kind: dict(m.payload) for m in shown}),
        "plotly": vendor.address(),
    }
    return page(request, "benchmarks.html", context, charts=True)


def shipped() -> list[Measurement]:
    """Results that lie in the checkout; a file that is no result is left out."""
    found = []
    for path in sorted(SHIPPED.glob("*.json")) if SHIPPED.is_dir() else []:
        if path.stat().st_size > LARGEST:
            continue
        try:
            payload = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            continue
        if isinstance(payload, dict) and isinstance(payload.get("machine"), dict):
            found.append(_measurement(str(payload.get("kind", path.stem)), payload, None))
    return found


def stored(store: Store) -> list[Measurement]:
    """Results in the database, oldest first."""
    return [_measurement(b.name, b.payload, b.id) for b in benchmarks.newest(store)]


def _measurement(kind: str, payload: Mapping[str, Any], stored_id: str | None) -> Measurement:
    machine = payload.get("machine") or {}
    return Measurement(kind, str(machine.get("commit", "unknown")), machine, payload, stored_id)


def history(everything: list[Measurement]) -> list[tuple[str, str, list[tuple[str, float]]]]:
    """Measured targets over commits: name, unit, (commit, value), for those that were measured more than once."""
    found: dict[tuple[str, str], list[tuple[str, float]]] = {}
    for measurement in everything:
        for target in measurement.payload.get("targets") or []:
            if isinstance(target.get("measured"), int | float):
                key = (str(target.get("name")), str(target.get("unit", "")))
                found.setdefault(key, []).append((measurement.commit, float(target["measured"])))
    return [(name, unit, points) for (name, unit), points in found.items() if len(points) > 1]
