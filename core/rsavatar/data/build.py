"""The rolling-shutter benchmark builder (paper, section 4.1): sharp footage in, a rolling-shutter subject out.

A build has a key, the sha256 of every byte that it reads and every setting that decides it. What is written goes to a
folder of that key beside the target, picture by picture, and becomes the target when it is whole: a build that was
interrupted goes on where it stopped, and one that is done is not done again.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from rsavatar.body.find import find_body
from rsavatar.data.base import BodyFit
from rsavatar.data.build_card import CARD, write_card
from rsavatar.data.build_files import write_annots, write_fits, write_meta
from rsavatar.data.build_fit import mid_fit, seen_fit
from rsavatar.data.build_plan import Clock, trigger_offsets
from rsavatar.data.build_work import Crew, Work
from rsavatar.data.footage import Footage
from rsavatar.errors import DataError, expected
from rsavatar.events import Note, Progress, Report, silent
from rsavatar.restore.interpolate import RECURSION, interpolator

FORMAT = 1  # raise it when the pictures change: it is part of the key
_FIT = {
    "mid": "the source's own fit at the mid frame",
    "rows": "the source's fits, every joint at the time of its own row, as a fit to rolling-shutter frames sees it",
}


@dataclass(frozen=True)
class Settings:
    """What decides a benchmark besides its source."""

    clock: Clock = field(default_factory=Clock)
    interpolator: str = "flow"
    weights: Path | None = None  # of rife and rife-v4
    recursion: int | Literal["auto", "rows"] = "auto"  # e; "auto": by the seam; "rows": each row at its own instant
    triggers: str | dict[str, float] = "0"  # "0", "random", or source frames by training camera
    rows: Literal["undistorted", "raw"] = "undistorted"  # which rows carry the time
    fit: Literal["mid", "rows"] = "mid"
    seed: int = 0  # of random triggers

    def __post_init__(self) -> None:
        if isinstance(self.recursion, int) and not 0 <= self.recursion <= 8:
            raise DataError(expected("e", "auto, rows, or 0 to 8", self.recursion))
        if self.recursion == "rows" and self.interpolator == "rife":
            raise DataError(expected("e of rife", "auto or a number: it halves intervals", "rows"))


def build(
    footage: Footage,
    out: Path,
    settings: Settings,
    protocol: Mapping[str, object],
    jobs: int | None = None,
    report: Report = silent,
) -> Path:
    """Writes the rolling-shutter subject of ``footage`` to ``out``, with its card; one that is there already is kept.

    **Convention**: times in source frames; row v of frame n in camera c is the scene at
    mid_n + delta_c + gamma K (v / H - 1/2); ground truth is the sharp picture at mid_n + delta_c.

    Args:
        footage: where from; see ``open_footage``.
        out: the subject's folder, new or built from the same by this function.
        settings: see ``Settings``.
        protocol: how results will be scored, for the card.
        jobs: processes; None: as many as cores that this process may use.
        report: hears of the progress.

    Raises:
        DataError: naming what is wrong with a picture, a camera or a setting, or if ``out`` holds something else.
    """
    key = key_of(footage, settings)
    if _is_built(out, key):
        report(Note(f"{out} is built already, of the same content."))
        return out
    workers = jobs or len(os.sched_getaffinity(0))
    part = out.with_name(f".{out.name}-{key[:16]}.part")
    part.mkdir(parents=True, exist_ok=True)
    with _locked(part):
        if _is_built(out, key):  # by the process that was waited for
            shutil.rmtree(part, ignore_errors=True)
            return out
        work = _plan(footage, settings, part)
        with Crew(work, workers) as crew:
            motion = _measured(work, crew, report)
            work = _resolved(work, settings, motion["D"])
            _write_pictures(work, crew, report)
        _write_numbers(work, settings, motion)
        write_card(part, card_of(work, settings, motion, protocol, key))
        (part / "measured.json").unlink()
        part.rename(out)
    return out


def key_of(footage: Footage, settings: Settings) -> str:
    """The sha256 of all that decides a build."""
    used = _interpolator_of(settings, RECURSION if isinstance(settings.recursion, str) else settings.recursion)
    words = asdict(settings) | {"weights": None, "interpolator": used}
    views = [footage.train, footage.test, footage.labelled, footage.pixel_centre]
    content = [FORMAT, words, views, footage.fingerprint([*footage.train, *footage.test])]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def card_of(
    work: Work, settings: Settings, motion: Mapping[str, Any], protocol: Mapping[str, object], key: str
) -> dict[str, Any]:
    """What ``benchmark.json`` says."""
    footage, clock = work.footage, work.clock
    cameras = {"train": list(footage.train), "test": list(footage.test), "excluded": list(footage.excluded)}
    recursion = work.interpolator[2]
    shift = max(footage.lens(camera).row_shift(footage.size(camera)) for camera in work.cameras())
    height = footage.size(footage.train[0])[0]
    late = sum(1 for value in work.triggers.values() if value != int(value))
    return {
        "name": work.footage.name,
        "key": key,
        "source": {
            "name": footage.name,
            "layout": footage.layout,
            "frames": footage.length,
            "licence": footage.licence,
        },
        "frames": len(work.mids),
        "K": clock.period,
        "gamma": clock.gamma,
        "readout": clock.readout,
        "row_time": "mid + delta_c + gamma K (v / H - 1/2), v = 0..H-1, source frames",
        "rows": work.rows,
        "lens_shift_rows": shift,
        "lens_shift_frames": shift / height * clock.readout,
        "e": "rows" if work.steps is None else recursion,
        "instants": None if work.steps is None else clock.instants(recursion),
        "seam_px": None if work.steps is None else clock.seam(motion["D"], recursion),
        "motion": dict(motion),
        "interpolator": _interpolator_of(settings, recursion),
        "triggers": dict(work.triggers),
        "ground_truth": {
            "real": (len(work.cameras()) - late) * len(work.mids),
            "interpolated": late * len(work.mids),
        },
        "cameras": cameras,
        "pictures": {"rolling": len(footage.train) * len(work.mids), "sharp": len(work.cameras()) * len(work.mids)},
        "fit": _FIT[settings.fit],
        "protocol": dict(protocol),
    }


def _interpolator_of(settings: Settings, recursion: int) -> str:
    used = interpolator(settings.interpolator, settings.weights, recursion)
    return f"{used.name} ({used.settings})" if used.settings else used.name


def _plan(footage: Footage, settings: Settings, out: Path) -> Work:
    clock = settings.clock
    triggers = trigger_offsets(settings.triggers, footage.train, clock.period, settings.seed)
    mids = clock.mids(footage.length, [0.0, *triggers.values()])
    if not mids:
        wanted = f"at least {2 * clock.period + 1} frames for K = {clock.period}: the first group is dropped"
        raise DataError(expected(f"{footage.root} length", wanted, footage.length))
    chosen = settings.interpolator, settings.weights, RECURSION
    return Work(footage, clock, tuple(mids), triggers, settings.rows, chosen, 2**RECURSION, out)


def _resolved(work: Work, settings: Settings, displacement: float) -> Work:
    """The work with its e."""
    name, weights, _ = work.interpolator
    if settings.recursion == "rows":
        chosen, steps = RECURSION, None
    else:
        chosen = work.clock.recursion(displacement) if settings.recursion == "auto" else settings.recursion
        steps = 2**chosen
    return replace(work, interpolator=(name, weights, chosen), steps=steps)


def _measured(work: Work, crew: Crew, report: Report) -> dict[str, Any]:
    """D over all cameras, and where; kept for a build that goes on."""
    path = work.out / "measured.json"
    if path.is_file():
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found
    begun, by_camera = time.monotonic(), {}
    for camera, lengths in crew.each(Work.measure, work.cameras()):
        by_camera[camera] = lengths
        report(Progress("measure", len(by_camera), len(work.cameras()), time.monotonic() - begun))
    worst = max(by_camera, key=lambda camera: float(by_camera[camera].max()))
    found = {
        "D": round(float(by_camera[worst].max()), 3),
        "camera": worst,
        "frame": int(by_camera[worst].argmax()),
        "by_camera": {name: round(float(by_camera[name].max()), 3) for name in sorted(by_camera)},
    }
    path.write_text(json.dumps(found), encoding="utf-8")
    return found


def _write_pictures(work: Work, crew: Crew, report: Report) -> None:
    begun, done = time.monotonic(), 0
    total = len(work.cameras()) * len(work.mids)
    for _, written in crew.each(Work.write, work.chunks(), interpolator=work.interpolator, steps=work.steps):
        done += written
        report(Progress("build", done, total, time.monotonic() - begun))


def _write_numbers(work: Work, settings: Settings, motion: Mapping[str, Any]) -> None:
    footage = work.footage
    write_annots(work)
    write_fits(work.out / "rs" / "new_params", _first_fit(work, settings))
    write_meta(work, motion)
    if footage.body is not None:
        shutil.copyfile(footage.body, work.out / "body.npz")


def _first_fit(work: Work, settings: Settings) -> BodyFit:
    footage = work.footage
    if settings.fit == "mid":
        return mid_fit(footage.fit, work.mids)
    cameras = [
        footage.calibrations[footage.index[name]].camera(footage.size(name), footage.pixel_centre)
        for name in footage.train
    ]
    return seen_fit(footage.fit, work.mids, work.clock, cameras, find_body("auto", footage)[0])


def _is_built(out: Path, key: str) -> bool:
    """Whether ``out`` is the whole build of ``key``; False where nothing is.

    Raises:
        DataError: if something else is there.
    """
    if not out.exists():
        return False
    try:
        there = json.loads((out / CARD).read_text(encoding="utf-8"))["key"]
    except (OSError, ValueError, KeyError, TypeError):
        there = None
    if there != key:
        got = "something else" if there is None else "a benchmark of other inputs or settings"
        raise DataError(expected(str(out), "nothing there, or the benchmark of these inputs and settings", got))
    return True


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Waits until no other process works in ``folder``."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
