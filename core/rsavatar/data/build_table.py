"""The paper's whole benchmark: the six subjects of ZJU-MoCap as rolling-shutter subjects, and a card over all."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsavatar.data.build import Settings, build
from rsavatar.data.build_card import CARD
from rsavatar.data.footage_sources import open_footage
from rsavatar.errors import DataError, expected
from rsavatar.events import Note, Report, silent

SUBJECTS = {"377": 55, "386": 57, "387": 58, "392": 49, "393": 58, "394": 77}  # output frames a view at K = 11
_FOLDERS = ("my_{}", "CoreView_{}", "zju-{}", "{}")  # refined, original, ours
SUMMARY = "RS-ZJU.md"


@dataclass(frozen=True)
class Built:
    """One subject of the benchmark."""

    name: str  # also the folder's
    folder: Path
    card: Mapping[str, Any]


def find_subjects(root: Path, only: Sequence[str] = ()) -> dict[str, Path]:
    """The folders of all six subjects under ``root``, or of some of them.

    Raises:
        DataError: naming those that are not there.
    """
    unknown = [number for number in only if number not in SUBJECTS]
    if unknown:
        raise DataError(expected("subjects", f"some of {', '.join(SUBJECTS)}", ", ".join(unknown)))
    found = {
        number: folder
        for number in SUBJECTS
        for folder in (root / pattern.format(number) for pattern in reversed(_FOLDERS))
        if folder.is_dir()
    }
    wanted_ones = [number for number in SUBJECTS if number in only or not only]
    missing = [number for number in wanted_ones if number not in found]
    if missing:
        wanted = "folders my_377 .. my_394 (refined) or CoreView_377 .. (original) of the paper's six subjects"
        raise DataError(expected(f"{root} subjects", wanted, f"none for {', '.join(missing)}"))
    return {number: found[number] for number in wanted_ones}


def build_all(
    folders: Mapping[str, Path],
    out: Path,
    settings: Settings,
    protocol: Mapping[str, object],
    jobs: int | None = None,
    report: Report = silent,
) -> list[Built]:
    """Builds ``out/zju-<number>`` of every subject, and ``out/RS-ZJU.md``; what is built already is kept.

    ``folders`` are those of ``find_subjects``; the other arguments are those of ``build.build``.

    Raises:
        DataError: see there, and where a subject is missing.
    """
    footages = {number: open_footage(folder) for number, folder in folders.items()}  # every mistake before any work
    built = []
    for number, footage in footages.items():
        folder = build(footage, out / f"zju-{number}", settings, protocol, jobs, report)
        built.append(Built(folder.name, folder, json.loads((folder / CARD).read_text(encoding="utf-8"))))
        report(Note(f"{folder}: {built[-1].card['frames']} frames a view"))
    (out / SUMMARY).write_text(summary(built, settings.clock.period), encoding="utf-8")
    return built


def summary(built: list[Built], period: int) -> str:
    """The benchmark as Markdown: a row a subject, and the sum that the paper states."""
    lines = [
        "# RS-ZJU",
        "",
        "| subject | source frames | frames a view | D, px | e | seam, px |",
        "|---|---|---|---|---|---|",
    ]
    for each in built:
        card = each.card
        seam = "none" if card["seam_px"] is None else f"{card['seam_px']:.2f}"
        numbers = f"{card['source']['frames']} | {card['frames']} | {card['motion']['D']:.1f} | {card['e']} | {seam}"
        lines.append(f"| {each.name} | {numbers} |")
    total = sum(each.card["frames"] for each in built)
    lines += ["", f"{total} frames a view in all, K = {period}."]
    if period == 11 and len(built) == len(SUBJECTS) and total != sum(SUBJECTS.values()):
        wanted = ", ".join(f"{name}: {count}" for name, count in SUBJECTS.items())
        lines.append(f"The paper has {sum(SUBJECTS.values())} ({wanted}): these sequences have another length.")
    first = built[0].card
    lines += [
        "",
        f"Cameras {', '.join(first['cameras']['train'])} train; {len(first['cameras']['test'])} are held out.",
    ]
    return "\n".join([*lines, ""])
