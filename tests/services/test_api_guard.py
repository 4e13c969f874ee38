from __future__ import annotations

from collections.abc import Iterator

import httpx
import pytest

from services.settings import Settings
from services.store.session import Store
from tests.services.conftest import serving
from tests.services.test_api_jobs import REQUEST


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8000", "user@127.0.0.1", "", "ü"])
def test_a_foreign_name_of_this_host_is_refused(untouched: httpx.Client, host: str) -> None:
    reply = untouched.get("/api/v1/jobs", headers={"host": host.encode()})
    assert reply.status_code in {400, 421}


@pytest.mark.parametrize("host", ["localhost", "localhost:99", "127.0.0.1", "[::1]:8000"])
def test_names_of_loopback_are_ours(untouched: httpx.Client, host: str) -> None:
    assert untouched.get("/healthz", headers={"host": host}).status_code == 200


def test_another_site_cannot_submit(client: httpx.Client) -> None:
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
        reply = client.post("/api/v1/jobs", json=REQUEST, headers={"origin": origin})
        assert (reply.status_code, reply.headers["content-type"]) == (403, "application/problem+json")
    own = str(client.base_url).rstrip("/")
    assert client.post("/api/v1/jobs", json=REQUEST, headers={"origin": own}).status_code == 202


def test_a_form_of_another_site_is_no_json(untouched: httpx.Client) -> None:
    reply = untouched.post("/api/v1/jobs", content=b'{"method":"gauhuman","subject":"studio"}')
    assert reply.status_code == 422


def test_large_bodies_are_refused_with_and_without_a_length(client: httpx.Client, settings: Settings) -> None:
    large = b" " * (settings.max_body_bytes + 1)

    def pieces() -> Iterator[bytes]:
        for start in range(0, len(large), 4096):
            yield large[start : start + 4096]

    for content in (large, pieces()):
        reply = client.post("/api/v1/jobs", content=content, headers={"content-type": "application/json"})
        assert reply.status_code == 413, reply.text


@pytest.mark.parametrize("path", ["/", "/api/v1/jobs", "/healthz", "/static/style.css", "/nowhere"])
def test_every_reply_carries_the_headers(untouched: httpx.Client, path: str) -> None:
    headers = untouched.get(path).headers
    assert "default-src 'none'" in headers["content-security-policy"]
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["cross-origin-resource-policy"] == "same-origin"
    assert "server" not in headers or "uvicorn" in headers["server"]


def test_unknown_paths_and_verbs_are_problems(untouched: httpx.Client) -> None:
    for reply, status in ((untouched.get("/nowhere"), 404), (untouched.delete("/api/v1/jobs"), 405)):
        assert (reply.status_code, reply.json()["status"]) == (status, status)
        assert reply.headers["content-type"] == "application/problem+json"


def test_a_named_host_is_let_in(settings: Settings, store: Store) -> None:
    with serving(settings.model_copy(update={"allowed_hosts": ("api",)})) as client:
        assert client.get("/healthz", headers={"host": "api:8000"}).status_code == 200
        assert client.get("/healthz", headers={"host": "apis"}).status_code == 421
