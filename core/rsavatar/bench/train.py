"""``rsavatar bench train``: held-out PSNR against the seconds of training, for each method at one budget.

Trains ``--preset`` on each of ``--subjects``, or on the built-in one. What a method prepares before its first step is
counted as training, with a cache that holds nothing; looking at the held-out views is not, and changes no number of it.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np
import torch
from pydantic import BaseModel, ConfigDict
from rich.console import Console

from rsavatar import __version__, catalog, kernels
from rsavatar.bench.machine import Machine, describe
from rsavatar.bench.study import place
from rsavatar.body.find import find_body
from rsavatar.checkpoint import Owner
from rsavatar.data.base import Subject
from rsavatar.data.catalogue import open_subject
from rsavatar.evaluate import render_view, unit
from rsavatar.events import Event, Progress, silent
from rsavatar.imaging import Actor
from rsavatar.methods.base import AbstractMethod, Case, build_actor, observations, settings
from rsavatar.metrics.image import dilate, psnr
from rsavatar.optimization import Saver
from rsavatar.spec import resolve
from rsavatar.train import fit

LOOK_SECONDS = 4.0  # of training between two looks
VIEWS_PER_CAMERA = 4  # at the middles of as many equal parts of the sequence


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TrainingCurve(_Record):
    """One method: what it had reached after so many seconds."""

    method: str
    seconds: list[float]
    steps: list[int]
    psnr_db: list[float]  # mean over the watched held-out views, in the dilated mask


class SubjectCurves(_Record):
    """All methods on one subject."""

    subject: str
    views: int
    curves: list[TrainingCurve]
    ahead_from_s: float | None  # seconds from which on rs-avatar is above the others


class TrainResult(_Record):
    """``rsavatar bench train``."""

    kind: Literal["train"] = "train"
    machine: Machine
    command: str
    preset: str
    subjects: list[SubjectCurves]


class Watch:
    """Follows one training run, which ``prepared`` for some seconds, and keeps its own time out of the account."""

    def __init__(self, actor: Actor, subject: Subject, prepared: float) -> None:
        self.actor, self.subject, self.prepared = actor, subject, prepared
        views = min(VIEWS_PER_CAMERA, subject.frames)
        frames = [subject.frames * (2 * i + 1) // (2 * views) for i in range(views)]
        self.views = [(camera, frame) for camera in subject.held_out for frame in frames]
        self.seconds: list[float] = []
        self.steps: list[int] = []
        self.psnr_db: list[float] = []
        self.looking = 0.0

    def __call__(self, event: Event) -> None:
        """Look now and then, and at the end."""
        if not isinstance(event, Progress):
            return
        trained = self.prepared + event.seconds - self.looking
        due = not self.seconds or trained - self.seconds[-1] >= LOOK_SECONDS or event.step == event.steps
        if due:
            begun = time.perf_counter()
            self.seconds.append(trained)
            self.steps.append(event.step)
            self.psnr_db.append(self.score())
            self.looking += time.perf_counter() - begun

    def score(self) -> float:
        """Mean PSNR of the watched views."""
        with torch.no_grad():
            weights = self.actor.skin_weights()
            values = []
            for camera, frame in self.views:
                image = render_view(self.actor, self.subject, camera, frame, weights, 1)
                truth, mask = self.subject.truth(camera, frame)
                if mask.any():
                    values.append(psnr(unit(image), unit(truth), dilate(mask > 0)))
        return float(np.mean(values))


def curve(name: str, subject: Subject, preset: str = "draft") -> TrainingCurve:
    """Train ``name`` on ``subject`` and watch it."""
    begun = time.perf_counter()
    spec = resolve({"method": name, "subject": subject.name, "preset": preset})
    method: AbstractMethod = catalog.load(catalog.METHODS, name)()
    case = Case(spec, subject, find_body(spec.body, subject)[0])
    with tempfile.TemporaryDirectory() as folder:
        with _empty_cache(Path(folder)):
            case = method.prepare(case, silent, lambda: False).case
        actor = build_actor(method, case)
        watch = Watch(actor, subject, time.perf_counter() - begun)
        owner = Owner(spec.sha256(), subject.fingerprint, case.body.sha256, __version__)
        saver = Saver(Path(folder) / "checkpoint.safetensors", owner)
        fit(actor, observations(method, case), settings(case), saver, watch, lambda: False)
    return TrainingCurve(method=name, seconds=watch.seconds, steps=watch.steps, psnr_db=watch.psnr_db)


@contextmanager
def _empty_cache(folder: Path) -> Iterator[None]:
    """Nothing is found in the cache; what is built goes to ``folder``."""
    before = os.environ.get("RSAVATAR_CACHE")
    os.environ["RSAVATAR_CACHE"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["RSAVATAR_CACHE"]
        else:
            os.environ["RSAVATAR_CACHE"] = before


def ahead_from(curves: Sequence[TrainingCurve], ours: str = "rs-avatar") -> float | None:
    """Seconds of training from which on ``ours`` is above every other learned method's curve; None if it never is.

    Curves are compared at all looks of all of them, linearly between looks; each holds its last value from its end on.
    """
    others = [c for c in curves if c.method not in (ours, "oracle")]
    mine = next(c for c in curves if c.method == ours)
    looks = sorted({t for c in (mine, *others) for t in c.seconds})
    best = np.max([np.interp(looks, c.seconds, c.psnr_db) for c in others], axis=0)
    behind = np.flatnonzero(np.interp(looks, mine.seconds, mine.psnr_db) <= best)
    if len(behind) == len(looks) or (len(behind) and behind[-1] == len(looks) - 1):
        return None
    return looks[int(behind[-1]) + 1] if len(behind) else looks[0]


def plot(subject: SubjectCurves, path: Path) -> None:
    """The curves of a subject, as PNG and SVG."""
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for line in subject.curves:
        axes.plot(line.seconds, line.psnr_db, label=line.method, marker=".", markersize=3)
    axes.set(xlabel="seconds of training", ylabel="held-out PSNR, dB", title=subject.subject)
    axes.set_xscale("log")
    axes.grid(alpha=0.3)
    axes.legend()
    for kind in (".png", ".svg"):
        figure.savefig(path.with_suffix(kind), dpi=150)
    plt.close(figure)


def page(result: TrainResult, stem: str = "train") -> str:
    """The end of every curve as Markdown, with what it was taken on, and the pictures, which are named by ``stem``."""
    machine = result.machine
    lines = [
        "# Training: held-out PSNR against seconds",
        "",
        f"Written by `{result.command}`, preset {result.preset}, seed 0; the JSON file beside it holds the curves."
        " Preparation counts, looking at the held-out views does not. Seconds are of the processor named here and"
        " grow when it is busy; who is above whom carries over.",
        "",
        f"Commit {machine.commit}; {machine.processor}, {machine.cores} cores, {machine.threads} kernel threads,"
        f" {machine.instructions}, load {machine.load:g} before.",
    ]
    for subject in result.subjects:
        lines += ["", f"## {subject.subject}", "", f"![{subject.subject}]({stem}-{subject.subject}.png)", ""]
        lines += ["| method | steps | seconds | PSNR at 10 s | PSNR at the end |", "|---|---:|---:|---:|---:|"]
        for c in subject.curves:
            early = "–" if c.seconds[0] > 10 else f"{np.interp(10.0, c.seconds, c.psnr_db):.2f}"  # –: it still prepares
            cells = (c.method, f"{c.steps[-1]}", f"{c.seconds[-1]:.0f}", early, f"{c.psnr_db[-1]:.2f}")
            lines.append("| " + " | ".join(cells) + " |")
        ahead = "never" if subject.ahead_from_s is None else f"from {subject.ahead_from_s:.0f} s on"
        lines += ["", f"rs-avatar is above the other learned methods {ahead}."]
    return "\n".join(lines) + "\n"


def main(json: Path | None, subjects: Sequence[str] = (), preset: str = "draft") -> int:
    """Train every method on every subject, print, and write ``json``, its page and its plots."""
    kernels.use_threads(len(os.sched_getaffinity(0)))
    torch.set_num_threads(1)
    places = [place(subject) for subject in subjects or ("studio",)]
    machine, console, done = describe(), Console(), []
    named = " ".join(["--subjects", *(name for name, _ in places)]) if subjects else ""
    words = ["rsavatar bench train", named, f"--preset {preset}", f"--json {json.name}" if json else ""]
    for name, folder in places:
        done.append(curves_of(open_subject(name, folder), console, preset))
        command = " ".join(filter(None, words))
        result = TrainResult(machine=machine, command=command, preset=preset, subjects=done)
        if json:
            json.parent.mkdir(parents=True, exist_ok=True)
            json.write_text(result.model_dump_json(indent=1) + "\n")
            json.with_suffix(".md").write_text(page(result, json.stem))
            plot(done[-1], json.with_name(f"{json.stem}-{name}"))
    console.print(page(result), markup=False, highlight=False)
    return 0


def curves_of(subject: Subject, console: Console, preset: str) -> SubjectCurves:
    """Every method that the subject allows, one after the other."""
    curves = []
    for name in catalog.METHODS:
        if name != "oracle" or subject.motion is not None:
            console.print(f"training {name} on {subject.name} ...")
            curves.append(curve(name, subject, preset))
    views = len(subject.held_out) * min(VIEWS_PER_CAMERA, subject.frames)
    return SubjectCurves(subject=subject.name, views=views, curves=curves, ahead_from_s=ahead_from(curves))
