"""Tables: means by hand, order, marks, escaping; equal rows in any order give equal bytes."""

import csv
import io
import json
import random
import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsavatar.errors import SpecError
from rsavatar.report.tables import PAPER_MAIN, TABLES, Row, render, render_main, render_per_subject

BASE = Row(
    method="rs-avatar", subject="wave", seed=0, psnr=24.0, ssim=0.8, flip=0.1, lpips=0.15, joint_mm=12.0,
    sub_frame_joint_mm=15.0, train_seconds=60.0, gaussians=7000, iterations=3000, job_id="job-0", commit="abc1234",
    data_sha256="f" * 64, protocol="mask radius 2 px",
)  # fmt: skip


def row(method: str, subject: str, psnr: float, seed: int = 0, **other: Any) -> Row:
    name = f"{method}/{subject}/{seed}"
    return replace(BASE, method=method, subject=subject, psnr=psnr, seed=seed, job_id=name, **other)


TWO_METHODS = [
    row("rs-avatar", "wave", 25.0),
    row("rs-avatar", "walk", 24.0),
    row("gauhuman", "wave", 23.0),
    row("gauhuman", "walk", 24.0),
]


def as_json(rows: list[Row], name: str = "main") -> Any:
    return json.loads(render(name, rows, "json"))


def test_the_mean_is_over_seeds_then_over_subjects() -> None:
    rows = [row("gauhuman", "wave", 20.0, 0), row("gauhuman", "wave", 22.0, 1), row("gauhuman", "walk", 31.0, 0)]
    line = as_json(rows)["rows"][0]
    assert line["psnr"] == pytest.approx((21.0 + 31.0) / 2)
    assert (line["subjects"], line["seeds"]) == (2, 2)
    assert "psnr_std" not in line  # only one seed ran on both subjects


def test_the_deviation_is_of_the_seeds_means_over_subjects() -> None:
    rows = [row("gauhuman", s, p, seed) for s, p, seed in [("a", 20, 0), ("b", 30, 0), ("a", 22, 1), ("b", 32, 1)]]
    assert as_json(rows)["rows"][0]["psnr_std"] == pytest.approx(2**0.5)  # of 25 and 27
    assert "26.00 ± 1.41" in render_main(rows, "md")
    assert r"26.00 $\pm$ 1.41" in render_main(rows, "tex")


def test_methods_stand_in_the_papers_order_beside_its_figures() -> None:
    methods = ["oracle", "rs-avatar", "jamnet+gauhuman", "mad-avatar", "gauhuman", "cvr+gauhuman"]
    table = as_json([row(m, "wave", 20.0) for m in methods])
    assert [r["method"] for r in table["rows"]] == [*PAPER_MAIN, "oracle"]
    assert [r["paper_psnr"] for r in table["rows"]] == [23.69, 23.99, 23.96, 22.99, 24.68, None]
    assert any("other data" in note for note in table["notes"])


def test_the_best_is_bold_in_every_column_where_better_means_something() -> None:
    rows = [replace(r, train_seconds=1.0) if r.method == "gauhuman" else replace(r, flip=0.05) for r in TWO_METHODS]
    ours = as_json(rows)["rows"][1]
    assert ours["method"] == "rs-avatar"
    assert {"psnr", "flip"} <= set(ours["best"])
    assert "train_seconds" not in ours["best"] + as_json(rows)["rows"][0]["best"]
    assert "**24.50**" in render_main(rows, "md")
    assert r"\textbf{24.50}" in render_main(rows, "tex")


def test_equal_as_shown_is_equally_best_and_the_oracle_never_is() -> None:
    rows = [row("rs-avatar", "wave", 25.001), row("gauhuman", "wave", 24.999), row("oracle", "wave", 40.0)]
    assert [("psnr" in r["best"]) for r in as_json(rows)["rows"]] == [True, True, False]


def test_a_method_of_fewer_subjects_is_marked_and_not_compared() -> None:
    rows = [*TWO_METHODS, row("mad-avatar", "wave", 99.0)]
    table = as_json(rows)
    assert [("psnr" in r["best"]) for r in table["rows"]] == [False, False, True]
    assert "† MAD-Avatar: mean over 1 of 2 subjects, without walk." in table["notes"]
    assert "| MAD-Avatar † |" in render_main(rows, "md")
    assert r"MAD-Avatar $^\dagger$" in render_main(rows, "tex")


@pytest.mark.parametrize("fmt", ["csv", "md", "tex"])
def test_absent_weights_are_words_not_numbers(fmt: str) -> None:
    rows = [replace(TWO_METHODS[0], lpips=None), *TWO_METHODS[1:]]
    assert "weights absent" in render_main(rows, fmt)
    assert "LPIPS: weights absent in 1 of 4 jobs." in render_main(rows, fmt)
    line = as_json(rows)["rows"][1]
    assert line["lpips"] is None
    assert "lpips" not in line["best"]


def test_no_truth_leaves_a_dash() -> None:
    rows = [replace(BASE, joint_mm=None, sub_frame_joint_mm=None)]
    assert " | – | – | 60 | 7000 |" in render_main(rows, "md")
    assert next(csv.DictReader(io.StringIO(render_main(rows, "csv"))))["joint_mm"] == ""


def test_what_makes_jobs_incomparable_is_said() -> None:
    rows = [TWO_METHODS[0], replace(TWO_METHODS[2], iterations=300, protocol="mask radius 0 px")]
    notes = as_json(rows)["notes"]
    assert "Iterations differ between jobs: 300, 3000." in notes
    assert "Metric protocols differ between jobs; see the provenance." in notes


def test_a_subjects_own_cameras_are_no_other_protocol() -> None:
    stated = [json.dumps({"mask_radius_px": 2, "cameras": cameras, "frames": 3}) for cameras in (["00"], ["01", "07"])]
    rows = [replace(r, protocol=text) for r, text in zip(TWO_METHODS, stated * 2, strict=True)]
    table = as_json(rows)
    assert not any("protocols differ" in note for note in table["notes"])
    assert table["provenance"]["protocol"] == ["mask_radius_px 2"]


@pytest.mark.parametrize("name", ["main", "per-subject", "shutter", "cost"])
@pytest.mark.parametrize("fmt", ["json", "csv", "md", "tex"])
def test_every_format_carries_its_provenance(name: str, fmt: str) -> None:
    text = render(name, TWO_METHODS, fmt)
    for stamp in ("gauhuman/walk/0", "abc1234", "walk sha256 ffffffffffff", "mask radius 2 px"):
        assert stamp in text


def test_per_subject_compares_within_a_subject() -> None:
    table = as_json(TWO_METHODS, "per-subject")
    assert [(r["subject"], r["method"]) for r in table["rows"]] == [
        ("walk", "gauhuman"), ("walk", "rs-avatar"), ("wave", "gauhuman"), ("wave", "rs-avatar"),
    ]  # fmt: skip
    assert ["psnr" in r["best"] for r in table["rows"]] == [True, True, False, True]
    assert "| wave | RS-Avatar (ours) | **25.00** |" in render_per_subject(TWO_METHODS, "md")


@pytest.mark.parametrize("name", ["main", "per-subject"])
def test_no_rows_are_a_table_all_the_same(name: str) -> None:
    assert as_json([], name)["rows"] == []
    assert "PSNR ↑" in render(name, [], "md")
    assert "No finished jobs." in render(name, [], "md")
    assert render(name, [], "csv").splitlines()[0].startswith("method" if name == "main" else "subject,method")
    assert r"\bottomrule" in render(name, [], "tex")


def test_hostile_text_stays_text() -> None:
    nasty = "50% of $x_1 & {y}\n\\input{/etc/passwd}"
    rows = [replace(BASE, protocol=nasty, commit="a|b", method=nasty)]
    tex = render_main(rows, "tex")
    assert all(line.startswith("%") for line in tex.splitlines() if r"\input" in line)
    assert r"50\% of \$x\_1 \& \{y\}" in tex
    bars = [line.replace("\\|", "").count("|") for line in render_main(rows, "md").splitlines()[:3]]
    assert len(set(bars)) == 1


def test_csv_is_read_back_by_a_parser_at_full_precision() -> None:
    text = render_main([row("gauhuman", "wave", 23.123456789)], "csv")
    lines = list(csv.DictReader(line for line in io.StringIO(text) if not line.startswith("#")))
    assert len(lines) == 1
    assert float(lines[0]["psnr"]) == 23.123456789


def test_latex_is_balanced() -> None:
    tex = render_main(TWO_METHODS, "tex")
    assert tex.count("{") - tex.count(r"\{") == tex.count("}") - tex.count(r"\}")
    body = tex.split(r"\midrule")[1].split(r"\bottomrule")[0].strip().splitlines()
    assert {line.count("&") for line in body} == {tex.split("{tabular}{l")[1].split("}")[0].count("r")}


values = st.floats(0, 50).map(lambda v: round(v, 3))
some_rows = st.lists(
    st.builds(
        row,
        method=st.sampled_from([*PAPER_MAIN, "flow+gauhuman", "unheard-of"]),
        subject=st.sampled_from(["a", "b", "c"]),
        psnr=values,
        seed=st.integers(0, 2),
        lpips=st.none() | values,
        joint_mm=st.none() | values,
        settings=st.sampled_from([(), (("T", "K"),), (("T", "scanline"), ("ablation", "no_rs"))]),
    ),
    max_size=8,
)


@given(some_rows, st.sampled_from(sorted(TABLES)), st.sampled_from(["json", "csv", "md", "tex"]), st.randoms())
def test_the_order_of_rows_does_not_matter(rows: list[Row], name: str, fmt: str, shuffle: random.Random) -> None:
    text = render(name, rows, fmt)
    shuffle.shuffle(rows)
    assert render(name, rows, fmt) == text


def test_unknown_names_and_formats_are_refused() -> None:
    wanted = "table: expected one of main, ablation, per-subject, shutter, cost, got 'costs'"
    with pytest.raises(SpecError, match=wanted):
        render("costs", [], "md")
    with pytest.raises(SpecError, match="format: expected one of json, csv, md, tex, got 'html'"):
        render("main", [], "html")


def test_needs_the_standard_library_only() -> None:
    code = "import rsavatar.report.tables, sys; print(sorted({'torch', 'numpy', 'pydantic'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_what_corrected_the_pictures_is_named_below_the_table() -> None:
    rows = [
        row("gauhuman", "wave", 20.0),
        row("cvr+gauhuman", "wave", 21.0, restorer="cvr version 1, reduced, sha256 ab"),
    ]
    assert "CVR + GauHuman: pictures corrected by cvr version 1, reduced, sha256 ab." in render_main(rows, "md")
    assert "pictures corrected" not in render_main(rows[:1], "md")
