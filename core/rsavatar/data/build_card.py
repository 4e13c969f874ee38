"""The benchmark card: what was built from what, in numbers for programs and in words for people."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

CARD, READABLE = "benchmark.json", "BENCHMARK.md"

_ROWS = {
    "undistorted": "Pictures were undistorted first: the rows of an ideal pinhole camera carry the time, as the model "
    "assumes. A real sensor reads distorted rows.",
    "raw": "The rows of the pictures as the sensor read them, distorted, carry the time; the loader undistorts "
    "afterwards, so the model's clock, which follows undistorted rows, is off by the rows that the lens moves.",
}


def write_card(root: Path, card: Mapping[str, Any]) -> None:
    """Writes ``benchmark.json`` and ``BENCHMARK.md`` into ``root``; ``card`` is what ``build.card_of`` collects."""
    (root / CARD).write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
    (root / READABLE).write_text(readable(card), encoding="utf-8")


def readable(card: Mapping[str, Any]) -> str:
    """The card as Markdown."""
    source, motion, cameras, truth = (card[part] for part in ("source", "motion", "cameras", "ground_truth"))
    window = f"[mid - {card['readout'] / 2:g}, mid + {card['readout'] / 2:g}]"
    facts = {
        "source": f"{source['name']} ({source['layout']}), {source['frames']} sharp frames a view",
        "output": f"{card['frames']} frames a view; the first group of K is dropped",
        "shutter": f"K = {card['K']}, gamma = {card['gamma']:g}: the window of a frame is {window} source frames",
        "trigger offsets": _offsets(card["triggers"]),
        "largest motion D": f"{motion['D']:.1f} px in one window (camera {motion['camera']}, frame {motion['frame']}), "
        "longest path on the body by dense optical flow over all views",
        "sub-frame instants": f"e = {card['e']}: {card['instants']} a frame, a seam of {card['seam_px']:.2f} px"
        if card["e"] != "rows"
        else "every row at its own: no seam",
        "interpolator": card["interpolator"],
        "ground truth": f"{truth['real']} real sharp frames at the mid row"
        + (f", {truth['interpolated']} interpolated at a trigger offset" if truth["interpolated"] else ""),
        "training cameras": ", ".join(cameras["train"]),
        "held-out cameras": f"{', '.join(cameras['test']) or 'none'} ({len(cameras['test'])})",
        "excluded cameras": ", ".join(cameras["excluded"]) or "none",
        "first fit": card["fit"],
    }
    lines = [f"# {card['name']}: a rolling-shutter benchmark", "", "| | |", "|---|---|"]
    lines += [f"| {name} | {value} |" for name, value in facts.items()]
    lines += ["", "## Which rows carry the time", "", f"t(v) = {card['row_time']}. {_ROWS[card['rows']]}"]
    if card["lens_shift_rows"]:
        shift = card["lens_shift_rows"]
        lines[-1] += (
            f" The lens moves a pixel by at most {shift:.1f} rows, {card['lens_shift_frames']:.2f} source frames."
        )
    lines += ["", "## How results are scored", ""]
    lines += [f"- {name}: {value}" for name, value in card["protocol"].items()]
    if card["source"]["licence"]:
        lines += ["", "## Licence of the source", "", card["source"]["licence"]]
    return "\n".join([*lines, "", f"Built from content {card['key']}.", ""])


def _offsets(triggers: Mapping[str, float]) -> str:
    if not any(triggers.values()):
        return "none"
    return ", ".join(f"{name}: {value:+.3g}" for name, value in triggers.items()) + " source frames"
