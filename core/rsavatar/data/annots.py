"""Calibration and fits in the files that ZJU-MoCap made customary: ``annots.npy`` and one ``<n>.npy`` per fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsavatar.data.base import Array, BodyFit
from rsavatar.data.images import Lens
from rsavatar.data.npy import load_plain
from rsavatar.errors import DataError, expected
from rsavatar.geometry.cameras import Camera

FIT_FOLDERS = ("new_params", "params", "smpl_params")  # the first that exists is read


@dataclass(frozen=True)
class Calibration:
    """One camera of ``annots.npy``, its translation already in metres."""

    matrix: Array  # [3, 3] as in the file
    rotation: Array  # [3, 3]
    translation: Array  # [3] metres
    distortion: Array  # [5]

    def camera(self, size: tuple[int, int], pixel_centre: float) -> Camera:
        """The pinhole camera in our convention; ``pixel_centre`` is where the file puts the first pixel's centre.

        Raises:
            DataError: on values that no camera has.
        """
        shift = 0.5 - pixel_centre
        (fx, _, cx), (_, fy, cy) = self.matrix[0], self.matrix[1]
        return Camera(
            rotation=self.rotation,
            translation=self.translation,
            fx=float(fx),
            fy=float(fy),
            cx=float(cx) + shift,
            cy=float(cy) + shift,
            height=size[0],
            width=size[1],
        )

    def lens(self, pixel_centre: float) -> Lens:
        """The same intrinsics for OpenCV, whose pixel centres are whole integers."""
        matrix = self.matrix.copy()
        matrix[:2, 2] -= pixel_centre
        return Lens(matrix, self.distortion)


def read_calibrations(path: Path) -> list[Calibration]:
    """All cameras of ``annots.npy``, in the file's order.

    **Convention**: K, R (world to camera) as they are; T is in MILLIMETRES in the file, metres in what is returned.

    Raises:
        DataError: if the file is missing or damaged, or K, R, T, D are absent or of the wrong shape.
    """
    annots = load_plain(path)
    table = annots.get("cams") if isinstance(annots, dict) else None
    if not isinstance(table, dict) or not {"K", "R", "T"} <= table.keys():
        got = sorted(map(str, table)) if isinstance(table, dict) else type(annots).__name__
        raise DataError(expected(f"{path} cams", "a dictionary with lists K, R, T, D", got))
    count = len(table["K"])
    distortions = table.get("D", [np.zeros(5)] * count)
    if not len(table["R"]) == len(table["T"]) == len(distortions) == count:
        lengths = [count, len(table["R"]), len(table["T"]), len(distortions)]
        raise DataError(expected(f"{path} cams", "lists K, R, T, D of one length", lengths))
    return [
        Calibration(
            matrix=numbers(f"{path} K[{i}]", table["K"][i], (3, 3)),
            rotation=numbers(f"{path} R[{i}]", table["R"][i], (3, 3)),
            translation=numbers(f"{path} T[{i}]", table["T"][i], (3,)) / 1000.0,
            distortion=numbers(f"{path} D[{i}]", distortions[i], (5,)),
        )
        for i in range(count)
    ]


def fit_folder(root: Path) -> Path:
    """The folder of fits under ``root``.

    Raises:
        DataError: if there is none of the customary names.
    """
    for name in FIT_FOLDERS:
        if (root / name).is_dir():
            return root / name
    raise DataError(expected(str(root), f"a folder of fits ({', '.join(FIT_FOLDERS)})", "none of them"))


def read_fits(folder: Path, indices: Sequence[int]) -> BodyFit:
    """The fits ``<i>.npy`` (or ``<iiiiii>.npy``) of ``indices``, in that order; shapes are averaged over them.

    Poses of 69 numbers get three zeros in front; a pose whose first three numbers are not zero is refused by its
    file's name, because EasyMocap's root rotation is Rh.

    Raises:
        DataError: naming the file that is missing, damaged or of the wrong shape.
    """
    fits = [read_fit(_fit_path(folder, index)) for index in indices]
    if not fits:
        raise DataError(expected(str(folder), "at least one fit", "none asked for"))
    stacked = {name: np.concatenate([getattr(fit, name) for fit in fits]) for name in ("poses", "Rh", "Th")}
    return BodyFit(**stacked, shapes=np.mean([fit.shapes for fit in fits], axis=0))


def read_fit(path: Path) -> BodyFit:
    """One fit (N = 1).

    Raises:
        DataError: if the file is missing or damaged, or lacks poses, Rh, Th or shapes.
    """
    values = load_plain(path)
    if not isinstance(values, dict):
        raise DataError(expected(str(path), "a dictionary", type(values).__name__))
    return parse_fit(str(path), values)


def parse_fit(name: str, values: Mapping[str, Any]) -> BodyFit:
    """One fit (N = 1) from EasyMocap's names, whatever the file was; ``name`` is for messages.

    Raises:
        DataError: if a name is missing, a shape is wrong, or the root rotation stands in the pose.
    """
    missing = [key for key in ("poses", "Rh", "Th", "shapes") if key not in values]
    if missing:
        hint = " (smplx names: convert them first)" if {"global_orient", "transl"} & values.keys() else ""
        raise DataError(expected(name, "poses, Rh, Th and shapes", f"no {', '.join(missing)}{hint}"))
    poses = np.asarray(values["poses"], float).reshape(-1)
    poses = numbers(f"{name} poses", np.concatenate([np.zeros(3), poses]) if poses.size == 69 else poses, (72,))
    if np.abs(poses[:3]).max() > 1e-6:
        raise DataError(expected(f"{name} poses[:3]", "zeros (the root's rotation is Rh)", poses[:3].tolist()))
    return BodyFit(
        poses=poses[None],
        Rh=numbers(f"{name} Rh", values["Rh"], (3,))[None],
        Th=numbers(f"{name} Th", values["Th"], (3,))[None],
        shapes=numbers(f"{name} shapes", values["shapes"], (10,)),
    )


def numbers(name: str, value: object, shape: tuple[int, ...]) -> Array:
    """``value`` as finite float64 of ``shape``; a row or column of the right length passes.

    Raises:
        DataError: if it is none.
    """
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DataError(expected(name, f"numbers of shape {shape}", error)) from error
    if array.size != int(np.prod(shape)):
        raise DataError(expected(name, f"shape {shape}", array.shape))
    if not np.isfinite(array).all():
        raise DataError(expected(name, "finite numbers", "NaN or infinity"))
    return array.reshape(shape)


def _fit_path(folder: Path, index: int) -> Path:
    padded = folder / f"{index:06d}.npy"
    return padded if padded.is_file() else folder / f"{index}.npy"
