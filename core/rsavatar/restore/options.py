"""The words of `rsavatar restore train`; knows no torch until the recipe is asked for."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rsavatar.restore.train import Recipe, Start


def add_training(parser: argparse.ArgumentParser) -> None:
    """The recipe's options, and where it starts and ends."""
    parser.add_argument("--model", required=True, choices=["cvr", "jamnet"])
    parser.add_argument(
        "--out", required=True, type=Path, metavar="FILE", help="weights, .safetensors; FILE.json is the recipe"
    )
    parser.add_argument("--width", type=float, default=1.0, help="part of the published channels (default: 1)")
    parser.add_argument("--star", action="store_true", help="CVR*: without the network that corrects flow and scale")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop here if the steps are not done")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--columns", type=int, default=192, help="width of the crops, a multiple of 64")
    parser.add_argument("--shrink", type=int, default=1, help="times smaller than the pairs are: fast first steps")
    parser.add_argument("--rate", type=float, default=1e-4, help="learning rate (default: the authors' 1e-4)")
    parser.add_argument("--instants", type=int, default=3, help="CVR: instants in a step (default: 3)")
    parser.add_argument("--warmup", type=float, default=0.25, help="CVR from nothing: part that teaches its flow alone")
    parser.add_argument("--slow", type=float, default=0.1, help="CVR with --init: rate of its flow and scale networks")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--held-out", type=int, default=8, help="takes to validate on (default: 8)")
    parser.add_argument("--every", type=int, default=500, help="steps between looks at these")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--init", type=Path, metavar="FILE", help="start from these weights of ours")
    parser.add_argument("--vgg", type=Path, metavar="FILE", help="VGG19 weights: adds the perceptual terms")


def recipe_of(arguments: argparse.Namespace, data: str) -> tuple[Recipe, Start]:
    """What ``add_training`` read.

    Raises:
        DataError: if a value is out of range.
    """
    from dataclasses import fields

    from rsavatar.restore.train import Recipe, Start

    named = {f.name: getattr(arguments, f.name) for f in fields(Recipe) if f.name != "data"}
    return Recipe(**named, data=data), Start(arguments.device, arguments.init, arguments.vgg)
