"""A backup is made while the service runs, notices damage, and gives everything back."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from sqlalchemy import text

from services import backup
from services.errors import BackupError
from services.settings import ROOT, Settings, make_home
from services.store import artifacts, audit, jobs, subjects
from services.store.records import Filters
from services.store.session import Store
from services.store.subject_records import Subject
from tests.services.conftest import POSTGRESQL, submit
from tests.services.test_audit import entry

pytestmark = pytest.mark.skipif(
    bool(POSTGRESQL) and shutil.which("pg_dump") is None, reason="pg_dump is not on PATH: no PostgreSQL backup here"
)


@pytest.fixture
def full(settings: Settings, store: Store) -> Settings:
    """A home with a job, an artifact of it, a log, an uploaded subject and an audit log."""
    job = submit(store)
    file = settings.home / "picture.png"
    file.write_bytes(b"bytes of a picture")
    artifact = artifacts.keep(store, "picture", file)
    with store.write() as session:
        artifacts.put(session, job.id, [artifact])
    log = settings.job_dir(job.id) / "log.txt"
    log.parent.mkdir(parents=True)
    log.write_text("said something\n")
    place = settings.home / "subjects" / "1" / "wave"
    (place / "rs").mkdir(parents=True)
    (place / "rs" / "annots.npy").write_bytes(b"calibration")
    subjects.add(store, Subject("wave", str(place), "rolling"))
    for number in range(3):
        audit.append(store, entry(number))
    return settings


def emptied(settings: Settings, home: Path) -> Settings:
    """Another home; the database of the environment, where one is set, without its tables."""
    other = settings.model_copy(update={"home": home})
    make_home(other)
    if POSTGRESQL:
        store = Store(other)
        with store.engine.begin() as connection:
            connection.execute(text("drop schema public cascade; create schema public"))
        store.close()
    return other


def test_all_comes_back_in_another_home(full: Settings, tmp_path: Path) -> None:
    folder = backup.create(full, tmp_path / "backups")
    other = emptied(full, tmp_path / "other")
    manifest = backup.restore(other, folder)
    store = Store(other)
    (job,) = jobs.page(store, Filters(), None, 10)
    (artifact,) = artifacts.of_job(store, job.id)
    assert artifacts.find(store, artifact.sha256)[1].read_bytes() == b"bytes of a picture"
    assert (other.job_dir(job.id) / "log.txt").read_text() == "said something\n"
    place = subjects.get(store, "wave").path
    assert place == str(other.home / "subjects" / "1" / "wave")
    assert (Path(place) / "rs" / "annots.npy").read_bytes() == b"calibration"
    assert audit.verify(store) == audit.Verdict(3, manifest.audit_head, None)
    store.close()
    with pytest.raises(BackupError, match="database: expected an empty one"):
        backup.restore(other, folder)


def test_the_second_backup_shares_what_has_not_changed(full: Settings, tmp_path: Path) -> None:
    first = backup.create(full, tmp_path / "backups")
    first = first.rename(first.with_name("2020-01-01T00-00-00Z"))
    pool = {path: path.stat().st_mtime_ns for path in (tmp_path / "backups" / "pool").rglob("*")}
    second = backup.create(full, tmp_path / "backups")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "backups" / "pool").rglob("*")} == pool
    assert backup.verify(first).pooled == backup.verify(second).pooled


@pytest.mark.parametrize("what", ["pool", "database", "manifest"])
def test_damage_is_found_before_anything_is_restored(full: Settings, tmp_path: Path, what: str) -> None:
    folder = backup.create(full, tmp_path / "backups")
    sha256 = backup.Manifest.read(folder).artifacts[0]
    files = {
        "pool": folder.parent / "pool" / sha256[:2] / sha256[2:],
        "database": next(folder.glob("database.*")),
        "manifest": folder / "manifest.json",
    }
    damaged = bytearray(files[what].read_bytes())
    damaged[len(damaged) // 2] ^= 0xFF
    files[what].write_bytes(damaged)
    other = emptied(full, tmp_path / "other")
    with pytest.raises(BackupError):
        backup.restore(other, folder)
    assert not (other.home / "rsavatar.db").exists()


def test_bytes_that_a_row_names_and_nobody_has_are_an_error(full: Settings, store: Store, tmp_path: Path) -> None:
    shutil.rmtree(full.home / "artifacts")
    with pytest.raises(BackupError, match=r"bytes [0-9a-f]{64}: expected a file with this hash, got none"):
        backup.create(full, tmp_path / "backups")
    assert not list((tmp_path / "backups").glob("*/manifest.json"))


def run(script: str, *words: str, settings: Settings, **env: str) -> subprocess.CompletedProcess[str]:
    place = {"RSAVATAR_HOME": str(settings.home), "RSAVATAR_DATABASE_URL": settings.database_url}
    whole = os.environ | place | {"PYTHON": sys.executable} | env
    command = ["sh", str(ROOT / "deploy" / "backup" / script), *words]
    return subprocess.run(command, env=whole, capture_output=True, text=True, check=False, cwd=ROOT)


def test_the_scripts_make_keep_forget_and_restore(full: Settings, tmp_path: Path) -> None:
    folder = tmp_path / "backups"
    for year in ("2019", "2020"):
        old = backup.create(full, folder).rename(folder / f"{year}-01-01T00-00-00Z")
    manifest = json.loads((old / "manifest.json").read_text())
    manifest["artifacts"].append("0" * 64)
    (folder / "pool" / "00").mkdir(exist_ok=True)
    (folder / "pool" / "00" / ("0" * 62)).write_text("named by the oldest alone")
    (folder / "2019-01-01T00-00-00Z" / "manifest.json").write_text(json.dumps(manifest))
    made = run("backup.sh", settings=full, BACKUPS=str(folder), KEEP="2")
    assert made.returncode == 0, made.stderr
    assert "forgot 2019-01-01T00-00-00Z" in made.stdout
    left = sorted(path.name for path in folder.iterdir())
    assert (len(left), left[0], left[-1]) == (3, "2020-01-01T00-00-00Z", "pool")
    assert not (folder / "pool" / "00" / ("0" * 62)).exists()
    assert run("backup.sh", settings=full, BACKUPS=str(folder), KEEP="none").returncode == 2
    other = emptied(full, tmp_path / "other")
    back = run("restore.sh", str(folder / left[1]), settings=other)
    assert back.returncode == 0, back.stderr
    assert "database is at version" in back.stdout
