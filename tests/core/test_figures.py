"""Figures: what they choose and average, by hand; that what is drawn is a file of its kind with its provenance."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rsavatar.catalog import METHODS
from rsavatar.errors import SpecError
from rsavatar.report import palette
from rsavatar.report.figures import FIGURES, build
from rsavatar.report.figures_charts import band_order
from rsavatar.report.figures_draw import FORMATS, draw
from rsavatar.report.runs import Figure, Run, Wish, interpolate, mean_curve, of_preset, standard
from rsavatar.report.tables import LABELS

CURVE = {"psnr": [(0, 10.0), (100, 30.0)], "loss": [(0, 0.1), (100, 0.01)]}
SCORES = {("03", 0): 20.0, ("03", 1): 22.0, ("07", 0): 24.0}


def run(method: str = "rs-avatar", subject: str = "walk", psnr: float = 25.0, **more: Any) -> Run:
    number = more.pop("number", 0)
    known: dict[str, Any] = {
        "job_id": f"{method}-{subject}-{more.get('seed', 0)}-{number}",
        "seed": 0,
        "preset": "draft",
        "bands": "K",
        "motion": "sequence-spline",
        "ablation": (),
        "is_standard": True,
        "iterations": 100,
        "train_seconds": 60.0,
        "gaussians": 7000,
        "commit": "abc1234",
        "data_sha256": "f" * 64,
        "means": {"psnr": psnr, "sub_frame_joint_mm": 50 - psnr},
        "curves": CURVE,
        "scores": SCORES,
    }
    return Run(method=method, subject=subject, **{**known, **more})


def everything() -> list[Run]:
    """Three methods on two subjects, an ablation, a sweep over T."""
    compared = [
        run(method, subject, base + gain, train_seconds=seconds)
        for method, gain, seconds in (("gauhuman", 0.0, 30.0), ("mad-avatar", -0.5, 90.0), ("rs-avatar", 2.0, 40.0))
        for subject, base in (("walk", 22.0), ("wave", 26.0))
    ]
    lesser = [run("rs-avatar", "walk", 23.0, ablation=("no_rs",), is_standard=False, number=1)]
    sweep = [run("rs-avatar", "walk", 20.0 + t, bands=str(t), is_standard=False, number=2 + t) for t in (1, 2, 4)]
    return [*compared, *lesser, *sweep]


def pictures_for(figure: Figure) -> dict[str, Any]:
    """Pictures of the sizes that a figure asks for."""
    slope = np.linspace(0, 255, 90 * 40 * 3).reshape(90, 40, 3).astype(np.uint8)
    wanted = figure.pictures
    if not wanted:
        return {}
    names = ["global", "blur", "bands", "rolling"] if wanted["kind"] == "shutter" else ["input", "truth"]
    jobs = [column["job"] for column in wanted.get("columns", ())]
    found: dict[str, Any] = dict.fromkeys((*names, *jobs), slope)
    for job in jobs:
        found[f"error:{job}"] = slope[..., 0].astype(np.float32) / 255
        found[f"psnr:{job}"] = 25.0
    return {**found, "box": [5, 10, 25, 30]}


@cache
def drawn(name: str, fmt: str) -> bytes:
    figure = build(name, everything())
    assert not figure.lacking
    return draw(figure, fmt, pictures_for(figure))


@pytest.mark.parametrize("name", FIGURES)
def test_without_runs_a_figure_says_what_it_lacks_and_cannot_be_drawn(name: str) -> None:
    figure = build(name, [])
    assert figure.lacking.startswith("a succeeded job" if name != "ablation" else "succeeded jobs")
    with pytest.raises(SpecError, match=f"figure {name}: expected"):
        draw(figure, "png", {})


def test_an_unknown_figure_or_format_is_named() -> None:
    with pytest.raises(SpecError, match="figure: expected one of qualitative"):
        build("pie", [])
    with pytest.raises(SpecError, match="format: expected one of png, svg, pdf"):
        draw(build("pareto", everything()), "bmp", {})


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_survives_its_json_and_names_all_its_jobs(name: str) -> None:
    figure = build(name, everything())
    assert Figure.from_json(figure.to_json()) == figure
    assert figure.provenance["commits"] == ["abc1234"]
    assert any(job.startswith("rs-avatar-walk") for job in figure.provenance["jobs"])


def test_the_preset_is_the_one_asked_for_or_the_widest_or_the_most_careful() -> None:
    runs = [run(preset="smoke"), run("gauhuman", preset="smoke"), run(preset="paper", number=1)]
    assert {r.preset for r in of_preset(runs, None)} == {"smoke"}
    assert {r.preset for r in of_preset(runs, "paper")} == {"paper"}
    assert {r.preset for r in of_preset(runs[1:], None)} == {"paper"}
    assert of_preset([], None) == []


def test_one_run_stands_for_a_method_the_standard_one_before_the_newest() -> None:
    newest = run(bands="4", is_standard=False, number=9)
    chosen = run(number=1)
    ablated = run(ablation=("no_rs",), number=99)
    other_seed = run(seed=1, is_standard=False)
    assert standard([newest, chosen, ablated, other_seed]) == [chosen, other_seed]
    assert standard([run(is_standard=False, number=1), newest]) == [newest]


def test_curves_are_interpolated_linearly_and_averaged_over_what_they_share() -> None:
    line = [(0, 1.0), (10, 3.0), (30, 7.0)]
    assert [interpolate(line, step) for step in (-5, 0, 5, 10, 20, 99)] == [1.0, 1.0, 2.0, 3.0, 5.0, 7.0]
    curve = mean_curve([[(0, 0.0), (100, 10.0)], [(20, 4.0), (200, 22.0)]])
    assert (curve["steps"][0], curve["steps"][-1]) == (20, 100)
    assert curve["mean"][0] == pytest.approx(3.0)
    assert (curve["low"][0], curve["high"][0]) == (pytest.approx(2.0), pytest.approx(4.0))
    assert curve["mean"][-1] == pytest.approx((10 + 12) / 2)


def test_means_are_over_seeds_then_subjects_with_the_deviation_over_seeds() -> None:
    runs = [run(subject=s, seed=n, psnr=p + n) for s, p in (("walk", 20.0), ("wave", 30.0)) for n in (0, 2)]
    rows = build("per-subject", runs).data["rows"]
    assert [(row["subject"], row["methods"][0]["psnr"]) for row in rows] == [("walk", 21.0), ("wave", 31.0)]
    mean = build("pareto", runs).data["means"][0]
    assert mean["psnr"] == pytest.approx(26.0)
    assert mean["psnr_std"] == pytest.approx(2**0.5)  # of 25 and 27
    assert (mean["count"], mean["runs"]) == (2, 4)


def test_the_front_holds_what_none_beats_in_both_and_never_the_oracle() -> None:
    runs = [*everything(), run("oracle", psnr=40.0, train_seconds=1.0)]
    assert set(build("pareto", runs).data["front"]) == {"gauhuman", "rs-avatar"}


def test_an_ablation_is_compared_with_the_same_model_of_motion() -> None:
    ablated = run(psnr=23.0, motion="frame-spline", ablation=("no_reg",), is_standard=False, number=1)
    assert build("ablation", [run(psnr=26.0), ablated]).lacking
    whole = run(psnr=25.0, motion="frame-spline", is_standard=False, number=2)
    variants = build("ablation", [run(psnr=26.0), ablated, whole]).data["variants"]
    assert [(v["flag"], v["psnr"]) for v in variants] == [("", 25.0), ("no_reg", 23.0)]


def test_an_ablation_is_compared_with_the_whole_method_on_its_subjects_alone() -> None:
    variants = build("ablation", everything()).data["variants"]
    assert [(v["flag"], v["psnr"], v["subjects"]) for v in variants] == [
        ("", 24.0, {"walk": 24.0}),
        ("no_rs", 23.0, {"walk": 23.0}),
    ]


def test_the_strip_shows_the_view_of_median_gain_ours_before_the_truth() -> None:
    ours = {("03", 0): 21.0, ("03", 1): 27.0, ("07", 0): 26.0}  # gains 1, 5 and 2
    runs = [run("gauhuman"), run("rs-avatar", scores=ours), run("oracle"), run("mad-avatar")]
    pictures = build("qualitative", runs).pictures
    assert (pictures["camera"], pictures["frame"]) == ("07", 0)
    assert [c["method"] for c in pictures["columns"]] == ["gauhuman", "mad-avatar", "rs-avatar", "oracle"]
    chosen = build("qualitative", runs, Wish(camera="03", frame=1)).pictures
    assert (chosen["camera"], chosen["frame"]) == ("03", 1)
    with pytest.raises(SpecError, match="camera and frame: expected a held-out view"):
        build("qualitative", runs, Wish(camera="99"))
    with pytest.raises(SpecError, match="subject: expected one with a finished job"):
        build("qualitative", runs, Wish(subject="nobody"))


def test_bands_are_in_the_order_of_their_number() -> None:
    assert sorted(["2K", "16", "K", "4"], key=band_order) == ["4", "16", "K", "2K"]


@pytest.mark.parametrize("name", FIGURES)
def test_a_png_has_the_column_width_and_its_provenance(name: str) -> None:
    picture = Image.open(io.BytesIO(drawn(name, "png")))
    assert picture.width in (int(3.25 * 300), int(6.875 * 300))
    assert picture.info["Title"] == build(name, everything()).title
    assert "jobs: " in picture.info["Description"]
    assert "abc1234" in picture.info["Description"]
    assert np.asarray(picture.convert("L")).std() > 5


@pytest.mark.parametrize("name", ["qualitative", "curves"])
def test_a_pdf_has_the_width_in_points_and_whole_fonts(name: str) -> None:
    data = drawn(name, "pdf")
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+)", data)
    assert box is not None
    assert float(box[1]) == pytest.approx(6.875 * 72, abs=0.5)
    objects = b"".join(inflated(stream) for stream in re.findall(rb"stream\r?\n(.*?)endstream", data, re.DOTALL))
    assert b"/FontFile2" in data + objects  # TrueType, embedded
    assert b"/Type3" not in data + objects
    assert b"abc1234" in data


def inflated(stream: bytes) -> bytes:
    try:
        return zlib.decompressobj().decompress(stream)
    except zlib.error:
        return b""


@pytest.mark.parametrize("name", ["shutter", "ablation"])
def test_an_svg_is_text_that_names_its_jobs_and_loads_nothing(name: str) -> None:
    text = drawn(name, "svg").decode()
    assert text.startswith("<?xml")
    assert "rs-avatar-walk" in text
    assert not re.search(r'(href|src)="(?!#|data:)', text.replace('xmlns:xlink="http', ""))


@pytest.mark.parametrize("fmt", FORMATS)
def test_equal_figures_are_equal_bytes(fmt: str) -> None:
    assert drawn("per-subject", fmt) == draw(build("per-subject", everything()), fmt, {})


def test_every_method_has_a_look_and_a_mark_of_its_own() -> None:
    assert set(METHODS) | set(LABELS) <= set(palette.METHODS)
    marks = [look.marker for look in palette.METHODS.values()]
    assert len(set(marks)) == len(marks)


def luminance(colour: str) -> float:
    """Relative luminance (WCAG 2.2)."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_colours_stand_out_from_both_papers() -> None:
    for name, look in {**palette.METHODS, "other": palette.OTHER}.items():
        assert 1.05 / (luminance(look.light) + 0.05) >= 3, name  # graphical objects on white
        assert (luminance(look.dark) + 0.05) / 0.05 >= 7, name  # and on black


def deuteranope(colour: str) -> np.ndarray:
    """How a reader without green cones sees a colour (Vienot, Brettel, Mollon 1999), linear RGB."""
    value = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]) ** 2.2
    return np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]]).dot(value).clip(0)


def test_the_main_methods_differ_for_colour_blind_readers() -> None:
    looks: Mapping[str, palette.Look] = {m: palette.METHODS[m] for m in ("rs-avatar", "gauhuman", "mad-avatar")}
    seen = [deuteranope(look.light) for look in looks.values()]
    for i, a in enumerate(seen):
        for b in seen[:i]:
            assert np.linalg.norm(a**0.45 - b**0.45) > 0.15


def test_the_style_sheet_names_every_method_in_both_schemes() -> None:
    text = palette.stylesheet()
    for name, look in palette.METHODS.items():
        word = f"--method-{name.replace('+', '-')}"
        assert f"{word}: {look.light};" in text
        assert f"{word}: {look.dark};" in text
