"""PWC-Net with dense connections (Sun, Yang, Liu, Kautz, CVPR 2018): the flow network inside CVR, in plain torch.

Written from a description of the published architecture; parameters have its authors' names, so their weights load.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from rsavatar.errors import DataError, expected

PYRAMID = (16, 32, 64, 96, 128, 196)  # channels of levels 1 (half resolution) to 6
DECODER = (128, 128, 96, 64, 32)
CONTEXT = ((128, 1), (128, 2), (128, 4), (96, 8), (64, 16), (32, 1))  # channels, dilation
REACH = 4  # pixels that the correlation looks to each side
MULTIPLE = 64
UNIT = 20.0  # pixels of full resolution in a unit of the network's flow
WARP_SCALE = {5: 0.625, 4: 1.25, 3: 2.5, 2: 5.0}  # pixels of a level in a unit of flow
LEAK = 0.1


def correlation(a: Tensor, b: Tensor, reach: int = REACH) -> Tensor:
    """Mean over channels of a(p) b(p + d) for every displacement d, black outside; differentiable in both.

    **Convention**: channels run over d = (dy, dx) in [-reach, reach]^2, dy slowest.

    Args:
        a, b: [B, C, h, w].
        reach: largest displacement along an axis, pixels.

    Returns:
        [B, (2 reach + 1)^2, h, w].
    """
    height, width = a.shape[2:]
    around = F.pad(b, [reach] * 4)
    steps = range(2 * reach + 1)
    return torch.cat(
        [(a * around[:, :, y : y + height, x : x + width]).mean(1, keepdim=True) for y in steps for x in steps], 1
    )


def masked_warp(features: Tensor, flow: Tensor) -> Tensor:
    """Fetches features [B, C, h, w] along a flow [B, 2, h, w], 0 where any of what is fetched lies outside.

    **Convention**: places are brought to [-1, 1] over w - 1 and read over w, as the published weights were trained:
    half a pixel off at the borders, nothing in the middle.
    """
    height, width = features.shape[2:]
    y, x = torch.meshgrid(
        torch.arange(height, dtype=flow.dtype, device=flow.device),
        torch.arange(width, dtype=flow.dtype, device=flow.device),
        indexing="ij",
    )
    along = 2 * (x + flow[:, 0]) / max(width - 1, 1) - 1
    down = 2 * (y + flow[:, 1]) / max(height - 1, 1) - 1
    grid = torch.stack([along, down], -1)
    fetched = F.grid_sample(features, grid, align_corners=False)
    inside = F.grid_sample(torch.ones_like(features[:, :1]), grid, align_corners=False)
    return fetched * (inside > 0.9999).to(fetched.dtype)


def convolution(before: int, after: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """3 x 3 with a leaky ReLU; parameters are called ``0.weight`` and ``0.bias``."""
    return nn.Sequential(nn.Conv2d(before, after, 3, stride, dilation, dilation), nn.LeakyReLU(LEAK))


class PWCNet(nn.Module):
    """``forward``: two images [B, 3, H, W] in [0, 1] to where each pixel of the first is in the second.

    Args:
        width: part of the published number of channels; 1 is the published network.
    """

    def __init__(self, width: float = 1.0) -> None:
        super().__init__()
        pyramid, self.dense = (tuple(max(4, round(width * c)) for c in table) for table in (PYRAMID, DECODER))
        before = 3
        for level, after in enumerate(pyramid, 1):
            names = ("a", "aa", "b") if level < 6 else ("aa", "a", "b")
            for k, name in enumerate(names):
                self.add_module(f"conv{level}{name}", convolution(before if k == 0 else after, after, 2 - (k > 0)))
            before = after
        for level in range(6, 1, -1):
            inputs = (2 * REACH + 1) ** 2 + (pyramid[level - 1] + 4 if level < 6 else 0)
            for k, after in enumerate(self.dense):
                self.add_module(f"conv{level}_{k}", convolution(inputs, after))
                inputs += after
            self.add_module(f"predict_flow{level}", nn.Conv2d(inputs, 2, 3, 1, 1))
            self.add_module(f"deconv{level}", nn.ConvTranspose2d(2, 2, 4, 2, 1))
            if level > 2:
                self.add_module(f"upfeat{level}", nn.ConvTranspose2d(inputs, 2, 4, 2, 1))
        for k, (after, dilation) in enumerate(CONTEXT, 1):
            narrow = max(4, round(width * after))
            self.add_module(f"dc_conv{k}", convolution(inputs, narrow, 1, dilation))
            inputs = narrow
        self.dc_conv7 = nn.Conv2d(inputs, 2, 3, 1, 1)

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Flow [B, 2, H, W], pixels, (x, y).

        Raises:
            DataError: if the size is not a multiple of 64.
        """
        finest = self.levels(first, second)[-1]
        return 4 * F.interpolate(finest, scale_factor=4.0, mode="bilinear", align_corners=False)

    def levels(self, first: Tensor, second: Tensor) -> list[Tensor]:
        """The flows of levels 6 to 2 (a 64th to a quarter of the resolution), each in pixels of its own level.

        Raises:
            DataError: if the size is not a multiple of 64.
        """
        if first.shape != second.shape or first.shape[2] % MULTIPLE or first.shape[3] % MULTIPLE:
            got = (tuple(first.shape), tuple(second.shape))
            raise DataError(expected("PWC-Net input", f"two [B, 3, H, W], multiples of {MULTIPLE}", got))
        mine, others = self._pyramid(first), self._pyramid(second)
        hidden = self._dense(6, F.leaky_relu(correlation(mine[6], others[6]), LEAK))
        found = []
        for level in range(5, 1, -1):
            coarse = self._part(f"predict_flow{level + 1}", hidden)
            found.append(coarse * (UNIT / 2 ** (level + 1)))
            flow = self._part(f"deconv{level + 1}", coarse)
            feature = self._part(f"upfeat{level + 1}", hidden)
            fetched = masked_warp(others[level], flow * WARP_SCALE[level])
            cost = F.leaky_relu(correlation(mine[level], fetched), LEAK)
            hidden = self._dense(level, torch.cat([cost, mine[level], flow, feature], 1))
        finest = self._part("predict_flow2", hidden) + self._context(hidden)
        return [*found, finest * (UNIT / 4)]

    def _pyramid(self, image: Tensor) -> dict[int, Tensor]:
        found: dict[int, Tensor] = {}
        x = image
        for level in range(1, 7):
            for name in ("a", "aa", "b") if level < 6 else ("aa", "a", "b"):
                x = self._part(f"conv{level}{name}", x)
            found[level] = x
        return found

    def _dense(self, level: int, x: Tensor) -> Tensor:
        for k in range(len(self.dense)):
            x = torch.cat([self._part(f"conv{level}_{k}", x), x], 1)
        return x

    def _context(self, x: Tensor) -> Tensor:
        for k in range(1, 8):
            x = self._part(f"dc_conv{k}", x)
        return x

    def _part(self, name: str, x: Tensor) -> Tensor:
        out: Tensor = self.get_submodule(name)(x)
        return out
