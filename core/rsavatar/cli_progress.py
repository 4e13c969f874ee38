"""What a running job says, on a terminal: a bar for its stage, lines for its notes; the same for remote jobs."""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
from rich.table import Table

LINE_EVERY_S = 10.0  # where there is no terminal to draw a bar on
UNITS = {
    "psnr": "dB in the dilated mask",
    "joint_mm": "mm",
    "sub_frame_joint_mm": "mm",
    "joint_deg": "degrees",
}


class Display:
    """Shows events in their JSON form (``events.to_json``) on stderr; a context manager."""

    def __init__(self) -> None:
        self._console = Console(stderr=True, highlight=False)
        columns = (
            TextColumn("{task.description:<9}"),
            BarColumn(30),
            MofNCompleteColumn(),
            TextColumn("{task.fields[state]}"),
        )
        self._bars = Progress(*columns, console=self._console, disable=not self._console.is_terminal)
        self._tasks: dict[str, TaskID] = {}
        self._last_line = -LINE_EVERY_S

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._bars.stop()

    def show(self, event: Mapping[str, Any]) -> None:
        """Draw one event; kinds that say nothing to a person here are passed over."""
        if event["kind"] == "progress":
            self._progress(event)
        elif event["kind"] == "note":
            self._console.print(str(event["text"]), markup=False)
        elif event["kind"] == "state":
            reason = f": {event['reason']}" if event.get("reason") else ""
            self._console.print(f"job is {event['state']}{reason}", markup=False)

    def _progress(self, event: Mapping[str, Any]) -> None:
        stage, step, steps, state = str(event["stage"]), int(event["step"]), int(event["steps"]), _state(event)
        if not self._console.is_terminal:
            self._line(f"{stage} {step}/{steps} {state}", last=step >= steps)
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=steps, state="")
        self._bars.update(self._tasks[stage], completed=step, total=steps, state=state)

    def _line(self, text: str, last: bool) -> None:
        if last or time.monotonic() - self._last_line >= LINE_EVERY_S:
            self._console.print(text, markup=False)
            self._last_line = time.monotonic()


def _state(event: Mapping[str, Any]) -> str:
    parts = [f"{name} {event[name]:{spec}}" for name, spec in _FIELDS.items() if event.get(name) is not None]
    seconds = event.get("eta_seconds")
    return "  ".join([*parts, f"{seconds:.0f} s left"] if seconds else parts)


_FIELDS = {"loss": ".4f", "psnr": ".2f", "gaussians": "d"}


def print_means(title: str, means: Mapping[str, Any], protocol: Mapping[str, Any]) -> None:
    """The means of a finished job as a table on stdout; a metric without a number says why where the protocol does."""
    table = Table(title=title, title_justify="left")
    table.add_column("metric")
    table.add_column("mean", justify="right")
    table.add_column("")
    for name, value in means.items():
        if value is None:
            table.add_row(name, "–", str(protocol.get(name, "")))
        else:
            table.add_row(name, f"{value:.4g}" if abs(value) < 1 else f"{value:.2f}", UNITS.get(name, ""))
    Console(highlight=False).print(table)
