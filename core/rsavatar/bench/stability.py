"""``rsavatar bench stability``: a stress suite with a verdict per row.

Every group of cases runs in a process of its own, so a case that crashed would cost its group's remaining rows and be
reported, not end the suite. The long run has 3000 steps; RSAVATAR_STABILITY_STEPS=100000 asks for more.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import import_module
from multiprocessing.connection import Connection
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from rsavatar import kernels
from rsavatar.bench.machine import Machine, describe
from rsavatar.bench.stability_case import Case

GROUPS = {"renderer": "stability_scenes", "numbers and refusals": "stability_numbers", "training": "stability_training"}
COMMAND = "rsavatar bench stability"
THREADS = 2


@dataclass(frozen=True)
class Row:
    """A case and how it went."""

    group: str
    case: str
    promise: str
    measured: str
    held: bool
    seconds: float


def main(json_path: Path | None) -> int:
    """Run all groups; print the table, write it as JSON and, beside that, as a page. Status 1 where a promise broke."""
    kernels.use_threads(THREADS)
    machine = describe()
    rows = [row for group in GROUPS for row in run(group)]
    _print(rows)
    if json_path:
        found = {
            "kind": "stability",
            "machine": machine.model_dump(),
            "command": COMMAND,
            "rows": [asdict(r) for r in rows],
        }
        json_path.parent.mkdir(parents=True, exist_ok=True)
        json_path.write_text(json.dumps(found, indent=1) + "\n")
        json_path.with_suffix(".md").write_text(page(rows, machine))
    return int(not all(row.held for row in rows))


def run(group: str) -> Iterator[Row]:
    """The rows of a group as they come, from a spawned process; one more if that process dies."""
    context = multiprocessing.get_context("spawn")
    inbox, outbox = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(group, outbox))
    process.start()
    outbox.close()
    try:
        while True:
            yield inbox.recv()
    except EOFError:
        process.join()
    if process.exitcode:
        yield Row(group, "process of the group", "no case crashes it", f"exit status {process.exitcode}", False, 0.0)


def _serve(group: str, outbox: Connection) -> None:
    torch.set_num_threads(1)
    kernels.use_threads(THREADS)
    cases: list[Case] = import_module(f"rsavatar.bench.{GROUPS[group]}").cases()
    for case in cases:
        begun = time.perf_counter()
        try:
            measured, held = case.run()
        except Exception as error:
            measured, held = f"{type(error).__name__}: {error}", False
        outbox.send(Row(group, case.name, case.promise, measured, held, round(time.perf_counter() - begun, 2)))


def _print(rows: list[Row]) -> None:
    table = Table("case", "measured", "verdict", title="Stability")
    for row in rows:
        table.add_row(row.case, row.measured, "held" if row.held else "[bold red]BROKEN")
    console = Console()
    console.print(table)
    console.print(_summary(rows))


def _summary(rows: list[Row]) -> str:
    return f"{sum(row.held for row in rows)} of {len(rows)} promises held."


def page(rows: list[Row], machine: Machine) -> str:
    """The table as Markdown, with what it was taken on."""
    lines = [
        "# Stability",
        "",
        "Float32 kernels against their float64 twin, and training, at their worst.",
        f"Written by `{COMMAND} --json docs/benchmarks/stability.json`; `stability.json` has the same rows as data.",
        "The last row's steps are 3000, or what RSAVATAR_STABILITY_STEPS says.",
        "",
        f"**{_summary(rows)}**",
        "",
        f"Commit {machine.commit}; {machine.processor}, {machine.cores} cores, {machine.threads} kernel threads,",
        f"{machine.instructions}; Python {machine.python}, torch {machine.torch}.",
    ]
    for group in dict.fromkeys(row.group for row in rows):
        lines += [
            "",
            f"## {group.capitalize()}",
            "",
            "| case | promise | measured | verdict | s |",
            "|---|---|---|---|---|",
        ]
        for r in rows:
            if r.group == group:
                verdict = "held" if r.held else "**broken**"
                cells = (r.case, r.promise, r.measured, verdict, f"{r.seconds:.1f}")
                lines.append("| " + " | ".join(cell.replace("|", "/").replace("\n", " ") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
