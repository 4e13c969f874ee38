"""SMPL-format body files: .npz, and the legacy .pkl of Python 2, both read without running code."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rsavatar.body.base import JOINTS, POSE_FEATURES, SHAPES, Array, BodyModel
from rsavatar.body.unpickle import dense, load_arrays
from rsavatar.errors import BodyError, expected

_NEEDED = ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs")


def load_body(path: Path) -> BodyModel:
    """Reads a body model with SMPL's keys: v_template f weights J_regressor kintree_table shapedirs posedirs.

    **Convention**: the root's parent, whatever number stands for it (4294967295 in published files), becomes -1. Of
    more than 10 shape directions the first 10 are kept; fewer are filled with zeros. ``posedirs`` may be missing or
    all zero: then there are no pose blend shapes.

    Args:
        path: a file ending in .npz or .pkl.

    Raises:
        BodyError: if the file is missing, damaged, lacks a key, holds anything but arrays, or is no 24-joint body.
    """
    path = Path(path)
    if not path.is_file():
        raise BodyError(expected("body file", "an SMPL-format .npz or .pkl", f"no file {path}"))
    readers = {".npz": _read_npz, ".pkl": _read_pickle}
    if path.suffix not in readers:
        raise BodyError(expected(f"body file {path.name}", "a name ending in .npz or .pkl", repr(path.suffix)))
    values = readers[path.suffix](path)
    missing = [key for key in _NEEDED if key not in values]
    if missing:
        raise BodyError(
            expected(f"body file {path.name}", f"the keys {', '.join(_NEEDED)}", f"no {', '.join(missing)}")
        )
    return _body_of({key: dense(key, values[key]) for key in (*_NEEDED, "posedirs") if key in values}, path.stem)


def save_body(path: Path, body: BodyModel) -> None:
    """Writes a body as an .npz with SMPL's keys, which ``load_body`` reads back exactly (root parent 4294967295)."""
    parents = np.array([2**32 - 1, *body.parents[1:]], np.int64)
    posed = {} if body.pose_directions is None else {"posedirs": body.pose_directions}
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            v_template=body.v_template,
            f=body.faces.astype(np.uint32),
            weights=body.weights,
            J_regressor=body.joint_regressor,
            kintree_table=np.stack([parents, np.arange(JOINTS)]),
            shapedirs=body.shape_directions,
            allow_pickle=False,
            **posed,
        )


def _read_npz(path: Path) -> Mapping[str, object]:
    """The members we need; one that holds a Python object goes through the restricted unpickler."""
    values: dict[str, object] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for key in (*_NEEDED, "posedirs"):
                if f"{key}.npy" in archive.namelist():
                    values[key] = _read_member(archive, f"{key}.npy")
    except (zipfile.BadZipFile, OSError, EOFError, ValueError) as error:
        raise BodyError(expected(f"body file {path.name}", "a readable .npz", error)) from error
    return values


def _read_member(archive: zipfile.ZipFile, name: str) -> object:
    with archive.open(name) as file:
        version = np.lib.format.read_magic(file)
        header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        if version not in header:
            raise ValueError(f"{name} has .npy version {version}, expected 1.0 or 2.0")
        is_object = header[version](file)[2].hasobject
        if is_object:
            return load_arrays(file)
    with archive.open(name) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _read_pickle(path: Path) -> Mapping[str, object]:
    with path.open("rb") as file:
        values = load_arrays(file)
    if not isinstance(values, Mapping):
        raise BodyError(expected(f"body file {path.name}", "a dictionary of arrays", type(values).__name__))
    return values


def _body_of(arrays: Mapping[str, Array], name: str) -> BodyModel:
    shapes = arrays["shapedirs"]
    if shapes.ndim != 3:
        raise BodyError(expected("body shapedirs", "shape (V, 3, at least 1)", shapes.shape))
    filled = np.zeros((*shapes.shape[:2], SHAPES))
    kept = min(SHAPES, shapes.shape[2])
    filled[..., :kept] = shapes[..., :kept]
    return BodyModel(
        v_template=arrays["v_template"],
        faces=arrays["f"].astype(np.int64),
        weights=arrays["weights"],
        joint_regressor=arrays["J_regressor"],
        parents=_parents_of(arrays["kintree_table"]),
        shape_directions=filled,
        pose_directions=_pose_directions_of(arrays.get("posedirs")),
        name=name,
    )


def _parents_of(table: Array) -> tuple[int, ...]:
    """Parents by column from the rows (parent's id, own id); the root is the first column."""
    if table.shape != (2, JOINTS):
        raise BodyError(expected("body kintree_table", f"shape (2, {JOINTS})", table.shape))
    column = {int(joint): j for j, joint in enumerate(table[1])}
    unknown = [int(parent) for parent in table[0, 1:] if int(parent) not in column]
    if unknown:
        raise BodyError(expected("body kintree_table", f"parents among {sorted(column)}", unknown))
    return (-1, *(column[int(parent)] for parent in table[0, 1:]))


def _pose_directions_of(directions: Array | None) -> Array | None:
    """[V, 3, 207], or None for a model whose pose blend shapes are missing or all zero."""
    if directions is None or not directions.any():
        return None
    if directions.ndim != 3 or directions.shape[2] != POSE_FEATURES:
        raise BodyError(expected("body posedirs", f"shape (V, 3, {POSE_FEATURES})", directions.shape))
    return directions
