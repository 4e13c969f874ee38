from __future__ import annotations

from typing import Any

import httpx
import pytest

from services.store import jobs, leases
from services.store.records import Failure
from services.store.session import Store
from tests.services.test_api_jobs import UNKNOWN, finish

BASE = {"subject": "studio", "preset": "smoke"}
METHODS = ["gauhuman", "rs-avatar"]


def body(**changes: Any) -> dict[str, Any]:
    return {"name": "two", "base": BASE, "axes": {"method": METHODS, "seed": [0, 1, 2]}, **changes}


def post(client: httpx.Client, key: str | None = None, dry_run: bool = False, **changes: Any) -> httpx.Response:
    headers = {"Idempotency-Key": key} if key else {}
    return client.post("/api/v1/grids", json=body(**changes), headers=headers, params={"dry_run": dry_run})


def test_a_grid_is_its_jobs_in_their_places(client: httpx.Client) -> None:
    reply = post(client)
    assert reply.status_code == 202
    grid = client.get(reply.headers["location"]).json()
    assert grid["id"] == reply.json()["id"]
    assert (grid["jobs"], grid["counts"]["queued"], grid["terminal"], grid["fraction"]) == (6, 6, False, 0.0)
    assert grid["axes"] == [{"name": "method", "values": METHODS}, {"name": "seed", "values": ["0", "1", "2"]}]
    assert [(c["place"]["method"], c["place"]["seed"]) for c in grid["cells"]] == [
        (method, str(seed)) for method in METHODS for seed in range(3)
    ]
    for cell in grid["cells"]:
        job = client.get(f"/api/v1/jobs/{cell['job_id']}").json()
        assert (job["method"], str(job["spec"]["seed"])) == (cell["place"]["method"], cell["place"]["seed"])
        assert (job["grid_id"], job["state"]) == (grid["id"], "queued")
    listed = client.get("/api/v1/jobs", params={"grid": grid["id"]}).json()["items"]
    assert {job["id"] for job in listed} == {cell["job_id"] for cell in grid["cells"]}


def test_the_matrix_fills_in(client: httpx.Client, store: Store) -> None:
    grid = post(client).json()["id"]
    first = finish(store, psnr=20.0)
    claim = leases.claim(store, "test", 60.0)
    assert claim is not None
    leases.fail(store, claim, Failure.BAD_DATA, "mask: expected a picture, got nothing", 0.0)
    seen = client.get(f"/api/v1/grids/{grid}").json()
    cells = {cell["job_id"]: cell for cell in seen["cells"]}
    assert (cells[first]["state"], cells[first]["metrics"]["psnr"], cells[first]["gaussians"]) == (
        "succeeded",
        20.0,
        42,
    )
    assert cells[claim.job_id]["error"] == {"kind": "bad data", "message": "mask: expected a picture, got nothing"}
    assert (seen["counts"]["succeeded"], seen["counts"]["failed"], seen["counts"]["queued"]) == (1, 1, 4)
    assert seen["fraction"] == pytest.approx(2 / 6)


def test_a_plan_changes_nothing_and_tells_what_it_stands_on(client: httpx.Client, store: Store) -> None:
    client.post("/api/v1/jobs", json={**BASE, "method": "gauhuman", "seed": 0})
    known = finish(store)  # 3 s of training, 1 s of evaluation, 300 steps
    plan = post(client, dry_run=True)
    assert plan.status_code == 200
    found = plan.json()
    assert (found["jobs"], found["reused"]) == (6, 1)
    assert [c["reuses"] for c in found["cells"]] == [known, None, None, None, None, None]
    estimates = {e["method"]: e for e in found["estimates"]}
    assert estimates["gauhuman"]["basis"] == "measured: 1 finished jobs of the same method, subject and preset"
    assert estimates["gauhuman"]["seconds"] == pytest.approx(4.0)
    assert estimates["rs-avatar"]["basis"].startswith("assumed: 0.05 s a step")
    assert found["seconds"] == pytest.approx(2 * 4.0 + 3 * (300 * 0.05 + 30))
    assert client.get("/api/v1/grids").json()["items"] == []


def test_a_repeated_key_repeats_nothing(client: httpx.Client) -> None:
    first, again, other = post(client, "k"), post(client, "k"), post(client, "k", base={**BASE, "iterations": 5})
    assert (first.status_code, again.status_code, other.status_code) == (202, 200, 422)
    assert first.json()["id"] == again.json()["id"]
    assert other.json()["errors"][0]["name"] == "Idempotency-Key"
    assert post(client, "K").status_code == 202
    assert len(client.get("/api/v1/grids").json()["items"]) == 2
    assert post(client, "x" * 201).status_code == 422


def test_verbs_reach_every_job_they_fit(client: httpx.Client, store: Store) -> None:
    grid = post(client).json()["id"]
    done = finish(store)
    running = leases.claim(store, "test", 60.0)
    assert running is not None
    seen = client.post(f"/api/v1/grids/{grid}/pause").json()
    assert (seen["counts"]["paused"], seen["counts"]["running"]) == (4, 1)
    assert jobs.get(store, running.job_id).pause_requested_at is not None
    assert client.post(f"/api/v1/grids/{grid}/resume").json()["counts"]["queued"] == 4
    seen = client.post(f"/api/v1/grids/{grid}/cancel").json()
    assert (seen["counts"]["cancelled"], seen["counts"]["succeeded"], seen["counts"]["running"]) == (4, 1, 1)
    leases.release(store, running)
    assert client.get(f"/api/v1/grids/{grid}").json()["terminal"]
    assert client.post(f"/api/v1/grids/{grid}/retry").json()["counts"]["queued"] == 5
    assert jobs.get(store, done).state == "succeeded"
    assert client.post(f"/api/v1/grids/{grid}/explode").status_code == 422


def test_pages_of_grids_follow_each_other(client: httpx.Client) -> None:
    made = [post(client, name=f"grid-{n}", axes={"seed": [n]}, base={**BASE, "method": "gauhuman"}) for n in range(3)]
    first = client.get("/api/v1/grids", params={"limit": 2}).json()
    rest = client.get("/api/v1/grids", params={"limit": 2, "cursor": first["next_cursor"]}).json()
    assert [g["id"] for g in first["items"] + rest["items"]] == [m.json()["id"] for m in made[::-1]]
    assert rest["next_cursor"] is None
    assert [g["name"] for g in client.get("/api/v1/grids", params={"name": "grid-1"}).json()["items"]] == ["grid-1"]


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"axes": {"method": ["gauhuman", "nerf"]}}, "axes.method"),
        ({"axes": {"subject": ["nobody"], "method": ["gauhuman"]}}, "axes.subject"),
        ({"axes": {"method": ["gauhuman"], "seed": list(range(1001))}}, "grid"),
        ({"axis": {}}, "body.axis"),
        ({"name": ""}, "body.name"),
        ({"axes": {"colour": ["red"]}}, "axes.colour"),
        ({"excludes": [{"seed": 5}]}, "excludes.seed"),
    ],
)
def test_a_refusal_names_what_was_wrong(untouched: httpx.Client, changes: dict[str, Any], name: str) -> None:
    reply = post(untouched, **changes)
    assert reply.status_code == 422
    assert reply.json()["errors"][0]["name"] == name
    assert post(untouched, dry_run=True, **changes).status_code == 422


def test_unknown_grids_and_the_built_in_ones(untouched: httpx.Client) -> None:
    assert untouched.get(f"/api/v1/grids/{UNKNOWN}").status_code == 404
    assert untouched.post(f"/api/v1/grids/{UNKNOWN}/cancel").status_code == 404
    known = untouched.get("/api/v1/grids/built-in").json()
    assert {"main", "ablation", "sweep-T", "sweep-P", "sweep-lambda", "seeds"} <= {grid["name"] for grid in known}
    for grid in known:
        assert untouched.post("/api/v1/grids", json=grid, params={"dry_run": True}).status_code == 200


def test_a_thousand_jobs_are_one_transaction(client: httpx.Client, store: Store) -> None:
    reply = post(client, axes={"method": METHODS, "seed": list(range(500))})
    assert reply.status_code == 202
    assert jobs.count_by_state(store)["queued"] == 1000
    assert len(reply.json()["cells"]) == 1000
