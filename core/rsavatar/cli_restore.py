"""Verbs of ``rsavatar restore``: train the correction networks, pack pairs for another machine, score weights."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rsavatar.errors import DataError, expected
from rsavatar.restore.options import add_training, recipe_of

if TYPE_CHECKING:
    from rsavatar.events import Report
    from rsavatar.restore.pairs import Take

AddVerb = Callable[..., argparse.ArgumentParser]
STUDIO = "studio-seeds"

TRAIN = """\
DATA is studio-seeds (pairs are drawn for --seeds), a subject's folder whose training cameras have sharp frames, or a
pack of `rsavatar restore pack`. Widths below 1 are for machines without a GPU: 0.25 trains in minutes on two cores.
Ctrl-C stops at the next step; the same command goes on. FILE.json keeps the recipe and the curve.

examples:
  rsavatar restore train --model jamnet --width 0.25 --steps 2000 --out weights/jamnet/ours.safetensors
  rsavatar restore train --model cvr --data data/rs-377 --device cuda --out weights/cvr/ours.safetensors

RSAVATAR_WEIGHTS_DIR=weights makes the methods jamnet+gauhuman and cvr+gauhuman use them.
"""
PACK = """\
One file that a machine with a GPU and little else can train from: python -m rsavatar.restore PACK --model ... --out ...

example:
  rsavatar restore pack pairs.npz --seeds 100-127 --size 256
"""
SCORE = """\
The gain of the corrected training views over the rolling ones, in the body and over the frame: choose checkpoints by
it. WEIGHTS is a file or a folder of the authors' or of ours; without it, what the methods would use.

examples:
  rsavatar restore score --model flow data/wave
  rsavatar restore score --model jamnet --weights weights/fastec data/wave
"""


def add_verbs(verbs: argparse._SubParsersAction[argparse.ArgumentParser], add: AddVerb) -> None:
    """Make ``train``, ``pack`` and ``score`` known."""
    train = add(verbs, "train", "rsavatar.cli_restore:train_network", "train CVR or JAMNet on pairs", TRAIN)
    train.add_argument("--data", default=STUDIO, metavar="DATA", help=f"(default: {STUDIO})")
    add_training(train)
    pack = add(verbs, "pack", "rsavatar.cli_restore:pack_pairs", "draw studio pairs into one file", PACK)
    pack.add_argument("out", type=Path, metavar="OUT")
    for parser in (train, pack):
        parser.add_argument("--seeds", default="100-107", metavar="A-B", help="studio seeds (default: 100-107)")
        parser.add_argument("--size", type=int, default=256, help="pixels a side of studio pairs (default: 256)")
    score = add(verbs, "score", "rsavatar.cli_restore:score", "what a corrector gains on a subject", SCORE)
    score.add_argument("directory", type=Path, metavar="DIR")
    score.add_argument("--model", required=True, choices=["flow", "cvr", "jamnet"])
    score.add_argument("--weights", type=Path, metavar="WEIGHTS")


def train_network(arguments: argparse.Namespace) -> int:
    """``rsavatar restore train``."""
    from rsavatar.cli_local import stop_on_signal
    from rsavatar.cli_progress import Display
    from rsavatar.events import to_json
    from rsavatar.restore.train import Trainer

    with stop_on_signal() as stop, Display() as display:

        def report(event: object) -> None:
            display.show(to_json(event))  # type: ignore[arg-type] # an Event: the channel of all jobs

        takes, data = _pairs(arguments, report)
        recipe, start = recipe_of(arguments, data)
        made = Trainer(recipe, takes, arguments.out, start).run(report, stop.is_set)
    print(made)
    return 0


def pack_pairs(arguments: argparse.Namespace) -> int:
    """``rsavatar restore pack``."""
    from rsavatar.cli_progress import Display
    from rsavatar.data.pairs import StudioPairs, studio_takes
    from rsavatar.events import to_json
    from rsavatar.restore.pairs import write_pack

    with Display() as display:
        wanted = StudioPairs(_seeds(arguments.seeds), arguments.size)
        write_pack(arguments.out, studio_takes(wanted, lambda event: display.show(to_json(event))))
    print(arguments.out)
    return 0


def score(arguments: argparse.Namespace) -> int:
    """``rsavatar restore score``."""
    from rsavatar.cli_progress import Display
    from rsavatar.data.catalogue import open_subject
    from rsavatar.events import to_json
    from rsavatar.methods.two_stage import measure_gain, restored_subject
    from rsavatar.restore.classical import FlowCorrector
    from rsavatar.restore.networks import network_corrector

    corrector = FlowCorrector() if arguments.model == "flow" else network_corrector(arguments.model, arguments.weights)
    subject = open_subject(arguments.directory.resolve().name, arguments.directory)
    with Display() as display:
        better = restored_subject(subject, corrector, lambda event: display.show(to_json(event)))
    gain = measure_gain(subject, better)
    if gain is None:
        raise DataError(expected(f"subject {subject.name}", "sharp frames of its training cameras", "none"))
    print(f"{corrector.identity}\nbody {gain.body_db:+.2f} dB, frame {gain.full_db:+.2f} dB")
    return 0


def _pairs(arguments: argparse.Namespace, report: Report) -> tuple[list[Take], str]:
    """The pairs that ``--data`` names, and the words for them."""
    from rsavatar.data.catalogue import open_subject
    from rsavatar.data.pairs import StudioPairs, studio_takes, subject_takes
    from rsavatar.restore.pairs import read_pack

    if arguments.data == STUDIO:
        wanted = StudioPairs(_seeds(arguments.seeds), arguments.size)
        return studio_takes(wanted, report), f"studio seeds {arguments.seeds}, {arguments.size} px"
    path = Path(arguments.data)
    if path.is_file():
        return read_pack(path), path.stem
    subject = open_subject(path.resolve().name, path)
    return subject_takes(subject), f"subject {subject.name}"


def _seeds(text: str) -> tuple[int, ...]:
    low, dash, high = text.partition("-")
    ends = (low, high if dash else low)
    if not all(end.isdecimal() for end in ends) or int(ends[1]) < int(ends[0]):
        raise DataError(expected("seeds", "a number, or A-B with A <= B", repr(text)))
    return tuple(range(int(ends[0]), int(ends[1]) + 1))
