"""``python -m services.bench [--json FILE]``: measures the service and writes the figures, and a page beside them."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from services.bench import dashboard, requests, workers
from services.bench.host import host
from services.bench.page import render
from services.bench.promises import figures_of, others_of, targets_of
from services.bench.requests import Found
from services.bench.results import ServiceResult, machine
from services.bench.sizes import LITTLE, WHOLE, Sizes

PARTS: dict[str, Callable[[Sizes], Found]] = {
    "log": workers.logging,
    "dispatch": workers.dispatch,
    "overhead": workers.overhead,
    "recovery": workers.recovery,
}


def measure(sizes: Sizes, say: Callable[[str], None] = print) -> dict[str, Found]:
    """Everything, part by part, each on a service of its own."""
    found: dict[str, Found] = {}
    with host() as running:
        running.start("redis")
        running.start("api")
        say("submissions")
        found["submit"] = requests.submissions(running, sizes)
        say(f"pages of {sizes.jobs} jobs")
        requests.fill(running, sizes.jobs)
        found["page"] = requests.pages(running, sizes)
        found["dashboard"] = dashboard.first_paint(running)
        say("a grid, curves")
        found["grid"] = requests.grid(running, sizes)
        found["curves"] = requests.curves(running, sizes)
        found["api"] = requests.weight(running)
    with host(api_processes=2) as running:
        running.start("redis")
        running.start("api")
        say("the same of two API processes")
        found["submit_two"] = requests.submissions(running, sizes)
        requests.fill(running, sizes.jobs)
        found["page_two"] = requests.pages(running, sizes)
    with host() as running:
        for name in ("redis", "api"):
            running.start(name)
        say("live numbers, figures, views")
        found["dashboard"] |= dashboard.live(running)
        running.start("worker")
        found["dashboard"] |= dashboard.drawings(running)
    for name, part in PARTS.items():
        say(name)
        found[name] = part(sizes)
    return found


def main(arguments: list[str] | None = None) -> int:
    """Measure, write, print."""
    words = argparse.ArgumentParser("services.bench", description=__doc__)
    words.add_argument(
        "--json", type=Path, metavar="FILE", help="write the figures here, and FILE's name .md beside it"
    )
    words.add_argument("--little", action="store_true", help="small counts: shows that it works, measures nothing")
    asked = words.parse_args(arguments)
    about = machine()
    found = measure(LITTLE if asked.little else WHOLE, lambda text: print(f"{text} ...", file=sys.stderr, flush=True))
    command = "python -m services.bench" + (f" --json {asked.json}" if asked.json else "")
    parts = (figures_of(found), targets_of(found), others_of(found))
    result = ServiceResult(machine=about, command=command, figures=parts[0], targets=parts[1], others=parts[2])
    page = render(result)
    if asked.json:
        asked.json.parent.mkdir(parents=True, exist_ok=True)
        asked.json.write_text(result.model_dump_json(indent=1) + "\n")
        asked.json.with_suffix(".md").write_text(page)
    print(page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
