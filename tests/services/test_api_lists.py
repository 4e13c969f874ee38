"""Lists and what is written on jobs: filters, orders, tags, notes, priority, curves side by side."""

from __future__ import annotations

import httpx
import pytest

from services.api.views import JobPage, JobView
from services.store import jobs, leases
from services.store.records import Failure
from services.store.session import Store
from tests.services.test_api_jobs import UNKNOWN, finish, post


def ids(client: httpx.Client, **query: object) -> list[str]:
    """Ids of a whole listing, page after page of two."""
    found: list[str] = []
    cursor: dict[str, str] = {}
    while True:
        reply = client.get("/api/v1/jobs", params={"limit": 2, **query, **cursor})
        assert reply.status_code == 200, reply.text
        page = reply.json()
        found += [job["id"] for job in page["items"]]
        if page["next_cursor"] is None:
            return found
        cursor = {"cursor": page["next_cursor"]}


def test_lists_are_filtered_and_sorted_over_pages(client: httpx.Client, store: Store) -> None:
    made = [post(client, seed=seed).json()["id"] for seed in range(5)]
    for psnr in (22.0, 25.0, 21.0):
        finish(store, psnr)
    assert ids(client) == made[::-1]
    assert ids(client, sort="submitted") == made
    assert ids(client, q="psnr>21.5", sort="psnr") == [made[0], made[1]]
    assert ids(client, sort="-psnr")[:3] == [made[1], made[0], made[2]]
    assert sorted(ids(client, sort="-psnr")) == made
    assert ids(client, q="state:queued not seed:4", method="gauhuman") == [made[3]]


@pytest.mark.parametrize(
    ("query", "name"),
    [
        ({"q": "state:failing"}, "q"),
        ({"q": "1; drop table jobs"}, "q"),
        ({"q": "__import__('os')"}, "q"),
        ({"q": "x" * 2000}, "query.q"),
        ({"sort": "spec"}, "query.sort"),
        ({"sort": "psnr desc"}, "query.sort"),
        ({"cursor": "1"}, "query.cursor"),
    ],
)
def test_what_cannot_be_understood_is_refused(untouched: httpx.Client, query: dict[str, str], name: str) -> None:
    reply = untouched.get("/api/v1/jobs", params=query)
    assert reply.status_code == 422
    assert reply.json()["errors"][0]["name"] == name


def test_the_words_of_a_filter_are_explained(untouched: httpx.Client) -> None:
    told = untouched.get("/api/v1/filters").json()
    assert {"state", "psnr", "tag", "created"} <= {field["name"] for field in told["fields"]}
    assert untouched.get("/api/v1/jobs", params={"q": told["example"]}).status_code == 200
    for sort in told["sorts"]:
        assert untouched.get("/api/v1/jobs", params={"sort": sort}).status_code == 200


def test_tags_notes_and_priority_are_written(client: httpx.Client, store: Store) -> None:
    job = post(client).json()["id"]
    place = f"/api/v1/jobs/{job}"
    written = client.patch(place, json={"tags": ["paper", "a.b", "paper"], "notes": "first try", "priority": 5}).json()
    assert (written["tags"], written["notes"], written["priority"]) == (["a.b", "paper"], "first try", 5)
    assert client.patch(place, json={"notes": ""}).json()["tags"] == ["a.b", "paper"]
    assert client.get("/api/v1/jobs", params={"q": "tag:paper"}).json()["items"][0]["tags"] == ["a.b", "paper"]
    assert client.get("/api/v1/tags").json() == {"a.b": 1, "paper": 1}
    assert client.get(place).json()["spec"]["priority"] == 0  # as it was submitted
    finish(store)
    assert client.patch(place, json={"priority": -3, "tags": []}).json()["priority"] == 5
    assert client.get("/api/v1/tags").json() == {}


@pytest.mark.parametrize(
    "body", [{"tags": ["a b"]}, {"tags": [""]}, {"tags": ["x"] * 51}, {"priority": 11}, {"state": "succeeded"}]
)
def test_bad_labels_are_refused(untouched: httpx.Client, body: dict[str, object]) -> None:
    assert untouched.patch(f"/api/v1/jobs/{UNKNOWN}", json=body).status_code == 422
    assert untouched.patch(f"/api/v1/jobs/{UNKNOWN}", json={"notes": "x"}).status_code == 404


def test_curves_of_jobs_are_compared(client: httpx.Client, store: Store) -> None:
    first, second = (post(client, seed=seed).json()["id"] for seed in (0, 1))
    finish(store)
    found = client.get("/api/v1/compare", params={"job": [first, second], "key": "loss"}).json()
    assert set(found) == {first, second}
    assert found[first]["loss"] == client.get(f"/api/v1/jobs/{first}/metrics").json()["loss"]
    assert found[second] == {}
    short = client.get(f"/api/v1/jobs/{first}/metrics", params={"key": ["loss"], "points": 4}).json()["loss"]
    assert (short[0], short[-1], len(short)) == ([1, 1.0], [10, 0.1], 4)
    assert client.get("/api/v1/compare", params={"job": [first, first]}).status_code == 422
    assert client.get("/api/v1/compare").status_code == 422
    assert client.get("/api/v1/compare", params={"job": [UNKNOWN]}).status_code == 404


def test_a_line_is_what_the_view_of_its_job_would_be(client: httpx.Client, store: Store) -> None:
    made = [post(client, seed=seed).json()["id"] for seed in range(3)]
    finish(store, 21.0)
    claim = leases.claim(store, "test", 60.0)
    assert claim is not None
    leases.fail(store, claim, Failure.BAD_DATA, "mask: expected a picture, got nothing", 0.0)
    client.patch(f"/api/v1/jobs/{made[2]}", json={"tags": ["a", "b"]})
    page = client.get("/api/v1/jobs").json()
    tags = {made[2]: ["a", "b"]}
    views = [JobView.of(jobs.get(store, job), tags.get(job, ())) for job in made[::-1]]
    assert page == JobPage(items=views, next_cursor=None).model_dump(mode="json")
