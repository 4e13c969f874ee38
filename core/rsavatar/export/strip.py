"""The pictures that figures ask for, rendered from checkpoints: views beside their truth, and one body's exposures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rsavatar.data.base import Bytes, Subject
from rsavatar.errors import SpecError, expected
from rsavatar.evaluate import unit
from rsavatar.export.replay import Replay, joints_at
from rsavatar.export.views import View, render_view
from rsavatar.metrics.image import dilate, psnr
from rsavatar.report.runs import OURS

Floats = npt.NDArray[np.float32]
AROUND = 0.05  # of the body's height: white around it
ZOOMED = 0.3  # of the picture's width and height together: side of what is enlarged
SHUTTER_SIZE = 640
BANDS, SMOOTH_BLUR = 4, 32


def draw_pictures(replays: Mapping[str, Replay], wanted: Mapping[str, Any]) -> dict[str, Any]:
    """What ``Figure.pictures`` asks for, by name.

    Raises:
        SpecError: if a camera or frame is asked for that the subject does not have.
    """
    if wanted["kind"] == "shutter":
        return exposures(replays[wanted["job"]], wanted["frame"])
    return views(replays, wanted["camera"], int(wanted["frame"]))


def views(replays: Mapping[str, Replay], camera: str, frame: int) -> dict[str, Any]:
    """``input``, ``truth``, a picture per job, on white; ``error:JOB`` and ``psnr:JOB``; ``box``, what to enlarge."""
    first = next(iter(replays.values()))
    subject = first.subject
    if camera not in subject.held_out + subject.training or not 0 <= frame < subject.frames:
        got = f"camera {camera!r}, frame {frame}"
        raise SpecError(expected("view", f"a camera of {subject.name} and a frame below {subject.frames}", got))
    truth, mask = subject.truth(camera, frame)
    x0, y0, x1, y1 = around(mask)
    cut = np.s_[y0:y1, x0:x1]
    size = max(truth.shape[:2])
    found: dict[str, Any] = {
        "truth": on_white(truth, mask)[cut],
        "input": _input(subject, camera, frame, (y1 - y0, x1 - x0)),
    }
    others, own = np.zeros(mask.shape, np.float32), np.zeros(mask.shape, np.float32)
    for job, replay in replays.items():
        black = render_view(replay, View(camera=camera, time=frame, size=size))
        error = np.abs(unit(black) - unit(truth)).mean(-1)
        found[job] = render_view(replay, View(camera=camera, time=frame, size=size, background="white"))[cut]
        found[f"error:{job}"] = error[cut]
        found[f"psnr:{job}"] = psnr(unit(black), unit(truth), dilate(mask > 0)) if mask.any() else float("nan")
        if replay.spec.method == OURS:
            own = error
        else:
            others = np.maximum(others, error)
    return {**found, "box": busiest(others[cut] - own[cut])}


def _input(subject: Subject, camera: str, frame: int, shape: tuple[int, int]) -> Bytes:
    """What the nearest training camera saw, on white, cut and scaled to ``shape``."""
    here = subject.cameras[camera].centre
    nearest = min(subject.training, key=lambda c: float(np.linalg.norm(subject.cameras[c].centre - here)))
    seen, mask = subject.observe(nearest, frame)
    x0, y0, x1, y1 = around(mask)
    cut = on_white(seen, mask)[y0:y1, x0:x1]
    scale = min(shape[0] / cut.shape[0], shape[1] / cut.shape[1])
    small = cv2.resize(cut, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    picture: Bytes = np.full((*shape, 3), 255, np.uint8)
    top, left = (shape[0] - small.shape[0]) // 2, (shape[1] - small.shape[1]) // 2
    picture[top : top + small.shape[0], left : left + small.shape[1]] = small[: shape[0], : shape[1]]
    return picture


def exposures(replay: Replay, frame: int | None) -> dict[str, Any]:
    """The body under four shutters at the frame that moves most, or at ``frame``; ``box``, where they differ most."""
    fastest = max(range(replay.subject.frames), key=lambda n: _motion(replay, n)) if frame is None else frame
    words = {"global": "global", "blur": f"blur:{SMOOTH_BLUR}", "bands": f"bands:{BANDS}", "rolling": "rolling"}
    pictures = {
        name: render_view(replay, View(time=fastest, shutter=word, azimuth=25, size=SHUTTER_SIZE, background="white"))
        for name, word in words.items()
    }
    covered = np.max([255 - p.min(-1) for p in pictures.values()], axis=0)
    x0, y0, x1, y1 = around((covered > 12).astype(np.uint8))
    cut = {name: picture[y0:y1, x0:x1] for name, picture in pictures.items()}
    difference = np.abs(unit(cut["rolling"]) - unit(cut["global"])).mean(-1)
    return {**cut, "box": busiest(difference)}


def _motion(replay: Replay, frame: int) -> float:
    """Metres that the fastest joint moves over a frame's readout."""
    half = replay.subject.timing.readout_frames / 2
    return float(
        np.linalg.norm(joints_at(replay.actor, frame, half) - joints_at(replay.actor, frame, -half), axis=1).max()
    )


def on_white(picture: Bytes, mask: Bytes) -> Bytes:
    """A picture that is black where its coverage is 0, on white."""
    white: Bytes = np.clip(picture + (255 - mask.astype(np.int32))[..., None], 0, 255).astype(np.uint8)
    return white


def around(mask: Bytes) -> tuple[int, int, int, int]:
    """Columns and rows (x0, y0, x1, y1) of the mask with some white; the whole picture for an empty one."""
    height, width = mask.shape
    if not mask.any():
        return 0, 0, width, height
    x, y, w, h = cv2.boundingRect((mask > 0).astype(np.uint8))
    margin = round(AROUND * max(w, h))
    return max(x - margin, 0), max(y - margin, 0), min(x + w + margin, width), min(y + h + margin, height)


def busiest(values: Floats) -> Sequence[int]:
    """The square (x0, y0, x1, y1) with the greatest mean, moved so that what it holds lies in its middle."""
    height, width = values.shape
    side = max(8, min(round(ZOOMED * (height + width) / 2 * 1.25), height, width))
    means = cv2.boxFilter(values, -1, (side, side), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    whole = means[: height - side + 1, : width - side + 1]
    y, x = (int(place) for place in np.unravel_index(int(whole.argmax()), whole.shape))
    held = np.clip(values[y : y + side, x : x + side], 0, None)
    if held.sum() > 0:
        down, right = np.indices(held.shape)
        y = round(y + float((down * held).sum() / held.sum()) - side / 2)
        x = round(x + float((right * held).sum() / held.sum()) - side / 2)
    x, y = min(max(x, 0), width - side), min(max(y, 0), height - side)
    return [x, y, x + side, y + side]
