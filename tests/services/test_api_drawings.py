"""Novel views, exports and figures over HTTP, drawn by the real process from a job that was really run."""

from __future__ import annotations

import io
import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import psutil
import pytest
from PIL import Image

from rsavatar.errors import SpecError
from services.api.drawings import DrawingCache, key_of
from services.api.renderer import RenderProcess
from services.errors import RenderError
from services.process import stop, terminate_with_parent
from services.settings import ROOT, Settings, make_home
from services.store import artifacts, jobs, leases, schema, subjects
from services.store.records import Outcome, Point, Score, Submission
from services.store.session import Store
from services.store.subject_records import Subject
from tests.core.finished_run import run_figure
from tests.services.conftest import serving, submit

UNKNOWN = "01a203b6-9786-7232-b632-ee4c3c69e042"


class Place:
    """A service with one finished job and one that waits."""

    def __init__(self, client: httpx.Client, store: Store, job: str, waiting: str) -> None:
        self.client, self.store, self.job, self.waiting = client, store, job, waiting

    def get(self, path: str, **options: object) -> httpx.Response:
        return self.client.get(f"/api/v1/jobs/{self.job}/{path}", timeout=120.0, **options)  # type: ignore[arg-type]


def finish(store: Store, folder: Path) -> str:
    """A job of the tiny figure as a worker leaves it."""
    source = run_figure(folder)
    found = json.loads((source.checkpoint.parent / "metrics.json").read_text())
    subjects.add(store, Subject("figure", str(source.subject_dir), "rolling", {}))
    spec = source.spec.model_dump(mode="json", by_alias=True)
    job, _ = jobs.submit(store, Submission(spec, source.spec.sha256(), "r", 3))
    claim = leases.claim(store, "test", 60.0)
    assert claim is not None
    assert claim.job_id == job.id
    curve = [Point("psnr", step, 10.0 + step) for step in (0, 10, 20)]
    leases.beat(store, claim, leases.Batch(points=curve), 60.0)
    scores = [Score(s["camera"], s["frame"], "psnr", s["psnr"]) for s in found["scores"]]
    numbers = (found["gaussians"], 12.0, 3.0, tuple(scores))
    kept = (artifacts.keep(store, "checkpoint", source.checkpoint),)
    parts = (found["means"], found["per_camera"], found["protocol"], found["provenance"])
    leases.succeed(store, claim, Outcome(*parts, *numbers, kept))
    return job.id


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, broker: str) -> Iterator[Place]:
    settings = Settings(home=tmp_path_factory.mktemp("drawings"), broker_url=broker, threads_per_job=1)
    make_home(settings)
    store = Store(settings)
    schema.migrate(store)
    job = finish(store, tmp_path_factory.mktemp("subjects"))
    waiting = submit(store).id
    with serving(settings) as client:
        yield Place(client, store, job, waiting)
    store.close()


def test_a_view_is_drawn_once_and_has_a_tag(place: Place) -> None:
    first = place.get("render", params={"time": 1.5, "shutter": "rolling", "size": 64})
    assert first.status_code == 200, first.text
    assert first.headers["content-type"] == "image/png"
    assert Image.open(io.BytesIO(first.content)).size == (64, 64)
    again = place.get("render", params={"size": 64, "shutter": "rolling", "time": 1.5})
    assert (again.content, again.headers["etag"]) == (first.content, first.headers["etag"])
    unchanged = place.get(
        "render",
        params={"time": 1.5, "shutter": "rolling", "size": 64},
        headers={"if-none-match": first.headers["etag"]},
    )
    assert (unchanged.status_code, unchanged.content) == (304, b"")
    other = place.get("render", params={"time": 1.5, "shutter": "global", "size": 64})
    assert other.headers["etag"] != first.headers["etag"]


def test_the_readout_slider_changes_the_rolling_view_and_no_other(place: Place) -> None:
    def seen(shutter: str, readout: float) -> bytes:
        return place.get("render", params={"time": 2, "shutter": shutter, "readout": readout, "size": 64}).content

    assert seen("rolling", 0.0) != seen("rolling", 11.0)
    assert seen("global", 0.0) == seen("global", 11.0)


@pytest.mark.parametrize(
    ("query", "name"),
    [
        ({"size": 4096}, "size"),
        ({"shutter": "roling"}, "shutter"),
        ({"time": "nan"}, "time"),
        ({"format": "bmp"}, "format"),
        ({"camera": "99"}, "camera"),
        ({"time": 77}, "time"),
        ({"readout": 500}, "readout"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_view_that_there_is_not_is_refused_by_name(place: Place, query: dict[str, object], name: str) -> None:
    reply = place.get("render", params=query)
    assert reply.status_code == 422
    assert name in reply.json()["errors"][0]["name"]


def test_a_job_without_a_checkpoint_and_an_unknown_one(place: Place) -> None:
    waiting = place.client.get(f"/api/v1/jobs/{place.waiting}/render")
    assert waiting.status_code == 409
    assert "a job that has written a checkpoint, got queued" in waiting.json()["detail"]
    assert place.client.get(f"/api/v1/jobs/{UNKNOWN}/scene").status_code == 404


def test_the_scene_and_the_exports_are_files(place: Place) -> None:
    scene = place.get("scene")
    assert scene.content[:4] == b"RSAV"
    length = struct.unpack("<I", scene.content[4:8])[0]
    assert json.loads(scene.content[8 : 8 + length])["frames"] == 5
    canonical, posed = place.get("export/ply"), place.get("export/ply", params={"time": 1.5})
    assert canonical.headers["content-disposition"] == 'attachment; filename="figure-rs-avatar-canonical.ply"'
    assert posed.headers["content-disposition"] == 'attachment; filename="figure-rs-avatar-frame-1.5.ply"'
    assert canonical.content.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert len(posed.content) == len(canonical.content)
    assert posed.content != canonical.content
    video = place.get("export/turntable", params={"size": 64, "pictures": 4})
    assert video.headers["content-type"] == "video/mp4"
    assert video.content[4:8] == b"ftyp"
    part = place.get("export/turntable", params={"size": 64, "pictures": 4}, headers={"range": "bytes=0-99"})
    assert (part.status_code, len(part.content)) == (206, 100)  # browsers seek in videos so


@pytest.mark.parametrize("name", ["qualitative", "per-subject", "shutter", "pareto", "curves"])
def test_a_figure_is_made_from_the_database_and_the_artifacts(place: Place, name: str) -> None:
    picture = place.client.get(f"/api/v1/figures/{name}.png", timeout=120.0)
    assert picture.status_code == 200, picture.text
    assert "sandbox" in picture.headers["content-security-policy"]
    assert place.job in Image.open(io.BytesIO(picture.content)).info["Description"]
    numbers = place.client.get(f"/api/v1/figures/{name}.json").json()
    assert numbers["provenance"]["jobs"] == [place.job]


def test_a_figure_without_data_says_what_it_needs_and_how_to_get_it(place: Place) -> None:
    reply = place.client.get("/api/v1/figures/ablation.pdf")
    assert reply.status_code == 404
    assert "with and without an ablation flag (try: rsavatar submit" in reply.json()["detail"]
    assert place.client.get("/api/v1/figures/pie.png").status_code == 404
    wrong = place.client.get("/api/v1/figures/qualitative.png", params={"camera": "77"})
    assert (wrong.status_code, wrong.json()["errors"][0]["name"]) == (422, "camera and frame")


def test_the_viewer_is_a_page_with_its_pictures_and_a_policy(place: Place) -> None:
    page = place.client.get(f"/jobs/{place.job}/viewer", params={"time": 2})
    assert page.status_code == 200
    assert "media-src 'self'" in page.headers["content-security-policy"]
    assert f'src="/api/v1/jobs/{place.job}/render?time=2.0&amp;size=448&amp;shutter=rolling"' in page.text
    empty = place.client.get(f"/jobs/{place.waiting}/viewer")
    assert "No avatar yet" in empty.text
    assert "viewer.js" not in empty.text
    assert place.client.get(f"/jobs/{UNKNOWN}/viewer").status_code == 404


def test_the_gallery_shows_what_there_is_and_how_to_get_the_rest(place: Place) -> None:
    page = place.client.get("/figures")
    assert '<img src="/api/v1/figures/qualitative.png"' in page.text
    assert "Not enough results yet" in page.text
    assert "ablation.no_rs=true" in page.text
    assert place.job in page.text
    chosen = place.client.get("/figures", params={"subject": "figure", "camera": "00", "frame": 1})
    assert "/api/v1/figures/qualitative.pdf?subject=figure&amp;camera=00&amp;frame=1" in chosen.text
    assert "Not with this choice" in place.client.get("/figures", params={"subject": "nobody"}).text
    assert "--method-rs-avatar" in place.client.get("/palette.css").text


def renderers() -> list[psutil.Process]:
    """Living render processes that this one has started."""
    living = [child for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE]
    return [child for child in living if "services.renderer" in child.cmdline()]


def test_a_render_process_that_was_killed_is_started_again(place: Place) -> None:
    place.get("render", params={"size": 48})
    before = {child.pid for child in renderers()}
    assert before
    for child in renderers():
        child.send_signal(signal.SIGKILL)
    assert place.get("render", params={"size": 50}).status_code == 200
    assert before.isdisjoint({child.pid for child in renderers()})


def test_an_answer_that_does_not_come_in_time_is_a_clear_refusal(tmp_path: Path) -> None:
    settings = Settings(home=tmp_path, render_seconds=0.01)
    make_home(settings)
    process = RenderProcess(settings, "views")
    with pytest.raises(RenderError, match=r"render process: expected an answer within 0.01 s, got none"):
        process.ask({"verb": "nothing"})
    process.close()


def test_a_render_process_ends_for_want_of_orders_and_with_the_one_that_asks(tmp_path: Path) -> None:
    settings = Settings(home=tmp_path, render_idle_seconds=0.2)
    make_home(settings)
    process = RenderProcess(settings, "views")
    for _ in range(2):  # the second order finds it gone, and starts another
        with pytest.raises(Exception, match="verb: expected one of view"):
            process.ask({"verb": "nothing"})
        assert process._process is not None
        process._process.wait(20)
        assert process._process.returncode == 0
    process.close()


def test_a_renderer_may_run_elsewhere_and_listen(tmp_path: Path) -> None:
    path = tmp_path / "r.sock"
    settings = Settings(home=tmp_path, render_socket=path)
    absent = RenderProcess(settings, "views")
    with pytest.raises(RenderError, match="expected one that listens on"):
        absent.ask({"verb": "nothing"})
    command = [sys.executable, "-m", "services.renderer", str(path)]
    listener = subprocess.Popen(command, cwd=ROOT, preexec_fn=terminate_with_parent)  # noqa: PLW1509
    try:
        while not path.exists():
            assert listener.poll() is None
            time.sleep(0.05)
        for lane in ("views", "files"):  # both at once, each on a connection of its own
            with pytest.raises(SpecError, match="verb: expected one of view"):
                RenderProcess(settings, lane).ask({"verb": "nothing"})
        assert path.stat().st_mode & 0o777 == 0o600
    finally:
        stop(listener, 5.0)


def test_a_process_that_cannot_start_is_a_clear_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings(home=tmp_path)
    make_home(settings)
    monkeypatch.setattr("services.api.renderer.ROOT", tmp_path)  # no `services` to import there
    monkeypatch.setenv("PYTHONPATH", "")
    process = RenderProcess(settings, "views")
    with pytest.raises(RenderError, match=r"expected an answer, got its end with status 1: .*No module named"):
        process.ask({"verb": "nothing"})


def test_drawings_are_kept_within_their_limit_the_least_used_go_first(tmp_path: Path) -> None:
    cache = DrawingCache(tmp_path / "drawings", limit_bytes=1000)
    keys = [key_of({"n": n}) for n in range(12)]
    for n, key in enumerate(keys):
        path = cache.put(key, bytes(100))
        os.utime(path, (n, n))
        if n == 5:
            assert cache.find(keys[0]) is not None  # used: now the newest
    left = {path.name for path in (tmp_path / "drawings").iterdir()}
    assert len(left) <= 10
    assert {keys[0], keys[-1]} <= left
    assert keys[1] not in left
    assert cache.find(key_of({"n": "other"})) is None


def test_equal_orders_have_equal_keys() -> None:
    assert key_of({"a": 1, "b": [2]}) == key_of({"b": [2], "a": 1})
    assert key_of({"a": 1}) != key_of({"a": 2})


def test_a_turn_that_does_not_come_is_a_clear_refusal(tmp_path: Path) -> None:
    settings = Settings(home=tmp_path, render_seconds=0.05)
    process = RenderProcess(settings, "views")
    process._turn.acquire()
    begun = time.monotonic()
    with pytest.raises(RenderError, match="a turn within"):
        process.ask({})
    assert time.monotonic() - begun >= 0.05
