"""Training pairs of rolling-shutter correction: sequences of rolling frames with their sharp twins, packed in one file.

A pack is an ``.npz`` of PNG files end to end (``images``, ``ends``) and of what they are (``sequences`` [S, 2]: frames,
and whether sharp frames at the first row's instant are among them). It needs no subject, no renderer and no kernels to
be read: pairs made on one machine are trained on another.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rsavatar.errors import DataError, expected

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Take:
    """N consecutive frames of one camera. **Convention**: RGB on black, readout equal to the frame period."""

    rolling: Bytes  # [N, H, W, 3]
    middle: Bytes  # [N, H, W, 3] sharp, at the middle row's instant
    first: Bytes | None  # [N, H, W, 3] sharp, at the first row's instant; None where nobody knows them

    def __post_init__(self) -> None:
        frames = self.rolling.shape
        if len(frames) != 4 or frames[0] < 2 or frames[3] != 3:
            raise DataError(expected("rolling frames", "[N, H, W, 3] with N of at least 2", list(frames)))
        for name, twin in {"middle": self.middle, "first": self.first}.items():
            if twin is not None and twin.shape != frames:
                raise DataError(expected(f"{name} frames", list(frames), list(twin.shape)))


def write_pack(path: Path, takes: Sequence[Take]) -> None:
    """Write a pack, whole or not at all.

    Raises:
        DataError: if there is nothing to write.
    """
    if not takes:
        raise DataError(expected("training pairs", "at least one take", "none"))
    files = [_encoded(image) for take in takes for image in _images(take)]
    kinds = np.array([[len(take.rolling), take.first is not None] for take in takes], np.int64)
    part = path.with_name(path.name + ".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    with part.open("wb") as file:
        np.savez(file, images=np.concatenate(files), ends=np.cumsum([len(f) for f in files]), sequences=kinds)
    part.replace(path)


def read_pack(path: Path) -> list[Take]:
    """The takes of a pack, decoded.

    Raises:
        DataError: if the file is missing, damaged or something else.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as held:
            images, ends, kinds = (np.asarray(held[name]) for name in ("images", "ends", "sequences"))
        files = iter(np.split(images, ends[:-1]))
        return [_take(files, int(frames), bool(first)) for frames, first in kinds]
    except (OSError, ValueError, KeyError, EOFError, StopIteration, zipfile.BadZipFile, cv2.error) as error:
        raise DataError(expected(str(path), "a pack of training pairs", error or "too few images")) from error


def shrunk(take: Take, factor: int) -> Take:
    """The take ``factor`` times smaller: means over squares of pixels.

    Raises:
        DataError: if the size is not a multiple of ``factor``.
    """
    if factor == 1:
        return take
    height, width = take.rolling.shape[1:3]
    if height % factor or width % factor:
        raise DataError(expected("size of training pairs", f"multiples of {factor}", (height, width)))

    def smaller(stack: Bytes) -> Bytes:
        split = stack.reshape(len(stack), height // factor, factor, width // factor, factor, 3)
        return np.asarray(split.mean((2, 4)) + 0.5, np.uint8)

    first = None if take.first is None else smaller(take.first)
    return Take(smaller(take.rolling), smaller(take.middle), first)


def _images(take: Take) -> Iterator[Bytes]:
    for stack in (take.rolling, take.middle, take.first):
        if stack is not None:
            yield from stack


def _encoded(image: Bytes) -> Bytes:
    done, file = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise DataError(expected("training image", "one that PNG can hold", list(image.shape)))
    return np.asarray(file, np.uint8).ravel()


def _take(files: Iterator[Bytes], frames: int, first: bool) -> Take:
    stacks = [np.stack([_decoded(next(files)) for _ in range(frames)]) for _ in range(2 + first)]
    return Take(stacks[0], stacks[1], stacks[2] if first else None)


def _decoded(file: Bytes) -> Bytes:
    image = cv2.imdecode(file, cv2.IMREAD_COLOR)
    if image is None:
        raise DataError(expected("training image", "a whole PNG", f"{len(file)} bytes"))
    return np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)
