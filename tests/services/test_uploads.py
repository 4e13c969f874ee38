"""Archives of subjects: honest ones become ready, all others are refused and leave nothing behind."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from services.settings import Settings, make_home
from services.store import schema, subjects
from services.store.session import Store
from services.unpack.caps import disguise, plain_path
from services.worker.checks import check_next
from tests.services.archives import REFUSED, folder_as, zip_of
from tests.services.conftest import bearer, serving

TYPES = {"zip": "application/zip", "tar.gz": "application/gzip"}
JOB = {"method": "gauhuman", "subject": "wave", "preset": "smoke"}


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A subject that is fit for training."""
    from rsavatar.data.studio import build

    return build(tmp_path_factory.mktemp("studio") / "studio", size=48, frames=4)


def send(client: httpx.Client, kind: str, content: bytes, name: str = "wave", **options: Any) -> httpx.Response:
    headers = {"content-type": TYPES[kind], **options.pop("headers", {})}
    return client.post(f"/api/v1/subjects?name={name}", content=content, headers=headers, **options)


def left(settings: Settings) -> list[str]:
    return [str(p) for folder in ("uploads", "subjects") for p in (settings.home / folder).rglob("*")]


@pytest.mark.parametrize("kind", ["zip", "tar.gz"])
def test_an_archive_becomes_a_subject_that_jobs_may_name(
    client: httpx.Client, settings: Settings, store: Store, studio: Path, kind: str
) -> None:
    reply = send(client, kind, folder_as(kind, studio, "wave-2024" if kind == "zip" else ""))
    assert (reply.status_code, reply.json()["state"]) == (202, "uploaded"), reply.text
    assert client.post("/api/v1/jobs", json=JOB).status_code == 409
    assert check_next(settings, store, threading.Event())
    shown = client.get(reply.headers["location"]).json()
    assert shown["state"] == "ready", shown["info"]
    assert "frames" in str(shown["info"]["report"])
    assert str(settings.home) not in str(shown["info"]["report"])
    assert (Path(shown["path"]) / "rs" / "annots.npy").stat().st_mode & 0o777 == 0o600
    assert client.post("/api/v1/jobs", json=JOB).status_code == 202
    assert send(client, kind, b"").status_code == 409
    assert not check_next(settings, store, threading.Event())


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory, broker: str) -> Iterator[tuple[httpx.Client, Settings]]:
    """One service for all archives that it refuses."""
    settings = Settings(home=tmp_path_factory.mktemp("shared"), broker_url=broker)
    make_home(settings)
    store = Store(settings)
    schema.migrate(store)
    store.close()
    with serving(settings) as client:
        yield client, settings


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_honest_archive_is_refused_and_gone(shared: tuple[httpx.Client, Settings], what: str) -> None:
    client, settings = shared
    kind, content, words = REFUSED[what]
    reply = send(client, kind, content)
    assert (reply.status_code, reply.headers["content-type"]) == (422, "application/problem+json"), reply.text
    assert words in reply.json()["detail"]
    assert left(settings) == []
    assert [s["name"] for s in client.get("/api/v1/subjects").json()] == ["studio"]


@pytest.fixture
def narrow(settings: Settings, store: Store) -> Iterator[httpx.Client]:
    """A service that takes little."""
    caps = {"max_upload_bytes": 50_000, "max_subject_bytes": 30_000, "max_entry_bytes": 20_000, "max_entries": 5}
    with serving(settings.model_copy(update=caps)) as client:
        yield client


def test_caps_hold_while_bytes_come(narrow: httpx.Client, settings: Settings) -> None:
    noise = np.random.default_rng(0).bytes

    def pieces() -> Iterator[bytes]:
        for _ in range(60):
            yield noise(1000)

    assert send(narrow, "zip", noise(60_000)).status_code == 413
    streamed = narrow.post("/api/v1/subjects?name=w", content=pieces(), headers={"content-type": TYPES["zip"]})
    assert streamed.status_code == 413, streamed.text
    for files, words in (
        ({"a.txt": noise(21_000)}, "at most 20000 bytes"),
        ({f"{n}.txt": noise(11_000) for n in range(3)}, "at most 30000 bytes unpacked"),
        ({f"{n}.txt": b"x" for n in range(6)}, "at most 5 files"),
    ):
        reply = send(narrow, "zip", zip_of(files))
        assert (reply.status_code, words in reply.text) == (422, True), reply.text
    assert left(settings) == []


def test_a_large_body_that_only_says_that_it_is_an_archive(narrow: httpx.Client, settings: Settings) -> None:
    for path in ("/api/v1/jobs", "/api/v1/subjects/", "/login"):
        reply = narrow.post(path, content=b" " * 70_000, headers={"content-type": "application/zip"})
        assert reply.status_code == 413, path
    ten_megabytes = b'{"method":"' + b"x" * 10_000_000 + b'"}'
    reply = narrow.post("/api/v1/jobs", content=ten_megabytes, headers={"content-type": "application/json"})
    assert (reply.status_code, reply.headers["content-type"]) == (413, "application/problem+json")


class Payload:
    """Says where it has been, when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.mark,))


def test_a_pickle_that_runs_something_runs_nothing(
    client: httpx.Client, settings: Settings, store: Store, studio: Path, tmp_path: Path
) -> None:
    mark = tmp_path / "was-run"
    evil = tmp_path / "evil.npy"
    np.save(evil, np.array(Payload(mark), dtype=object), allow_pickle=True)
    assert b"touch" in evil.read_bytes()
    files = {str(p.relative_to(studio)): p.read_bytes() for p in studio.rglob("*") if p.is_file()}
    assert send(client, "zip", zip_of(files | {"rs/annots.npy": evil.read_bytes()})).status_code == 202
    assert check_next(settings, store, threading.Event())
    shown = client.get("/api/v1/subjects/wave").json()
    assert shown["state"] == "refused"
    assert "plain" in str(shown["info"]["report"])
    assert not mark.exists()
    pickle.loads(pickle.dumps(Payload(mark)))
    assert mark.exists(), "the payload works where it is run"
    assert client.post("/api/v1/jobs", json=JOB).status_code == 409
    assert client.delete("/api/v1/subjects/wave").status_code == 204
    assert left(settings) == []


def test_a_subject_is_deleted_by_its_owner_when_no_open_job_names_it(
    closed: httpx.Client, settings: Settings, store: Store, studio: Path
) -> None:
    ann, bob, read = bearer(store, "submit"), bearer(store, "submit", owner="bob"), bearer(store, "read")
    assert send(closed, "zip", folder_as("zip", studio), headers=read).status_code == 403
    assert send(closed, "zip", folder_as("zip", studio), headers=ann).status_code == 202
    assert check_next(settings, store, threading.Event())
    job = closed.post("/api/v1/jobs", json=JOB, headers=ann).json()["id"]
    assert closed.delete("/api/v1/subjects/wave", headers=bob).status_code == 403
    assert closed.delete("/api/v1/subjects/wave", headers=ann).status_code == 409
    closed.post(f"/api/v1/jobs/{job}/cancel", headers=ann)
    assert closed.delete("/api/v1/subjects/wave", headers=ann).status_code == 204
    assert closed.delete("/api/v1/subjects/wave", headers=ann).status_code == 404
    assert closed.delete("/api/v1/subjects/studio", headers=ann).status_code in {403, 409}
    assert left(settings) == []


def test_the_check_is_taken_over_from_a_dead_worker_and_given_up_by_a_stopping_one(
    client: httpx.Client, settings: Settings, store: Store, studio: Path
) -> None:
    send(client, "zip", folder_as("zip", studio))
    taken = subjects.claim_check(store, "a", 60.0, lambda owner: False)
    assert taken is not None
    assert subjects.claim_check(store, "b", 60.0, lambda owner: False) is None
    assert subjects.claim_check(store, "b", 60.0, lambda owner: owner == "a") is not None
    late = subjects.finish_check(store, "wave", "a", subjects.SubjectState.READY, [])
    assert (late, subjects.look(store, "wave").state) == (False, "checking")
    subjects.finish_check(store, "wave", "b", subjects.SubjectState.UPLOADED, [])
    stopping = threading.Event()
    stopping.set()
    assert not check_next(settings, store, stopping)
    assert subjects.look(store, "wave").state == "uploaded"


def test_a_check_without_an_end_is_a_refusal(
    client: httpx.Client, settings: Settings, store: Store, studio: Path
) -> None:
    send(client, "zip", folder_as("zip", studio))
    hasty = settings.model_copy(update={"check_seconds": 0.05})
    assert check_next(hasty, store, threading.Event())
    shown = subjects.look(store, "wave")
    assert (shown.state, shown.info["report"][0]["got"]) == ("refused", "none in 0.05 s")


def test_other_bodies_and_names(untouched: httpx.Client) -> None:
    assert untouched.post("/api/v1/subjects?name=a", content=b"x").status_code == 415
    assert send(untouched, "zip", b"x", name="../x").status_code == 422
    assert untouched.post("/api/v1/subjects", content=b"x", headers={"content-type": TYPES["zip"]}).status_code == 422
    assert send(untouched, "zip", b"x", name="studio").status_code == 409


@pytest.mark.parametrize("name", ["a.txt", "rs/new_params/0.npy", "Größe/ñ.png"])
def test_honest_names_pass(name: str) -> None:
    assert str(plain_path(name)) == name
    assert disguise(plain_path(name)) == disguise(plain_path(name.upper())) or "ß" in name
