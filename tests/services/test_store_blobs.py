"""Bytes by their hash on a disk and in a bucket, their collection, and what decides a result."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

import boto3
import pytest
from moto.server import ThreadedMotoServer

from rsavatar.spec import resolve
from services.errors import RequestError, SettingsError
from services.settings import Settings
from services.store import artifacts, blobs, content, garbage, jobs, leases, subjects
from services.store.records import Batch, Checkpoint, Outcome
from services.store.session import Store
from services.store.subject_records import Subject
from tests.services.conftest import submit

OLD = -1.0  # a grace that everything is older than


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """A bucket of a server that speaks S3, in this process; the environment says where it is."""
    server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    named = {
        "AWS_ENDPOINT_URL": f"http://{host}:{port}",
        "AWS_ACCESS_KEY_ID": "id",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_REGION": "us-east-1",
    }
    with pytest.MonkeyPatch.context() as patch:
        for name, value in named.items():
            patch.setenv(name, value)
        boto3.client("s3", region_name="us-east-1").create_bucket(Bucket="results")
        yield "s3://results/rsavatar"
    server.stop()


@pytest.fixture(params=["disk", "bucket"])
def kept(request: pytest.FixtureRequest, tmp_path: Path) -> blobs.AbstractBlobs:
    url = request.getfixturevalue("bucket") if request.param == "bucket" else ""
    return blobs.open_blobs(Settings(home=tmp_path / "home", artifacts_url=url))


def put(kept: blobs.AbstractBlobs, data: bytes) -> str:
    incoming = blobs.new_incoming(kept.root)
    sha256, size = blobs.write_hashed(incoming, iter([data]))
    assert size == len(data)
    kept.keep(sha256, incoming)
    return sha256


def test_what_is_kept_is_found_until_it_is_removed(kept: blobs.AbstractBlobs) -> None:
    data = os.urandom(100_000)
    sha256 = put(kept, data)
    assert sha256 == hashlib.sha256(data).hexdigest()
    assert put(kept, data) == sha256
    path = kept.path(sha256)
    assert path is not None
    assert path.read_bytes() == data
    assert [(b.sha256, b.size) for b in kept.all() if b.sha256 == sha256] == [(sha256, len(data))]
    assert list(kept.strays()) == []
    kept.remove(sha256)
    kept.remove(sha256)
    assert kept.path(sha256) is None
    assert sha256 not in {b.sha256 for b in kept.all()}


def test_a_bucket_is_read_by_a_machine_that_has_nothing(bucket: str, tmp_path: Path) -> None:
    here = blobs.open_blobs(Settings(home=tmp_path / "here", artifacts_url=bucket))
    there = blobs.open_blobs(Settings(home=tmp_path / "there", artifacts_url=bucket))
    sha256 = put(here, b"far away")
    path = there.path(sha256)
    assert path is not None
    assert path.read_bytes() == b"far away"
    key = f"rsavatar/{sha256[:2]}/{sha256[2:]}"
    boto3.client("s3", region_name="us-east-1").put_object(Bucket="results", Key=key, Body=b"damaged!")
    third = blobs.open_blobs(Settings(home=tmp_path / "third", artifacts_url=bucket))
    assert third.path(sha256) is None
    assert list(third.strays()) == []


@pytest.mark.parametrize("url", ["ftp://host/dir", "s3:///nothing", "file://host/dir", "results"])
def test_other_places_are_refused(url: str, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="RSAVATAR_ARTIFACTS_URL: expected"):
        blobs.open_blobs(Settings(home=tmp_path, artifacts_url=url))


def keep(store: Store, name: str, data: bytes, folder: Path) -> artifacts.Artifact:
    file = folder / name
    file.write_bytes(data)
    return artifacts.keep(store, name, file)


def test_only_what_nothing_names_is_collected(store: Store, settings: Settings, tmp_path: Path) -> None:
    job = submit(store)
    claim = leases.claim(store, "worker", 60.0)
    assert claim is not None
    result, old, new, lost = (keep(store, name, name.encode(), tmp_path) for name in ("result", "old", "new", "lost"))
    for step, file in ((1, old), (2, new)):
        leases.beat(store, claim, Batch(checkpoint=Checkpoint(step, file.sha256, file.size)), 60.0)
    stray = store.blobs.root / f"{blobs.INCOMING}1-dead"
    stray.write_bytes(b"part")
    orphan = settings.job_dir("0190-nobody")
    orphan.mkdir(parents=True)
    everything = {b.sha256 for b in store.blobs.all()}

    dry = garbage.collect(store, settings.home / "jobs", OLD, dry_run=True)
    assert (dry.blobs, dry.bytes, dry.strays, dry.folders) == (2, len("result") + len("lost"), 1, 1)
    assert {b.sha256 for b in store.blobs.all()} == everything
    assert (stray.exists(), orphan.exists()) == (True, True)
    assert garbage.totals(store) == garbage.Totals(4, 16, 2, 10)

    leases.succeed(store, claim, Outcome({"psnr": 1.0}, {}, {}, {}, 5, 1.0, 1.0, (), (result,)))
    assert garbage.collect(store, settings.home / "jobs", 3600.0, dry_run=False) == garbage.Garbage()
    done = garbage.collect(store, settings.home / "jobs", OLD, dry_run=False)
    assert (done.blobs, done.strays, done.folders) == (3, 1, 1)  # the checkpoints went with the success
    assert {b.sha256 for b in store.blobs.all()} == {result.sha256}
    assert (stray.exists(), orphan.exists()) == (False, False)
    assert artifacts.of_job(store, job.id) == [result]
    assert lost.sha256 not in {b.sha256 for b in store.blobs.all()}


def test_bytes_without_a_row_are_collected_and_rows_without_bytes_are_told(
    store: Store, settings: Settings, tmp_path: Path
) -> None:
    stranger = put(store.blobs, b"of a crash")
    submit(store)
    claim = leases.claim(store, "worker", 60.0)
    assert claim is not None
    named = keep(store, "a", b"a", tmp_path)
    leases.beat(store, claim, Batch(artifacts=[named]), 60.0)
    store.blobs.remove(named.sha256)
    time.sleep(0.01)
    assert garbage.collect(store, settings.home / "jobs", OLD, dry_run=True).blobs == 1
    found = garbage.collect(store, settings.home / "jobs", OLD, dry_run=False)
    assert (found.blobs, found.missing) == (1, [named.sha256])
    assert store.blobs.path(stranger) is None


def test_a_content_is_its_spec_its_data_and_its_code(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(content, "FRESH_SECONDS", 0.0)
    root = tmp_path / "subject"
    root.mkdir()
    (root / "image.png").write_bytes(b"one")
    subject = Subject("mine", str(root), "rolling")
    subjects.add(store, subject)
    spec = resolve({"method": "gauhuman", "subject": "mine", "preset": "smoke", "body": "anny"})

    def of(**changes: object) -> str:
        return content.content_sha256(store, spec.model_copy(update=changes), subject)

    first = of()
    assert of() == of(priority=5, stall_seconds=60.0) == first
    assert of(seed=1) != first
    os.utime(root / "image.png", (1.0, 1.0))
    assert of() == first  # touched, not changed
    (root / "image.png").write_bytes(b"two")
    assert of() != first
    (root / "image.png").write_bytes(b"one")
    assert of() == first
    with pytest.raises(RequestError, match="files that can be read"):
        of(body=str(tmp_path / "none.npz"))
    studio = Subject("studio", None, "built-in")
    assert content.content_sha256(store, spec, studio) != first
    assert jobs.count_by_state(store)["queued"] == 0
