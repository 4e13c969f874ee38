"""EasyMocap's own output: SMPL parameters as JSON, cameras as ``intri.yml`` and ``extri.yml``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rsavatar.body.skinning import easymocap_to_smplx, smplx_to_easymocap
from rsavatar.data.annots import Calibration, numbers, parse_fit
from rsavatar.data.base import Array, BodyFit
from rsavatar.errors import DataError, expected


@dataclass(frozen=True)
class SmplxFit:
    """The same states in the convention of the ``smplx`` package: x_world = R (smpl(poses, shapes) - p0) + p0 + transl.

    p0 is the rest pelvis of the shaped body.
    """

    global_orient: Array  # [N, 3] axis-angle
    body_pose: Array  # [N, 69]
    transl: Array  # [N, 3] metres
    shapes: Array  # [10]


def read_frames(paths: Sequence[Path], person: int | None = None) -> BodyFit:
    """The fits of N files ``<ffffff>.json`` in the order given; shapes are averaged over them.

    A file is a list of persons or ``{"annots": [...]}``; ``person`` is the wanted ``id`` and may be None where each
    file holds one person. EasyMocap prints three decimals: 1e-3 rad, 1 mm.

    Raises:
        DataError: naming the file that is missing, is not JSON, or lacks the person.
    """
    if not paths:
        raise DataError(expected("EasyMocap files", "at least one", "none"))
    fits = [_read_frame(path, person) for path in paths]
    stacked = {name: np.concatenate([getattr(fit, name) for fit in fits]) for name in ("poses", "Rh", "Th")}
    return BodyFit(**stacked, shapes=np.mean([fit.shapes for fit in fits], axis=0))


def read_calibrations(intri: Path, extri: Path) -> dict[str, Calibration]:
    """Cameras by EasyMocap's name, from OpenCV's YAML.

    **Convention**: ``K_<name>``, ``dist_<name>`` in one file, ``Rot_<name>`` (3 x 3) or ``R_<name>`` (axis-angle) and
    ``T_<name>`` in METRES in the other; R, T take world to camera; K is for pixel centres at whole integers.

    Raises:
        DataError: if a file is missing or a matrix in it is.
    """
    inner, outer = _open_yaml(intri), _open_yaml(extri)
    try:
        names = inner.getNode("names")
        listed = [names.at(i).string() for i in range(names.size())]
        if not listed:
            raise DataError(expected(f"{intri} names", "a list of cameras", "none"))
        return {name: _calibration(name, (intri, inner), (extri, outer)) for name in listed}
    finally:
        inner.release()
        outer.release()


def to_smplx(fit: BodyFit, pelvis: Array) -> SmplxFit:
    """EasyMocap's R(Rh) x + Th as smplx's rotation about the pelvis: transl = Th + R p0 - p0.

    ``pelvis`` [3] is p0, the first rest joint of the body shaped by ``fit.shapes``, metres.
    """
    orient, transl = easymocap_to_smplx(*map(torch.from_numpy, (fit.Rh, fit.Th, pelvis)))
    return SmplxFit(orient.numpy(), fit.poses[:, 3:], transl.numpy(), fit.shapes)


def from_smplx(fit: SmplxFit, pelvis: Array) -> BodyFit:
    """The inverse of ``to_smplx``: Th = transl + p0 - R p0.

    Raises:
        DataError: on wrong shapes or non-finite values.
    """
    Rh, Th = smplx_to_easymocap(*map(torch.from_numpy, (fit.global_orient, fit.transl, pelvis)))
    poses = np.concatenate([np.zeros((len(fit.body_pose), 3)), fit.body_pose], axis=1)
    return BodyFit(poses, Rh.numpy(), Th.numpy(), fit.shapes)


def _read_frame(path: Path, person: int | None) -> BodyFit:
    try:
        held: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(expected(str(path), "a JSON file", error)) from error
    persons = held.get("annots") if isinstance(held, dict) else held
    if not isinstance(persons, list) or not all(isinstance(each, dict) for each in persons):
        raise DataError(expected(str(path), 'a list of persons or {"annots": [...]}', type(held).__name__))
    chosen = [each for each in persons if person is None or each.get("id") == person]
    if len(chosen) != 1:
        wanted = "one person" if person is None else f"one person of id {person}"
        raise DataError(expected(str(path), wanted, f"ids {[each.get('id') for each in persons]}"))
    return parse_fit(str(path), chosen[0])


def _open_yaml(path: Path) -> Any:
    if not path.is_file():
        raise DataError(expected(str(path), "a file", "nothing there"))
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:
        raise DataError(expected(str(path), "a YAML file of OpenCV", error)) from error
    if not storage.isOpened():
        raise DataError(expected(str(path), "a YAML file of OpenCV", "something else"))
    return storage


def _calibration(name: str, intri: tuple[Path, Any], extri: tuple[Path, Any]) -> Calibration:
    turned = extri[1].getNode(f"Rot_{name}").mat()
    if turned is None:
        vector = numbers(f"{extri[0]} R_{name}", extri[1].getNode(f"R_{name}").mat(), (3,))
        turned = Rotation.from_rotvec(vector).as_matrix()
    distortion = np.zeros(5) if (found := intri[1].getNode(f"dist_{name}").mat()) is None else np.ravel(found)[:5]
    return Calibration(
        matrix=numbers(f"{intri[0]} K_{name}", intri[1].getNode(f"K_{name}").mat(), (3, 3)),
        rotation=numbers(f"{extri[0]} Rot_{name}", turned, (3, 3)),
        translation=numbers(f"{extri[0]} T_{name}", extri[1].getNode(f"T_{name}").mat(), (3,)),
        distortion=numbers(f"{intri[0]} dist_{name}", distortion, (5,)),
    )
