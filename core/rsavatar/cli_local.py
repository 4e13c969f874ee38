"""Verbs that work on this machine: run, bench, data."""

from __future__ import annotations

import argparse
import importlib
import json
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from rsavatar.catalog import STUDIES
from rsavatar.errors import DataError, Interrupted, SpecError, expected


def run(arguments: argparse.Namespace) -> int:
    """``rsavatar run``: one job, to the end or to the next Ctrl-C."""
    from rsavatar.cli_request import read_request
    from rsavatar.spec import resolve

    spec = resolve(read_request(arguments.spec, arguments.set, arguments.subject_dir))
    from rsavatar import experiment  # seconds to import: after the mistakes that can be told without it
    from rsavatar.cli_progress import Display, print_means
    from rsavatar.events import to_json

    out: Path = arguments.out or Path("runs") / f"{spec.subject}-{spec.method}-{spec.sha256()[:8]}"
    try:
        with stop_on_signal() as stop, Display() as display:
            result = experiment.run(
                spec, out, arguments.subject_dir, lambda event: display.show(to_json(event)), stop.is_set
            )
    except Interrupted:
        print(f"stopped; the checkpoint is in {out}\nthe same command with --out {out} goes on from there")
        return 130
    cost = f"{result.gaussians} Gaussians, trained in {result.train_seconds:.0f} s"
    print_means(f"{spec.method} on {spec.subject}: {cost}", result.means, result.protocol)
    for name, path in result.artifacts.items():
        print(f"{name:<12} {path}")
    return 0


def bench(arguments: argparse.Namespace) -> int:
    """``rsavatar bench``: one benchmark, by name."""
    if arguments.name in STUDIES:
        return _study(STUDIES[arguments.name], arguments)
    place = f"rsavatar.bench.{arguments.name}"
    try:
        module = importlib.import_module(place)
    except ModuleNotFoundError as error:
        if error.name not in {"rsavatar.bench", place}:
            raise
        raise SpecError(f"bench {arguments.name}: not available in this version") from None
    given = {"train": (arguments.subjects, arguments.preset), "builder": (arguments.subjects,)}
    more = given.get(arguments.name, ())
    return int(module.main(arguments.json, *more) or 0)


def _study(place: str, arguments: argparse.Namespace) -> int:
    """``rsavatar bench ablation`` and its like."""
    for name in ("seeds", "jobs"):
        if getattr(arguments, name) < 1:
            raise SpecError(expected(f"--{name}", "a whole number of at least 1", getattr(arguments, name)))
    from rsavatar.bench.study import Request, main

    words = (tuple(arguments.subjects), arguments.preset, arguments.seeds, arguments.jobs, arguments.json)
    return main(place, Request(*words))


def check(arguments: argparse.Namespace) -> int:
    """``rsavatar data check``: the findings, and status 1 where an error is among them."""
    if not arguments.directory.is_dir():
        raise DataError(expected("DIR", "a folder", repr(str(arguments.directory))))
    from rsavatar.data import check as checking

    report = checking.check(arguments.directory, arguments.body)
    if arguments.json:
        print(json.dumps({"ok": report.ok, "findings": [vars(finding) for finding in report.findings]}))
    else:
        print(checking.render(report))
    return 0 if report.ok else 1


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """An event that the first SIGINT or SIGTERM sets; the second acts as if nothing had been caught."""
    stop = threading.Event()
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in former.items():
            signal.signal(number, handler)

    def ask(number: int, frame: FrameType | None) -> None:
        stop.set()
        restore()

    for number in former:
        signal.signal(number, ask)
    try:
        yield stop
    finally:
        restore()
