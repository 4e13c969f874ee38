"""Pages without a browser: complete, closed to foreign scripts, and shown for every state that there is."""

from __future__ import annotations

import gzip
import io
import json
import re
import zipfile
from html.parser import HTMLParser
from pathlib import Path

import httpx
import pytest

from rsavatar.spec import JobSpec
from services.api import findings, layout, vendor
from services.api.form import fields_of_spec
from services.api.pages_job import heat_map
from services.store import artifacts, benchmarks, jobs, leases, listing
from services.store.records import Artifact, Batch, Failure, Filters, Outcome, Score
from services.store.session import Store
from tests.services.conftest import submit
from tests.services.test_api_jobs import UNKNOWN, finish, post

PAGES = ("/", "/jobs", "/jobs/new", "/grids", "/benchmarks", "/subjects")
LOCAL_ADDRESS = re.compile(r"^(/(?!/)|#|\?)")


class Outline(HTMLParser):
    """What a page is made of."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.ids: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.tags.append((tag, found))
        if found.get("id"):
            self.ids.append(str(found["id"]))

    def of(self, *names: str) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag in names]


def look_at(reply: httpx.Response) -> Outline:
    """A page that keeps the house's rules: nothing inline, nothing foreign, one title, unique ids, pictures named."""
    assert reply.headers["content-type"].startswith("text/html"), reply.text[:200]
    page = Outline(reply.text)
    assert len(page.of("h1")) == 1
    assert page.of("html")[0]["lang"] == "en"
    assert len(page.ids) == len(set(page.ids))
    for tag, attributes in page.tags:
        assert not any(name.startswith("on") for name in attributes), (tag, attributes)
        assert "style" not in attributes, (tag, attributes)
        for name in ("src", "href", "action"):
            value = attributes.get(name)
            assert value is None or LOCAL_ADDRESS.match(value), (tag, value)
    assert all("src" in script or script.get("type") == "application/json" for script in page.of("script"))
    assert all("alt" in image for image in page.of("img"))
    assert "script-src 'self';" in reply.headers["content-security-policy"]
    return page


@pytest.mark.parametrize("url", PAGES)
def test_pages_of_an_empty_service_invite(untouched: httpx.Client, url: str) -> None:
    reply = untouched.get(url)
    assert reply.status_code == 200
    look_at(reply)


@pytest.mark.parametrize(
    "url", ["/jobs?state=", "/jobs?sort=psnr&order=asc&method=&subject=studio", "/benchmarks?commit="]
)
def test_forms_may_send_empty_choices(untouched: httpx.Client, url: str) -> None:
    assert untouched.get(url).status_code == 200


@pytest.mark.parametrize(
    ("url", "status"),
    [
        (f"/jobs/{UNKNOWN}", 404),
        ("/jobs/nonsense", 422),
        (f"/grids/{UNKNOWN}", 404),
        ("/jobs?sort=password", 422),
        (f"/jobs/compare?id={UNKNOWN}", 422),
        (f"/jobs/new?from={UNKNOWN}", 404),
        ("/subjects/nobody/thumbnail", 404),
    ],
)
def test_refusals_are_pages_that_say_what_to_do(untouched: httpx.Client, url: str, status: int) -> None:
    reply = untouched.get(url)
    assert reply.status_code == status
    page = look_at(reply)
    assert any(link.get("href") == "/jobs" for link in page.of("a"))


def test_a_job_page_exists_for_every_state(client: httpx.Client, store: Store) -> None:
    for seed in range(6):
        post(client, seed=seed)
    succeeded = finish(store)
    failed = leases.claim(store, "w", 60.0)
    assert failed is not None
    leases.fail(store, failed, Failure.DIVERGED, "DivergedError: <script>alert(1)</script>", 0.0)
    running = leases.claim(store, "w", 60.0)
    assert running is not None
    leases.beat(store, running, Batch(), 60.0)
    cancelled, paused, queued = (job.id for job in jobs.page(store, Filters(state="queued"), None, 9))
    jobs.cancel(store, cancelled)
    jobs.pause(store, paused)
    states = {}
    for job in (succeeded, failed.job_id, running.job_id, cancelled, paused, queued):
        reply = client.get(f"/jobs/{job}")
        assert reply.status_code == 200
        page = look_at(reply)
        states[job] = next(a["data-state"] for a in page.of("article"))
        assert "<script>alert" not in reply.text
    assert set(states.values()) == {"succeeded", "failed", "running", "cancelled", "paused", "queued"}
    assert "weights absent" in client.get(f"/jobs/{succeeded}").text
    for url in ("/", "/jobs", f"/jobs/compare?id={succeeded}&id={queued}", f"/jobs/new?from={succeeded}"):
        look_at(client.get(url))


@pytest.mark.parametrize("key", list(listing.SORTS))
@pytest.mark.parametrize("descending", [True, False])
def test_walking_a_sorted_list_meets_every_job_once(store: Store, key: str, descending: bool) -> None:
    made = {submit(store, seed=i, method=("gauhuman", "rs-avatar")[i % 2]).id for i in range(7)}
    for _ in range(3):
        finish(store)
    order, met, last = listing.Order(key, descending), [], None
    while batch := listing.page(store, Filters(), order, last, 2):
        met += batch
        last = batch[-1].id
    assert len(met) == len(made)
    assert {job.id for job in met} == made
    if key == "psnr":
        values = [-1.0 if job.psnr is None else job.psnr for job in met]
        assert values == sorted(values, reverse=descending)


def test_the_list_says_in_its_links_what_it_shows(client: httpx.Client, store: Store) -> None:
    for i in range(55):
        submit(store, seed=i)
    first = client.get("/jobs?sort=subject&method=gauhuman")
    page = look_at(first)
    onward = next(a["href"] for a in page.of("a") if a.get("rel") == "next")
    assert onward is not None
    assert "sort=subject" in onward
    assert "method=gauhuman" in onward
    second = look_at(client.get(onward))
    rows = [{a["data-job"] for a in p.of("tr") if "data-job" in a} for p in (page, second)]
    assert (len(rows[0]), len(rows[1]), rows[0] & rows[1]) == (50, 5, set())
    assert [h["aria-sort"] for h in page.of("th") if "aria-sort" in h] == ["descending"]


def test_the_form_asks_for_every_word_of_a_spec() -> None:
    form = fields_of_spec({})
    asked = {f.name for _, _, fields in form.groups for f in fields} | {"method", "subject", "preset", "ablation"}
    assert asked == set(JobSpec.model_json_schema(by_alias=True)["properties"])
    assert all(f.about for _, _, fields in form.groups for f in fields)
    assert all(choice.about for choice in (*form.methods, *form.presets))


def test_a_clone_names_what_was_changed_and_nothing_else() -> None:
    spec = JobSpec(method="rs-avatar", subject="studio", preset="smoke", iterations=300, T=7, checkpoint_every=150)
    form = fields_of_spec(spec.model_dump(mode="json", by_alias=True))
    assert {f.name: f.value for _, _, fields in form.groups for f in fields if f.value is not None} == {"T": 7}


def test_a_heat_map_is_shaded_from_its_worst_to_its_best() -> None:
    scores = [
        Score(c, n, m, v) for c, n, m, v in (("a", 0, "psnr", 20.0), ("a", 1, "psnr", 30.0), ("b", 0, "psnr", 25.0))
    ]
    scores += [Score("a", 0, "flip", 0.1), Score("a", 1, "flip", 0.3), Score("b", 1, "psnr", None)]
    heat = heat_map(scores, "psnr")
    assert heat is not None
    assert [[(c.value, c.shade) for c in row] for _, row in heat.rows] == [
        [(20.0, 0), (30.0, 9)],
        [(25.0, 5), (None, 0)],
    ]
    flip = heat_map(scores, "flip")
    assert flip is not None
    assert [c.shade for c in flip.rows[0][1]] == [9, 0]
    assert heat_map([], "psnr") is None


def test_the_finding_is_the_mean_gain_over_subjects_that_have_both(store: Store) -> None:
    wanted = [("gauhuman", "a", 20.0), ("rs-avatar", "a", 22.0), ("oracle", "a", 24.0), ("rs-avatar", "b", 30.0)]
    entries = []
    for method, subject, psnr in wanted:
        submit(store, method=method, subject=subject)
        job = finish(store, psnr)
        entries.append(listing.results_of(store, [job])[job])
    found = findings.finding(entries, "smoke")
    assert (found.gain, found.cost, found.recovered, found.compared) == (2.0, 1.0, 0.5, 1)
    assert [lane.subject for lane in found.lanes] == ["a", "b"]
    marks = found.lanes[0].marks
    assert [mark.method for mark in marks] == ["gauhuman", "rs-avatar", "oracle"]
    assert marks[1].x - marks[0].x == pytest.approx(marks[2].x - marks[1].x)
    assert findings.finding([], "smoke").gain is None


def test_the_recovered_gap_is_a_ratio_of_means_as_in_the_main_table(store: Store) -> None:
    entries = []
    for subject, scores in {"a": (20.0, 22.0, 24.0), "b": (30.0, 30.9, 31.0)}.items():
        for method, psnr in zip(("gauhuman", "rs-avatar", "oracle"), scores, strict=True):
            submit(store, method=method, subject=subject)
            job = finish(store, psnr)
            entries.append(listing.results_of(store, [job])[job])
    assert findings.finding(entries, "smoke").recovered == pytest.approx(2.9 / 5.0)


def test_the_overview_shows_methods_as_they_are_meant(client: httpx.Client, store: Store) -> None:
    for psnr, changes in ((26.5, {}), (21.5, {"ablation": {"no_rs": True}})):
        assert post(client, method="rs-avatar", **changes).is_success
        finish(store, psnr)
    page = client.get("/").text
    assert "26.50" in page
    assert "w/o RS model" not in page
    assert "w/o RS model" in client.get("/api/v1/tables/main.md").text


def with_archives(store: Store, folder: Path) -> str:
    """A succeeded job that kept two pictures."""
    submit(store)
    claim = leases.claim(store, "w", 60.0)
    assert claim is not None
    files: list[Artifact] = []
    for name, members in {"pictures": ["04/000002/result.png"], "references": ["04/000002/truth.png"]}.items():
        data = io.BytesIO()
        with zipfile.ZipFile(data, "w") as archive:
            for member in members:
                archive.writestr(member, f"bytes of {member}")
        path = folder / f"{name}.zip"
        path.write_bytes(data.getvalue())
        files.append(artifacts.keep(store, name, path))
    leases.succeed(store, claim, Outcome({"psnr": 1.0}, {}, {}, {}, 1, 1.0, 1.0, (), files))
    return claim.job_id


def test_a_picture_is_found_by_camera_frame_and_kind(client: httpx.Client, store: Store, tmp_path: Path) -> None:
    url = f"/api/v1/jobs/{with_archives(store, tmp_path)}/frames"
    assert client.get(url).json() == [{"camera": "04", "frames": [2], "kinds": ["result", "truth"]}]
    reply = client.get(f"{url}/04/2/truth.png")
    assert (reply.content, reply.headers["content-type"]) == (b"bytes of 04/000002/truth.png", "image/png")
    again = client.get(f"{url}/04/2/truth.png", headers={"if-none-match": reply.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    for wrong in ("04/3/truth.png", "05/2/truth.png", "04/2/input.png"):
        assert client.get(f"{url}/{wrong}").status_code == 404
    for wrong in (
        "04/2/secret.png",
        "..%2f..%2fetc/2/truth.png",
        "04/-1/truth.png",
        "04/2/truth.txt",
        "a.b/2/truth.png",
    ):
        assert client.get(f"{url}/{wrong}").status_code in {404, 422}
    assert client.get(f"/api/v1/jobs/{UNKNOWN}/frames").status_code == 404


def test_the_chart_library_comes_from_its_package_and_is_kept(untouched: httpx.Client) -> None:
    url = vendor.address()
    assert url is not None
    with untouched.stream("GET", url, headers={"accept-encoding": "gzip"}) as reply:
        raw = b"".join(reply.iter_raw())
    assert reply.headers["content-encoding"] == "gzip"
    assert "immutable" in reply.headers["cache-control"]
    path = vendor.script()
    assert path is not None
    assert gzip.decompress(raw) == path.read_bytes()
    assert len(raw) < 2_000_000
    assert untouched.get("/static/vendor/plotly-0.0.1.min.js").status_code == 404


def test_results_of_benchmarks_are_kept_once_and_beside_those_of_other_commits(store: Store, tmp_path: Path) -> None:
    machine = {"commit": "one"}
    (tmp_path / "speed.json").write_text(json.dumps({"kind": "speed", "machine": machine, "targets": []}))
    (tmp_path / "broken.json").write_text("{")
    (tmp_path / "other.json").write_text("[1]")
    before = {b.id for b in benchmarks.newest(store)}
    benchmarks.discover(store, tmp_path)
    benchmarks.discover(store, tmp_path)
    (tmp_path / "speed.json").write_text(json.dumps({"kind": "speed", "machine": {"commit": "two"}, "targets": []}))
    benchmarks.discover(store, tmp_path)
    found = [(b.name, b.commit) for b in benchmarks.newest(store) if b.id not in before]
    assert found == [("speed", "one"), ("speed", "two")]


def test_stored_benchmarks_stand_beside_those_of_the_checkout(client: httpx.Client, store: Store) -> None:
    machine = {"commit": "abcdef012345", "processor": "a test", "cores": 2, "instructions": "none", "load": 0.0}
    target = {"name": "a thing", "bound": 5.0, "sense": "at most", "measured": 4.0, "unit": "ms"}
    for measured in (4.0, 6.0):
        payload = {
            "kind": "speed",
            "machine": machine,
            "command": "measure",
            "targets": [{**target, "measured": measured}],
        }
        benchmarks.add(store, "speed", payload)
    reply = client.get("/benchmarks?commit=abcdef012345")
    look_at(reply)
    assert "✕ not met" in reply.text
    assert "a thing, ms" in reply.text
    assert reply.headers["content-security-policy"] == layout.CHART_POLICY


def test_numbers_are_written_for_people() -> None:
    assert [layout.duration(s) for s in (None, 0.3, 42.4, 61.0, 120.0, 7300.0, 200_000.0)] == [
        "–", "0.3 s", "42 s", "1 min 1 s", "2 min", "2 h 2 min", "2.3 days",
    ]  # fmt: skip
    assert [layout.size(n) for n in (None, 12, 2048, 3 << 20)] == ["–", "12 B", "2.0 KB", "3.0 MB"]
    assert layout.whole(12345.0) == "12\u202f345"
