"""Studies: every variant is a valid job, a study runs, goes on where it was cut, and its page says what was found."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

from rsavatar import kernels
from rsavatar.bench import study as engine
from rsavatar.bench.machine import Machine
from rsavatar.bench.study import Column, Request, Run, Study, StudyResult, Variant, place
from rsavatar.bench.study_page import render
from rsavatar.bench.superres import truth_between
from rsavatar.bench.train import TrainingCurve, ahead_from, curve
from rsavatar.catalog import STUDIES
from rsavatar.data.catalogue import open_subject
from rsavatar.errors import DataError
from rsavatar.spec import Ablation, resolve
from tests.core.subject_files import write_rolling

MACHINE = Machine(
    commit="abc", processor="p", cores=2, threads=1, instructions="avx2", lanes=8, load=0.0, python="3", torch="2"
)
TINY = Study(
    name="tiny",
    title="Tiny",
    about="About.",
    variants=(
        Variant("first", {"iterations": 20}, reported="24.65"),
        Variant("second", {"iterations": 20, "method": "gauhuman"}),
    ),
    columns=(Column("psnr", "PSNR"),),
    reported="paper",
)


def study_of(name: str) -> Study:
    study: Study = import_module(STUDIES[name]).STUDY
    return study


@pytest.mark.parametrize("name", STUDIES)
def test_every_variant_is_a_job_of_its_own(name: str) -> None:
    study = study_of(name)
    assert study.name == name
    names = [variant.name for variant in study.variants]
    assert len(set(names)) == len(names)
    for variant in study.variants:
        resolve({"method": "rs-avatar", "preset": "draft", "subject": "s", **variant.words})


def test_the_ablation_study_has_every_flag_and_sweep_of_the_paper() -> None:
    words = [variant.words for variant in study_of("ablation").variants]
    flags = {flag for w in words for flag in w.get("ablation", {})}
    assert flags == set(Ablation.model_fields)
    assert {"K", "2K", "4K", "scanline"} <= {w.get("T") for w in words}
    assert any("P" in w for w in words)
    assert any("lambda" in w for w in words)


def result(*runs: tuple[str, str, int, float]) -> StudyResult:
    found = [Run(variant=v, subject=s, seed=k, spec_sha256="x", values={"psnr": p}) for v, s, k, p in runs]
    return StudyResult(name="tiny", command="c", machine=MACHINE, code="c", preset="draft", iterations=20, runs=found)


def test_the_page_has_means_paired_differences_and_what_others_report() -> None:
    runs = [("first", "a", 0, 20.0), ("first", "b", 0, 30.0), ("second", "a", 0, 19.0), ("second", "b", 0, 28.0)]
    lines = render(TINY, result(*runs)).splitlines()
    first, second = (next(line for line in lines if line.startswith(f"| {name}")) for name in ("first", "second"))
    assert first == "| first | 25.00 | – | 20.00 | 30.00 | 24.65 |"
    assert second == "| second | 23.50 | -1.50 ± 0.50 | 19.00 | 28.00 | – |"


def test_a_job_that_failed_is_on_the_page() -> None:
    broken = Run(variant="first", subject="a", seed=0, spec_sha256="x", error="DataError: no")
    page = render(TINY, result().model_copy(update={"runs": [broken]}))
    assert "- a, seed 0, first: DataError: no" in page


def test_subjects_are_folders_or_studios(tmp_path: Path) -> None:
    assert place(str(tmp_path)) == (tmp_path.name, tmp_path)
    with pytest.raises(DataError, match=r"--subjects: expected folders, studio.*got 'stadium'"):
        place("stadium")


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
def test_a_study_runs_and_goes_on_where_it_was_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("tiny_study")
    module.STUDY = TINY  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "tiny_study", module)
    monkeypatch.setattr(engine, "_run_all", lambda jobs, processes: ((job, engine.run_job(job)) for job in jobs))
    monkeypatch.setattr(engine, "describe", lambda: MACHINE)
    subject = write_rolling(tmp_path / "subject").root
    request = Request((str(subject),), "smoke", 1, 1, tmp_path / "out.json")
    assert engine.main("tiny_study", request) == 0
    done = StudyResult.model_validate_json((tmp_path / "out.json").read_text())
    assert [(r.variant, r.error) for r in done.runs] == [("first", ""), ("second", "")]
    assert (tmp_path / "out.md").read_text() == render(TINY, done)
    cut = done.model_copy(update={"runs": done.runs[:1]})
    (tmp_path / "out.json").write_text(cut.model_dump_json())
    monkeypatch.setattr(
        engine, "run_job", lambda job: done.runs[1] if job.variant == "second" else pytest.fail("rerun")
    )
    assert engine.main("tiny_study", request) == 0
    assert StudyResult.model_validate_json((tmp_path / "out.json").read_text()).runs == done.runs


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
def test_a_training_curve_ends_at_the_last_step(tmp_path: Path) -> None:
    subject = open_subject("subject", write_rolling(tmp_path / "subject").root)
    found = curve("rs-avatar", subject, "smoke")
    assert found.steps[-1] == resolve({"method": "rs-avatar", "preset": "smoke", "subject": "s"}).iterations
    assert found.seconds == sorted(found.seconds)
    assert found.psnr_db[-1] > found.psnr_db[0]


def test_who_is_ahead_from_when_on() -> None:
    def line(method: str, *psnr: float) -> TrainingCurve:
        return TrainingCurve(method=method, seconds=[1.0, 2.0, 3.0, 4.0], steps=[1, 2, 3, 4], psnr_db=list(psnr))

    ours, ceiling = line("rs-avatar", 10, 20, 23, 24), line("oracle", 30, 30, 30, 30)
    assert ahead_from([ours, ceiling, line("gauhuman", 9, 9, 9, 9)]) == 1.0
    assert ahead_from([ours, ceiling, line("gauhuman", 15, 21, 21, 21)]) == 3.0
    assert ahead_from([ours, ceiling, line("gauhuman", 9, 9, 9, 25)]) is None


def test_a_subject_without_source_frames_has_no_truth_between(tmp_path: Path) -> None:
    assert truth_between(open_subject("subject", write_rolling(tmp_path / "subject").root)) is None
