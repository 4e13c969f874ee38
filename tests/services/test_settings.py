from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from services import redis_server
from services.errors import BrokerError, SettingsError
from services.settings import LONGEST_SOCKET_PATH, Settings, read_settings, without_secrets


def test_environment_is_read_under_the_prefix(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RSAVATAR_HOME", str(tmp_path))
    monkeypatch.setenv("RSAVATAR_SUBJECT_ROOTS", "/a:/b")
    monkeypatch.setenv("RSAVATAR_ALLOWED_HOSTS", "one, two")
    settings = read_settings()
    assert settings.home == tmp_path
    assert settings.subject_roots == (Path("/a"), Path("/b"))
    assert settings.allowed_hosts == ("one", "two")
    assert settings.database == f"sqlite:///{tmp_path}/rsavatar.db"


def test_bad_value_names_its_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RSAVATAR_PORT", "many")
    with pytest.raises(SettingsError, match=r"RSAVATAR_PORT: expected .*integer.*, got 'many'"):
        read_settings()


@pytest.mark.parametrize(
    "changes", [{"host": "0.0.0.0"}, {"host": "::"}, {"allowed_hosts": ("lab",)}, {"require_token": True}]
)
def test_tokens_are_asked_for_wherever_others_could_come(changes: dict[str, Any]) -> None:
    assert Settings(**changes).needs_token
    assert not Settings().needs_token


def test_socket_of_a_deep_home_is_short_enough_and_one_per_home() -> None:
    near, deep, other = Settings(home=Path("/h")), Settings(home=Path("/h" * 80)), Settings(home=Path("/h" * 81))
    assert near.socket == Path("/h/run/redis.sock")
    assert len(str(deep.socket)) <= LONGEST_SOCKET_PATH
    assert deep.socket != other.socket


def test_cores_are_shared_between_the_jobs_of_a_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    assert Settings(worker_concurrency=3).threads == 2
    assert Settings(worker_concurrency=16).threads == 1
    assert Settings(threads_per_job=5).threads == 5


def test_a_named_server_must_be_executable(tmp_path: Path) -> None:
    with pytest.raises(BrokerError, match="RSAVATAR_REDIS_SERVER: expected an executable"):
        redis_server.find_server(Settings(redis_server=tmp_path / "none"))


def test_private_server_has_no_port_and_loses_nothing(tmp_path: Path) -> None:
    settings = Settings(home=tmp_path)
    settings.socket.parent.mkdir(mode=0o755)
    words = redis_server.command(settings)
    options = dict(zip(words[1::2], words[2::2], strict=True))
    assert options["--port"] == "0"
    assert options["--unixsocketperm"] == "700"
    assert options["--appendonly"] == "yes"
    assert options["--maxmemory-policy"] == "noeviction"
    assert settings.socket.parent.stat().st_mode & 0o777 == 0o700


def test_secrets_come_from_files_and_go_to_no_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "url"
    file.write_text("redis://:word@redis:6379/0\nand a second line\n")
    monkeypatch.setenv("RSAVATAR_BROKER_URL_FILE", str(file))
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "key")
    assert read_settings().broker == "redis://:word@redis:6379/0"
    given = without_secrets(os.environ)
    assert not [name for name in given if "BROKER" in name or name.startswith("AWS_")]
    assert given["PATH"] == os.environ["PATH"]
    monkeypatch.setenv("RSAVATAR_BROKER_URL", "redis://other")
    with pytest.raises(SettingsError, match="RSAVATAR_BROKER_URL: expected nothing, because"):
        read_settings()
    monkeypatch.delenv("RSAVATAR_BROKER_URL")
    file.unlink()
    with pytest.raises(SettingsError, match="RSAVATAR_BROKER_URL_FILE: expected a readable file"):
        read_settings()
