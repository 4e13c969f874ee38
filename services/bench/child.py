"""A job's process that trains nothing: it counts steps of pure work, and notes when it began and when it was done.

Told by ``RSAVATAR_BENCH_STEP_MS`` how much CPU time a step takes; 0 makes a job of nothing but its own start and end.
"""

import time

BEGUN = time.time()  # before everything that a job imports: what lies before it is the service's doing

import json  # noqa: E402
import os  # noqa: E402
import sys  # noqa: E402
from collections.abc import Callable, Mapping  # noqa: E402
from dataclasses import dataclass, field  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

from rsavatar import errors, events  # noqa: E402
from rsavatar.spec import JobSpec  # noqa: E402
from services.worker.child import serve  # noqa: E402

STEP_MS = "RSAVATAR_BENCH_STEP_MS"
REPORT_EVERY = 25  # steps, as training does
INSTANTS = "instants.json"


@dataclass(frozen=True)
class Nothing:
    """A result without numbers of interest."""

    found: Mapping[str, Any]
    artifacts: Mapping[str, Path] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return dict(self.found)


def work(seconds: float) -> None:
    """Use the processor for this long."""
    until = time.process_time() + seconds
    while time.process_time() < until:
        sum(range(1000))


def run(
    spec: JobSpec, out: Path, subject_dir: Path | None, report: events.Report, should_stop: Callable[[], bool]
) -> Nothing:
    """Count to ``spec.iterations``."""
    step_seconds = float(os.environ.get(STEP_MS, "0")) / 1e3
    started = time.monotonic()
    for step in range(1, spec.iterations + 1):
        work(step_seconds)
        if should_stop():
            raise errors.Interrupted("asked to stop")
        if step % REPORT_EVERY == 0 or step == spec.iterations:
            seconds = time.monotonic() - started
            report(events.Progress("train", step, spec.iterations, seconds, 1.0 / step, None, 7000))
    used = time.process_time()
    found = {
        "spec": spec.model_dump(mode="json", by_alias=True),
        "means": {"psnr": 20.0},
        "per_camera": {},
        "scores": [],
        "protocol": {},
        "gaussians": 7000,
        "train_seconds": time.monotonic() - started,
        "evaluate_seconds": 0.0,
        "provenance": {},
    }
    (out / INSTANTS).write_text(json.dumps({"begun": BEGUN, "done": time.time(), "cpu_seconds": used}))
    return Nothing(found)


if __name__ == "__main__":
    sys.exit(serve(run))
