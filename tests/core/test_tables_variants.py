"""Tables of one method against itself, settings told apart, the recovered gap, costs: by hand on few rows."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from rsavatar.report.paper import paper_table
from rsavatar.report.rows import FLAGS, Row, distinguish
from rsavatar.report.tables import render
from rsavatar.report.variants import bands_place, operator_of
from tests.core.test_tables import row


def varied(psnr: float, ablation: str = "", T: str = "K", subject: str = "wave", **other: Any) -> Row:
    """A row of ours that leaves something out or has other bands."""
    more = tuple(other.pop("settings", ()))
    settings = (*((("ablation", ablation),) if ablation else ()), ("T", T), *more)
    name = f"{ablation}/{T}/{subject}/{other.get('seed', 0)}/{more}"
    return replace(row("rs-avatar", subject, psnr), settings=settings, job_id=name, **other)


def as_json(name: str, rows: list[Row]) -> Any:
    return json.loads(render(name, rows, "json"))


PAPERS = [
    varied(24.0),
    varied(23.0, "no_rs"),
    varied(21.0, "no_spline"),
    varied(23.5, "no_pose_deformation"),
    varied(23.9, "no_lbs_refinement"),
    varied(22.5, "no_reg"),
    varied(23.95, T="2K"),
    varied(23.90, T="4K"),
    varied(24.2, T="scanline"),
]


def test_the_ablation_table_stands_in_the_papers_order_beside_its_figures() -> None:
    lines = as_json("ablation", PAPERS[::-1])["rows"]
    assert [line["variant"] for line in lines] == ["full", *FLAGS, "T=2K", "T=4K", "scanline"]
    figures = paper_table("ablation").rows
    assert [line["paper_psnr"] for line in lines] == [*(r["psnr"] for r in figures.values()), None]
    assert list(figures) == ["full", *FLAGS, "T=2K", "T=4K"]
    assert [line["delta_psnr"] for line in lines[:3]] == [None, pytest.approx(-1.0), pytest.approx(-3.0)]
    tex = render("ablation", PAPERS, "tex")
    assert "full model (T = K)" in tex
    assert r"w/o L\_reg" in tex
    assert r"\toprule" in tex
    assert r"\textbf{24.20}" in tex
    assert "+0.20" in tex


def test_other_methods_and_other_bands_do_not_disturb_the_ablation() -> None:
    own = [varied(24.0, T="scanline"), varied(22.0, "no_rs", T="scanline"), varied(23.0, T="K")]
    table = as_json("ablation", [*own, row("gauhuman", "wave", 20.0)])
    assert [line["variant"] for line in table["rows"]] == ["full", "no_rs", "T=K"]
    assert table["notes"][0] == "All rows are RS-Avatar (ours); the full model has T = scanline."
    assert len(table["provenance"]["jobs"]) == 3


def test_settings_that_the_ablation_does_not_vary_make_lines_of_their_own() -> None:
    short, long = (("iterations", "300"),), (("iterations", "3000"),)
    rows = [varied(24.0, settings=long), varied(23.0, "no_rs", settings=long), varied(20.0, settings=short)]
    table = as_json("ablation", rows)
    assert [(line["variant"], line["psnr"]) for line in table["rows"]] == [
        ("full", 20.0),
        ("full", 24.0),
        ("no_rs", 23.0),
    ]
    assert table["rows"][2]["delta_psnr"] == pytest.approx(-1.0)
    assert "full model (T = K), iterations=3000" in render("ablation", rows, "md")


def test_seeds_make_error_bars_in_the_ablation() -> None:
    rows = [varied(24.0), varied(26.0, seed=1), varied(20.0, "no_rs"), varied(22.0, "no_rs", seed=1)]
    full, without = as_json("ablation", rows)["rows"]
    assert (full["psnr"], full["psnr_std"], full["seeds"]) == (25.0, pytest.approx(2**0.5), 2)
    assert without["delta_psnr"] == pytest.approx(-4.0)


def test_a_change_is_of_the_same_subjects() -> None:
    rows = [varied(24.0), varied(26.0, subject="walk"), varied(20.0, "no_rs")]
    full, without = as_json("ablation", rows)["rows"]
    assert without["delta_psnr"] is None
    assert "psnr" not in without["best"] + full["best"]
    assert "† Not all of the 2 subjects." in as_json("ablation", rows)["notes"]


def test_the_shutter_table_is_by_operator_and_bands() -> None:
    mad = [replace(row("mad-avatar", "wave", 19.0), settings=(("T", t),), job_id=t) for t in ("11", "K")]
    rows = [*PAPERS, *mad, row("gauhuman", "wave", 20.0)]
    lines = as_json("shutter", rows)["rows"]
    assert [(line["operator"], line["method"], line["T"]) for line in lines] == [
        ("identity", "gauhuman", "1"),
        ("identity", "rs-avatar", "1"),
        ("averaging", "mad-avatar", "11"),
        ("averaging", "mad-avatar", "K"),
        ("selection", "rs-avatar", "K"),
        ("selection", "rs-avatar", "2K"),
        ("selection", "rs-avatar", "4K"),
        ("selection", "rs-avatar", "scanline"),
    ]
    assert [line["paper_psnr"] for line in lines] == [None, None, None, None, 24.65, 24.59, 24.54, None]
    assert operator_of(PAPERS[1]) == "identity"


def test_bands_are_ordered_by_their_number() -> None:
    bands = ["scanline", "4K", "K", "11", "2K", "3", "10K"]
    assert sorted(bands, key=bands_place) == ["3", "11", "K", "2K", "4K", "10K", "scanline"]


def test_the_recovered_gap_is_between_baseline_and_truth() -> None:
    rows = [row("gauhuman", "wave", 20.0), row("rs-avatar", "wave", 23.0), row("oracle", "wave", 24.0)]
    for name in ("main", "per-subject"):
        table = as_json(name, rows)
        assert [line["gap"] for line in table["rows"]] == [0.0, pytest.approx(0.75), 1.0]
        assert any("Recovered gap" in note for note in table["notes"])
    assert [line["gap"] for line in as_json("main", rows[:2])["rows"]] == [None, None]
    fewer = [*rows, row("rs-avatar", "walk", 30.0)]
    assert [line["gap"] for line in as_json("main", fewer)["rows"]] == [0.0, None, 1.0]
    upside = [rows[0], rows[1], row("oracle", "wave", 19.0)]
    assert [line["gap"] for line in as_json("main", upside)["rows"]] == [None] * 3


def test_several_settings_of_a_method_are_told_apart_by_few_words() -> None:
    shared = (("K", "11"), ("motion", "frame-spline"))
    a, b, c = ((("T", "K"), *shared), (("T", "2K"), *shared), (("ablation", "no_rs"), ("T", "2K"), *shared))
    assert distinguish([a]) == {a: ""}
    assert distinguish([a, b]) == {a: "T=K", b: "T=2K"}
    assert distinguish([a, b, c]) == {a: "T=K", b: "T=2K", c: "w/o RS model, T=2K"}
    rows = [varied(24.0), varied(22.0, "no_rs"), row("gauhuman", "wave", 20.0)]
    names = [line.split(" | ")[0] for line in render("main", rows, "md").splitlines()[2:5]]
    assert names == ["| GauHuman", "| RS-Avatar (ours)", "| RS-Avatar (ours), w/o RS model"]


def test_costs_are_means_with_deviations() -> None:
    cheap = {"renders": 1.0, "paper_renders": 11.0, "evaluate_seconds": 5.0}
    rows = [
        replace(row("rs-avatar", "wave", 24.0, seed), train_seconds=seconds, **cheap)
        for seed, seconds in enumerate((60.0, 66.0))
    ]
    rows.append(replace(row("mad-avatar", "wave", 20.0), train_seconds=300.0, renders=11.0, paper_renders=11.0))
    mad, ours = as_json("cost", rows)["rows"]
    assert (ours["train_seconds"], ours["train_seconds_std"]) == (63, pytest.approx(18**0.5))
    assert (ours["step_ms"], ours["renders"], ours["paper_renders"]) == (pytest.approx(21.0), 1.0, 11.0)
    assert {"train_seconds", "step_ms", "renders"} <= set(ours["best"])
    assert mad["evaluate_seconds"] is None


def test_latex_leaves_out_columns_that_say_nothing() -> None:
    rows = [replace(r, joint_mm=None, sub_frame_joint_mm=None) for r in PAPERS]
    tex = render("ablation", rows, "tex")
    assert "joints" not in tex
    assert "PSNR" in tex
    assert tex.index(r"\caption") < tex.index(r"\label{tab:ablation}")
    assert tex.count("{") - tex.count(r"\{") == tex.count("}") - tex.count(r"\}")
