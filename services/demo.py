"""``python -m services.demo``: the paper's comparison in small, through the whole service, in a few minutes.

Starts a private service, submits one job for every method over HTTP, shows how they train, prints the main table
and stops everything. Nothing is left behind unless --home (or RSAVATAR_HOME) names a place to keep it.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from services.errors import ServiceError
from services.settings import Settings
from services.store.tokens import first_token_file
from services.up import Stack, raise_interrupt, running

METHODS = ("gauhuman", "mad-avatar", "rs-avatar")
LOOK_SECONDS = 0.3
LOG_LINES = 20
HIDDEN = frozenset({"paper_psnr", "paper_ssim", "paper_lpips", "subjects", "seeds", "iterations"})
COLUMNS = (
    TextColumn("{task.description:<12}"),
    BarColumn(),
    TextColumn("{task.percentage:>3.0f} %"),
    TimeElapsedColumn(),
    TextColumn("{task.fields[says]}"),
)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    example = (
        "examples:\n  python -m services.demo\n  python -m services.demo --preset draft --methods rs-avatar gauhuman"
    )
    shape = argparse.RawDescriptionHelpFormatter
    words = argparse.ArgumentParser("services.demo", description=__doc__, epilog=example, formatter_class=shape)
    words.add_argument("--preset", default="smoke", choices=("smoke", "draft", "paper"), help="size (default: smoke)")
    words.add_argument("--iterations", type=int, help="optimiser steps (default: the preset's)")
    words.add_argument("--subject", default="studio", help="built in: studio (default)")
    words.add_argument("--methods", nargs="+", default=list(METHODS), metavar="METHOD", help="default: all three")
    words.add_argument("--seed", type=int, default=0, help="seed of every random choice (default: 0)")
    words.add_argument("--home", type=Path, help="keep everything here (default: RSAVATAR_HOME, or nothing is kept)")
    words.add_argument("--port", type=int, help="port of the API (default: any free one)")
    return words


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def home_of(asked: Path | None) -> Iterator[Path]:
    """The home to use: the one asked for, the environment's, or a temporary one that disappears."""
    kept = asked or os.environ.get("RSAVATAR_HOME")
    if kept:
        yield Path(kept)
        return
    with tempfile.TemporaryDirectory(prefix="rsavatar-demo-") as folder:
        yield Path(folder)


def submit(client: httpx.Client, options: argparse.Namespace, method: str) -> str:
    """Submit one job and return its id.

    Raises:
        httpx.HTTPStatusError: if the service refuses it.
    """
    asked = {"method": method, "subject": options.subject, "preset": options.preset, "seed": options.seed}
    if options.iterations is not None:
        asked["iterations"] = options.iterations
    reply = client.post("/api/v1/jobs", json=asked)
    reply.raise_for_status()
    return str(reply.json()["id"])


def show(progress: Progress, task: TaskID, job: dict[str, Any]) -> None:
    """Move one bar to where its job is."""
    look = job["progress"]
    says = job["state"] if job["state"] != "running" else (look["stage"] or "starting")
    if look["loss"] is not None and job["state"] == "running":
        says += f", loss {look['loss']:.4f}"
    if job["state"] == "succeeded" and look["psnr"] is not None:
        says += f", PSNR {look['psnr']:.2f} dB"
    progress.update(task, completed=look["fraction"], says=says)
    if job["terminal"]:
        progress.stop_task(task)
    elif job["started_at"] and not progress.tasks[task].started:
        progress.start_task(task)


def watch(stack: Stack, client: httpx.Client, jobs: dict[str, str], console: Console) -> dict[str, dict[str, Any]]:
    """Show all jobs (method by id) until each has ended; returns their last views."""
    views: dict[str, dict[str, Any]] = {}
    with Progress(*COLUMNS, console=console) as progress:
        tasks = {job: progress.add_task(name, start=False, total=1.0, says="queued") for job, name in jobs.items()}
        while not (views and all(view["terminal"] for view in views.values())):
            stack.tend()
            time.sleep(LOOK_SECONDS)
            try:
                views = {job: client.get(f"/api/v1/jobs/{job}").json() for job in jobs}
            except httpx.TransportError:  # the API is being started again; the jobs are safe
                continue
            for job, view in views.items():
                show(progress, tasks[job], view)
    return views


def explain(stack: Stack, views: dict[str, dict[str, Any]], console: Console) -> bool:
    """Print why jobs failed; whether all succeeded."""
    failed = {job: view for job, view in views.items() if view["state"] != "succeeded"}
    for job, view in failed.items():
        error = view["error"] or {"kind": view["state"], "message": "no message"}
        console.print(f"[red]{view['method']}: {error['kind']}[/red]\n{error['message']}", highlight=False)
        log = stack.settings.job_dir(job) / "log.txt"
        if log.is_file() and "Traceback" not in error["message"]:
            console.print(
                "\n".join(log.read_text("utf-8", "replace").splitlines()[-20:]), highlight=False, markup=False
            )
    return not failed


def print_table(main: dict[str, Any], console: Console) -> None:
    """The main table without the columns in which it has no number."""
    shown = [
        c for c in main["columns"] if c["key"] not in HIDDEN and any(row[c["key"]] is not None for row in main["rows"])
    ]
    table = Table(box=SIMPLE, padding=(0, 1, 0, 0), pad_edge=False)
    for column in shown:
        is_name = column["key"] == "method"
        table.add_column(column["title"], justify="left" if is_name else "right", no_wrap=is_name, overflow="fold")
    for row in main["rows"]:
        table.add_row(*(text_of(row[column["key"]]) for column in shown))
    console.print(table)
    for note in main["notes"]:
        console.print(note, style="dim", highlight=False)


def text_of(value: str | float | None) -> str:
    """A value of the table's JSON, in four digits."""
    if value is None:
        return "–"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def proof(settings: Settings) -> dict[str, str]:
    """The header that lets us in, where one is asked for."""
    file = first_token_file(settings.home)
    return {"authorization": f"Bearer {file.read_text('utf-8').strip()}"} if settings.needs_token else {}


def demonstrate(options: argparse.Namespace, settings: Settings, console: Console) -> bool:
    """Run the jobs and print the table; whether all succeeded."""
    with (
        running(settings, console.print) as stack,
        httpx.Client(base_url=settings.url, timeout=30.0, trust_env=False, headers=proof(settings)) as client,
    ):
        console.print(f"service ready at {settings.url}, home {settings.home}", highlight=False)
        jobs = {submit(client, options, method): method for method in options.methods}
        succeeded = explain(stack, watch(stack, client, jobs, console), console)
        print_table(client.get("/api/v1/tables/main.json", params={"preset": options.preset}).json(), console)
        return succeeded


def main() -> int:
    """Run the demo; 0 only if every job succeeded."""
    signal.signal(signal.SIGTERM, raise_interrupt)
    options = parser().parse_args()
    console = Console()
    try:
        with home_of(options.home) as home:
            os.environ["RSAVATAR_HOME"] = str(home)
            settings = Settings(home=home, port=options.port or free_port())
            return 0 if demonstrate(options, settings, console) else 1
    except ServiceError as error:
        console.print(str(error), markup=False)
    except httpx.HTTPStatusError as error:
        console.print(error.response.text, markup=False)
    except KeyboardInterrupt:
        console.print("stopped")
    return 1


if __name__ == "__main__":
    sys.exit(main())
