"""``rsavatar grid``: many jobs of one request, planned, queued, followed and steered as one."""

from __future__ import annotations

import argparse
import re
import sys
import time
from collections.abc import Callable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from rsavatar.cli_request import parse_setting
from rsavatar.client import Client, Json
from rsavatar.errors import SpecError, expected
from rsavatar.grids.cells import expand
from rsavatar.grids.request import GridRequest, grid_names, read_grid, read_grid_file, vary

ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
LOOK_SECONDS = 2.0
LINE_SECONDS = 30.0  # between two lines where there is no terminal to draw on
NEWEST = 10  # grids of the service that a listing shows
VERBS = ("cancel", "pause", "resume", "retry")


def grid(arguments: argparse.Namespace) -> int:
    """``rsavatar grid``: list, or do what the words say to one grid; status 1 where a followed one does not succeed."""
    with Client(arguments.url) as client:
        if arguments.name is None:
            return _list(client)
        if not ID.fullmatch(arguments.name):
            return _submit(client, arguments)
        verb = next((verb for verb in VERBS if getattr(arguments, verb)), None)
        found = client.grid(arguments.name) if verb is None else client.steer_grid(arguments.name, verb)
        if arguments.watch:
            return _follow(client, found["id"])
        print(_line(found))
        for cell in found["cells"]:
            print(_cell_line(cell))
        return 0


def _list(client: Client) -> int:
    for name in grid_names():
        request = read_grid(name)
        print(f"{name:<14} {len(expand(request)):>4} jobs a subject   {request.about}")
    print(flush=True)
    for found in islice(client.grids(), NEWEST):
        print(_line(found))
    return 0


def read(arguments: argparse.Namespace) -> GridRequest:
    """The grid that the command line means.

    Raises:
        SpecError: if there is no such grid or file, or a setting is malformed.
    """
    path = Path(arguments.name)
    if arguments.name not in grid_names() and not path.is_file():
        wanted = f"a TOML file, the id of a grid, or one of {', '.join(grid_names())}"
        raise SpecError(expected("GRID", wanted, repr(arguments.name)))
    request = read_grid(arguments.name) if arguments.name in grid_names() else read_grid_file(path)
    for setting in arguments.set:
        words, value = parse_setting(setting)
        request = vary(request, ".".join(words), value)
    if arguments.subjects:
        request = vary(request, "subject", [name.strip() for name in arguments.subjects.split(",")])
    return request


def _submit(client: Client, arguments: argparse.Namespace) -> int:
    request = read(arguments)
    expand(request)  # mistakes are told before anything is sent
    body = request.model_dump(mode="json")
    if arguments.dry_run:
        _print_plan(client.plan_grid(body))
        return 0
    found = client.submit_grid(body, arguments.key, arguments.force)
    print(found["id"], flush=True)
    if not arguments.watch:
        print(f"{found['jobs']} jobs; follow them with: rsavatar grid {found['id']} --watch", file=sys.stderr)
        return 0
    return _follow(client, found["id"])


def _print_plan(plan: Mapping[str, Any]) -> None:
    print(f"{plan['name']}: {plan['jobs']} jobs, {plan['reused']} of which have a known result")
    for guess in plan["estimates"]:
        what = f"{guess['method']} on {guess['subject']}, {guess['preset']}, {guess['iterations']} steps"
        print(f"  {guess['jobs']:>4} x {what}: {_duration(guess['seconds'])} each ({guess['basis']})")
    side = "one after another" if plan["parallel"] == 1 else f"{plan['parallel']} side by side"
    print(f"about {_duration(plan['eta_seconds'])}, {side}")


def _follow(client: Client, grid_id: str) -> int:
    """Draw a grid until all its jobs have ended; a service that goes away is waited for by the client's caller."""
    console = Console(stderr=True, highlight=False)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(30),
        TextColumn("{task.percentage:>3.0f} %  {task.fields[says]}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        task = bars.add_task("grid", total=1.0, says="")
        say = _every(LINE_SECONDS, lambda text: console.print(text, markup=False))
        while True:
            found = client.grid(grid_id)
            bars.update(task, description=found["name"], completed=found["fraction"], says=_counts(found))
            if not console.is_terminal:
                say(_line(found), found["terminal"])
            if found["terminal"]:
                break
            time.sleep(LOOK_SECONDS)
    bad = [cell for cell in found["cells"] if cell["state"] != "succeeded"]
    for cell in bad:
        print(_cell_line(cell), file=sys.stderr)
    return 1 if bad else 0


def _every(seconds: float, say: Callable[[str], None]) -> Callable[[str, bool], None]:
    last = -seconds

    def maybe(text: str, is_last: bool) -> None:
        nonlocal last
        if is_last or time.monotonic() - last >= seconds:
            last = time.monotonic()
            say(text)

    return maybe


def _line(found: Json) -> str:
    return f"{found['id']}  {found['name']:<14} {found['fraction']:>5.0%}  {_counts(found)}"


def _counts(found: Json) -> str:
    counts = ", ".join(f"{count} {state}" for state, count in found["counts"].items() if count)
    eta = found.get("eta_seconds")
    return counts if eta is None else f"{counts}; about {_duration(eta)} left"


def _cell_line(cell: Json) -> str:
    place = ", ".join(f"{name}={label}" for name, label in cell["place"].items())
    psnr = cell["metrics"].get("psnr")
    said = cell["error"]["message"].splitlines()[0] if cell["error"] else "" if psnr is None else f"{psnr:.2f} dB"
    return f"  {cell['job_id']}  {cell['state']:<10} {cell['fraction']:>5.0%}  {place}  {said}".rstrip()


def _duration(seconds: float) -> str:
    """Two units at most: ``2 h 05 min``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
