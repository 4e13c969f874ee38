"""A study: the same job in several variants, on several subjects and seeds; one table. ``rsavatar bench NAME``.

A study says its variants and columns (``bench/ablation.py`` and its neighbours); this file runs them, several
processes at a time where asked, and writes the figures after each job, so that a study that was cut goes on. Results do
not depend on the number of processes: training does not depend on the number of threads.
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, ValidationError
from rich.console import Console

import rsavatar
from rsavatar import experiment
from rsavatar.bench.machine import Machine, describe
from rsavatar.data.studio import studio_subject_dir
from rsavatar.errors import DataError, RsAvatarError, SpecError, expected
from rsavatar.spec import JobSpec, resolve

EXPOSURE = 5.5  # source frames: half a period, the studio's "-exposed" variant
_STUDIO = re.compile(r"studio(?:-(\d+))?(-exposed)?$")


@dataclass(frozen=True)
class Variant:
    """A row of the table: what is changed, and what others report for it."""

    name: str
    words: Mapping[str, Any]
    group: str = ""  # rows of a group stand in one table; differences are to its first row
    reported: str = ""


@dataclass(frozen=True)
class Column:
    """A metric: its key in the results, its heading, its digits."""

    key: str
    heading: str
    digits: int = 2


@dataclass(frozen=True)
class Study:
    """What is varied and what is looked at."""

    name: str
    title: str
    about: str  # Markdown
    variants: tuple[Variant, ...]
    columns: tuple[Column, ...]
    reported: str = ""  # heading of the column of what others report; empty = there is none
    subjects: tuple[str, ...] = ("studio",)
    each: Column = Column("psnr", "PSNR")  # is shown for every subject, where there are several
    score: str = ""  # "module:function" (spec, folder, out) -> more metrics, called where the job was run


@dataclass(frozen=True)
class Request:
    """What to run a study on, and how."""

    subjects: tuple[str, ...] = ()  # folders, studio, studio-N, studio-N-exposed; empty = the study's own
    preset: str = "draft"
    seeds: int = 1
    jobs: int = 1
    json: Path | None = None


class Run(BaseModel):
    """One job of a study."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    variant: str
    subject: str
    seed: int
    spec_sha256: str
    values: dict[str, float | None] = field(default_factory=dict)
    error: str = ""


class StudyResult(BaseModel):
    """All jobs of a study that are done."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["study"] = "study"
    name: str
    command: str
    machine: Machine
    code: str  # sha256 of the package's sources: runs of other code are not gone on from
    preset: str
    iterations: int
    runs: list[Run]

    def of(self, variant: str, subject: str | None, key: str) -> list[float]:
        """Values of a metric, over the seeds of one subject or of all."""
        runs = [r for r in self.runs if r.variant == variant and subject in (None, r.subject)]
        return [v for r in runs if (v := r.values.get(key)) is not None]


@dataclass(frozen=True)
class Job:
    """One cell of a study, as it goes to another process."""

    study: str  # module
    variant: str
    subject: str
    seed: int
    preset: str
    threads: int

    def spec(self, study: Study) -> JobSpec:
        """The complete spec."""
        words = next(v.words for v in study.variants if v.name == self.variant)
        request = {"method": "rs-avatar", "preset": self.preset, "subject": place(self.subject)[0], "seed": self.seed}
        return resolve({**request, **words})


def place(subject: str) -> tuple[str, Path]:
    """Name and folder of what ``--subjects`` names; studio subjects are made on the spot.

    Raises:
        DataError: if it is neither a folder nor a studio subject.
    """
    if Path(subject).is_dir():
        return Path(subject).resolve().name, Path(subject).resolve()
    studio = _STUDIO.match(subject)
    if studio is None:
        raise DataError(expected("--subjects", "folders, studio, studio-N or studio-N-exposed", repr(subject)))
    return subject, studio_subject_dir(int(studio[1] or 0), EXPOSURE if studio[2] else 0.0)


def run_job(job: Job) -> Run:
    """Run one cell; a job that fails is a cell that says so."""
    os.environ["RSAVATAR_THREADS"] = str(job.threads)
    study: Study = import_module(job.study).STUDY
    spec = job.spec(study)
    run = Run(variant=job.variant, subject=spec.subject, seed=job.seed, spec_sha256=spec.sha256())
    folder = place(job.subject)[1]
    try:
        with tempfile.TemporaryDirectory() as out:
            result = experiment.run(spec, Path(out), folder)
            values = {**result.means, "gaussians": float(result.gaussians), "train_s": result.train_seconds}
            values["doubted"] = float(len(result.provenance["doubted_images"]))
            if study.score:
                module, _, name = study.score.partition(":")
                values |= getattr(import_module(module), name)(spec, folder, Path(out))
    except RsAvatarError as error:
        return run.model_copy(update={"error": f"{type(error).__name__}: {error}"})
    return run.model_copy(update={"values": values})


def main(module: str, request: Request) -> int:
    """Run the study of ``module``, print its table, write it as JSON and beside that as Markdown.

    Returns:
        0, or 1 where a job failed.
    """
    study: Study = import_module(module).STUDY
    console, machine = Console(), describe()
    jobs = _jobs(module, study, request)
    kept = _kept(request.json, study, jobs)
    left = [job for job in jobs if job not in kept]
    runs = dict(kept)
    console.print(f"{study.title}: {len(jobs)} jobs, {len(left)} to run, {request.jobs} at a time")
    for job, run in _run_all(left, request.jobs):
        runs[job] = run
        psnr = run.values.get("psnr")
        console.print(f"{run.subject} seed {run.seed} {run.variant}: {run.error or f'{psnr:.2f} dB'}", highlight=False)
        _write(study, request, machine, [runs[j] for j in jobs if j in runs])
    result = _write(study, request, machine, [runs[j] for j in jobs])
    console.print(page(study, result), markup=False, highlight=False)
    return int(any(run.error for run in runs.values()))


def _jobs(module: str, study: Study, request: Request) -> list[Job]:
    subjects = request.subjects or study.subjects
    names = [place(subject)[0] for subject in subjects]
    if len(set(names)) < len(names):
        raise SpecError(expected("--subjects", "different names", ", ".join(names)))
    cores = len(os.sched_getaffinity(0))
    threads = max(cores // request.jobs, 1)
    return [
        Job(module, variant.name, subject, seed, request.preset, threads)
        for subject in subjects
        for seed in range(request.seeds)
        for variant in study.variants
    ]


def _kept(path: Path | None, study: Study, jobs: Sequence[Job]) -> dict[Job, Run]:
    """Runs of an earlier, cut call: of the same code and specs, without error."""
    if path is None or not path.is_file():
        return {}
    try:
        before = StudyResult.model_validate_json(path.read_text())
    except ValidationError:
        return {}
    if before.code != code_sha256():
        return {}
    found = {(r.variant, r.subject, r.seed, r.spec_sha256): r for r in before.runs if not r.error}
    keys = {job: (job.variant, place(job.subject)[0], job.seed, job.spec(study).sha256()) for job in jobs}
    return {job: found[key] for job, key in keys.items() if key in found}


@cache
def code_sha256() -> str:
    """Of every file of the package that can change a figure."""
    digest, package = hashlib.sha256(), Path(rsavatar.__file__).parent
    for path in sorted([*package.rglob("*.py"), *package.rglob("*.so")]):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _run_all(jobs: Sequence[Job], processes: int) -> Iterator[tuple[Job, Run]]:
    """Jobs with their runs, as they end."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, max_tasks_per_child=1) as pool:
        waiting = {pool.submit(run_job, job): job for job in jobs}
        for future in as_completed(waiting):
            yield waiting[future], future.result()


def _write(study: Study, request: Request, machine: Machine, runs: list[Run]) -> StudyResult:
    preset = resolve({"method": "rs-avatar", "subject": "any", "preset": request.preset})
    result = StudyResult(
        name=study.name,
        command=command(study, request),
        machine=machine,
        code=code_sha256(),
        preset=request.preset,
        iterations=preset.iterations,
        runs=runs,
    )
    if request.json:
        request.json.parent.mkdir(parents=True, exist_ok=True)
        part = request.json.with_suffix(".part")
        part.write_text(result.model_dump_json(indent=1) + "\n")
        part.replace(request.json)
        request.json.with_suffix(".md").write_text(page(study, result))
    return result


def command(study: Study, request: Request) -> str:
    """The call that gives these figures again; folders by their names."""
    subjects = " ".join(("DIR/" + Path(s).name) if Path(s).is_dir() else s for s in request.subjects)
    words = ["rsavatar bench", study.name, f"--subjects {subjects}" if subjects else ""]
    words += [f"--preset {request.preset}", f"--seeds {request.seeds}"]
    return " ".join(word for word in words if word)


def page(study: Study, result: StudyResult) -> str:
    """The study as Markdown."""
    from rsavatar.bench.study_page import render

    return render(study, result)
