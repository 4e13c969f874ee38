"""Tables over HTTP: which results they are of, reused ones once, equal bytes, a whole grid as LaTeX."""

from __future__ import annotations

from typing import Any

import httpx
import pytest
from sqlalchemy import insert

from rsavatar.grids.request import read_grid, vary
from services.api.tables import settings_of
from services.store import leases, metrics
from services.store.records import Outcome
from services.store.session import Store
from services.store.tables import TagRow
from tests.services.test_api_jobs import finish, post

WORK = {"images": 4, "drawn_passes": 8, "paper_passes": 44}


def table(client: httpx.Client, name: str, **query: Any) -> Any:
    reply = client.get(f"/api/v1/tables/{name}.json", params=query)
    assert reply.status_code == 200, reply.text
    return reply.json()


def finish_all(store: Store, first: float = 20.0) -> int:
    """Let every waiting job succeed, each a tenth of a dB better than the one before."""
    count = 0
    while (claim := leases.claim(store, "test", 60.0)) is not None:
        provenance = {"commit": "c" * 12, "data_sha256": "d" * 64, "work": WORK}
        means = {"psnr": first + count / 10, "ssim": 0.8}
        leases.succeed(store, claim, Outcome(means, {}, {"mask_radius_px": 2}, provenance, 42, 3.0, 1.0))
        count += 1
    return count


def test_the_ablation_grid_comes_out_as_latex(client: httpx.Client, store: Store) -> None:
    request = vary(read_grid("ablation"), "preset", "smoke").model_dump(mode="json")
    grid = client.post("/api/v1/grids", json=request).json()["id"]
    post(client)  # a job that is not of the grid
    assert finish_all(store) == 10
    tex = client.get("/api/v1/tables/ablation.tex", params={"grid": grid})
    assert tex.headers["content-type"].startswith("application/x-tex")
    body = tex.text.split(r"\midrule")[1].split(r"\bottomrule")[0]
    assert body.count(r"\\") == 9
    for words in ("full model (T = K)", "w/o RS model", r"w/o L\_reg", "T=4K", "scanline", "24.65", r"\textbf{"):
        assert words in body
    assert "mask_radius_px 2" in tex.text
    assert tex.content == client.get("/api/v1/tables/ablation.tex", params={"grid": grid}).content
    shutter = table(client, "shutter", grid=grid)
    assert [line["T"] for line in shutter["rows"]] == ["1", "K", "2K", "4K", "scanline"]
    costs = table(client, "cost", grid=grid)["rows"]
    assert {(line["renders"], line["paper_renders"]) for line in costs} == {(2.0, 11.0)}


def test_tables_are_of_the_results_that_are_asked_for(client: httpx.Client, store: Store) -> None:
    grid = {"base": {"subject": "studio", "preset": "smoke", "method": "gauhuman"}, "axes": {"seed": [0, 1, 2]}}
    made = client.post("/api/v1/grids", json=grid).json()
    post(client, method="mad-avatar")
    assert finish_all(store) == 4
    tagged = made["cells"][2]["job_id"]
    with store.write() as session:
        session.execute(insert(TagRow), [{"job_id": tagged, "tag": "paper"}])
    assert [line["method"] for line in table(client, "main")["rows"]] == ["gauhuman", "mad-avatar"]
    assert [line["seeds"] for line in table(client, "main", grid=made["id"])["rows"]] == [3]
    assert [line["seeds"] for line in table(client, "main", seed=[0, 2])["rows"]] == [2, 1]
    assert table(client, "main", tag="paper")["provenance"]["jobs"] == [tagged]
    assert [line["method"] for line in table(client, "main", q="psnr>20.25")["rows"]] == ["mad-avatar"]
    assert table(client, "main", preset="paper")["rows"] == []
    assert client.get("/api/v1/tables/main.json", params={"q": "psnr>"}).json()["errors"][0]["name"] == "q"
    assert client.get("/api/v1/tables/main.json", params={"colour": "red"}).status_code == 422


def test_a_reused_result_counts_once(client: httpx.Client, store: Store) -> None:
    first = post(client).json()["id"]
    finish(store, 21.0)
    again = post(client).json()
    assert (again["state"], again["reused_from"]) == ("succeeded", first)
    found = table(client, "main")
    assert (found["rows"][0]["seeds"], found["provenance"]["jobs"]) == (1, [first])
    assert len(metrics.table_entries(store)) == 1


@pytest.mark.parametrize("name", ["main", "ablation", "per-subject", "shutter", "cost"])
def test_every_table_has_every_format_even_without_rows(untouched: httpx.Client, name: str) -> None:
    for fmt in ("json", "csv", "md", "tex"):
        assert untouched.get(f"/api/v1/tables/{name}.{fmt}").status_code == 200
    assert untouched.get("/api/v1/tables/none.csv").status_code == 404


def test_settings_are_the_words_that_decide_a_result() -> None:
    spec = {"method": "m", "subject": "s", "seed": 1, "priority": 0, "T": None, "P": 4, "lambda": 0.5, "densify": True}
    spec |= {"ablation": {"no_rs": True, "no_reg": False, "no_spline": True}, "K": 11, "motion": "still"}
    assert settings_of(spec) == (
        ("K", "11"), ("P", "4"), ("ablation", "no_rs+no_spline"), ("densify", "true"), ("lambda", "0.5"),
        ("motion", "still"),
    )  # fmt: skip
