"""The benchmark of the service: its arithmetic by hand, its clients against a real service, its page. No times."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from services.bench import requests
from services.bench.host import host
from services.bench.load import Sample, closed_loop, encode, open_loop
from services.bench.page import render
from services.bench.promises import OTHERS, TARGETS, figures_of, others_of, targets_of, unit_of
from services.bench.results import Other, ServiceResult, Target, machine
from services.bench.sizes import LITTLE
from services.store import jobs

TINY = replace(LITTLE, warm_up=2, requests=20, jobs=60, grid_jobs=6, submissions_per_second=500.0)


def test_quantiles_are_by_nearest_rank() -> None:
    sample = Sample(tuple(float(n) for n in range(1, 101)), 2.0)
    assert [sample.quantile(share) for share in (0.01, 0.5, 0.95, 1.0)] == [1.0, 50.0, 95.0, 100.0]
    assert sample.per_second == 50.0
    assert Sample((7.0,), 1.0).quantile(0.5) == 7.0


def test_a_request_is_what_a_server_reads() -> None:
    head, _, body = encode("POST", "/x", {"a": 1}).partition(b"\r\n\r\n")
    assert head.startswith(b"POST /x HTTP/1.1\r\nhost: 127.0.0.1\r\n")
    assert json.loads(body) == {"a": 1}
    assert f"content-length: {len(body)}".encode() in head


def test_a_service_is_measured_and_does_what_it_is_measured_for() -> None:
    with host(api_processes=2) as running:
        running.start("redis")
        api = running.start("api")
        assert sum("--multiprocessing-fork" in " ".join(child.cmdline()) for child in api.children()) == 2
        found = {"submit": requests.submissions(running, TINY)}
        assert jobs.count_by_state(running.store)["queued"] == 2 + 20 + 20
        requests.fill(running, TINY.jobs)
        assert sum(jobs.count_by_state(running.store).values()) == 42 + 60
        found |= {"page": requests.pages(running, TINY), "grid": requests.grid(running, TINY)}
        assert sum(jobs.count_by_state(running.store).values()) == 42 + 60 + 6
        found |= {"curves": requests.curves(running, TINY), "api": requests.weight(running)}
        with pytest.raises(RuntimeError, match="answer: expected 200, got 404"):
            closed_loop(running.settings.port, 1, lambda n: encode("GET", "/api/v1/nothing"), 200)
        health = open_loop(running.settings.port, 40, lambda n: encode("GET", "/healthz"), 200, 400.0)
        assert len(health.latencies_ms) == 40
        assert health.seconds >= 39 / 400
    assert all(value >= 0 for part in found.values() for value in part.values())
    assert found["api"]["torch"] == 0


def test_the_page_says_what_was_promised_and_what_came_of_it() -> None:
    found: dict[str, dict[str, float]] = {}
    for part, figure, *_ in (*TARGETS, *OTHERS):
        found.setdefault(part, {})[figure] = 1.0
    found["submit"]["per_second"] = 299.0
    parts = {"figures": figures_of(found), "targets": targets_of(found), "others": others_of(found)}
    result = ServiceResult(machine=machine(), command="test", **parts)
    assert ServiceResult.model_validate_json(result.model_dump_json()) == result
    page = render(result)
    assert "| POST /jobs, 20 clients without a pause | at least 300 1/s | 299 1/s | not met |" in page
    assert "| torch in the API's process | at most 0 | 1 | not met |" in page
    assert "| memory of the API's process | at most 150 MB | 1 MB | met |" in page
    assert "| submit.per_second | 299 1/s |" in page


def test_ratios_are_in_our_favour_above_one() -> None:
    common = {"what": "w", "who": "x", "source": "s"}
    assert Other(**common, theirs=10.0, ours=5.0, unit="ms").ratio == 2.0
    assert Other(**common, theirs=10.0, ours=50.0, unit="1/s").ratio == 5.0
    assert not Target(name="t", bound=1.0, sense="at most", measured=1.1, unit="s").met
    assert Target(name="t", bound=1.0, sense="at least", measured=1.0, unit="s").met
    assert [unit_of(name) for name in ("p50_ms", "per_second", "rss_mb", "torch")] == ["ms", "1/s", "MB", ""]
