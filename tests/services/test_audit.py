"""The audit log: what changes something is in it, and what changes it is seen."""

from __future__ import annotations

import hashlib
import json
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from services.settings import Settings
from services.store import audit, tokens
from services.store.session import Store
from tests.services.conftest import bearer, serving
from tests.services.test_api_access import JOB


def entry(number: int = 0) -> audit.Entry:
    return audit.Entry("ann", None, "POST", f"/api/v1/jobs/{number}", "done", 202, "127.0.0.1", "r", {"n": number})


def test_the_chain_is_the_one_that_anybody_can_compute(store: Store) -> None:
    first, second = audit.append(store, entry(1)), audit.append(store, entry(2))
    assert (first.previous_sha256, second.previous_sha256) == ("0" * 64, first.sha256)
    said = {
        "actor": "ann", "token_id": None, "verb": "POST", "object": "/api/v1/jobs/1", "outcome": "done", "status": 202,
        "ip": "127.0.0.1", "request_id": "r", "detail": {"n": 1}, "at": round(first.at * 1e6), "previous": "0" * 64,
    }  # fmt: skip
    text = json.dumps(said, sort_keys=True, separators=(",", ":"))
    assert first.sha256 == hashlib.sha256(text.encode()).hexdigest()
    assert audit.verify(store) == audit.Verdict(2, second.sha256, None)


@pytest.mark.parametrize(
    "crime",
    [
        "update audit set actor = 'bob' where id = 3",
        "update audit set at = at - 60 where id = 3",
        "update audit set detail = '{}' where id = 3",
        "delete from audit where id = 3",
    ],
)
def test_what_was_changed_is_found(store: Store, crime: str) -> None:
    for number in range(5):
        audit.append(store, entry(number))
    assert audit.verify(store).broken_at is None
    with store.engine.begin() as connection:
        connection.exec_driver_sql(crime)
    assert audit.verify(store).broken_at == (4 if crime.startswith("delete") else 3)


def test_writers_at_once_make_one_chain(store: Store) -> None:
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda n: audit.append(store, entry(n)), range(40)))
    verdict = audit.verify(store)
    assert (verdict.rows, verdict.broken_at) == (40, None)


def test_requests_that_change_something_are_logged_with_their_outcome(closed: httpx.Client, store: Store) -> None:
    ann, admin = bearer(store, "submit"), bearer(store, "admin", owner="eve")
    reply = closed.post("/api/v1/jobs", json=JOB, headers=ann | {"x-request-id": "first"})
    closed.post("/api/v1/jobs", json={"method": "none"}, headers=ann)
    closed.post("/api/v1/jobs", json=JOB)
    closed.get("/api/v1/jobs", headers=ann)
    assert closed.get("/api/v1/audit", headers=ann).status_code == 403
    page = closed.get("/api/v1/audit?limit=2", headers=admin).json()
    rest = closed.get(f"/api/v1/audit?cursor={page['next_cursor']}", headers=admin).json()
    records = [*page["items"], *rest["items"]]
    assert [(r["actor"], r["status"], r["outcome"]) for r in records] == [
        ("anonymous", 401, "refused"),
        ("ann", 422, "refused"),
        ("ann", 202, "done"),
    ]
    first = records[-1]
    assert (first["request_id"], first["object"], first["ip"]) == ("first", "/api/v1/jobs", "127.0.0.1")
    assert first["detail"]["location"] == f"/api/v1/jobs/{reply.json()['id']}"
    assert rest["next_cursor"] is None
    verdict = closed.get("/api/v1/audit/verify", headers=admin).json()
    assert verdict == {"whole": True, "rows": 3, "head": records[0]["sha256"], "broken_at": None}


def test_a_login_is_logged_with_its_token_and_without_its_secret(closed: httpx.Client, store: Store) -> None:
    token, secret = tokens.issue(store, "n", "ann", ["read"])
    closed.post("/login", data={"token": secret})
    closed.cookies.clear()
    closed.post("/login", data={"token": "rsa_wrong"})
    wrong, right = audit.page(store, None, 10)
    assert (right.entry.actor, right.entry.token_id, right.entry.status) == ("ann", token.id, 303)
    assert (wrong.entry.actor, wrong.entry.token_id, wrong.entry.status) == ("anonymous", None, 401)
    assert "rsa_" not in str([wrong, right])


def test_counts_and_latencies_are_for_those_who_may_read(
    settings: Settings, store: Store, client: httpx.Client
) -> None:
    client.get("/api/v1/jobs")
    text = client.get("/metrics").text
    assert 'rsavatar_http_request_seconds_count{method="GET",route="/api/v1/jobs",status="2xx"} 1.0' in text
    with serving(settings.model_copy(update={"require_token": True})) as closed:
        assert closed.get("/metrics").status_code == 401
        assert closed.get("/metrics", headers=bearer(store, "read")).status_code == 200
