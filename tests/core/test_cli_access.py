"""Tokens on the command line: kept where nobody else reads them, sent to the service that they belong to."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from rsavatar import cli, credentials
from rsavatar.client import Client
from rsavatar.errors import ClientError
from services.store import tokens
from tests.core.live_service import Service, live_service
from tests.services.archives import zip_of


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with live_service(tmp_path_factory.mktemp("closed"), require_token=True) as running:
        yield running


@pytest.fixture(autouse=True)
def private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.delenv("RSAVATAR_TOKEN", raising=False)


def log_in(service: Service, monkeypatch: pytest.MonkeyPatch, scope: str) -> str:
    secret = tokens.issue(service.store, "test", "ann", [scope])[1]
    monkeypatch.setattr("sys.stdin", io.StringIO(secret + "\n"))
    assert cli.main(["login", "--url", service.url]) == 0
    return secret


def test_a_login_is_kept_for_its_service_alone(
    service: Service, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["jobs", "--url", service.url]) == 2
    assert "expected a bearer token" in capsys.readouterr().err
    secret = log_in(service, monkeypatch, "read")
    shown = capsys.readouterr().out
    assert "ann (read)" in shown
    assert secret not in shown
    assert credentials.file().stat().st_mode & 0o777 == 0o600
    assert json.loads(credentials.file().read_text()) == {service.url: secret}
    assert cli.main(["jobs", "--url", service.url]) == 0
    assert credentials.token_for("http://elsewhere:8000") is None
    assert cli.main(["login", "--forget", "--url", service.url]) == 0
    assert cli.main(["jobs", "--url", service.url]) == 2


def test_a_wrong_token_is_not_kept(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("rsa_wrong\n"))
    assert cli.main(["login", "--url", service.url]) == 2
    assert not credentials.file().exists()


def test_a_file_that_others_may_read_is_not_used(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    log_in(service, monkeypatch, "read")
    credentials.file().chmod(0o644)
    with pytest.raises(ClientError, match="its owner alone"):
        Client(service.url)
    monkeypatch.setenv("RSAVATAR_TOKEN", tokens.issue(service.store, "test", "eve", ["read"])[1])
    with Client(service.url) as client:
        assert client.whoami()["owner"] == "eve", "the environment goes first"


def test_tokens_are_issued_listed_and_revoked(
    service: Service, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log_in(service, monkeypatch, "admin")
    capsys.readouterr()
    assert cli.main(["token", "create", "laptop", "--owner", "bob", "--days", "1", "--url", service.url]) == 0
    secret = capsys.readouterr().out.strip()
    with Client(service.url, token=secret) as client:
        me = client.whoami()
        assert (me["owner"], me["scopes"]) == ("bob", ["read", "submit"])
        with pytest.raises(ClientError, match="scope admin"):
            client.tokens()
    assert cli.main(["token", "list", "--url", service.url]) == 0
    assert "laptop" in capsys.readouterr().out
    assert cli.main(["token", "revoke", str(me["token_id"]), "--url", service.url]) == 0
    with Client(service.url, token=secret) as client, pytest.raises(ClientError, match="revoked"):
        client.whoami()


def test_an_owner_is_bounded_and_listed(
    service: Service, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log_in(service, monkeypatch, "admin")
    capsys.readouterr()
    words = ["owner", "set", "bob", "--queued", "5", "--running", "0", "--share", "2", "--url", service.url]
    assert cli.main(words) == 0
    line = capsys.readouterr().out
    assert line.split() == ["bob", "waiting:", "5", "running:", "no", "limit", "share:", "2"]
    assert cli.main(["owner", "list", "--url", service.url]) == 0
    assert line in capsys.readouterr().out
    assert cli.main([*words, "--share", "0"]) == 2
    assert "share" in capsys.readouterr().err


def test_a_subject_is_uploaded_and_removed(
    service: Service, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    log_in(service, monkeypatch, "submit")
    archive = tmp_path / "wave.zip"
    archive.write_bytes(zip_of({"rs/annots.npy": b"not yet looked at"}))
    url = ["--url", service.url]
    assert cli.main(["subjects", "--upload", "wave", str(archive), *url]) == 0
    assert "uploaded" in capsys.readouterr().out
    assert cli.main(["subjects", "--upload", "wave", str(tmp_path / "none.zip"), *url]) == 2
    assert cli.main(["subjects", "--remove", "wave", *url]) == 0
    assert "wave" not in capsys.readouterr().out
