"""JobSpec: presets resolve, contradictions are refused by name, specs go round, the hash is of the result."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsavatar.catalog import DESCRIPTIONS, METHODS
from rsavatar.errors import SpecError
from rsavatar.spec import FLAGS_OF_METHOD, NOT_OF_RESULT, Ablation, JobSpec, presets_dir, read_preset, resolve

PRESETS = ("smoke", "draft", "paper")


def spec(**words: Any) -> JobSpec:
    return resolve({"method": "rs-avatar", "subject": "wave", **words})


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_resolves_for_every_method(preset: str, method: str) -> None:
    made = resolve({"preset": preset, "method": method, "subject": "wave"})
    assert (made.preset, made.method) == (preset, method)
    assert made.iterations == read_preset(preset)["iterations"]


def test_there_is_a_file_per_preset_that_names_itself() -> None:
    assert {p.stem for p in presets_dir().glob("*.toml")} == set(PRESETS)
    for path in presets_dir().glob("*.toml"):
        assert tomllib.loads(path.read_text())["preset"] == path.stem


def test_the_paper_preset_is_the_papers_text() -> None:
    """Section 4.3: P = 4 control points, T = K row bands, lambda = 1, 20k iterations."""
    paper = spec(preset="paper")
    assert (paper.P, paper.bands(11), paper.lambda_reg, paper.iterations) == (4, 11, 1.0, 20_000)
    assert paper.mask_weight == 0.0
    assert paper.continuity == "paper"


def test_every_method_is_described_and_has_its_flags() -> None:
    assert set(DESCRIPTIONS) == set(METHODS) == set(FLAGS_OF_METHOD)
    assert all(flags <= set(Ablation.model_fields) for flags in FLAGS_OF_METHOD.values())


@pytest.mark.parametrize(
    ("T", "bands"), [(None, 11), (1, 1), (22, 22), ("K", 11), ("2K", 22), ("16K", 176), ("scanline", "scanline")]
)
def test_bands_are_counted_in_source_frames(T: int | str | None, bands: int | str) -> None:
    made = JobSpec.model_validate({"method": "rs-avatar", "subject": "wave", "T": T})
    assert made.bands(11) == bands


def test_a_presets_scanline_is_not_laid_under_methods_that_select_no_rows() -> None:
    assert spec(preset="draft").T == "scanline"
    assert spec(preset="draft", method="mad-avatar").T is None
    assert spec(preset="draft", method="gauhuman").T is None


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ({"method": "gaussians"}, "method: expected one of rs-avatar, gauhuman, .*mad-avatar.*got 'gaussians'"),
        ({"preset": "quick"}, "preset: expected one of draft, paper, smoke, got 'quick'"),
        ({"iterations": 0}, "iterations: expected .* greater than or equal to 1, got 0"),
        ({"P": 1}, "P: expected .* greater than or equal to 2, got 1"),
        ({"T": 0}, "T: expected an integer from 1 to 8192, K, 2K to 99K, or scanline, got 0"),
        ({"T": "some"}, "T.*got 'some'"),
        ({"T": "1K"}, "T.*got '1K'"),
        ({"seed": -1}, "seed: expected .*got -1"),
        ({"lambda": -1.0}, "lambda: expected .*got -1.0"),
        ({"subject": "../etc"}, "subject: expected .*got '../etc'"),
        ({"subject": ""}, "subject: expected .*got ''"),
        ({"colour": "red"}, "colour: expected .*got 'red'"),
        ({"ablation": {"no_skin": True}}, "ablation.no_skin: expected .*got True"),
        (
            {"method": "gauhuman", "ablation": {"no_rs": True}},
            "ablation: expected components that gauhuman has.*got no_rs",
        ),
        ({"motion": "frame-spline", "knots": 2}, "knots: expected 1, or motion sequence-spline, got 2"),
        ({"method": "mad-avatar", "T": "scanline"}, "T: expected a finite number .*got 'scanline'"),
    ],
)
def test_a_contradiction_is_refused_with_name_expected_got(words: dict[str, Any], sentence: str) -> None:
    with pytest.raises(SpecError, match=sentence):
        spec(**words)


def test_all_mistakes_are_named_at_once() -> None:
    with pytest.raises(SpecError, match=r"iterations: .*; seed: "):
        spec(iterations=0, seed=-1)


def test_equal_words_in_another_order_are_the_same_job() -> None:
    assert spec(P=3, seed=1).sha256() == spec(seed=1, P=3).sha256()


def test_the_hash_ignores_how_a_job_runs_and_nothing_else() -> None:
    changes: dict[str, Any] = {
        "method": "gauhuman", "subject": "walk", "K": 7, "T": 5, "P": 3, "lambda": 2.0, "seed": 1, "iterations": 5,
        "preset": "smoke", "body": "anny", "motion": "frame-spline",
        "regime": "authors", "continuity": "paper", "perturbation": "positive", "sh_degree": 0,
        "mask_weight": 0.25, "densify": False, "checkpoint_every": 7, "ablation": {"no_rs": True},
        "calibrate": ["readout"], "exposure_samples": 2, "doubt": True, "disturb": {"masks": 0.1},
        "exposure_frames": 0.0, "ssim_weight": 0.2, "residual": "additive", "knots": 2, "skip": ["body"],
        "blur_triggers": True,
    }  # fmt: skip
    names = {field.alias or name for name, field in JobSpec.model_fields.items()}
    assert set(changes) == names - NOT_OF_RESULT  # a new word must be given a change here
    base = {"method": "rs-avatar", "subject": "wave"}
    original = JobSpec.model_validate(base).sha256()
    apart = {"priority": 9, "memory_limit_mb": 4000, "stall_seconds": 60.0}
    assert set(apart) == NOT_OF_RESULT
    assert JobSpec.model_validate({**base, **apart}).sha256() == original
    needs = {"blur_triggers": {"method": "mad-avatar"}}
    hashes = {
        name: JobSpec.model_validate({**base, name: value, **needs.get(name, {})}).sha256()
        for name, value in changes.items()
    }
    assert original not in hashes.values()
    assert len(set(hashes.values())) == len(hashes)


def test_a_spec_is_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        spec().seed = 3


def flags_of(method: str) -> st.SearchStrategy[dict[str, bool]]:
    return st.fixed_dictionaries({}, optional=dict.fromkeys(sorted(FLAGS_OF_METHOD[method]), st.booleans()))


@st.composite
def requests(draw: st.DrawFn) -> dict[str, Any]:
    method = draw(st.sampled_from(sorted(METHODS)))
    bands = [st.integers(1, 8192), st.sampled_from(["K", "2K", "4K"])]
    words = {
        "preset": st.sampled_from(PRESETS),
        "K": st.integers(1, 1000),
        "T": st.one_of(*bands, *([st.just("scanline")] if method == "rs-avatar" else [])),
        "P": st.integers(2, 8),
        "lambda": st.floats(0, 1e4),
        "iterations": st.integers(1, 1_000_000),
        "seed": st.integers(0, 2**31 - 1),
        "priority": st.integers(-10, 10),
        "ablation": flags_of(method),
    }
    optional = draw(st.fixed_dictionaries({}, optional=words))
    subject = draw(st.from_regex(r"\A[A-Za-z0-9][A-Za-z0-9._-]{0,20}\Z"))
    return {"method": method, "subject": subject, **optional}


@given(requests())
def test_what_was_asked_for_is_in_the_spec(request: dict[str, Any]) -> None:
    made = resolve(request).model_dump(mode="json", by_alias=True)
    for name, value in request.items():
        if name == "ablation":
            assert {flag: made["ablation"][flag] for flag in value} == value
        else:
            assert made[name] == value


@pytest.mark.parametrize("by_alias", [True, False])
@given(request=requests())
def test_a_spec_goes_round_through_json(request: dict[str, Any], by_alias: bool) -> None:
    made = resolve(request)
    stored = json.loads(json.dumps(made.model_dump(mode="json", by_alias=by_alias)))
    again = JobSpec.model_validate(stored)
    assert again == made
    assert again.sha256() == made.sha256()
    assert not by_alias or resolve(stored) == made


def test_the_schema_can_be_served() -> None:
    schema = JobSpec.model_json_schema()
    assert set(schema["required"]) == {"method", "subject"}
    assert all("description" in value or "$ref" in value for value in schema["properties"].values())


def test_presets_are_found_beside_the_package() -> None:
    assert isinstance(presets_dir(), Path)
    with pytest.raises(SpecError, match="preset: expected one of"):
        read_preset("../draft")
