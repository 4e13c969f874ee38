"""The two small networks: a residual on the pose, and an offset on the skinning weights (paper, section 3.3)."""

from __future__ import annotations

import torch
from torch import Tensor

WIDTH = 128
OCTAVES = 10


class PoseResidual(torch.nn.Module):
    """Axis-angle residual [D, 23, 3] predicted from the interpolated pose [D, 23, 3] (paper, eq. disp).

    Starts at (almost) zero: the last layer is uniform in +-1e-5. ``additive`` says how it is meant: added to the
    pose's axis-angle vectors as the paper writes it, or composed with the rotations.
    """

    def __init__(self, additive: bool = False) -> None:
        super().__init__()
        self.additive = additive
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(69, WIDTH),
            torch.nn.ReLU(),
            torch.nn.Linear(WIDTH, WIDTH),
            torch.nn.ReLU(),
            torch.nn.Linear(WIDTH, 69),
        )
        linear = [layer for layer in self.layers if isinstance(layer, torch.nn.Linear)]
        for layer in linear:
            torch.nn.init.xavier_uniform_(layer.weight, gain=torch.nn.init.calculate_gain("relu"))
            torch.nn.init.zeros_(layer.bias)
        torch.nn.init.uniform_(linear[-1].weight, -1e-5, 1e-5)

    def forward(self, pose: Tensor) -> Tensor:
        """[D, 23, 3] to [D, 23, 3], radians."""
        residual: Tensor = self.layers(pose.flatten(-2))
        return residual.reshape(pose.shape)


class SkinOffset(torch.nn.Module):
    """Offset [24, M] on the log skinning weights, from canonical positions [3, M] in metres.

    Positions are encoded as (x, sin 2^k x, cos 2^k x), k = 0..9; four hidden layers, the input again at the last one.
    The head starts at zero, so the weights start at the body's own.
    """

    frequencies: Tensor

    def __init__(self) -> None:
        super().__init__()
        encoded = 3 * (1 + 2 * OCTAVES)
        self.trunk = torch.nn.Sequential(
            torch.nn.Linear(encoded, WIDTH),
            torch.nn.ReLU(),
            torch.nn.Linear(WIDTH, WIDTH),
            torch.nn.ReLU(),
            torch.nn.Linear(WIDTH, WIDTH),
            torch.nn.ReLU(),
        )
        self.join = torch.nn.Linear(encoded + WIDTH, WIDTH)
        self.head = torch.nn.Linear(WIDTH, 24)
        torch.nn.init.zeros_(self.head.weight)
        torch.nn.init.zeros_(self.head.bias)
        self.register_buffer("frequencies", 2.0 ** torch.arange(OCTAVES), persistent=False)

    def forward(self, means: Tensor) -> Tensor:
        """[3, M] to [24, M]."""
        x = means.T
        angles = (x[:, None, :] * self.frequencies[:, None]).flatten(1)
        encoded = torch.cat([x, angles.sin(), angles.cos()], 1)
        joined = torch.relu(self.join(torch.cat([encoded, self.trunk(encoded)], 1)))
        offset: Tensor = self.head(joined)
        return offset.T


LEAST_WEIGHT = 1e-4  # refined weights under this are dropped: the renderer skips joints that nobody uses


def refine(prior: Tensor, offset: Tensor) -> Tensor:
    """Refined skinning weights [24, M]: softmax of the log prior plus ``offset`` over the joints that the prior uses.

    A joint that the body does not bind a vertex to stays unbound, so refined weights are as sparse as the prior.
    """
    weights = torch.softmax(prior.log() + offset, 0)  # log 0 is -inf: such joints get exactly 0
    weights = torch.where(weights > LEAST_WEIGHT, weights, torch.zeros_like(weights))
    return weights / weights.sum(0)
