"""``rsavatar bench skips``: what every skip saves, and what it changes, on each subject."""

from __future__ import annotations

import math
from pathlib import Path

import torch

from rsavatar import catalog, checkpoint
from rsavatar.bench.study import Column, Study, Variant
from rsavatar.body.find import find_body
from rsavatar.data.catalogue import open_subject
from rsavatar.imaging import expose
from rsavatar.methods.base import Case, build_actor, observations
from rsavatar.optimization import load_actor
from rsavatar.render.base import Rendering
from rsavatar.skipping import needed_nodes, thinned
from rsavatar.spec import SKIPS, JobSpec

LOOKS = 12  # images that the errors are taken over


def without(skip: str) -> dict[str, tuple[str, ...]]:
    """The words of a job that does not use ``skip``."""
    return {"skip": tuple(s for s in SKIPS if s != skip)}


STUDY = Study(
    name="skips",
    title="What is skipped, what that saves, and what it changes",
    about="""\
The first row uses every skip that is on by default; each row after it leaves one out, so its seconds less the first
row's are what that skip saves. `settled` is off by default. On the finished avatars' training images: *nodes, dB* is
the image with the pose nodes that it needs against the image with all of them (promised: 60; a dash: all are needed);
*pixels* is the share of the frame inside the body's box, beyond which nothing is drawn; *splats* the share of Gaussians
that survive culling, which changes nothing: an opacity under 1/255 is none in this model; *nodes* the mean number of
pose nodes, of 5.""",
    variants=(
        Variant("every skip", {}),
        Variant("whole frames, not the body's box", without("body")),
        Variant("all pose nodes", without("nodes")),
        Variant("linear harmonics from the start", without("harmonics")),
        Variant("skinning network every step", without("networks")),
        Variant("no skip at all", {"skip": ()}),
        Variant("settled images rest, too", {"skip": (*SKIPS, "settled")}),
    ),
    columns=(
        Column("train_s", "training, s", 1),
        Column("psnr", "PSNR ↑"),
        Column("nodes_db", "nodes, dB", 1),
        Column("pixels", "pixels", 2),
        Column("splats", "splats", 3),
        Column("nodes", "nodes", 2),
    ),
    score="rsavatar.bench.skips:score",
    each=Column("train_s", "s", 1),
)


def score(spec: JobSpec, folder: Path, out: Path) -> dict[str, float | None]:
    """Image errors of the skips that a single image shows, and the means of the counters."""
    subject = open_subject(spec.subject, folder)
    body, _ = find_body(spec.body, subject)
    case, method = Case(spec, subject, body), catalog.load(catalog.METHODS, spec.method)()
    actor = build_actor(method, case)
    load_actor(actor, checkpoint.read(out / "checkpoint.safetensors")[0])
    seen = observations(method, case)
    errors, shares = [], []
    with torch.no_grad():
        weights = actor.skin_weights()
        for one in seen[:: max(len(seen) // LOOKS, 1)]:
            whole = actor.scene(one.frame, one.camera, one.schedule, weights, spec.sh_degree)
            image, needed = expose(whole), needed_nodes(whole)
            if needed < one.schedule.coefficients:
                fewer = actor.scene(one.frame, one.camera, thinned(one.schedule, needed), weights, spec.sh_degree)
                errors.append(_error(expose(fewer), image))
            box = one.camera.height * one.camera.width / math.prod(one.full_size)
            shares.append((box, image.splats / (len(whole.rows) * whole.gaussians.count), float(needed)))
    pixels, splats, nodes = (sum(column) / len(shares) for column in zip(*shares, strict=True))
    return {"nodes_db": _decibels(errors), "pixels": pixels, "splats": splats, "nodes": nodes}


def _error(image: Rendering, truth: Rendering) -> float:
    """Mean squared error in the body."""
    inside = truth.transmittance < 0.5
    return float((image.rgb - truth.rgb)[:, inside].square().mean()) if bool(inside.any()) else 0.0


def _decibels(errors: list[float]) -> float | None:
    """Of the mean error; None where nothing was skipped."""
    return -10 * math.log10(max(sum(errors) / len(errors), 1e-12)) if errors else None
