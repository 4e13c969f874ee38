"""The body model: one mesh, 24 joints, linear blend shapes and skinning weights in SMPL's format."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from rsavatar.errors import BodyError, expected

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

JOINTS = 24
SHAPES = 10
POSE_FEATURES = 9 * (JOINTS - 1)
WEIGHT_TOLERANCE = 1e-4  # published files store weights in 32 bits and round them to 4 to 6 digits


@dataclass(frozen=True, eq=False)
class BodyModel:
    """A mesh in its rest (T) pose with everything that moves it.

    **Convention**: metres, y up, x to the body's left, facing +z, as SMPL's own files. ``parents[0] == -1`` is the
    root (pelvis) and every parent comes before its children. ``pose_directions`` is None where the model has none.

    Raises:
        BodyError: on a wrong shape, a non-finite number, a face outside the mesh, weights that are negative or do not
            sum to 1 within ``WEIGHT_TOLERANCE``, or parents out of order.
    """

    v_template: Array  # [V, 3] metres
    faces: Indices  # [F, 3]
    weights: Array  # [V, 24]
    joint_regressor: Array  # [24, V]
    parents: tuple[int, ...]  # (24,)
    shape_directions: Array  # [V, 3, 10] metres per unit
    pose_directions: Array | None  # [V, 3, 207] metres per unit of (R_j - I)
    name: str

    def __post_init__(self) -> None:
        self._check_shapes()
        self._check_values()

    def _check_shapes(self) -> None:
        V = len(self.v_template)
        wanted: dict[str, tuple[int, ...]] = {
            "v_template": (V, 3),
            "faces": (len(self.faces), 3),
            "weights": (V, JOINTS),
            "joint_regressor": (JOINTS, V),
            "shape_directions": (V, 3, SHAPES),
        }
        if self.pose_directions is not None:
            wanted["pose_directions"] = (V, 3, POSE_FEATURES)
        for name, shape in wanted.items():
            value: npt.NDArray[np.generic] = getattr(self, name)
            if value.shape != shape:
                raise BodyError(expected(f"body {name}", f"shape {shape}", value.shape))
            if not np.isfinite(value).all():
                raise BodyError(expected(f"body {name}", "finite numbers", "NaN or infinity"))

    def _check_values(self) -> None:
        if self.faces.size and not 0 <= self.faces.min() <= self.faces.max() < self.vertices:
            span = f"[{self.faces.min()}, {self.faces.max()}]"
            raise BodyError(expected("body faces", f"vertex indices in [0, {self.vertices})", span))
        error = float(np.abs(self.weights.sum(1) - 1).max(initial=0.0))
        if error > WEIGHT_TOLERANCE or self.weights.min(initial=0.0) < -WEIGHT_TOLERANCE:
            wanted = f"weights of at least 0 that sum to 1 within {WEIGHT_TOLERANCE}"
            raise BodyError(expected("body weights", wanted, f"error {error:.3g}, least {self.weights.min():.3g}"))
        ordered = all(0 <= parent < j for j, parent in enumerate(self.parents) if j > 0)
        if len(self.parents) != JOINTS or self.parents[0] != -1 or not ordered:
            raise BodyError(expected("body parents", "24 of them, -1 first, each before its children", self.parents))

    @property
    def vertices(self) -> int:
        """V, the number of vertices."""
        return len(self.v_template)

    @cached_property
    def joint_template(self) -> Array:
        """Rest joints [24, 3] of the mean shape, metres."""
        return self.joint_regressor @ self.v_template

    @cached_property
    def joint_directions(self) -> Array:
        """Derivative [24, 3, 10] of the rest joints by the shape coefficients, metres per unit."""
        flat = self.joint_regressor @ self.shape_directions.reshape(self.vertices, -1)
        return flat.reshape(JOINTS, 3, SHAPES)

    @cached_property
    def sha256(self) -> str:
        """Digest of all numbers of the model, 64 hexadecimal digits; the name does not enter."""
        digest = hashlib.sha256(repr(self.parents).encode())
        arrays = (self.v_template, self.faces, self.weights, self.joint_regressor, self.shape_directions)
        for array in (*arrays, self.pose_directions):
            digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def shaped(self, shapes: Array) -> Array:
        """Rest vertices [V, 3] of shape coefficients [10], metres, without pose blend shapes."""
        return self.v_template + self.shape_directions @ shapes

    def rest_joints(self, shapes: Array) -> Array:
        """Rest joints [24, 3] of shape coefficients [10], metres: the regressor applied to ``shaped``."""
        return self.joint_template + self.joint_directions @ shapes
