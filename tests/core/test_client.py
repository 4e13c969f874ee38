"""The client against the real application, and against a server that breaks off in the middle of a sentence."""

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from rsavatar import client as client_module
from rsavatar.client import Client, ServerEvent, parse_events
from rsavatar.errors import ClientError
from tests.core.live_service import Service, live_service

JOB = {"preset": "smoke", "method": "gauhuman", "subject": "studio"}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with live_service(tmp_path_factory.mktemp("home")) as running:
        yield running


@pytest.fixture
def client(service: Service) -> Iterator[Client]:
    with Client(service.url) as connected:
        yield connected


def test_a_job_goes_from_submission_to_its_row_in_the_table(service: Service, client: Client) -> None:
    job = client.submit(JOB)
    assert (job["state"], job["method"], job["spec"]["iterations"]) == ("queued", "gauhuman", 300)
    claim = service.claim()
    assert client.job(job["id"])["state"] == "running"
    service.say(claim, "note", text="hello")
    service.succeed(claim, psnr=23.456)
    assert client.results(job["id"])["means"]["psnr"] == 23.456
    assert "| GauHuman | 23.46 |" in client.table("main")
    assert json.loads(client.table("per-subject", "json"))["rows"][0]["subject"] == "studio"


def test_the_same_key_is_the_same_job(service: Service, client: Client) -> None:
    first, again = client.submit(JOB, "key-1"), client.submit(JOB, "key-1")
    assert first["id"] == again["id"] != client.submit(JOB, "key-2")["id"]
    with pytest.raises(ClientError) as refused:
        client.submit({**JOB, "seed": 5}, "key-1")
    assert refused.value.status in {409, 422}
    for job in client.jobs(state="queued"):
        client.cancel(job["id"])


def test_listing_walks_over_pages_newest_first(service: Service, client: Client) -> None:
    made = [client.submit({**JOB, "method": "mad-avatar", "seed": seed})["id"] for seed in range(5)]
    listed = [job["id"] for job in client.jobs(method="mad-avatar", limit="2")]
    assert listed == made[::-1]
    for job_id in made:
        client.cancel(job_id)
    assert [job["id"] for job in client.jobs(method="mad-avatar", state="queued")] == []


def test_cancel_and_retry(service: Service, client: Client) -> None:
    job = client.submit({**JOB, "seed": 71})  # a seed of its own: known results are not computed again
    assert client.cancel(job["id"])["state"] == "cancelled"
    assert client.retry(job["id"])["state"] == "queued"
    client.cancel(job["id"])
    assert [event.data["state"] for event in client.events(job["id"]) if event.kind == "state"][-1] == "cancelled"


def test_events_are_followed_to_the_end_and_resumed_after_any_of_them(service: Service, client: Client) -> None:
    job = client.submit({**JOB, "seed": 72})
    claim = service.claim()

    def work() -> None:
        for step in range(3):
            time.sleep(0.05)
            service.say(claim, "progress", stage="train", step=step, steps=3)
        service.succeed(claim, 20.0)

    worker = threading.Thread(target=work)
    worker.start()
    seen = list(client.events(job["id"]))
    worker.join()
    assert [e.data["step"] for e in seen if e.kind == "progress"] == [0, 1, 2]
    assert seen[-1].data["state"] == "succeeded"
    for i, event in enumerate(seen):
        assert list(client.events(job["id"], event.id)) == seen[i + 1 :]


def test_subjects_are_listed_and_registered(client: Client, tmp_path: Path) -> None:
    assert client.subjects()[0]["name"] == "studio"
    (tmp_path / "rs").mkdir()
    (tmp_path / "rs" / "annots.npy").touch()
    assert client.register_subject("mine", str(tmp_path))["kind"] == "rolling"
    assert "mine" in [subject["name"] for subject in client.subjects()]


def test_a_refusal_carries_the_problems_title_and_detail(client: Client) -> None:
    with pytest.raises(ClientError) as refused:
        client.submit({**JOB, "iterations": 0})
    assert refused.value.status == 422
    assert "iterations: expected" in refused.value.detail
    assert str(refused.value) == f"{refused.value.title}: {refused.value.detail}"
    with pytest.raises(ClientError, match="Not Found"):
        client.table("nothing")
    with pytest.raises(ClientError, match=r"[Nn]ot"):
        client.job("../subjects")  # a path is quoted, not walked
    with pytest.raises(ClientError) as unknown:
        next(client.events("00000000-0000-0000-0000-000000000000"))
    assert unknown.value.status == 404


def test_an_absent_service_is_a_clear_sentence() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
    with Client(url) as client, pytest.raises(ClientError, match=f"cannot reach {url}: is `make up` running?"):
        client.subjects()


def test_the_address_is_given_or_of_the_environment_or_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RSAVATAR_URL", "http://127.0.0.1:1/")
    assert Client("http://127.0.0.1:2").url == "http://127.0.0.1:2"
    assert Client().url == "http://127.0.0.1:1"
    monkeypatch.delenv("RSAVATAR_URL")
    assert Client().url == "http://127.0.0.1:8000"
    for wrong in ("localhost:8000", "http://", "http://a:b"):
        with pytest.raises(ClientError, match="not an address"):
            Client(wrong)


def test_loopback_is_never_reached_through_a_proxy(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.delenv("NO_PROXY", raising=False)
    with Client(service.url) as client:
        assert client.subjects()


def test_a_stream_is_parsed_by_the_standard() -> None:
    text = ": comment\nretry: 5\n\nid: 1\nevent: note\ndata: {\ndata: }\n\nid:2\ndata:{}\n\nevent: empty\n\n"
    text += "id: 3\ndata: {}"
    assert list(parse_events(text.split("\n"))) == [ServerEvent("1", "note", {}), ServerEvent("2", "message", {})]


class BreaksOff(BaseHTTPRequestHandler):
    """Says two events and half of a third, then cuts the line; the second time, goes on after Last-Event-ID."""

    resumed: list[str | None]

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Content-Length", "100000")  # more than will come: the client sees a broken reply
        self.end_headers()
        last = self.headers.get("Last-Event-ID")
        self.resumed.append(last)
        steps = [f'id: {i}\nevent: progress\ndata: {{"step": {i}}}\n\n' for i in range(int(last or 0) + 1, 4)]
        text = "".join(steps[:2]) + steps[2][:20] if last is None else "".join(steps)
        ending = "" if last is None else 'id: 4\nevent: state\ndata: {"state": "succeeded"}\n\n'
        self.wfile.write((text + ending).encode())

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing."""


@pytest.fixture
def broken() -> Iterator[str]:
    BreaksOff.resumed = []
    with ThreadingHTTPServer(("127.0.0.1", 0), BreaksOff) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_a_broken_stream_is_taken_up_after_the_last_whole_event(broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "PAUSE_SECONDS", 0.01)
    with Client(broken) as client:
        stream = client.events("job")
        assert [next(stream).id for _ in range(4)] == ["1", "2", "3", "4"]
        stream.close()
    assert BreaksOff.resumed == [None, "2"]


def test_patience_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_module, "PATIENCE_SECONDS", 0.05)
    monkeypatch.setattr(client_module, "PAUSE_SECONDS", 0.02)
    with Client("http://127.0.0.1:1") as client, pytest.raises(ClientError, match="cannot reach"):
        list(client.events("job"))


def test_a_stranger_on_the_port_is_named(broken: str) -> None:
    class Chatty(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(b"<html>")

        def log_message(self, format: str, *args: Any) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Chatty) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        with (
            Client(f"http://127.0.0.1:{server.server_port}") as client,
            pytest.raises(ClientError, match="gave no JSON"),
        ):
            client.subjects()
        server.shutdown()
        thread.join()


def test_the_client_is_torch_free() -> None:
    code = "import rsavatar.client, sys; print(sorted({'torch', 'numpy', 'pydantic'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
