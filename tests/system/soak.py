"""``make soak``: a grid of jobs while something is killed every few seconds.

The grid's distinct jobs run once in peace. Then the grid runs while workers, the processes that train, the API and the
broker (which also loses its memory) are killed in turn. At the end every job must have succeeded exactly once with the
numbers of its peaceful run, the grid must tell of every job once, and no process, file or row may be left over.

The soak's own grid is made of ``--distinct`` jobs at as many checkpoint intervals as it takes; those move no number.
``--grid`` runs another one, with the words of ``rsavatar grid``, and ends with its table:

  python -m tests.system.soak --grid ablation --subjects DIR --set preset=draft --kill-every 60 --table ablation.tex
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import func, select

from rsavatar import cli_grid
from rsavatar.grids.request import GridRequest
from rsavatar.report.tables import TABLES
from services.api.tables import MIMES
from services.demo import free_port
from services.settings import Settings
from services.store import events
from services.store.records import TERMINAL
from services.store.tables import JobRow
from tests import postgresql
from tests.system import checks
from tests.system.fire import WORKERS, Fire
from tests.system.harness import Host, until
from tests.system.lives import Life, life_of

REAL = Settings.model_fields["child_command"].default
SHORTEST = 25  # steps between two checkpoints: of a hundred steps there is always one before the end
ALL = 1_000_000  # events of a job
SHOWN = 100  # jobs that a report names one by one
Json = Mapping[str, Any]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    words = argparse.ArgumentParser(
        "tests.system.soak", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--jobs", type=int, default=1000, help="of the soak's own grid (default: 1000)")
    words.add_argument("--distinct", type=int, default=20, help="distinct jobs among them (default: 20)")
    words.add_argument("--iterations", type=int, default=100, help="optimiser steps of a job (default: 100)")
    words.add_argument("--grid", metavar="GRID", help="instead, a built-in grid or a TOML file")
    words.add_argument("--subjects", default="", metavar="A,B", help="on these: built-in names, or folders")
    words.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a word of all jobs, or an axis")
    words.add_argument("--peace", action="store_true", help="run that grid in peace first, and compare the numbers")
    endings = ", ".join(MIMES)
    words.add_argument("--table", type=Path, action="append", default=[], metavar="FILE",
                       help=f"the grid's table, by its ending ({endings}); else LaTeX, printed")  # fmt: skip
    words.add_argument("--kill-every", type=float, default=4.0, metavar="SECONDS", help="mean pause (default: 4)")
    words.add_argument("--seed", type=int, default=0, help="of the order of kills")
    words.add_argument("--quick", action="store_true", help="count in place of training: tests the service alone")
    words.add_argument("--postgresql", action="store_true", help="on PostgreSQL (default: SQLite)")
    words.add_argument("--home", type=Path, metavar="DIR", help="a new folder, kept (default: one that disappears)")
    return words


def own_grid(options: argparse.Namespace) -> GridRequest:
    """As many jobs as asked for, of few distinct results."""
    distinct = [
        {"label": f"{method} {number}", "method": method, "seed": number, "priority": number % 3,
         "iterations": options.iterations + number}
        for number in range(options.distinct) for method in [("rs-avatar", "gauhuman")[number % 2]]
    ]  # fmt: skip
    intervals = range(SHORTEST, SHORTEST + options.jobs // options.distinct)
    base = {"subject": "studio", "preset": "smoke"}
    return GridRequest(name="soak", base=base, axes={"job": distinct, checks.NOT_OF_NUMBERS: list(intervals)})


def named_grid(host: Host, options: argparse.Namespace) -> GridRequest:
    """The grid of the command line, its folders registered as subjects."""
    names = [register(host, word) for word in options.subjects.split(",") if word]
    return cli_grid.read(argparse.Namespace(name=options.grid, set=options.set, subjects=",".join(names)))


def register(host: Host, word: str) -> str:
    """The name of a subject, which a folder gets."""
    folder = Path(word).resolve()
    if "/" not in word:
        return word
    reply = host.client.post("/api/v1/subjects", json={"name": folder.name, "path": str(folder)})
    assert reply.is_success, reply.text
    return folder.name


def submit(host: Host, request: GridRequest) -> Json:
    """The accepted grid, whose jobs run whatever is known."""
    reply = host.client.post("/api/v1/grids", params={"force": True}, json=request.model_dump(mode="json"))
    assert reply.status_code == 202, reply.text
    found: Json = reply.json()
    return found


def ended(host: Host, grid: str) -> int:
    """Jobs of a grid that will not run again."""
    mine = (JobRow.grid_id == grid) & JobRow.state.in_(TERMINAL)
    with host.store.read() as session:
        return session.scalar(select(func.count()).where(mine)) or 0


def in_peace(host: Host, request: GridRequest) -> dict[checks.Place, Json]:
    """Every distinct job once, undisturbed: its numbers by its place."""
    axes = {name: values for name, values in request.axes.items() if name != checks.NOT_OF_NUMBERS}
    grid = submit(host, request.model_copy(update={"name": "peace", "axes": axes}))
    until(lambda: ended(host, grid["id"]) == grid["jobs"], 86_400.0)
    return {checks.place_of(cell): checks.numbers(host, cell["job_id"]) for cell in grid["cells"]}


def report_of(grid: Json, lives: Sequence[Life]) -> dict[str, Any]:
    """What the jobs went through."""
    waits = [wait for life in lives for wait in life.waits]
    lost = [life.seconds_lost for life in lives]
    by_job = {
        ", ".join(cell["place"].values()): f"attempts {life.attempts}, seconds lost {life.seconds_lost:.1f}"
        for cell, life in zip(grid["cells"], lives, strict=True)
    }
    return {
        "grid": grid["name"], "jobs": grid["jobs"], "counts": {k: v for k, v in grid["counts"].items() if v},
        "attempts": dict(sorted(Counter(life.attempts for life in lives).items())),
        "seconds_lost": {"sum": round(sum(lost), 1), "max": round(max(lost), 1)},
        "requeued_to_running_seconds": {"median": round(statistics.median(waits), 2),
                                        "max": round(max(waits), 2)} if waits else None,
    } | ({"by_job": by_job} if len(lives) <= SHOWN else {})  # fmt: skip


def run(options: argparse.Namespace, host: Host) -> bool:
    """Everything; prints a report as JSON. Whether nothing is wrong."""
    for name in ("redis", "api", *WORKERS):
        host.start(name)
    request = named_grid(host, options) if options.grid else own_grid(options)
    expected = in_peace(host, request) if options.peace or not options.grid else {}
    begun = time.monotonic()
    grid = submit(host, request)
    fire = Fire(host, options.kill_every, options.seed)
    fire.until(lambda: ended(host, grid["id"]) == grid["jobs"], lambda: f"{ended(host, grid['id'])} ended")
    seconds = time.monotonic() - begun
    until(lambda: not host.children(), 60.0)
    grid = host.client.get(f"/api/v1/grids/{grid['id']}").json()
    lives = [life_of(events.after(host.store, 0, cell["job_id"], ALL)) for cell in grid["cells"]]
    wrong = [*checks.of_grid(host, grid), *checks.of_jobs(host, grid["cells"], lives, expected)]
    wrong += checks.left_over(host)
    report = report_of(grid, lives) | {
        "seconds": round(seconds), "kills": dict(fire.kills), "compared_with": len(expected), "wrong": wrong,
        "database": host.store.engine.dialect.name, "child": "count" if options.quick else "training",
    }  # fmt: skip
    print(json.dumps(report, indent=1), flush=True)
    tables(host, grid, options)
    return not wrong


def tables(host: Host, grid: Json, options: argparse.Namespace) -> None:
    """The table of the grid's name, else the main one, as the API gives it."""
    name = grid["name"] if grid["name"] in TABLES else "main"
    for file in options.table or ([None] if options.grid else []):
        form = "tex" if file is None else file.suffix[1:]
        text = host.client.get(f"/api/v1/tables/{name}.{form}", params={"grid": grid["id"]}).raise_for_status().text
        if file is None:
            print(text)
        else:
            file.write_text(text, "utf-8")


def read(words: Sequence[str] | None = None) -> argparse.Namespace:
    """The options, refused where they make no grid."""
    line = parser()
    options = line.parse_args(words)
    if options.jobs % options.distinct:
        line.error(f"--jobs: expected a multiple of --distinct = {options.distinct}, got {options.jobs}")
    if strange := [file for file in options.table if file.suffix[1:] not in MIMES]:
        line.error(f"--table: expected an ending of {', '.join(MIMES)}, got {strange[0]}")
    return options


def main() -> int:
    """Run it in a home of its own."""
    options = read()
    changes: dict[str, Any] = {"max_attempts": 1000, "worker_concurrency": 1, "threads_per_job": 1, "gc_hours": 0.0}
    changes |= {"max_grid_jobs": max(1000, options.jobs)}
    changes |= {} if options.quick else {"child_command": REAL, "stall_seconds": 300.0}
    with contextlib.ExitStack() as stack:
        folder = options.home or stack.enter_context(tempfile.TemporaryDirectory(prefix="rsavatar-soak-"))
        server = stack.enter_context(postgresql.running()) if options.postgresql else None
        if options.postgresql:
            assert server is not None, "no PostgreSQL here"
            changes["database_url"] = server.migrated()
        host = Host(Path(folder).resolve() / "home", free_port(), **changes)
        try:
            return 0 if run(options, host) else 1
        finally:
            host.close()


if __name__ == "__main__":
    sys.exit(main())
