"""Nobody passes without a token, and nobody does with one what it does not allow."""

from __future__ import annotations

import re
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts

from services.api.access import PUBLIC, csrf_of, is_public, require_scopes, unguarded
from services.api.app import create_app
from services.settings import Settings
from services.store import tokens
from services.store.session import Store
from tests.services.conftest import bearer, serving

JOB = {"method": "gauhuman", "subject": "studio", "preset": "smoke"}
SOME = {"job_id": "00000000-0000-7000-8000-000000000000", "verb": "cancel", "format": "md"}


def routes_of(app: FastAPI) -> list[tuple[str, str]]:
    """Method and a path that matches, of every route."""
    found = []
    for route in iter_route_contexts(app.routes):
        path = str(route.path)
        for name in (part.split("}")[0].split(":")[0] for part in path.split("{")[1:]):
            path = path.replace(f"{{{name}}}", SOME.get(name, SOME["job_id"])).replace(f"{{{name}:path}}", "x")
        found += [(method, path) for method in sorted(route.methods or {"GET"})]
    return found


def test_every_route_has_a_scope_or_is_public(settings: Settings, store: Store) -> None:
    app = create_app(settings)
    assert list(unguarded(app)) == []
    assert len(routes_of(app)) > 30
    assert {"/healthz", "/readyz", "/login", "/palette.css"} == PUBLIC


def test_an_application_with_a_forgotten_route_does_not_start(settings: Settings, store: Store) -> None:
    app = create_app(settings)

    @app.get("/forgotten")
    def forgotten() -> str:
        return "secret"

    with pytest.raises(RuntimeError, match="/forgotten"):
        require_scopes(app)


def test_every_route_refuses_who_has_no_token(settings: Settings, store: Store) -> None:
    closed = settings.model_copy(update={"require_token": True})
    walked = [
        (method, path)
        for method, path in routes_of(create_app(settings))
        if not is_public(path) and not path.startswith("/static")
    ]
    with serving(closed) as client:
        for method, path in walked:
            reply = client.request(method, path)
            assert reply.status_code in {401, 429}, (method, path)
            assert reply.headers["content-type"] == "application/problem+json"
            assert "www-authenticate" in reply.headers or "retry-after" in reply.headers


def test_wrong_tokens_of_every_shape_are_refused(closed: httpx.Client, store: Store) -> None:
    good = bearer(store, "read")["authorization"]
    assert closed.get("/api/v1/jobs", headers={"authorization": good}).status_code == 200
    for wrong in (
        good[:-1] + ("A" if good[-1] != "A" else "B"),
        good[:-1],
        "Bearer",
        "Bearer  x",
        "Basic YTpi",
        good[7:],
    ):
        assert closed.get("/api/v1/jobs", headers={"authorization": wrong}).status_code == 401, wrong
    assert closed.get(f"/api/v1/jobs?token={good[7:]}").status_code == 401
    assert closed.get("/healthz").status_code == closed.get("/static/style.css").status_code == 200


def test_only_a_hash_is_kept(store: Store) -> None:
    token, secret = tokens.issue(store, "n", "o", ["read"])
    with store.engine.connect() as connection:
        kept = str(connection.exec_driver_sql("select * from tokens").all())
    assert token.prefix in secret
    assert secret not in kept
    assert secret.rpartition("_")[2] not in kept
    assert tokens.digest(secret) in kept


def test_scopes_are_steps(closed: httpx.Client, store: Store) -> None:
    read, submit, admin = (bearer(store, scope) for scope in ("read", "submit", "admin"))
    token = {"name": "ci", "owner": "bob", "scopes": ["submit"], "days": 1}
    for headers, may in ((read, (200, 403, 403)), (submit, (200, 202, 403)), (admin, (200, 202, 201))):
        got = (
            closed.get("/api/v1/jobs", headers=headers),
            closed.post("/api/v1/jobs", json=JOB, headers=headers),
            closed.post("/api/v1/tokens", json=token, headers=headers),
        )
        assert tuple(reply.status_code for reply in got) == may
    issued = got[2].json()
    me = closed.get("/api/v1/tokens/me", headers={"authorization": f"Bearer {issued['secret']}"}).json()
    assert me == {"owner": "bob", "scopes": ["read", "submit"], "token_id": issued["id"]}
    assert all("secret" not in each for each in closed.get("/api/v1/tokens", headers=admin).json())


def test_an_administrator_bounds_an_owner(closed: httpx.Client, store: Store) -> None:
    admin, ann = bearer(store, "admin", owner="root"), bearer(store, "submit")
    allowed = {"max_queued": 1, "max_running": None, "share": 2.0}
    assert closed.put("/api/v1/owners/ann", json=allowed, headers=ann).status_code == 403
    reply = closed.put("/api/v1/owners/ann", json=allowed, headers=admin)
    assert (reply.status_code, reply.json()) == (200, {"name": "ann", **allowed})
    assert {"name": "ann", **allowed} in closed.get("/api/v1/owners", headers=admin).json()
    replies = [closed.post("/api/v1/jobs", json={**JOB, "seed": seed}, headers=ann) for seed in (1, 2)]
    assert [r.status_code for r in replies] == [202, 429]
    for wrong in ({"max_queued": -1}, {"share": 0}, {"max_running": "many"}, {"more": 1}):
        assert closed.put("/api/v1/owners/ann", json=wrong, headers=admin).status_code == 422
    assert closed.put("/api/v1/owners/a:b", json=allowed, headers=admin).status_code == 422


def test_expired_and_revoked_tokens_end_at_once(closed: httpx.Client, store: Store) -> None:
    admin = bearer(store, "admin")
    token, secret = tokens.issue(store, "n", "o", ["read"])
    headers = {"authorization": f"Bearer {secret}"}
    assert closed.get("/api/v1/jobs", headers=headers).status_code == 200
    for _ in range(2):
        assert closed.delete(f"/api/v1/tokens/{token.id}", headers=admin).json()["revoked_at"] is not None
    assert closed.get("/api/v1/jobs", headers=headers).status_code == 401
    assert tokens.find(store, tokens.issue(store, "n", "o", ["read"], lifetime=0.0)[1]) is None
    assert closed.delete(f"/api/v1/tokens/{SOME['job_id']}", headers=admin).status_code == 404


def test_the_first_token_is_issued_once_and_read_by_its_owner_alone(store: Store, tmp_path: Path) -> None:
    path = tokens.issue_first(store, tmp_path)
    assert path is not None
    assert path.stat().st_mode & 0o777 == 0o600
    token = tokens.find(store, path.read_text().strip())
    assert token is not None
    assert token.scopes == ("admin",)
    assert tokens.issue_first(store, tmp_path) is None
    tokens.revoke(store, token.id)
    assert tokens.issue_first(store, tmp_path) == path
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["admin-token"]


def log_in(client: httpx.Client, store: Store, *scopes: str) -> str:
    """Log in as a browser; returns the secret of the session."""
    secret = bearer(store, *scopes)["authorization"][7:]
    reply = client.post("/login", data={"token": secret, "next": "/jobs"})
    assert (reply.status_code, reply.headers["location"]) == (303, "/jobs")
    said = reply.headers["set-cookie"].lower()
    assert "httponly" in said
    assert "samesite=strict" in said
    return reply.cookies["rsavatar_session"]


def test_a_browser_is_sent_to_the_login_and_back(closed: httpx.Client, store: Store) -> None:
    page = closed.get("/jobs", headers={"accept": "text/html"})
    assert (page.status_code, page.headers["location"]) == (303, "/login?next=/jobs")
    form = closed.get(page.headers["location"]).text
    assert 'name="token"' in form
    assert "<nav" not in form
    for path in re.findall(r'(?:href|src)="(/[^"]+\.(?:css|js|svg))"', form):
        assert closed.get(path).status_code == 200, "what the login page needs comes without a token"
    assert closed.post("/login", data={"token": "rsa_no"}).status_code == 401
    session = log_in(closed, store, "read")
    assert closed.get("/api/v1/jobs").status_code == 200
    assert closed.post("/login", data={"token": session}).status_code == 401, "a session opens no session"


def test_a_session_changes_nothing_without_the_word_of_our_page(closed: httpx.Client, store: Store) -> None:
    session = log_in(closed, store, "submit")
    assert closed.post("/api/v1/jobs", json=JOB).status_code == 403
    assert closed.post("/api/v1/jobs", json=JOB, headers={"x-csrf-token": b"\xfc"}).status_code == 403
    word = csrf_of(session)
    assert closed.post("/api/v1/jobs", json=JOB, headers={"x-csrf-token": word}).status_code == 202
    assert closed.post("/logout", data={"csrf": "other"}).status_code == 403
    assert closed.post("/logout", data={"csrf": word}).headers["location"] == "/login"
    closed.cookies.set("rsavatar_session", session)
    assert closed.get("/api/v1/jobs").status_code == 401


def test_a_session_ends_with_the_token_that_opened_it(closed: httpx.Client, store: Store) -> None:
    log_in(closed, store, "read")
    assert closed.get("/api/v1/jobs").status_code == 200
    (token,) = tokens.all_of(store)
    tokens.revoke(store, token.id)
    assert closed.get("/api/v1/jobs").status_code == 401


@pytest.mark.parametrize(
    "target", ["//evil.example", "https://evil.example", "/\\evil.example", "javascript:x", "/a\r\nb"]
)
def test_the_login_leads_nowhere_else(closed: httpx.Client, store: Store, target: str) -> None:
    secret = bearer(store, "read")["authorization"][7:]
    assert closed.post("/login", data={"token": secret, "next": target}).headers["location"] == "/"


def test_all_see_a_job_and_its_owner_or_an_administrator_steers_it(closed: httpx.Client, store: Store) -> None:
    ann, bob, admin = bearer(store, "submit"), bearer(store, "submit", owner="bob"), bearer(store, "admin", owner="eve")
    job = closed.post("/api/v1/jobs", json=JOB, headers=ann).json()["id"]
    assert closed.get(f"/api/v1/jobs/{job}", headers=bob).status_code == 200
    assert closed.post(f"/api/v1/jobs/{job}/cancel", headers=bob).status_code == 403
    assert closed.post(f"/api/v1/jobs/{job}/pause", headers=ann).status_code == 202
    assert closed.post(f"/api/v1/jobs/{job}/cancel", headers=admin).status_code == 202
    assert closed.post(f"/api/v1/jobs/{SOME['job_id']}/cancel", headers=bob).status_code == 404


def test_who_asks_too_often_waits(settings: Settings, store: Store) -> None:
    slow = settings.model_copy(update={"require_token": True, "request_burst": 5.0, "requests_per_second": 0.01})
    with serving(slow) as client:
        headers, other = bearer(store, "read"), bearer(store, "read")
        statuses = [client.get("/api/v1/jobs", headers=headers).status_code for _ in range(7)]
        assert statuses == [200] * 5 + [429] * 2
        reply = client.get("/api/v1/jobs", headers=headers)
        assert 1 <= int(reply.headers["retry-after"]) <= 100
        assert reply.json()["status"] == 429
        assert client.get("/api/v1/jobs", headers=other).status_code == 200


def test_limits_hold_without_redis(settings: Settings, store: Store) -> None:
    away = {"broker_url": "redis+socket:///nowhere/redis.sock", "require_token": True, "request_burst": 2.0}
    with serving(settings.model_copy(update={**away, "requests_per_second": 0.01})) as client:
        headers = bearer(store, "read")
        assert [client.get("/api/v1/jobs", headers=headers).status_code for _ in range(3)] == [200, 200, 429]


def test_an_error_nobody_foresaw_is_a_problem_with_an_id(settings: Settings, store: Store) -> None:
    app = create_app(settings)

    @app.get("/broken")
    def broken() -> None:
        raise ZeroDivisionError

    with serving(settings, app) as client:
        reply = client.get("/broken", headers={"x-request-id": "abc-1"})
        assert (reply.status_code, reply.headers["content-type"]) == (500, "application/problem+json")
        assert "abc-1" in reply.json()["detail"]
        assert reply.headers["x-request-id"] == "abc-1"
        assert "ZeroDivision" not in reply.text
        assert "default-src" in reply.headers["content-security-policy"]
        assert client.get("/healthz", headers={"x-request-id": "a b"}).headers["x-request-id"] != "a b"
