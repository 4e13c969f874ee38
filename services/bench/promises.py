"""What the measurements are called, what they promise, and what others were measured at."""

from __future__ import annotations

from collections.abc import Mapping

from services.bench.requests import Found
from services.bench.results import Figure, Other, Target

Measured = Mapping[str, Found]

CLOSED = "20 clients without a pause"
TWO = "two API processes"
UNITS = {"_ms": "ms", "_s": "s", "_mb": "MB", "_kb": "KB", "_percent": "%", "per_second": "1/s"}
TARGETS: tuple[tuple[str, str, float, str, str], ...] = (  # part, figure, bound, sense, name
    ("submit", "per_second", 300.0, "at least", f"POST /jobs, {CLOSED}"),
    ("submit", "paced_p95_ms", 30.0, "at most", "POST /jobs at 300/s from 20 clients, p95"),
    ("submit", "closed_p95_ms", 30.0, "at most", f"POST /jobs, {CLOSED}, p95"),
    ("page", "paced_p95_ms", 20.0, "at most", "page of 50 among 100 000 jobs at 100/s from 20 clients, p95"),
    ("page", "closed_p95_ms", 20.0, "at most", f"page of 50 among 100 000 jobs, {CLOSED}, p95"),
    ("submit_two", "per_second", 300.0, "at least", f"POST /jobs, {CLOSED}, {TWO}"),
    ("submit_two", "closed_p95_ms", 30.0, "at most", f"POST /jobs, {CLOSED}, p95, {TWO}"),
    (
        "page_two",
        "paced_p95_ms",
        20.0,
        "at most",
        f"page of 50 among 100 000 jobs at 100/s from 20 clients, p95, {TWO}",
    ),
    ("page_two", "closed_p95_ms", 20.0, "at most", f"page of 50 among 100 000 jobs, {CLOSED}, p95, {TWO}"),
    ("log", "log_10_p50_ms", 15.0, "at most", "log 10 metrics, 20 jobs at once, p50"),
    ("log", "log_500_p50_ms", 60.0, "at most", "log 500 metrics, 20 jobs at once, p50"),
    ("curves", "compare_p50_ms", 150.0, "at most", "compare 10 jobs of 10 000 points, p50"),
    ("grid", "queued_s", 2.0, "at most", "grid of 1000 jobs expanded, deduplicated, queued and announced"),
    ("dispatch", "dispatch_mean_ms", 150.0, "at most", "dispatch overhead of a job"),
    ("overhead", "overhead_percent", 0.5, "at most", "logging and heartbeats, of the job's CPU time"),
    ("recovery", "recovery_killed_s", 90.0, "at most", "recovery from a killed worker"),
    ("recovery", "recovery_silent_s", 90.0, "at most", "recovery from a worker that fell silent"),
    ("dashboard", "first_paint_ms", 1000.0, "at most", "first paint of the jobs page, 100 000 jobs, empty cache"),
    ("dashboard", "loaded_kb", 300.0, "at most", "its bytes, styles, scripts and fonts included, compressed"),
    ("dashboard", "live_worst_ms", 1000.0, "at most", "a worker's report on the page of its job, worst of 10"),
    ("dashboard", "figure_first_s", 5.0, "at most", "a figure, the first: its process starts"),
    ("dashboard", "figure_s", 5.0, "at most", "a figure"),
    ("dashboard", "view_p50_ms", 100.0, "at most", "novel view, 512 px, p50"),
    ("dashboard", "rolling_view_p50_ms", 100.0, "at most", "novel view through a rolling shutter, 512 px, p50"),
    ("api", "rss_mb", 150.0, "at most", "memory of the API's process"),
    ("api", "torch", 0.0, "at most", "torch in the API's process"),
)
SQLITE = "bar chart of FastTrackML's repository, 20 clients x 100, SQLite, mean"
GO = "mlflow-go-backend's README, 20 clients, PostgreSQL, mean"
QUEUES = "steventen/python_queue_benchmark, 20 000 empty jobs"
TUNE = "Ray's documentation, tune-scalability"
OTHERS: tuple[tuple[str, str, float, str, str, str], ...] = (  # part, figure, theirs, what, who, source
    ("submit", "closed_p50_ms", 355.0, "create a run", "MLflow", SQLITE),
    ("submit", "closed_p50_ms", 66.0, "create a run", "FastTrackML", SQLITE),
    ("submit", "per_second", 784.0, "create a run", "MLflow", GO),
    ("submit", "per_second", 1448.0, "create a run", "MLflow-Go", GO),
    ("page", "closed_p50_ms", 448.0, "list runs", "MLflow", SQLITE),
    ("page", "closed_p50_ms", 2.0, "list runs (few)", "FastTrackML", SQLITE),
    ("page", "per_second", 19.0, "list runs", "MLflow", GO),
    ("page", "per_second", 192.0, "list runs", "MLflow-Go", GO),
    ("log", "log_10_p50_ms", 355.0, "log 10 metrics", "MLflow", SQLITE),
    ("log", "log_10_p50_ms", 335.0, "log 10 metrics", "FastTrackML", SQLITE),
    ("log", "log_10_p50_ms", 18.2, "log 10 metrics", "MLflow-Go", GO),
    ("log", "log_500_p50_ms", 1095.0, "log 500 metrics", "MLflow", SQLITE),
    ("log", "log_500_p50_ms", 480.0, "log 500 metrics", "FastTrackML", SQLITE),
    (
        "recovery",
        "recovery_silent_s",
        3600.0,
        "a silent worker's job runs again",
        "Celery on Redis, as it comes",
        "its source",
    ),
    ("recovery", "recovery_silent_s", 7200.0, "a silent worker's job runs again", "ClearML", "its source"),
    (
        "recovery",
        "recovery_silent_s",
        540.0,
        "a silent worker's job runs again",
        "Prefect, with an automation",
        "its source",
    ),
)


def unit_of(figure: str) -> str:
    """The unit that a figure's name ends in."""
    return next((unit for ending, unit in UNITS.items() if figure.endswith(ending)), "")


def figures_of(found: Measured) -> list[Figure]:
    """Every number, named by its part."""
    return [
        Figure(name=f"{part}.{name}", value=value, unit=unit_of(name))
        for part, figures in found.items()
        for name, value in figures.items()
    ]


def targets_of(found: Measured) -> list[Target]:
    """Every promise with its measurement."""
    return [
        Target(
            name=name,
            bound=bound,
            sense="at least" if sense == "at least" else "at most",
            measured=found[part][figure],
            unit=unit_of(figure),
        )
        for part, figure, bound, sense, name in TARGETS
        if figure in found[part]  # without a browser, nothing is known of pages
    ]


def others_of(found: Measured) -> list[Other]:
    """What others were measured at, beside ours."""
    return [
        Other(what=what, who=who, theirs=theirs, ours=found[part][figure], unit=unit_of(figure), source=source)
        for part, figure, theirs, what, who, source in OTHERS
    ]
