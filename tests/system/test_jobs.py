"""Jobs through real Redis, API, worker and child processes, none of which is disturbed from outside."""

from __future__ import annotations

import pytest

from services import jobs as wake_up
from tests.system.harness import Host, until
from tests.system.quick_child import ALWAYS_DIES, DIVERGES, HANGS, HAS_A_BUG, KILLS_ITSELF_ONCE


def test_a_job_from_submission_to_table(host: Host) -> None:
    job = host.submit()
    view = host.wait_for(job, "succeeded")
    assert (view["attempt"], view["failures"], view["progress"]["step"]) == (1, 0, 60)
    results = host.client.get(f"/api/v1/jobs/{job}/results").json()
    assert results["means"]["lpips"] is None  # NaN of the child
    assert {(s["camera"], s["metric"]) for s in results["scores"]} >= {("01", "psnr"), ("02", "psnr"), ("02", "ssim")}
    assert "a stray print" in host.client.get(f"/api/v1/jobs/{job}/log").text
    assert host.client.get(f"/api/v1/jobs/{job}/metrics").json()["loss"]
    names = [a["name"] for a in host.client.get(f"/api/v1/jobs/{job}/artifacts").json()]
    assert names == ["final", "preview", "preview/00000060-preview.png"]
    assert job in host.client.get("/api/v1/tables/main.json").json()["provenance"]["jobs"]
    assert host.children() == []


def test_the_same_job_again_ends_at_once_with_the_known_result(host: Host) -> None:
    spec = {"method": "gauhuman", "subject": "studio", "preset": "smoke", "iterations": 37}
    first = host.client.post("/api/v1/jobs", json=spec).json()["id"]
    beside = host.client.post("/api/v1/jobs", json={**spec, "priority": 3}).json()["id"]
    assert host.wait_for(first, "succeeded")["attempt"] + host.wait_for(beside, "succeeded")["attempt"] == 1
    again = host.client.post("/api/v1/jobs", json=spec)
    assert (again.status_code, again.json()["state"], again.json()["attempt"]) == (200, "succeeded", 0)
    results = [host.client.get(f"/api/v1/jobs/{job}/results").json() for job in (first, beside, again.json()["id"])]
    assert results[0]["means"] == results[1]["means"] == results[2]["means"]
    forced = host.client.post("/api/v1/jobs", params={"force": True}, json=spec)
    assert (forced.status_code, forced.json()["reused_from"]) == (202, None)
    assert host.wait_for(forced.json()["id"], "succeeded")["attempt"] == 1


def test_duplicate_deliveries_change_nothing(host: Host) -> None:
    job = host.submit(iterations=30)
    app = wake_up.make_app(host.settings)
    for _ in range(5):
        assert wake_up.enqueue(app, job)
    host.wait_for(job, "succeeded")
    until(lambda: wake_up.backlog(app) == 0)
    assert host.job(job)["attempt"] == 1
    assert host.notes(job) == ["starting at step 0"]


def test_a_child_killed_from_outside_goes_on_from_its_checkpoint(host: Host) -> None:
    job = host.submit(seed=KILLS_ITSELF_ONCE)
    view = host.wait_for(job, "succeeded", "failed", "dead")
    assert (view["state"], view["attempt"], view["failures"]) == ("succeeded", 2, 1)
    assert host.notes(job) == ["starting at step 0", "starting at step 20"]
    undisturbed = host.submit()
    host.wait_for(undisturbed, "succeeded")
    assert host.state(job) == host.state(undisturbed)


@pytest.mark.parametrize(
    ("seed", "state", "attempts", "kind", "words"),
    [
        (DIVERGES, "failed", 1, "diverged", "expected a finite number"),
        (HAS_A_BUG, "failed", 1, "bug", "ZeroDivisionError"),
        (ALWAYS_DIES, "dead", 3, "infrastructure", "SIGKILL"),
    ],
)
def test_failures_end_as_their_kind_says(
    host: Host, seed: int, state: str, attempts: int, kind: str, words: str
) -> None:
    view = host.wait_for(host.submit(seed=seed, iterations=10), "succeeded", "failed", "dead")
    assert (view["state"], view["attempt"], view["error"]["kind"]) == (state, attempts, kind)
    assert words in view["error"]["message"]


def test_a_job_that_hangs_is_killed(host: Host) -> None:
    job = host.submit(seed=HANGS, iterations=10, stall_seconds=2.0)
    view = until(lambda: v if (v := host.job(job))["failures"] else {})
    assert "no progress in 2 s" in view["error"]["message"]
    host.client.post(f"/api/v1/jobs/{job}/cancel")
    host.wait_for(job, "cancelled")


def test_cancel_leaves_a_checkpoint_from_which_retry_goes_on(host: Host) -> None:
    job = host.submit(iterations=400, checkpoint_every=400)
    host.wait_for_step(job, 5)
    assert host.client.post(f"/api/v1/jobs/{job}/cancel").json()["cancel_requested"]
    assert host.wait_for(job, "cancelled")["progress"]["step"] < 400
    assert host.children() == []
    host.client.post(f"/api/v1/jobs/{job}/retry")
    host.wait_for(job, "succeeded")
    first, second = host.notes(job)
    assert first == "starting at step 0"
    assert int(second.rsplit(" ", 1)[1]) >= 5


def test_pause_and_resume(host: Host) -> None:
    job = host.submit(iterations=200)
    host.wait_for_step(job, 5)
    host.client.post(f"/api/v1/jobs/{job}/pause")
    assert host.wait_for(job, "paused")["failures"] == 0
    host.client.post(f"/api/v1/jobs/{job}/resume")
    assert host.wait_for(job, "succeeded")["attempt"] == 2
