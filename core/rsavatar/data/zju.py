"""ZJU-MoCap sequences, refined ("my_377") and original ("CoreView_377"): sharp, global-shutter, many cameras.

refined    images/<cc>/<ffffff>.jpg   mask/<cc>/<ffffff>.png              smpl_params/<i>.npy
original   Camera_B<k>/<ffffff>.jpg   mask[_cihp]/Camera_B<k>/...png      new_params/<i>.npy or params/<i>.npy
           Camera (<k>)/...           the same, frame number in the fifth field of the name
both       annots.npy                 cams {K, R, T (millimetres), D}, ims
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rsavatar.data.annots import Calibration, fit_folder, read_calibrations, read_fits
from rsavatar.data.base import Image, ReadImage, Subject, Timing
from rsavatar.data.images import Frame, Frames, fingerprint, locate, numbered, read_coverage, read_rgb, size_of
from rsavatar.data.rolling import find_body_file, name_of
from rsavatar.errors import DataError, expected

TRAINING = ("04", "10", "16", "22")
EXCLUDED = ("03",)
_ORIGINAL = re.compile(r"Camera(?:_B| \()(\d+)\)?$")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Folders:
    """Where the pictures and masks of one camera lie."""

    images: Path
    masks: Path


def load(root: Path, pixel_centre: float | None = None) -> Subject:
    """The sequence in ``root`` as a global-shutter subject: readout 0, period 1, ``mid`` the number in a frame's name.

    Frames are those that have both a fit and an image. ``truth`` is ``observe``, for all cameras.

    **Convention**: OpenCV calibrated K for pixel centres at WHOLE integers, so 0.5 is added to cx and cy;
    ``pixel_centre`` (default: what a ``meta.json`` in ``root`` or above it says, else 0) is for synthetic sequences
    in this layout. Original camera ``Camera_B<k>`` is "k-1" with two digits. Cameras 04, 10, 16, 22 train, 03 is left
    out, the rest is held out; a camera without a folder is left out with a note in the log.

    Raises:
        DataError: naming the file that is missing or damaged, or if no training camera is on disk.
    """
    calibrations = read_calibrations(root / "annots.npy")
    folders = camera_folders(root)
    _check_cameras(root, folders, len(calibrations))
    fits = fit_folder(root)
    numbers = _frame_numbers(folders, fits)
    frames = {
        (camera, index): frame
        for camera, folder in folders.items()
        for index, frame in enumerate(locate(folder.images, folder.masks, numbers))
    }
    centre = pixel_centre_of(root) if pixel_centre is None else pixel_centre
    read = _reader(frames, calibrations, centre)
    return Subject(
        name=root.resolve().name,
        root=root,
        cameras={c: calibrations[int(c)].camera(size_of(frames[c, 0].image), centre) for c in folders},
        training=tuple(camera for camera in folders if camera in TRAINING),
        held_out=tuple(camera for camera in folders if camera not in TRAINING),
        fit=read_fits(fits, numbers),
        timing=Timing(np.asarray(numbers, np.float64), readout_frames=0.0, period_frames=1.0),
        observe=read,
        truth=read,
        fingerprint=_fingerprint(root, fits, list(frames.values())),
        body=find_body_file(root),
    )


def camera_folders(root: Path) -> dict[str, Folders]:
    """Folders of the cameras on disk by two-digit name, in the order of the names; camera 03 is left out.

    Raises:
        DataError: if there are neither ``images/<cc>`` nor ``Camera...`` folders, or no folder of masks.
    """
    masks = next((root / name for name in ("mask", "mask_cihp") if (root / name).is_dir()), None)
    if masks is None:
        raise DataError(expected(str(root), "a folder mask or mask_cihp", "none"))
    inside = root / "images" if (root / "images").is_dir() else root
    named = {_camera_name(path.name): path for path in inside.iterdir() if path.is_dir()}
    found = {name: Folders(path, masks / path.name) for name, path in sorted(named.items()) if name}
    if not found:
        raise DataError(expected(str(inside), "folders 00..22 or Camera_B1..Camera_B23", "none"))
    return {name: folders for name, folders in found.items() if name not in EXCLUDED}


def _camera_name(folder: str) -> str:
    original = _ORIGINAL.match(folder)
    if original:
        return name_of(int(original[1]) - 1)
    return folder if re.fullmatch(r"\d\d", folder) else ""


def _check_cameras(root: Path, folders: Mapping[str, Folders], calibrated: int) -> None:
    if not set(folders) & set(TRAINING):
        raise DataError(expected(f"{root} cameras", f"at least one of {', '.join(TRAINING)}", ", ".join(folders)))
    unknown = [camera for camera in folders if int(camera) >= calibrated]
    if unknown:
        wanted = f"calibrations of cameras {', '.join(folders)}"
        raise DataError(expected(str(root / "annots.npy"), wanted, f"{calibrated} cameras, none for {unknown}"))
    absent = sorted({name_of(c) for c in range(calibrated)} - set(folders) - set(EXCLUDED))
    if absent:
        _log.info("%s: cameras %s are calibrated but not on disk; they are left out", root, ", ".join(absent))


def _frame_numbers(folders: Mapping[str, Folders], fits: Path) -> list[int]:
    fitted = {int(path.stem) for path in fits.glob("*.npy") if path.stem.isdecimal()}
    seen = set().union(*(numbered(folder.images) for folder in folders.values()))
    if not fitted & seen:
        got = f"{len(fitted)} fits and {len(seen)} images without a common number"
        raise DataError(expected(f"{fits} and the images", "frames with a fit and an image", got))
    return sorted(fitted & seen)


def pixel_centre_of(root: Path) -> float:
    """Where K puts the first pixel's centre: what a ``meta.json`` in ``root`` or above it says, else 0.

    Raises:
        DataError: if that file is no JSON object.
    """
    for path in (root / "meta.json", root.resolve().parent / "meta.json"):
        if path.is_file():
            try:
                return float(json.loads(path.read_text(encoding="utf-8")).get("pixel_centre", 0.0))
            except (OSError, ValueError, AttributeError, TypeError) as error:
                raise DataError(expected(str(path), "a JSON object", error)) from error
    return 0.0


def _reader(frames: Frames, calibrations: Sequence[Calibration], pixel_centre: float) -> ReadImage:
    def read(camera: str, index: int) -> Image:
        if (camera, index) not in frames:
            known = sorted({name for name, _ in frames})
            got = f"camera {camera!r}, frame {index}"
            raise DataError(expected("camera and frame", f"one of cameras {known}", got))
        return read_labelled(frames[camera, index], calibrations[int(camera)], pixel_centre)

    return read


def read_labelled(frame: Frame, calibration: Calibration, pixel_centre: float) -> Image:
    """Undistorted colours and coverage; the mask holds labels, any of which is the person, so coverage is 0 or 255.

    Raises:
        DataError: if a file cannot be decoded, or image and mask differ in size.
    """
    lens = calibration.lens(pixel_centre)
    colours, labels = read_rgb(frame.image), read_coverage(frame.mask)
    if colours.shape[:2] != labels.shape:
        raise DataError(expected(f"size of {frame.mask}", colours.shape[:2], labels.shape))
    person = lens.undistorted(np.where(labels != 0, 255, 0).astype(np.uint8)) >= 128
    return np.where(person[..., None], lens.undistorted(colours), 0).astype(np.uint8), person.astype(np.uint8) * 255


def _fingerprint(root: Path, fits: Path, frames: Sequence[Frame]) -> str:
    pictures = [path for frame in frames for path in (frame.image, frame.mask)]
    return fingerprint(root, [root / "annots.npy", *fits.glob("*.npy")], sizes=pictures)
