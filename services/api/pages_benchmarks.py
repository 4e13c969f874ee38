"""Benchmarks: what was measured, on which commit and machine. What ships with the code is stored at the start."""

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
from services.store import benchmarks
from services.store.session import Store

ORDER = ("render", "growth", "train", "stability")
TITLES = {
    "render": "Run time against error",
    "growth": "Growth",
    "train": "Quality against time",
    "stability": "Stability",
    "service": "Service",
}

router = APIRouter(route_class=PageRoute, prefix="/benchmarks")


@dataclass(frozen=True)
class Measurement:
    """One run of a benchmark."""

    kind: str
    commit: str
    machine: Mapping[str, Any]
    payload: Mapping[str, Any]

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
    everything = [m for m in stored(back.store) if m.kind in TITLES or m.payload.get("targets")]  # what is drawn here
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


def stored(store: Store) -> list[Measurement]:
    """Results in the database, oldest first."""
    return [Measurement(b.name, b.commit, b.machine, b.payload) for b in benchmarks.newest(store)]


def history(everything: list[Measurement]) -> list[tuple[str, str, list[tuple[str, float]]]]:
    """Measured targets over commits: name, unit, (commit, value), for those that were measured more than once."""
    found: dict[tuple[str, str], list[tuple[str, float]]] = {}
    for measurement in everything:
        for target in measurement.payload.get("targets") or []:
            if isinstance(target.get("measured"), int | float):
                key = (str(target.get("name")), str(target.get("unit", "")))
                found.setdefault(key, []).append((measurement.commit, float(target["measured"])))
    return [(name, unit, points) for (name, unit), points in found.items() if len(points) > 1]
