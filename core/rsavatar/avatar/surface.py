"""The rest body as the Gaussians see it: vertices to be near to, and what those vertices know."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from rsavatar.body.base import BodyModel
from rsavatar.body.skinning import pose_feature
from rsavatar.geometry.rotations import exp_so3

Array = npt.NDArray[np.float64]


class Surface:
    """The body in its rest pose at the initial shape: canonical space (paper, section 3.1).

    ``vertices`` [V, 3] metres; ``weights`` [24, V]; ``shape_directions`` [10, 3, V] metres per unit.
    """

    def __init__(self, body: BodyModel, shapes: Array) -> None:
        self.body = body
        self.shapes = torch.from_numpy(shapes).float()
        self.vertices: Array = body.shaped(shapes)
        self.weights = torch.from_numpy(body.weights.T.copy()).float()
        self.shape_directions = torch.from_numpy(body.shape_directions.transpose(2, 1, 0).copy()).float()
        self._pose_directions = None if body.pose_directions is None else torch.from_numpy(body.pose_directions).float()
        self._tree = cKDTree(self.vertices)

    def nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Nearest vertex [M] to each of ``points`` [3, M], and its distance [M] in metres."""
        distance, vertex = self._tree.query(points.detach().double().T.numpy())
        return torch.from_numpy(np.asarray(vertex, np.int64)), torch.from_numpy(np.asarray(distance)).float()

    def spacing(self) -> Tensor:
        """Root mean squared distance [V] of each vertex to its three nearest neighbours, metres, at least 0.3 mm."""
        distance: Array = np.asarray(self._tree.query(self.vertices, k=4)[0])
        mean = np.sqrt(np.square(distance[:, 1:]).mean(1))
        return torch.from_numpy(np.maximum(mean, 3e-4)).float()

    def pose_offsets(self, poses: Array) -> Tensor | None:
        """Pose blend shapes [N, 3, V] of local poses [N, 72], metres; None for a body that has none."""
        if self._pose_directions is None:
            return None
        features = pose_feature(exp_so3(torch.from_numpy(poses.reshape(-1, 24, 3)))).float()
        return torch.stack([(self._pose_directions @ feature).T for feature in features])
