"""CVR (Fan, Dai, Zhang, Liu, He, CVPR 2022): flow, undistortion under constant velocity, splatting, and a blend.

Written from a description of the published architecture; parameters have its authors' names, so their weights load.
Two consecutive rolling-shutter frames in, the sharp frame at any instant between their middle rows out. **Convention**:
time 0 is the first frame's middle row, 1 the second's, 0.5 the second's first row: the readout fills the frame period.
Rows are those of the whole sensor, so a crop may lose columns only.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from rsavatar.errors import DataError, expected
from rsavatar.restore.pwc import LEAK, PWCNet
from rsavatar.restore.warp import backward_warp, softmax_splat

MULTIPLE = 64  # of the input's height and width
CHANNELS = (32, 64, 128, 256, 512)
KERNELS = (7, 5, 3, 3, 3)
SHARPNESS = 20.0  # of the splatting metric: how fast a bad match loses importance
EPSILON = 1e-4  # keeps the undistortion off exactly 0


@dataclass(frozen=True, eq=False)
class Flows:
    """Motion between the two frames and what each counts for when splatted."""

    forth: Tensor  # [B, 2, H, W] frame 0 to frame 1, pixels
    back: Tensor
    forth_scale: Tensor  # [B, 1, H, W] in (0, 1); 0.5 takes the flow for the motion in one period
    back_scale: Tensor
    forth_metric: Tensor  # [B, 1, H, W]
    back_metric: Tensor


@dataclass(frozen=True, eq=False)
class Synthesis:
    """The result at one instant, not clamped, and what it was made of."""

    image: Tensor  # [B, 3, H, W]
    coarse: tuple[Tensor, Tensor]  # both frames brought there by the undistortion flows
    fine: tuple[Tensor, Tensor]  # and by the refined ones
    flows: tuple[Tensor, Tensor]  # refined, [B, 2, H, W]
    metrics: tuple[Tensor, Tensor]  # of the splatting
    weights: tuple[Tensor, Tensor]  # [B, 1, H, W] of the two in the blend

    def carried(self, first: Tensor, second: Tensor) -> Tensor:
        """Anything that belongs to the two frames [B, C, H, W], moved and blended as they were."""
        pictures = zip((first, second), self.flows, self.metrics, strict=True)
        a, b = (splat(image, flow, metric) for image, flow, metric in pictures)
        return (self.weights[0] * a + self.weights[1] * b) / (self.weights[0] + self.weights[1])


class CVR(nn.Module):
    """``motion`` once for a pair, then ``at`` for every instant.

    Args:
        width: part of the published number of channels; 1 is the published network.
        star: CVR*: without the network that corrects flows and scales.
    """

    def __init__(self, width: float = 1.0, star: bool = False) -> None:
        super().__init__()
        self.net_flow = PWCNet(width)
        self.net_scale = None if star else UNet(10, 6, width)
        self.net_syn = UNet(20, 5, width)

    def motion(self, frames: Tensor) -> Flows:
        """Flows of a pair [B, 6, H, W] in [0, 1].

        Raises:
            DataError: if the shape is wrong.
        """
        if frames.dim() != 4 or frames.shape[1] != 6 or frames.shape[2] % MULTIPLE or frames.shape[3] % MULTIPLE:
            raise DataError(expected("CVR input", f"[B, 6, H, W], multiples of {MULTIPLE}", tuple(frames.shape)))
        a, b = frames[:, :3], frames[:, 3:]
        forth, back = self.net_flow(a, b), self.net_flow(b, a)
        metrics = (_metric(a, b, forth), _metric(b, a, back))
        scales = [torch.full_like(forth[:, :1], 0.5)] * 2
        if self.net_scale is not None:
            found = self.net_scale(torch.cat([a, forth, b, back], 1))
            scales = list(found[:, :2].sigmoid().split(1, 1))
            forth, back = forth + found[:, 2:4], back + found[:, 4:6]
        return Flows(forth, back, scales[0], scales[1], *metrics)

    def at(self, frames: Tensor, flows: Flows, time: float, rows: int | None = None) -> Synthesis:
        """The sharp frame at ``time`` in [0, 1]; ``rows`` of the sensor, if the input was padded below."""
        a, b = frames[:, :3], frames[:, 3:]
        from_a, from_b = undistortion(flows, time, rows or frames.shape[2])
        coarse = (splat(a, from_a, flows.forth_metric), splat(b, from_b, flows.back_metric))
        found = self.net_syn(torch.cat([frames, flows.forth, flows.back, from_a, from_b, *coarse], 1))
        from_a, from_b = from_a + found[:, :2], from_b + found[:, 2:4]
        fine = (splat(a, from_a, flows.forth_metric), splat(b, from_b, flows.back_metric))
        late = 0.98 * time + 0.01
        visible = found[:, 4:5].sigmoid()
        weights = ((1 - late) * visible, late * (1 - visible))
        image = (weights[0] * fine[0] + weights[1] * fine[1]) / (weights[0] + weights[1])
        metrics = (flows.forth_metric, flows.back_metric)
        return Synthesis(image, coarse, fine, (from_a, from_b), metrics, weights)


def undistortion(flows: Flows, time: float, rows: int) -> tuple[Tensor, Tensor]:
    """From each row's instant to ``time``, at constant velocity: flows [B, 2, H, W] of frame 0 and of frame 1."""
    height = flows.forth.shape[2]
    row = torch.arange(height, dtype=flows.forth.dtype, device=flows.forth.device).view(1, 1, height, 1) / rows
    from_a = flows.forth * (2 * flows.forth_scale) * ((time + 0.5) - row + EPSILON)
    from_b = flows.back * (2 * flows.back_scale) * (row - (time - 0.5) + EPSILON)
    return from_a, from_b


def splat(image: Tensor, flow: Tensor, metric: Tensor) -> Tensor:
    """Softmax splatting; holes are 0."""
    return softmax_splat(image, flow, metric)[0]


def _metric(image: Tensor, other: Tensor, flow: Tensor) -> Tensor:
    difference = (image - backward_warp(other, flow)).abs().mean(1, keepdim=True)
    return -SHARPNESS * difference


class UNet(nn.Module):
    """The network of CVR's second and third stage: 23 convolutions without biases, skips are added."""

    def __init__(self, before: int, after: int, width: float = 1.0) -> None:
        super().__init__()
        channels = tuple(max(4, round(width * c)) for c in CHANNELS)
        number, last = 1, before
        for c, kernel in zip((*channels, channels[-1]), (*KERNELS, 3), strict=True):
            for inputs in (last, c):
                self.add_module(f"conv{number}", nn.Conv2d(inputs, c, kernel, 1, kernel // 2, bias=False))
                number += 1
            last = c
        for c in channels[::-1]:
            for inputs in (last, c):
                self.add_module(f"conv{number}", nn.Conv2d(inputs, c, 3, 1, 1, bias=False))
                number += 1
            last = c
        self.conv23 = nn.Conv2d(last, after, 3, 1, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """[B, before, H, W] to [B, after, H, W]."""
        skips = []
        for level, kernel in enumerate(KERNELS):
            x = self._conv(2 * level + 2, self._conv(2 * level + 1, x))
            skips.append(x)
            x = F.avg_pool2d(x, kernel, 2, kernel // 2)
        x = self._conv(12, self._conv(11, x))
        for level, skip in enumerate(reversed(skips)):
            x = F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
            x = self._conv(2 * level + 14, self._conv(2 * level + 13, x) + skip)
        out: Tensor = self.conv23(x)
        return out

    def _conv(self, number: int, x: Tensor) -> Tensor:
        return F.leaky_relu(self.get_submodule(f"conv{number}")(x), LEAK)
