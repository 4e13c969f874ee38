"""Pinhole cameras, OpenCV axes (x right, y down, z forward).

**Convention**: pixel centres lie at half integers, so the first pixel's centre is (0.5, 0.5) and the image spans
[0, W] x [0, H]. Data whose K is for centres at whole integers (OpenCV's own convention) has 0.5 added to cx
and cy on loading.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rsavatar.errors import DataError, expected

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A calibrated pinhole camera: ``x_cam = rotation @ x_world + translation``, metres; focal lengths in pixels.

    Raises:
        DataError: if a value is not finite, a focal length or a size is not positive, or ``rotation`` is no rotation.
    """

    rotation: Array  # [3, 3]
    translation: Array  # [3], metres
    fx: float
    fy: float
    cx: float
    cy: float
    height: int
    width: int

    def __post_init__(self) -> None:
        if self.rotation.shape != (3, 3) or self.translation.shape != (3,):
            shapes = f"{self.rotation.shape} and {self.translation.shape}"
            raise DataError(expected("camera rotation and translation", "shapes (3, 3) and (3,)", shapes))
        numbers = np.concatenate([self.rotation.ravel(), self.translation, [self.fx, self.fy, self.cx, self.cy]])
        if not np.isfinite(numbers).all():
            raise DataError(expected("camera", "finite numbers", numbers))
        if min(self.fx, self.fy) <= 0 or min(self.height, self.width) <= 0:
            raise DataError(expected("camera focal lengths and size", "positive numbers", self))
        error = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        if error > 1e-3 or np.linalg.det(self.rotation) < 0:
            wanted = "an orthonormal matrix of determinant 1"
            raise DataError(expected("camera rotation", wanted, self.rotation.tolist()))

    @property
    def centre(self) -> Array:
        """Position in the world [3], metres."""
        return -self.rotation.T @ self.translation

    def cropped(self, x0: int, y0: int, x1: int, y1: int) -> Camera:
        """The same camera seeing only columns [x0, x1) and rows [y0, y1)."""
        return replace(self, cx=self.cx - x0, cy=self.cy - y0, width=x1 - x0, height=y1 - y0)

    def turned(self) -> Camera:
        """The same camera held a quarter turn aside: its picture is this one's, turned clockwise (``np.rot90(p, -1)``).

        Columns, from the left, become rows, from the top.
        """
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return Camera(
            quarter @ self.rotation,
            quarter @ self.translation,
            fx=self.fy,
            fy=self.fx,
            cx=self.height - self.cy,
            cy=self.cx,
            height=self.width,
            width=self.height,
        )

    def scaled(self, factor: float) -> Camera:
        """The same camera with pixels ``1 / factor`` times as large."""
        return replace(
            self,
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=self.cx * factor,
            cy=self.cy * factor,
            height=round(self.height * factor),
            width=round(self.width * factor),
        )

    def project(self, points: Array) -> tuple[Array, Array]:
        """World points [..., 3] to pixels [..., 2] and depths [...] (metres; negative behind the camera)."""
        local = points @ self.rotation.T + self.translation
        depth = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = self.fx * local[..., 0] / depth + self.cx
            v = self.fy * local[..., 1] / depth + self.cy
        return np.stack([u, v], -1), depth
