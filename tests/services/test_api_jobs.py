from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from services.settings import Settings
from services.store import artifacts, jobs, leases
from services.store.records import Batch, Event, Look, Outcome, Point, Score
from services.store.session import Store

REQUEST = {"method": "gauhuman", "subject": "studio", "preset": "smoke"}
UNKNOWN = "00000000-0000-7000-8000-000000000000"


def post(client: httpx.Client, key: str | None = None, **changes: object) -> httpx.Response:
    headers = {"Idempotency-Key": key} if key else {}
    return client.post("/api/v1/jobs", json={**REQUEST, **changes}, headers=headers)


def finish(store: Store, psnr: float = 21.5) -> str:
    """Claim the next job and let it succeed."""
    claim = leases.claim(store, "test", 60.0)
    assert claim is not None
    look = Look("train", 10, 10, 0.25, None, 42, 0.0)
    points = [Point("loss", step, 1.0 / step) for step in range(1, 11)]
    leases.beat(store, claim, Batch([Event("note", {"text": "a body"})], points, [], look), 60.0)
    scores = (Score("01", 1, "psnr", psnr),)
    provenance = {"commit": "c" * 40, "data_sha256": "d" * 64}
    protocol = {"dilation": 5, "cameras": ["01"]}
    outcome = Outcome({"psnr": psnr, "lpips": None}, {"01": {"psnr": psnr}}, protocol, provenance, 42, 3.0, 1.0, scores)
    leases.succeed(store, claim, outcome)
    return claim.job_id


def test_a_job_is_accepted_complete_and_found_again(client: httpx.Client) -> None:
    reply = post(client, T=4, method="rs-avatar")
    assert reply.status_code == 202
    job = client.get(reply.headers["location"]).json()
    assert job["id"] == reply.json()["id"]
    assert (job["state"], job["spec"]["T"], job["spec"]["P"], job["spec"]["lambda"]) == ("queued", 4, 4, 1.0)
    assert job["created_at"].endswith("Z")


def test_a_repeated_key_repeats_nothing(client: httpx.Client) -> None:
    first, again, other = post(client, "k"), post(client, "k"), post(client, "k", seed=1)
    assert (first.status_code, again.status_code, other.status_code) == (202, 200, 422)
    assert first.json()["id"] == again.json()["id"]
    assert other.json()["errors"][0]["name"] == "Idempotency-Key"
    assert len(client.get("/api/v1/jobs").json()["items"]) == 1


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"iteratoins": 3}, "iteratoins"),
        ({"method": "nerf"}, "method"),
        ({"method": ["gauhuman"]}, "method"),
        ({"preset": "tiny"}, "preset"),
        ({"subject": "nobody"}, "subject"),
        ({"subject": "../../etc"}, "subject"),
        ({"ablation": {"no_rs": True}}, "ablation"),
        ({"iterations": 0}, "iterations"),
        ({"iterations": "many"}, "iterations"),
    ],
)
def test_a_refusal_names_what_was_wrong(untouched: httpx.Client, changes: dict[str, object], name: str) -> None:
    reply = post(untouched, **changes)
    assert reply.status_code == 422
    assert reply.headers["content-type"] == "application/problem+json"
    problem = reply.json()
    assert problem["errors"][0]["name"].split(".")[0] == name, problem
    assert problem["errors"][0]["expected"]
    assert untouched.get("/api/v1/jobs").json()["items"] == []


@pytest.mark.parametrize("body", [b"", b"[]", b"nul", b'{"a":', b'"text"', b"\xff\xfe"])
def test_a_body_that_is_no_object_is_refused(untouched: httpx.Client, body: bytes) -> None:
    reply = untouched.post("/api/v1/jobs", content=body, headers={"content-type": "application/json"})
    assert reply.status_code in {400, 422}
    assert reply.headers["content-type"] == "application/problem+json"


def test_listing_pages_and_filters(client: httpx.Client) -> None:
    ids = [post(client, seed=n, method=("gauhuman", "rs-avatar")[n % 2]).json()["id"] for n in range(5)]
    first = client.get("/api/v1/jobs", params={"limit": 3}).json()
    second = client.get("/api/v1/jobs", params={"limit": 3, "cursor": first["next_cursor"]}).json()
    assert [job["id"] for job in first["items"] + second["items"]] == ids[::-1]
    assert second["next_cursor"] is None
    assert len(client.get("/api/v1/jobs", params={"method": "rs-avatar", "state": "queued"}).json()["items"]) == 2
    for bad in ({"limit": 1000}, {"cursor": "x"}, {"state": "lost"}, {"colour": "red"}):
        assert client.get("/api/v1/jobs", params=bad).status_code == 422


def test_verbs_and_their_refusals(client: httpx.Client) -> None:
    job = post(client).json()["id"]
    assert client.post(f"/api/v1/jobs/{job}/pause").json()["state"] == "paused"
    assert client.post(f"/api/v1/jobs/{job}/resume").json()["state"] == "queued"
    assert client.post(f"/api/v1/jobs/{job}/cancel").json()["state"] == "cancelled"
    assert client.post(f"/api/v1/jobs/{job}/retry").json()["state"] == "queued"
    refusal = client.post(f"/api/v1/jobs/{job}/resume")
    assert (refusal.status_code, refusal.json()["errors"][0]["got"]) == (409, "queued")
    assert client.post(f"/api/v1/jobs/{job}/explode").status_code == 422
    assert client.post(f"/api/v1/jobs/{UNKNOWN}/cancel").status_code == 404


@pytest.mark.parametrize("place", ["", "/metrics", "/results", "/artifacts", "/log", "/events"])
def test_an_unknown_job_is_unknown_everywhere(untouched: httpx.Client, place: str) -> None:
    assert untouched.get(f"/api/v1/jobs/{UNKNOWN}{place}").status_code == 404
    assert untouched.get(f"/api/v1/jobs/1{place}").status_code == 422


def test_results_curves_and_log(client: httpx.Client, store: Store, settings: Settings) -> None:
    job = post(client).json()["id"]
    assert client.get(f"/api/v1/jobs/{job}/results").status_code == 409
    assert client.get(f"/api/v1/jobs/{job}/log").text == ""
    assert finish(store) == job
    settings.job_dir(job).mkdir(parents=True)
    (settings.job_dir(job) / "log.txt").write_text("line one\nline two\n")
    results = client.get(f"/api/v1/jobs/{job}/results").json()
    assert results["means"] == {"psnr": 21.5, "lpips": None}
    assert results["scores"] == [{"camera": "01", "frame": 1, "metric": "psnr", "value": 21.5}]
    assert client.get(f"/api/v1/jobs/{job}/metrics").json()["loss"][0] == [1, 1.0]
    tail = client.get(f"/api/v1/jobs/{job}/log", params={"offset": 9})
    assert (tail.text, tail.headers["x-next-offset"]) == ("line two\n", "18")
    seen = client.get(f"/api/v1/jobs/{job}").json()
    assert (seen["state"], seen["progress"]["fraction"], seen["progress"]["psnr"]) == ("succeeded", 1.0, 21.5)


def test_artifacts_are_served_as_they_are_and_run_nowhere(client: httpx.Client, store: Store, tmp_path: Path) -> None:
    job = post(client).json()["id"]
    claim = leases.claim(store, "test", 60.0)
    assert claim is not None
    kept = []
    for name, data in (("page.html", b"<script>"), ("view.png", b"\x89PNG")):
        (tmp_path / name).write_bytes(data)
        kept.append(artifacts.keep(store, name, tmp_path / name))
    leases.beat(store, claim, Batch(artifacts=kept), 60.0)
    page, view = (client.get(a["url"]) for a in client.get(f"/api/v1/jobs/{job}/artifacts").json())
    assert (page.content, page.headers["content-type"]) == (b"<script>", "application/octet-stream")
    assert page.headers["content-disposition"].startswith("attachment")
    assert (view.headers["content-type"], view.headers["content-disposition"][:6]) == ("image/png", "inline")
    for reply in (page, view):
        assert reply.headers["x-content-type-options"] == "nosniff"
        assert "sandbox" in reply.headers["content-security-policy"]
        assert "immutable" in reply.headers["cache-control"]
    assert client.get(f"/api/v1/artifacts/{'0' * 64}").status_code == 404
    assert client.get("/api/v1/artifacts/..%2f..%2frsavatar.db").status_code in {404, 422}
    store.blobs.remove(kept[0].sha256)
    assert client.get(f"/api/v1/artifacts/{kept[0].sha256}").status_code == 404


def test_an_accepted_job_does_not_need_the_broker(settings: Settings, store: Store) -> None:
    from tests.services.conftest import serving

    away = settings.model_copy(update={"broker_url": f"redis+socket://{settings.home}/away.sock"})
    with serving(away) as client:
        job = post(client).json()["id"]
        assert jobs.get(store, job).state == "queued"
        ready = client.get("/readyz")
        assert (ready.status_code, ready.json()["checks"]["database"]) == (503, "ok")
        assert "broker" in ready.json()["checks"]["broker"]
