"""The programs of a deployment with tokens asked for: the first is issued once, uploads are checked by the worker."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx

from services.demo import free_port
from services.store.tokens import first_token_file
from tests.services.archives import zip_of
from tests.system.harness import Host, until


def test_the_first_start_tells_a_token_and_the_second_does_not(tmp_path: Path) -> None:
    host = Host(tmp_path / "home", free_port(), require_token=True)
    try:
        host.start("redis")
        host.start("api")
        log = host.settings.home / "logs" / "api.log"
        secret = first_token_file(host.settings.home).read_text().strip()
        assert until(lambda: log.read_text().count(secret) == 1)
        assert host.client.get("/api/v1/jobs").status_code == 401
        host.client.headers["authorization"] = f"Bearer {secret}"
        assert host.client.get("/api/v1/tokens/me").json()["owner"] == "admin"
        host.kill("api")
        host.start("api")
        assert log.read_text().count("first admin token") == 1
        assert host.client.get("/api/v1/jobs").status_code == 200
        host.start("worker")
        refused_by_the_worker(host)
    finally:
        host.close()


def refused_by_the_worker(host: Host) -> None:
    content = zip_of({"rs/annots.npy": b"no array"})
    headers = {"content-type": "application/zip"}
    sent = host.client.post("/api/v1/subjects?name=wave", content=content, headers=headers)
    assert sent.status_code == 202, sent.text
    until(lambda: look(host)["state"] == "refused", 60.0)
    assert any(finding["severity"] == "error" for finding in look(host)["info"]["report"])


def look(host: Host) -> dict[str, Any]:
    reply: httpx.Response = host.client.get("/api/v1/subjects/wave")
    view: dict[str, Any] = reply.json()
    return view
