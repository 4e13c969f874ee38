from __future__ import annotations

import csv
import io
from pathlib import Path

import httpx
import pytest

from rsavatar.catalog import METHODS
from services.settings import Settings
from services.store.session import Store
from tests.services.conftest import bearer, serving
from tests.services.test_api_jobs import finish, post


@pytest.fixture
def subject(tmp_path: Path) -> Path:
    folder = tmp_path / "data" / "wave"
    (folder / "rs").mkdir(parents=True)
    (folder / "rs" / "annots.npy").touch()
    return folder


def test_catalogue(untouched: httpx.Client) -> None:
    methods = untouched.get("/api/v1/methods").json()
    assert [m["name"] for m in methods] == list(METHODS)
    assert all(m["description"] for m in methods)
    assert {"smoke", "draft", "paper"} <= set(untouched.get("/api/v1/presets").json())
    assert "lambda" in untouched.get("/api/v1/spec/schema").json()["properties"]


def test_openapi_shows_the_spec_as_the_body_of_a_submission(untouched: httpx.Client) -> None:
    document = untouched.get("/api/v1/openapi.json").json()
    body = document["components"]["schemas"]["JobRequest"]
    assert body["required"] == ["method", "subject"]
    assert body["additionalProperties"] is False
    assert "iterations" in body["properties"]
    assert "#/components/schemas/Ablation" in str(body["properties"]["ablation"])


def test_an_operator_registers_a_directory(client: httpx.Client, subject: Path) -> None:
    body = {"name": "wave", "path": str(subject)}
    first, again = client.post("/api/v1/subjects", json=body), client.post("/api/v1/subjects", json=body)
    assert (first.status_code, again.status_code, first.json()["kind"]) == (201, 200, "rolling")
    assert [s["name"] for s in client.get("/api/v1/subjects").json()] == ["studio", "wave"]
    assert post(client, subject="wave").status_code == 202
    other = client.post("/api/v1/subjects", json={"name": "studio", "path": str(subject)})
    assert other.status_code == 409


@pytest.mark.parametrize("path", ["relative", "/nowhere/at/all", "/", "/etc/passwd", "/etc\0/x"])
def test_what_is_no_subject_is_refused(untouched: httpx.Client, path: str) -> None:
    reply = untouched.post("/api/v1/subjects", json={"name": "x", "path": path})
    assert (reply.status_code, reply.json()["errors"][0]["name"]) == (422, "path")


def test_off_loopback_only_the_roots_count(settings: Settings, store: Store, subject: Path, tmp_path: Path) -> None:
    outside = tmp_path / "secret"
    outside.mkdir()
    (outside / "annots.npy").touch()
    (subject.parent / "link").symlink_to(outside)
    remote = settings.model_copy(update={"require_token": True, "subject_roots": (subject.parent,)})
    with serving(remote) as client:
        client.headers.update(bearer(store, "admin"))
        for path in (outside, subject.parent / "link", subject.parent / ".." / "secret"):
            reply = client.post("/api/v1/subjects", json={"name": "x", "path": str(path)})
            assert reply.status_code == 422
        assert client.post("/api/v1/subjects", json={"name": "x", "path": str(subject)}).status_code == 201


def test_what_lies_in_a_root_is_known_from_the_start(settings: Settings, store: Store, subject: Path) -> None:
    (subject.parent / "notes").mkdir()
    (subject.parent / "not a name").symlink_to(subject)
    with serving(settings.model_copy(update={"subject_roots": (subject.parent,)})) as client:
        assert [s["name"] for s in client.get("/api/v1/subjects").json()] == ["studio", subject.name]


def test_tables_in_every_format(client: httpx.Client, store: Store) -> None:
    for method in ("gauhuman", "rs-avatar"):
        post(client, method=method)
        finish(store, psnr=20.0 if method == "gauhuman" else 22.0)
    kinds = {"json": "application/json", "csv": "text/csv", "md": "text/markdown", "tex": "application/x-tex"}
    for name in ("main", "per-subject"):
        for fmt, kind in kinds.items():
            reply = client.get(f"/api/v1/tables/{name}.{fmt}")
            assert reply.status_code == 200
            assert reply.headers["content-type"].startswith(kind)
            assert reply.content == client.get(f"/api/v1/tables/{name}.{fmt}").content
    rows = list(csv.DictReader(io.StringIO(client.get("/api/v1/tables/main.csv").text.split("\n#")[0])))
    assert [(row["method"], float(row["psnr"])) for row in rows if row["psnr"]][:2] == [
        ("gauhuman", 20.0),
        ("rs-avatar", 22.0),
    ]
    assert "22" not in client.get("/api/v1/tables/main.csv?preset=paper").text.split("\n")[1:2]
    assert client.get("/api/v1/tables/none.csv").status_code == 404
    assert client.get("/api/v1/tables/main.xls").status_code == 422


def test_health_readiness_and_counts(client: httpx.Client) -> None:
    post(client)
    assert client.get("/healthz").json() == {"status": "ok"}
    assert client.get("/readyz").json() == {
        "status": "ok",
        "checks": {"database": "ok", "broker": "ok", "disk": "ok"},
    }
    text = client.get("/metrics").text
    assert 'rsavatar_jobs{state="queued"} 1' in text
    assert "rsavatar_oldest_wait_seconds 0." in text


def test_static_files_name_no_other_site(untouched: httpx.Client) -> None:
    for name in ("style.css", "live.js", "icon.svg"):
        text = untouched.get(f"/static/{name}").text.replace("http://www.w3.org/2000/svg", "")
        assert "//" not in text.replace("// ", "")
