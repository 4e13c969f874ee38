"""A turntable: the camera goes once around the body, which stands still or moves, as a video for slides and pages."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from rsavatar.data.base import Bytes
from rsavatar.errors import DataError, SpecError, expected
from rsavatar.export.replay import Replay
from rsavatar.export.views import View, render_view

CODECS = {"mp4": "vp09", "webm": "VP80"}  # encoders that OpenCV's wheels carry, and browsers play
FORMATS = (*CODECS, "gif")
RATE = 24  # pictures a second


@dataclass(frozen=True)
class Turntable:
    """``pictures`` views over one turn from ``view`` on; with ``moving``, time goes once through the sequence."""

    view: View
    pictures: int = 96
    moving: bool = True


def views(replay: Replay, turntable: Turntable) -> Iterator[View]:
    """The views of one turn; the last is one step short of the first, so that the video loops."""
    last = replay.subject.frames - 1
    for i in range(turntable.pictures):
        share = i / turntable.pictures
        time = share * last if turntable.moving else turntable.view.time
        yield replace(turntable.view, time=time, azimuth=turntable.view.azimuth + 360 * share)


def write_turntable(replay: Replay, turntable: Turntable, fmt: str) -> bytes:
    """The video's file: VP9 in .mp4, VP8 in .webm, or a .gif.

    Raises:
        SpecError: if the format is none of these, or the background is transparent.
        DataError: if the encoder cannot be opened.
    """
    if fmt not in FORMATS:
        raise SpecError(expected("format", f"one of {', '.join(FORMATS)}", repr(fmt)))
    if turntable.view.background == "transparent":
        raise SpecError(expected("background", "black or white for a video", "transparent"))
    pictures = (_even(render_view(replay, view)) for view in views(replay, turntable))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"turntable.{fmt}"
        if fmt == "gif":
            _write_gif(path, [Image.fromarray(picture) for picture in pictures])
        else:
            _write_video(path, CODECS[fmt], pictures)
        return path.read_bytes()


def _even(picture: Bytes) -> Bytes:
    """Cut to even sides, which video encoders want."""
    return picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2]


def _write_video(path: Path, codec: str, pictures: Iterator[Bytes]) -> None:
    writer = None
    for picture in pictures:
        if writer is None:
            size = (picture.shape[1], picture.shape[0])
            writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), RATE, size)
            if not writer.isOpened():
                raise DataError(expected(f"video encoder {codec}", "one in this build of OpenCV", "none"))
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    if writer is not None:
        writer.release()


def _write_gif(path: Path, pictures: list[Image.Image]) -> None:
    first, *others = pictures
    first.save(path, save_all=True, append_images=others, duration=round(1000 / RATE), loop=0)
