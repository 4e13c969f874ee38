"""Grids: cells counted by hand, refusals that name axis and value, and every built-in grid against the paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsavatar.errors import SpecError
from rsavatar.grids.cells import expand, place_of, read_axes
from rsavatar.grids.request import GridRequest, grid_names, parse_grid, read_grid, read_grid_file, vary

BASE = {"method": "rs-avatar", "subject": "wave", "preset": "smoke"}


def grid(axes: dict[str, Any], **other: Any) -> GridRequest:
    return parse_grid({"base": BASE, "axes": axes, **other})


def test_cells_are_the_product_with_the_last_axis_running_fastest() -> None:
    cells = expand(grid({"method": ["gauhuman", "rs-avatar"], "seed": [0, 1, 2]}))
    assert [(c.place["method"], c.spec.seed) for c in cells] == [
        (method, seed) for method in ("gauhuman", "rs-avatar") for seed in range(3)
    ]
    assert [c.number for c in cells] == list(range(6))
    assert all(c.spec.method == c.place["method"] and c.spec.subject == "wave" for c in cells)


def test_ablation_axes_take_flags_lists_of_flags_and_full() -> None:
    cells = expand(grid({"ablation": ["full", "no_rs", ["no_rs", "no_spline"]]}))
    assert [c.spec.ablation.flags() for c in cells] == [(), ("no_rs",), ("no_rs", "no_spline")]
    assert [c.place["ablation"] for c in cells] == ["full", "no_rs", "no_rs+no_spline"]
    single = expand(grid({"ablation.no_rs": [False, True], "ablation.no_spline": [False, True]}))
    assert [c.spec.ablation.flags() for c in single] == [(), ("no_spline",), ("no_rs",), ("no_rs", "no_spline")]


def test_variants_lay_several_words() -> None:
    variants = [{"label": "ours"}, {"label": "bands", "T": "2K", "motion": "frame-spline"}]
    ours, bands = expand(grid({"variant": variants}))
    assert (ours.spec.T, ours.spec.motion) == ("scanline", "sequence-spline")
    assert (bands.spec.T, bands.spec.motion, bands.place) == ("2K", "frame-spline", {"variant": "bands"})


def test_excludes_leave_out_and_includes_add() -> None:
    axes = {"method": ["gauhuman", "rs-avatar"], "T": ["K", "2K"], "seed": [0, 1]}
    excludes = [{"method": "gauhuman", "T": "2K"}, {"seed": [1], "T": "K"}]
    includes = [{"method": "rs-avatar", "seed": 7, "iterations": 5}]
    cells = expand(grid(axes, excludes=excludes, includes=includes))
    assert [c.number for c in cells] == [0, 4, 6, 7, 8]
    assert (cells[-1].spec.seed, cells[-1].spec.iterations) == (7, 5)
    assert cells[-1].place == {"method": "rs-avatar", "seed": "7", "iterations": "5"}


def test_the_same_job_twice_is_one_cell() -> None:
    cells = expand(grid({"variant": [{"label": "a"}, {"label": "b", "seed": 0}, {"label": "c", "seed": 1}]}))
    assert [c.place["variant"] for c in cells] == ["a", "c"]


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"T": ["K", "3Q"]}, r"axes\.T: expected .*, got '3Q' in T=3Q \(T: expected an integer"),
        ({"seed": [0], "method": ["gauhuman", "nerf"]}, r"axes\.method: .* got 'nerf' in seed=0, method=nerf"),
        ({"ablation": ["no_hands"]}, r"axes\.ablation: .*'no_hands'"),
        ({"method": ["gauhuman"], "ablation": ["no_rs"]}, r"axes\.ablation: .* components that gauhuman has"),
        ({"seed": []}, r"axes\.seed: expected at least one value, got none"),
        ({"seed": [1, 1]}, r"axes\.seed: expected every value once, got '1' twice"),
        ({"sede": [1, 2]}, r"axes\.sede: expected a word of a job \(.*seed.*\), or tables with a label, got 1"),
        ({"a": [{"label": "x", "T": 3}], "T": [4]}, r"axes\.T: expected words that axis a does not set, got T"),
        ({"a": [{"label": "x", "colour": 3}]}, r"axes\.a: .*colour"),
    ],
)
def test_a_refusal_names_axis_and_value(axes: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        expand(grid(axes))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"excludes": [{"method": "gauhuman"}]}, r"excludes: expected names of axes \(seed\), got 'method'"),
        ({"excludes": [{"seed": 9}]}, r"excludes\.seed: expected one of 0, 1, got 9"),
        ({"excludes": [{"seed": [0, 1]}]}, "grid: expected at least one job"),
        ({"includes": [{"colour": 1}]}, r"includes\.colour: expected a value of an axis, or a word of a job, got 1"),
        ({"base": {"subject": "wave", "method": "rs-avatar", "P": 99}}, r"base: .*P: expected"),
        ({"bases": {}}, "bases: expected"),
        ({"name": "../x"}, "name: expected"),
    ],
)
def test_a_refusal_names_the_part(words: dict[str, Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        expand(parse_grid({"base": BASE, "axes": {"seed": [0, 1]}, **words}))


def test_grids_are_bounded_before_they_are_built() -> None:
    with pytest.raises(SpecError, match="grid: expected at most 10 jobs, got 11 or more"):
        expand(grid({"seed": list(range(11))}), limit=10)
    many = list(range(1000))
    with pytest.raises(SpecError, match="at most 100000 combinations, got 1000000"):
        expand(grid({"seed": many, "iterations": [n + 1 for n in many]}))


@given(
    st.integers(1, 4), st.integers(1, 3), st.integers(0, 2), st.lists(st.tuples(st.integers(0, 3), st.integers(0, 2)))
)
def test_a_number_finds_its_place_again(seeds: int, bands: int, more: int, left_out: list[tuple[int, int]]) -> None:
    axes = {"seed": list(range(seeds)), "T": list(range(1, bands + 1))}
    excludes = [{"seed": s, "T": t + 1} for s, t in left_out if s < seeds and t < bands]
    includes = [{"iterations": n + 1} for n in range(more)]
    request = grid(axes, excludes=excludes, includes=[{"iterations": 77}, *includes])
    for cell in expand(request):
        assert place_of(request, read_axes(request), cell.number) == cell.place
    assert place_of(request, read_axes(request), seeds * bands + more + 1) is None


def test_one_word_is_varied_or_fixed() -> None:
    request = vary(vary(read_grid("ablation"), "subject", ["a", "b"]), "preset", "draft")
    cells = expand(request)
    assert len(cells) == 18
    assert {c.spec.preset for c in cells} == {"draft"}
    assert {c.spec.subject for c in cells} == {"a", "b"}
    fixed = vary(vary(request, "subject", "a"), "ablation.no_spline", True)
    assert {c.spec.ablation.no_spline for c in expand(fixed)} == {True}


@pytest.mark.parametrize("name", grid_names())
@pytest.mark.parametrize("preset", ["smoke", "draft", "paper"])
def test_built_in_grids_are_valid_for_every_preset(name: str, preset: str) -> None:
    cells = expand(vary(read_grid(name), "preset", preset))
    assert read_grid(name).about
    assert len(cells) == len({c.spec.sha256() for c in cells}) > 1
    assert {c.spec.preset for c in cells} == {preset}


def test_the_ablation_grid_is_the_papers_table() -> None:
    cells = {c.place["variant"]: c.spec for c in expand(read_grid("ablation"))}
    flags = ["no_rs", "no_spline", "no_pose_deformation", "no_lbs_refinement", "no_reg"]
    assert list(cells) == ["full", *flags, "T=2K", "T=4K", "scanline"]
    assert [cells[flag].ablation.flags() for flag in flags] == [(flag,) for flag in flags]
    assert [cells[name].bands(11) for name in ("full", "T=2K", "T=4K", "scanline")] == [11, 22, 44, "scanline"]
    assert len({(s.P, s.lambda_reg, s.motion, s.iterations) for s in cells.values()}) == 1


def test_files_that_are_no_grids(tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text("axes = 3")
    with pytest.raises(SpecError, match="axes: expected"):
        read_grid_file(bad)
    bad.write_text("= 3")
    with pytest.raises(SpecError, match="expected a TOML file"):
        read_grid_file(bad)
    with pytest.raises(SpecError, match="grid: expected one of ablation, main"):
        read_grid("../main")
