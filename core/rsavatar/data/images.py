"""Pictures on disk: which there are, how large, what they hold; undistortion."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as Pillow

from rsavatar.data.base import Array, Bytes, Image
from rsavatar.errors import DataError, expected

SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Lens:
    """Intrinsics and distortion (k1, k2, p1, p2, k3) as OpenCV takes them.

    **Convention**: ``matrix`` is OpenCV's, for pixel centres at WHOLE integers; both images keep that matrix.
    """

    matrix: Array  # [3, 3]
    distortion: Array  # [5]

    @property
    def distorts(self) -> bool:
        """False when undistorting would copy the image."""
        return bool(np.any(self.distortion != 0))

    def scaled(self, factor: float) -> Lens:
        """The same lens for images ``factor`` times as large."""
        matrix = self.matrix.copy()
        matrix[:2, 2] += 0.5
        matrix[:2] *= factor
        matrix[:2, 2] -= 0.5
        return Lens(matrix, self.distortion)

    def raw_rows(self, size: tuple[int, int]) -> Array:
        """For every pixel [H, W] of the undistorted picture, the row of the raw one that shows it (pixel indices).

        That row's time is when a real sensor exposed it.
        """
        height, width = size
        x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ np.linalg.inv(self.matrix).T
        pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self.matrix, self.distortion)[0]
        return np.asarray(pixels.reshape(height, width, 2)[..., 1], np.float64)

    def row_shift(self, size: tuple[int, int]) -> float:
        """The largest distance, in rows, between a pixel and where the raw picture shows it; 0 without distortion."""
        if not self.distorts:
            return 0.0
        return float(np.abs(self.raw_rows(size) - np.arange(size[0])[:, None]).max())

    def undistorted(self, image: Bytes) -> Bytes:
        """The image an ideal pinhole camera of the same matrix would have taken (bilinear, black outside)."""
        if not self.distorts:
            return image
        return np.asarray(cv2.undistort(image, self.matrix, self.distortion), np.uint8)


@dataclass(frozen=True)
class Frame:
    """Where one picture and its mask lie."""

    image: Path
    mask: Path


Frames = Mapping[tuple[str, int], Frame]  # by (camera name, frame index)


def numbered(directory: Path) -> dict[int, Path]:
    """Pictures of a folder by the frame number in their name; other files are passed over.

    ``000012.png`` is 12, and so is a name whose fifth field between underscores is ``0012``: ZJU-MoCap has both.

    Raises:
        DataError: if the folder is missing.
    """
    if not directory.is_dir():
        raise DataError(expected(str(directory), "a folder of numbered images", "nothing there"))
    pictures = sorted(path for path in directory.iterdir() if path.suffix.lower() in SUFFIXES)
    return {number: path for path in pictures if (number := _number(path.stem)) is not None}


def locate(images: Path, masks: Path, indices: Iterable[int]) -> list[Frame]:
    """The frames ``indices`` of one camera, every file known to be there.

    Raises:
        DataError: naming the first missing image or mask.
    """
    pictures, covers = numbered(images), numbered(masks)
    frames = []
    for index in indices:
        for folder, found in ((images, pictures), (masks, covers)):
            if index not in found:
                raise DataError(expected(str(folder / f"{index:06d}.png"), "an image", "nothing there"))
        frames.append(Frame(pictures[index], covers[index]))
    return frames


def size_of(path: Path) -> tuple[int, int]:
    """(height, width) from the file's header.

    Raises:
        DataError: if it is not an image.
    """
    try:
        with Pillow.open(path) as picture:
            return picture.height, picture.width
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(expected(str(path), "an image file", error)) from error


def read_rgb(path: Path) -> Bytes:
    """Colour image [H, W, 3], RGB, 0..255.

    Raises:
        DataError: if the file is missing, truncated or not an image.
    """
    return _decoded(path, colour=True)


def read_coverage(path: Path) -> Bytes:
    """Mask [H, W], 0..255, 0 where nobody is. Labels (a mask whose largest value is 1) become 0 and 255.

    Raises:
        DataError: if the file is missing, truncated or not an image.
    """
    values = _decoded(path, colour=False)
    if values.ndim == 3:
        values = values[..., :3].max(-1)
    if values.dtype != np.uint8 or values.max(initial=0) <= 1:
        return np.where(values != 0, 255, 0).astype(np.uint8)
    return values


def read_frame(frame: Frame, lens: Lens) -> Image:
    """Undistorted colours and coverage of one picture, black where the coverage is 0.

    Raises:
        DataError: if a file cannot be decoded, or image and mask differ in size.
    """
    colours, coverage = read_rgb(frame.image), read_coverage(frame.mask)
    if colours.shape[:2] != coverage.shape:
        raise DataError(expected(f"size of {frame.mask}", colours.shape[:2], coverage.shape))
    colours, coverage = lens.undistorted(colours), lens.undistorted(coverage)
    return np.where(coverage[..., None] != 0, colours, 0).astype(np.uint8), coverage


def write_png(path: Path, pixels: Bytes) -> None:
    """Writes a picture whole or not at all.

    Raises:
        DataError: if there is no room.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part.png")
    if not cv2.imwrite(str(part), np.ascontiguousarray(pixels)):
        raise DataError(expected(str(path), "room for a picture", "a failed write"))
    part.replace(path)


def fingerprint(root: Path, contents: Iterable[Path], sizes: Iterable[Path] = ()) -> str:
    """sha256 over files, in the order of their names relative to ``root``.

    Of ``contents`` every byte counts; of ``sizes`` (sequences of gigabytes) the name and the length only.

    Raises:
        DataError: if a file cannot be read.
    """
    digest = hashlib.sha256()
    whole = set(contents)
    for path in sorted(whole | set(sizes)):
        try:
            length = path.stat().st_size
            content = path.read_bytes() if path in whole else b""
        except OSError as error:
            raise DataError(expected(str(path), "a readable file", error)) from error
        digest.update(f"{path.relative_to(root).as_posix()}\0{length}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def _number(stem: str) -> int | None:
    fields = stem.split("_")
    for text in (stem, fields[4] if len(fields) > 4 else ""):
        if text.isdecimal():
            return int(text)
    return None


def _decoded(path: Path, colour: bool) -> Bytes:
    # Pillow, because OpenCV hands back the upper half of a truncated file without a word.
    try:
        with Pillow.open(path) as picture:
            return np.asarray(picture.convert("RGB") if colour else picture)
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(expected(str(path), "a complete image file", error)) from error
