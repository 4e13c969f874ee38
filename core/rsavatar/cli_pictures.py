"""Verbs that give pictures and files: figure and export. The ending of the file's name says what it is to be."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rsavatar.client import Client
from rsavatar.errors import SpecError, expected
from rsavatar.spec import JobSpec

FIGURES = ("png", "svg", "pdf", "json")
IMAGES, VIDEOS = ("png", "webp"), ("mp4", "webm", "gif")
CHOICES = ("preset", "subject", "camera", "frame")
LOOKS = ("camera", "time", "shutter", "readout", "azimuth", "elevation", "size")


def figure(arguments: argparse.Namespace) -> int:
    """``rsavatar figure``: a figure of the service's results, into a file."""
    fmt = ending(arguments.out, FIGURES)
    with Client(arguments.url) as client:
        arguments.out.write_bytes(client.figure(arguments.name, fmt, **named(arguments, CHOICES)))
    print(arguments.out)
    return 0


def export(arguments: argparse.Namespace) -> int:
    """``rsavatar export``: Gaussians, a view or a turntable of a job, or of a folder that ``rsavatar run`` wrote."""
    fmt = ending(arguments.out, ("ply", *IMAGES, *VIDEOS))
    look = named(arguments, LOOKS)
    run = Path(arguments.source)
    if run.is_dir():
        data = export_run(run, arguments.subject_dir, fmt, look)
    else:
        with Client(arguments.url) as client:
            if fmt in IMAGES:
                data = client.view(arguments.source, format=fmt, **look)
            else:
                kind = {} if fmt == "ply" else {"format": fmt}
                data = client.export(arguments.source, "ply" if fmt == "ply" else "turntable", **kind, **look)
    arguments.out.write_bytes(data)
    print(arguments.out)
    return 0


def ending(path: Path, known: tuple[str, ...]) -> str:
    """What a file's name says that it is.

    Raises:
        SpecError: if it is none of ``known``.
    """
    fmt = path.suffix[1:].lower()
    if fmt not in known:
        raise SpecError(expected("--out", f"a name that ends in .{', .'.join(known)}", repr(path.name)))
    return fmt


def named(arguments: argparse.Namespace, names: tuple[str, ...]) -> dict[str, Any]:
    """The options that were given."""
    return {name: value for name in names if (value := getattr(arguments, name)) is not None}


def export_run(run: Path, subject_dir: Path | None, fmt: str, look: Mapping[str, Any]) -> bytes:
    """A file of a run on this machine.

    Raises:
        SpecError: if the folder holds no run, or ``look`` asks for what there is not.
        DataError, BodyError, CheckpointError: if the subject, the body or the checkpoint cannot be used.
    """
    from rsavatar.export.ply import canonical_cloud, posed_cloud, write_ply
    from rsavatar.export.replay import Source, open_replay
    from rsavatar.export.turntable import Turntable, write_turntable
    from rsavatar.export.views import View, encode, render_view

    try:
        spec = JobSpec.model_validate(json.loads((run / "metrics.json").read_text("utf-8"))["spec"])
    except (OSError, ValueError, KeyError) as error:
        raise SpecError(expected(str(run), "a folder that `rsavatar run` has finished", error)) from None
    replay = open_replay(Source(spec, run / "checkpoint.safetensors", subject_dir))
    if fmt == "ply":
        time = look.get("time")
        return write_ply(canonical_cloud(replay) if time is None else posed_cloud(replay, time))
    if fmt in VIDEOS:
        return write_turntable(replay, Turntable(View(background="white", **look)), fmt)
    return encode(render_view(replay, View(**look)), "png" if fmt == "png" else "webp")
