"""Random but valid bodies in SMPL's file format."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from rsavatar.body.base import BodyModel
from rsavatar.body.smpl import load_body, save_body

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)


def smpl_arrays(seed: int = 0, vertices: int = 60, shapes: int = 10) -> dict[str, Any]:
    """A cloud of vertices with SMPL's keys and SMPL's own way of writing them: sparse regressor, unsigned root."""
    rng = np.random.default_rng(seed)
    regressor = rng.random((24, vertices)) * (rng.random((24, vertices)) < 0.2) + np.eye(24, vertices)
    weights = rng.random((vertices, 24)) ** 4
    root = np.array([2**32 - 1, *PARENTS[1:]], np.uint32)
    return {
        "v_template": rng.normal((0.1, -0.2, 0.05), 0.5, (vertices, 3)),
        "f": rng.integers(0, vertices, (2 * vertices, 3)).astype(np.uint32),
        "weights": weights / weights.sum(1, keepdims=True),
        "J_regressor": scipy.sparse.csc_matrix(regressor / regressor.sum(1, keepdims=True)),
        "kintree_table": np.stack([root, np.arange(24, dtype=np.uint32)]),
        "shapedirs": rng.normal(0, 0.05, (vertices, 3, shapes)),
        "posedirs": rng.normal(0, 0.02, (vertices, 3, 207)),
    }


def write_pickle(path: Path, arrays: object, protocol: int = 2) -> Path:
    """The arrays as a pickle."""
    path.write_bytes(pickle.dumps(arrays, protocol=protocol))
    return path


def synthetic_body(folder: Path, seed: int = 0) -> BodyModel:
    """A body that has gone through a file."""
    return load_body(write_pickle(folder / f"body-{seed}.pkl", smpl_arrays(seed)))


def saved(path: Path, body: BodyModel) -> Path:
    """The body as an .npz."""
    save_body(path, body)
    return path
