"""``python -m rsavatar.restore PACK.npz --model jamnet --out FILE``: `rsavatar restore train` on a pack of pairs.

For machines with a GPU and little else: it needs torch, numpy, OpenCV and safetensors only.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rsavatar.events import Event, Note, Progress
from rsavatar.restore.options import add_training, recipe_of


def main() -> None:
    """Train, printing a line at every look at the held-out pairs."""
    from rsavatar.restore.pairs import read_pack
    from rsavatar.restore.train import Trainer

    parser = argparse.ArgumentParser("python -m rsavatar.restore", description=__doc__)
    parser.add_argument("pack", type=Path)
    add_training(parser)
    arguments = parser.parse_args()
    recipe, start = recipe_of(arguments, arguments.pack.stem)
    print(Trainer(recipe, read_pack(arguments.pack), arguments.out, start).run(_say))


def _say(event: Event) -> None:
    if isinstance(event, Note):
        print(event.text, flush=True)
    elif isinstance(event, Progress):
        psnr = "" if event.psnr is None else f"  body {event.psnr:.2f} dB"
        print(f"step {event.step}/{event.steps}  {event.seconds:.0f} s  loss {event.loss:.4f}{psnr}", flush=True)


if __name__ == "__main__":
    main()
