"""Verbs of ``rsavatar data`` that make data: build-rs, build-zju, convert. The words here, the work below ``data``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rsavatar.errors import DataError, expected

if TYPE_CHECKING:
    from rsavatar.data.build import Settings

AddVerb = Callable[..., argparse.ArgumentParser]

BUILD = """\
SOURCE is a sharp multi-view sequence: our minimal folder (docs/data.md), ZJU-MoCap's (refined or original), or
EasyMocap's output. DIR becomes a rolling-shutter subject, with a benchmark card in BENCHMARK.md. A build that was
interrupted goes on where it stopped; one that is done is not done again.

examples:
  rsavatar data build-rs data/my_377 --out data/rs/377
  rsavatar data build-rs data/mine --out data/rs/mine --views 01,05,09:rest --K 7
  rsavatar data build-rs data/my_377 --out data/rs/377 --interpolator rife --weights flownet.pkl --e 4
"""
ZJU = """\
ROOT holds my_377, my_386, my_387, my_392, my_393 and my_394 (or CoreView_...). DIR gets a subject for each, and
RS-ZJU.md: 354 frames a view. `make paper-table ZJU=ROOT` builds them and runs the whole table on them.

example:
  rsavatar data build-zju data/zju_mocap_refine --out data/rs-zju
"""
CONVERT = """\
Writes our minimal folder (docs/data.md) from any layout that build-rs reads.

example:
  rsavatar data convert data/easymocap-output --views 01,03,05:07 --out data/mine
"""


STUDIO = """\
A painted person with a true motion before eight cameras, every row drawn at its own instant. Jobs on the subjects
"studio" and "studio-N" make them by themselves; this verb makes one to look at, or another one.

examples:
  rsavatar data studio data/studio
  rsavatar data studio data/boxer --seed 3 --size 512 --motion punch --clothes drawn --delta random
  rsavatar data studio data/whole --source           sharp frames as well, for build-rs data/whole/source
"""


def add_verbs(nouns: object, add: AddVerb) -> None:
    """Teach the parser this file's verbs; ``add`` is the command line's own way to."""
    one = add(nouns, "build-rs", "rsavatar.cli_data:build_rs", "make a rolling-shutter subject of footage", BUILD)
    one.add_argument("source", type=Path, metavar="SOURCE")
    one.add_argument("--views", default="", metavar="A,B:C,D", help="training : held-out cameras; rest = all others")
    every = add(nouns, "build-zju", "rsavatar.cli_data:build_zju", "make the paper's whole benchmark", ZJU)
    every.add_argument("source", type=Path, metavar="ROOT")
    every.add_argument("--only", default="", metavar="A,B", help="of the six subjects only these, such as 377,386")
    for parser in (one, every):
        _add_settings(parser)
    made = add(nouns, "studio", "rsavatar.cli_data:studio", "make a synthetic subject, without any download", STUDIO)
    _add_studio(made)
    other = add(nouns, "convert", "rsavatar.cli_data:convert", "make our minimal folder of footage", CONVERT)
    other.add_argument("source", type=Path, metavar="SOURCE")
    other.add_argument("--views", default="", metavar="A,B:C,D", help="training : held-out cameras; rest = all others")
    other.add_argument("--out", type=Path, required=True, metavar="DIR")


def _add_studio(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("directory", type=Path, metavar="OUT")
    parser.add_argument("--seed", type=int, default=0, help="build, cameras, tempo, motion and clothes (default: 0)")
    parser.add_argument("--size", type=int, help="height and width of the pictures, pixels (default: 160)")
    parser.add_argument("--frames", type=int, help="output frames (default: 14)")
    parser.add_argument("--gamma", type=float, help="readout as a part of the frame period; 0 = global shutter")
    parser.add_argument("--K", type=int, dest="period", help="source frames per output frame (default: 11)")
    parser.add_argument("--exposure", type=float, help="of every row, source frames (default: 0)")
    parser.add_argument(
        "--motion", help="wave, twist, march, punch or squat (default: one of the first three, by seed)"
    )
    parser.add_argument("--clothes", choices=["drawn"], help="of the seed's own (default: one of three sets, by seed)")
    parser.add_argument("--delta", choices=["0", "random"], dest="triggers", help="trigger offsets of the cameras")
    parser.add_argument("--source", action="store_true", help="write the sharp source frames of all cameras, too")


def _add_settings(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--K", type=int, default=11, help="source frames per output frame (default: 11)")
    parser.add_argument("--gamma", type=float, default=1.0, help="readout as a part of the frame period (default: 1)")
    parser.add_argument("--interpolator", default="flow", help="flow, rife, rife-v4, linear or copy (default: flow)")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="the authors' flownet.pkl, for rife and rife-v4")
    parser.add_argument("--e", default="auto", help="2^e instants a source frame; auto: a seam below half a pixel; "
                        "rows: every row at its own (default: auto)")  # fmt: skip
    parser.add_argument("--delta", default="0", help="trigger offsets: 0, random, or a JSON file {camera: frames}")
    parser.add_argument("--rows", choices=["undistorted", "raw"], default="undistorted",
                        help="which rows carry the time (default: undistorted)")  # fmt: skip
    parser.add_argument("--fit", choices=["mid", "rows"], default="mid", help="first fit: as at the mid frame, or "
                        "every joint as its own row saw it (default: mid)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="of random trigger offsets")
    parser.add_argument("--jobs", type=int, metavar="N", help="processes (default: one a core)")


def build_rs(arguments: argparse.Namespace) -> int:
    """``rsavatar data build-rs``: one subject; prints its folder."""
    from rsavatar.cli_progress import Display
    from rsavatar.data.build import build
    from rsavatar.data.footage_sources import open_footage
    from rsavatar.events import to_json
    from rsavatar.metrics.base import protocol

    settings = _settings(arguments)
    footage = open_footage(arguments.source, arguments.views)
    with Display() as display:
        built = build(
            footage, arguments.out, settings, protocol(), arguments.jobs, lambda event: display.show(to_json(event))
        )
    print(built)
    return 0


def build_zju(arguments: argparse.Namespace) -> int:
    """``rsavatar data build-zju``: all six subjects; prints their folders."""
    from rsavatar.cli_progress import Display
    from rsavatar.data.build_table import build_all, find_subjects
    from rsavatar.events import to_json
    from rsavatar.metrics.base import protocol

    settings = _settings(arguments)
    with Display() as display:
        built = build_all(
            find_subjects(arguments.source, [name for name in arguments.only.split(",") if name]),
            arguments.out,
            settings,
            protocol(),
            arguments.jobs,
            lambda event: display.show(to_json(event)),
        )
    for each in built:
        print(each.folder)
    return 0


def studio(arguments: argparse.Namespace) -> int:
    """``rsavatar data studio``: make a synthetic subject in a folder, and print the folder."""
    from rsavatar.cli_progress import Display
    from rsavatar.data.studio import Shoot, shoot
    from rsavatar.events import to_json

    names = ("seed", "size", "frames", "gamma", "period", "exposure", "motion", "clothes", "triggers", "source")
    chosen = {name: value for name in names if (value := getattr(arguments, name)) is not None}
    with Display() as display:
        made = shoot(arguments.directory, Shoot(**chosen), lambda event: display.show(to_json(event)))
    print(made)
    return 0


def convert(arguments: argparse.Namespace) -> int:
    """``rsavatar data convert``: our minimal folder; prints it."""
    from rsavatar.data.convert import convert as write
    from rsavatar.data.footage_sources import open_footage

    print(write(open_footage(arguments.source, arguments.views), arguments.out))
    return 0


def _settings(arguments: argparse.Namespace) -> Settings:
    from rsavatar.data.build import Settings
    from rsavatar.data.build_plan import Clock

    if arguments.jobs is not None and arguments.jobs < 1:
        raise DataError(expected("--jobs", "at least 1", arguments.jobs))
    return Settings(
        clock=Clock(arguments.K, arguments.gamma),
        interpolator=arguments.interpolator,
        weights=arguments.weights,
        recursion=_recursion(arguments.e),
        triggers=_triggers(arguments.delta),
        rows=arguments.rows,
        fit=arguments.fit,
        seed=arguments.seed,
    )


def _recursion(word: str) -> int | Literal["auto", "rows"]:
    words: dict[str, Literal["auto", "rows"]] = {"auto": "auto", "rows": "rows"}
    if word in words:
        return words[word]
    if not word.isdecimal():
        raise DataError(expected("--e", "auto, rows, or a number", repr(word)))
    return int(word)


def _triggers(word: str) -> str | dict[str, float]:
    if word in ("0", "random"):
        return word
    try:
        held: Any = json.loads(Path(word).read_text(encoding="utf-8"))
        return {str(name): float(value) for name, value in held.items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise DataError(expected("--delta", "0, random, or a JSON file {camera: frames}", error)) from error
