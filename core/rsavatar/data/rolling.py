"""Rolling-shutter subjects: ``meta.json``, ``rs/`` and, for synthetic ones, ``truth/``.

meta.json            mid, K, gamma, train, test; optional excluded, delta, pixel_centre (default 0), fps (of the
                     source), exposure (source frames), missing ([camera, frame] pairs of rs/images that do not exist)
rs/annots.npy        calibration, T in millimetres
rs/images/<cc>/<nnnnnn>.png  rs/mask/...     what the training cameras saw; mask != 0 is the person
rs/gt/<cc>/...       rs/gt_mask/...          sharp frames at the mid-row time of all listed cameras
rs/new_params/<n>.npy                        initial fits (also: params, smpl_params)
truth/motion.npz     body*.npz               optional: exact motion, body model
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from rsavatar.data.annots import Calibration, fit_folder, numbers, read_calibrations, read_fits
from rsavatar.data.base import Array, BodyFit, Direction, Image, ReadImage, Subject, Timing, TrueMotion
from rsavatar.data.images import Frame, Frames, fingerprint, locate, read_frame, size_of
from rsavatar.errors import DataError, expected


@dataclass(frozen=True)
class Meta:
    """What ``meta.json`` says, checked. Times in source frames; cameras by index into ``annots.npy``."""

    train: tuple[int, ...]
    test: tuple[int, ...]
    mid: Array  # [N]
    period: float  # K
    gamma: float  # readout / period
    delta: tuple[float, ...]  # by camera index; empty = all 0
    pixel_centre: float  # where the first pixel's centre lies
    exposure: float  # source frames
    fps: float | None  # source frames a second
    direction: Direction  # in which the sensors are read
    missing: frozenset[tuple[str, int]]  # training images, by camera name and frame, that there are none of


def load(root: Path) -> Subject:
    """The rolling-shutter subject in ``root``; pictures are read when asked for, but all are known to be there.

    **Convention**: ``annots.npy`` holds millimetres; K is brought to pixel centres at half integers; times are the
    paper's eq. rowtime with the window centred on ``mid``. Without ``rs/gt`` there are no held-out cameras.

    Raises:
        DataError: naming the file that is missing, damaged or contradicts another.
    """
    meta = read_meta(root / "meta.json")
    calibrations = read_calibrations(root / "rs" / "annots.npy")
    sharp = (root / "rs" / "gt").is_dir()
    listed = meta.train + meta.test if sharp else meta.train
    _check_cameras(root, listed, len(calibrations))
    frames = range(len(meta.mid))
    observed = _frames(root / "rs" / "images", root / "rs" / "mask", meta.train, frames, meta.missing)
    truths = _frames(root / "rs" / "gt", root / "rs" / "gt_mask", listed, frames) if sharp else {}
    folder = fit_folder(root / "rs")
    picture = {camera: frame.image for (camera, _), frame in {**truths, **observed}.items()}  # any one of a camera
    return Subject(
        name=root.resolve().name,
        root=root,
        cameras={
            name_of(c): calibrations[c].camera(size_of(picture[name_of(c)]), meta.pixel_centre) for c in sorted(listed)
        },
        training=tuple(map(name_of, meta.train)),
        held_out=tuple(map(name_of, meta.test)) if sharp else (),
        fit=read_fits(folder, frames),
        timing=_timing(meta, listed),
        observe=_reader("training camera and frame", observed, calibrations, meta.pixel_centre),
        truth=_reader("camera and frame with a sharp image", truths, calibrations, meta.pixel_centre),
        fingerprint=_fingerprint(root, folder, [*observed.values(), *truths.values()]),
        body=find_body_file(root),
        motion=read_motion(root / "truth" / "motion.npz"),
        missing=meta.missing,
    )


def name_of(camera: int) -> str:
    """Two-digit name of a camera index."""
    return f"{camera:02d}"


def read_meta(path: Path) -> Meta:
    """``meta.json``, checked; excluded cameras are gone from ``train`` and ``test``.

    Raises:
        DataError: if the file is missing, not JSON, or a value is missing or impossible.
    """
    try:
        values: Any = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DataError(expected(str(path), "a file", "nothing there")) from None
    except (OSError, ValueError) as error:
        raise DataError(expected(str(path), "a JSON file", error)) from error
    if not isinstance(values, dict) or not {"train", "test", "mid", "K"} <= values.keys():
        got = sorted(values) if isinstance(values, dict) else type(values).__name__
        raise DataError(expected(str(path), "an object with train, test, mid and K", got))
    try:
        meta = _parse_meta(path, values)
    except (TypeError, ValueError) as error:
        raise DataError(expected(str(path), "numbers and lists of numbers", error)) from error
    _check_meta(path, meta, values.get("frames", len(meta.mid)))
    return meta


def read_motion(path: Path) -> TrueMotion | None:
    """The exact motion, or None where there is no such file.

    Raises:
        DataError: if the file is damaged or a name in it is missing.
    """
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as held:
            values = {key: np.asarray(held[key], np.float64) for key in held.files}
            mid = BodyFit(values["mid_poses"], values["mid_Rh"], values["mid_Th"], values["betas"])
            names = ("mid_joints", "sub_poses", "sub_Rh", "sub_Th", "sub_joints")
            return TrueMotion(mid, **{name: values[name] for name in names})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(expected(str(path), "mid_* and sub_* poses, Rh, Th, joints and betas", error)) from error


def find_body_file(root: Path) -> Path | None:
    """The body model that lies with the data: ``body.npz``, else the first ``body*.npz``, else None."""
    found = sorted(root.glob("body*.npz"), key=lambda path: (path.name != "body.npz", path.name))
    return found[0] if found else None


def _parse_meta(path: Path, values: dict[str, Any]) -> Meta:
    excluded = set(values.get("excluded", []))
    return Meta(
        train=tuple(int(c) for c in values["train"] if c not in excluded),
        test=tuple(int(c) for c in values["test"] if c not in excluded and c not in values["train"]),
        mid=numbers(f"{path} mid", values["mid"], (len(values["mid"]),)),
        period=float(values["K"]),
        gamma=float(values.get("gamma", 1.0)),
        delta=tuple(map(float, values.get("delta", []))),
        pixel_centre=float(values.get("pixel_centre", 0.0)),
        exposure=float(values.get("exposure", 0.0)),
        fps=None if values.get("fps") is None else float(values["fps"]),
        direction=values.get("direction", "down"),
        missing=frozenset((name_of(int(c)), int(n)) for c, n in values.get("missing", [])),
    )


def _check_meta(path: Path, meta: Meta, frames: int) -> None:
    if len(meta.mid) == 0 or len(meta.mid) != frames:
        raise DataError(expected(f"{path} mid", f"frames = {frames} > 0 times", len(meta.mid)))
    if not meta.train:
        raise DataError(expected(f"{path} train", "at least one camera that is not excluded", "none"))
    if not (meta.period > 0 and meta.gamma >= 0 and np.isfinite([meta.period, meta.gamma]).all()):
        raise DataError(expected(f"{path} K and gamma", "K > 0, gamma >= 0", (meta.period, meta.gamma)))
    if not (0 <= meta.exposure < np.inf and (meta.fps is None or 0 < meta.fps < np.inf)):
        raise DataError(expected(f"{path} exposure and fps", "exposure >= 0, fps > 0", (meta.exposure, meta.fps)))
    unknown = sorted(f for f in meta.missing if f[0] not in map(name_of, meta.train) or not 0 <= f[1] < frames)
    if unknown:
        raise DataError(expected(f"{path} missing", "pairs of a training camera and a frame", unknown))
    if meta.direction not in get_args(Direction):
        raise DataError(expected(f"{path} direction", f"one of {', '.join(get_args(Direction))}", meta.direction))
    if meta.pixel_centre not in (0.0, 0.5):
        raise DataError(expected(f"{path} pixel_centre", "0 or 0.5", meta.pixel_centre))
    if meta.delta and len(meta.delta) <= max(meta.train + meta.test):
        wanted = f"a value for each camera up to {max(meta.train + meta.test)}"
        raise DataError(expected(f"{path} delta", wanted, f"{len(meta.delta)} values"))


def _check_cameras(root: Path, listed: Iterable[int], calibrated: int) -> None:
    unknown = [camera for camera in listed if not 0 <= camera < calibrated]
    if unknown:
        wanted = f"calibrations of cameras {sorted(listed)}"
        raise DataError(expected(str(root / "rs" / "annots.npy"), wanted, f"{calibrated} cameras, none for {unknown}"))


def _frames(
    images: Path,
    masks: Path,
    cameras: Iterable[int],
    frames: range,
    missing: frozenset[tuple[str, int]] = frozenset(),
) -> dict[tuple[str, int], Frame]:
    found = {}
    for name in map(name_of, cameras):
        there = [index for index in frames if (name, index) not in missing]
        located = locate(images / name, masks / name, there)
        found.update({(name, index): frame for index, frame in zip(there, located, strict=True)})
    return found


def _reader(what: str, frames: Frames, calibrations: list[Calibration], pixel_centre: float) -> ReadImage:
    def read(camera: str, index: int) -> Image:
        if (camera, index) not in frames:
            known = sorted({name for name, _ in frames})
            raise DataError(expected(what, f"one of cameras {known}", f"camera {camera!r}, frame {index}"))
        return read_frame(frames[camera, index], calibrations[int(camera)].lens(pixel_centre))

    return read


def _timing(meta: Meta, listed: Iterable[int]) -> Timing:
    triggers = {name_of(camera): meta.delta[camera] for camera in listed} if meta.delta else {}
    return Timing(meta.mid, meta.gamma * meta.period, meta.period, triggers, meta.exposure, meta.fps, meta.direction)


def _fingerprint(root: Path, folder: Path, frames: list[Frame]) -> str:
    fixed = [root / "meta.json", root / "rs" / "annots.npy", *folder.glob("*.npy")]
    return fingerprint(root, fixed + [path for frame in frames for path in (frame.image, frame.mask)])
