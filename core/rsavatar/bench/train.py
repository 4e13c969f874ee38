"""``rsavatar bench train``: held-out PSNR against the seconds of training, for each method at one budget.

Trains the draft preset on the subject in RSAVATAR_BENCH_SUBJECT (a folder), or on the built-in one. Looking at the
held-out views is not counted as training, and changes no number of it.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Literal

import matplotlib.pyplot as plt
import numpy as np
import torch
from pydantic import BaseModel, ConfigDict
from rich.console import Console
from rich.table import Table

from rsavatar import __version__, catalog, kernels
from rsavatar.bench.machine import Machine, describe
from rsavatar.body.find import find_body
from rsavatar.checkpoint import Owner
from rsavatar.data.base import Subject
from rsavatar.data.catalogue import open_subject
from rsavatar.evaluate import render_view, unit
from rsavatar.events import Event, Progress
from rsavatar.imaging import Actor
from rsavatar.methods.base import AbstractMethod, Case, build_actor, observations, settings
from rsavatar.metrics.image import dilate, psnr
from rsavatar.optimization import Saver
from rsavatar.spec import resolve
from rsavatar.train import fit

METHODS = ("gauhuman", "mad-avatar", "rs-avatar", "oracle")
LOOK_SECONDS = 4.0  # of training between two looks
VIEWS_PER_CAMERA = 3


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TrainingCurve(_Record):
    """One method: what it had reached after so many seconds."""

    method: str
    seconds: list[float]
    steps: list[int]
    psnr_db: list[float]  # mean over the watched held-out views, in the dilated mask


class TrainResult(_Record):
    """``rsavatar bench train``."""

    kind: Literal["train"] = "train"
    machine: Machine
    command: str
    subject: str
    views: int
    curves: list[TrainingCurve]


class Watch:
    """Follows one training run and keeps its own time out of the account."""

    def __init__(self, actor: Actor, subject: Subject) -> None:
        self.actor, self.subject = actor, subject
        frames = np.linspace(0, subject.frames - 1, min(VIEWS_PER_CAMERA, subject.frames)).round().astype(int)
        self.views = [(camera, int(frame)) for camera in subject.held_out for frame in sorted(set(frames.tolist()))]
        self.seconds: list[float] = []
        self.steps: list[int] = []
        self.psnr_db: list[float] = []
        self.looking = 0.0

    def __call__(self, event: Event) -> None:
        """Look now and then, and at the end."""
        if not isinstance(event, Progress):
            return
        trained = event.seconds - self.looking
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


def curve(name: str, subject: Subject) -> TrainingCurve:
    """Train ``name`` on ``subject`` and watch it."""
    spec = resolve({"method": name, "subject": subject.name, "preset": "draft"})
    case = Case(spec, subject, find_body(spec.body, subject)[0])
    method: AbstractMethod = catalog.load(catalog.METHODS, name)()
    actor = build_actor(method, case)
    watch = Watch(actor, subject)
    with tempfile.TemporaryDirectory() as folder:
        owner = Owner(spec.sha256(), subject.fingerprint, case.body.sha256, __version__)
        saver = Saver(Path(folder) / "checkpoint.safetensors", owner)
        fit(actor, observations(method, case), settings(case), saver, watch, lambda: False)
    return TrainingCurve(method=name, seconds=watch.seconds, steps=watch.steps, psnr_db=watch.psnr_db)


def plot(result: TrainResult, path: Path) -> None:
    """The curves, as PNG and SVG."""
    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for line in result.curves:
        axes.plot(line.seconds, line.psnr_db, label=line.method, marker=".", markersize=3)
    axes.set(xlabel="seconds of training", ylabel="held-out PSNR, dB", title=f"{result.subject}, draft preset")
    axes.set_xscale("log")
    axes.grid(alpha=0.3)
    axes.legend()
    for kind in (".png", ".svg"):
        figure.savefig(path.with_suffix(kind), dpi=150)
    plt.close(figure)


def main(json: Path | None) -> int:
    """Train, print, and write ``json`` and its plot."""
    kernels.keep_memory()
    kernels.use_threads(len(os.sched_getaffinity(0)))
    torch.set_num_threads(1)
    folder = os.environ.get("RSAVATAR_BENCH_SUBJECT")
    subject = open_subject(Path(folder).name, Path(folder)) if folder else open_subject("studio", None)
    methods = [m for m in METHODS if m != "oracle" or subject.motion is not None]
    machine, console = describe(), Console()
    curves = []
    for name in methods:
        console.print(f"training {name} on {subject.name} ...")
        curves.append(curve(name, subject))
    views = len(subject.held_out) * min(VIEWS_PER_CAMERA, subject.frames)
    command = "rsavatar bench train" + (f" --json {json}" if json else "")
    result = TrainResult(machine=machine, command=command, subject=subject.name, views=views, curves=curves)
    table = Table("method", "steps", "seconds", "PSNR, dB", title=f"{subject.name}, {views} held-out views")
    for line in result.curves:
        table.add_row(line.method, str(line.steps[-1]), f"{line.seconds[-1]:.0f}", f"{line.psnr_db[-1]:.2f}")
    console.print(table)
    if json:
        json.parent.mkdir(parents=True, exist_ok=True)
        json.write_text(result.model_dump_json(indent=1) + "\n")
        plot(result, json)
    return 0
