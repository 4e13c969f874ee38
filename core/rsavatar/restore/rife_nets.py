"""The two networks of RIFE (Huang et al., ECCV 2022): IFNet with refinement, and IFNet of version 4.6.

Modules are named as in the authors' files, so that their state dictionaries fit. **Convention**: pictures [B, 3, H, W]
in 0..1, H and W multiples of 32; a flow [B, 4, H, W] leads, in pixels, from the wanted instant to the first picture
(channels 0, 1) and to the second (2, 3); ``share`` [B, 1, H, W] is the first picture's part in 0..1.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from rsavatar.restore.warp import backward_warp

WIDTH = 16  # channels of the context network's first level


@dataclass(frozen=True)
class Between:
    """The picture between two others, and how it was made of them."""

    picture: Tensor  # [B, 3, H, W]
    flow: Tensor  # [B, 4, H, W]
    share: Tensor  # [B, 1, H, W]

    def blend(self, first: Tensor, second: Tensor) -> Tensor:
        """Anything else that the two pictures hold [B, C, H, W], moved and blended as their colours were."""
        return _blend(first, second, self.flow, self.share)


class IFNet(nn.Module):
    """The network of the paper: the instant half-way. 10.07 million parameters; the teacher is for training only."""

    def __init__(self) -> None:
        super().__init__()
        self.block0 = _Block(6, 240)
        self.block1 = _Block(13 + 4, 150)
        self.block2 = _Block(13 + 4, 90)
        self.contextnet = _Context()
        self.unet = _Unet()

    def forward(self, first: Tensor, second: Tensor) -> Between:
        """The picture half-way between two."""
        flow, mask = self.block0(torch.cat([first, second], 1), None, 4)
        for block, scale in ((self.block1, 2), (self.block2, 1)):
            seen = [first, second, *_moved(first, second, flow), mask]
            more_flow, more_mask = block(torch.cat(seen, 1), flow, scale)
            flow, mask = flow + more_flow, mask + more_mask
        share = mask.sigmoid()
        contexts = self.contextnet(first, flow[:, :2]), self.contextnet(second, flow[:, 2:])
        everything = torch.cat([first, second, *_moved(first, second, flow), mask, flow], 1)
        residual = 2 * self.unet(everything, *contexts) - 1
        return Between((_blend(first, second, flow, share) + residual).clamp(0, 1), flow, share)


class IFNetV4(nn.Module):
    """Version 4.6: any instant, no refinement."""

    def __init__(self) -> None:
        super().__init__()
        self.block0 = _BlockV4(7, 192)
        self.block1 = _BlockV4(8 + 4, 128)
        self.block2 = _BlockV4(8 + 4, 96)
        self.block3 = _BlockV4(8 + 4, 64)

    def forward(self, first: Tensor, second: Tensor, time: float) -> Between:
        """The picture at ``time`` in 0..1."""
        instant = torch.full_like(first[:, :1], time)
        flow, mask = self.block0(torch.cat([first, second, instant], 1), None, 8)
        for block, scale in ((self.block1, 4), (self.block2, 2), (self.block3, 1)):
            seen = torch.cat([*_moved(first, second, flow), instant, mask], 1)
            more_flow, more_mask = block(seen, flow, scale)
            flow, mask = flow + more_flow, mask + more_mask
        share = mask.sigmoid()
        return Between(_blend(first, second, flow, share), flow, share)


class _Block(nn.Module):
    """Flow and mask at 1 / (4 scale) of the picture's size."""

    def __init__(self, given: int, width: int) -> None:
        super().__init__()
        self.conv0 = nn.Sequential(_conv(given, width // 2, 2), _conv(width // 2, width, 2))
        self.convblock = nn.Sequential(*(_conv(width, width) for _ in range(8)))
        self.lastconv = nn.ConvTranspose2d(width, 5, 4, 2, 1)

    def forward(self, seen: Tensor, flow: Tensor | None, scale: int) -> tuple[Tensor, Tensor]:
        features = self.conv0(_shrunk(seen, flow, scale))
        found = _resized(self.lastconv(self.convblock(features) + features), 2 * scale)
        return found[:, :4] * (2 * scale), found[:, 4:]


class _BlockV4(nn.Module):
    def __init__(self, given: int, width: int) -> None:
        super().__init__()
        self.conv0 = nn.Sequential(_leaky(given, width // 2), _leaky(width // 2, width))
        self.convblock = nn.Sequential(*(_Residual(width) for _ in range(8)))
        self.lastconv = nn.Sequential(nn.ConvTranspose2d(width, 4 * 6, 4, 2, 1), nn.PixelShuffle(2))

    def forward(self, seen: Tensor, flow: Tensor | None, scale: int) -> tuple[Tensor, Tensor]:
        features = self.convblock(self.conv0(_shrunk(seen, flow, scale)))
        found = _resized(self.lastconv(features), scale)
        return found[:, :4] * scale, found[:, 4:5]


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(width, width, 3, 1, 1)
        self.beta = nn.Parameter(torch.ones(1, width, 1, 1))
        self.relu = nn.LeakyReLU(0.2)

    def forward(self, features: Tensor) -> Tensor:
        out: Tensor = self.relu(self.conv(features) * self.beta + features)
        return out


class _Pair(nn.Module):
    """Two convolutions, the first of stride 2."""

    def __init__(self, given: int, width: int) -> None:
        super().__init__()
        self.conv1 = _conv(given, width, 2)
        self.conv2 = _conv(width, width)

    def forward(self, features: Tensor) -> Tensor:
        out: Tensor = self.conv2(self.conv1(features))
        return out


class _Context(nn.Module):
    """Features of one picture at four sizes, each moved along the flow."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = _Pair(3, WIDTH)
        self.conv2 = _Pair(WIDTH, 2 * WIDTH)
        self.conv3 = _Pair(2 * WIDTH, 4 * WIDTH)
        self.conv4 = _Pair(4 * WIDTH, 8 * WIDTH)

    def forward(self, picture: Tensor, flow: Tensor) -> list[Tensor]:
        out = []
        for level in (self.conv1, self.conv2, self.conv3, self.conv4):
            picture = level(picture)
            flow = _resized(flow, 0.5) * 0.5
            out.append(backward_warp(picture, flow))
        return out


class _Unet(nn.Module):
    """What the blend of two moved pictures lacks, in 0..1."""

    def __init__(self) -> None:
        super().__init__()
        self.down0 = _Pair(17, 2 * WIDTH)
        self.down1 = _Pair(4 * WIDTH, 4 * WIDTH)
        self.down2 = _Pair(8 * WIDTH, 8 * WIDTH)
        self.down3 = _Pair(16 * WIDTH, 16 * WIDTH)
        self.up0 = _deconv(32 * WIDTH, 8 * WIDTH)
        self.up1 = _deconv(16 * WIDTH, 4 * WIDTH)
        self.up2 = _deconv(8 * WIDTH, 2 * WIDTH)
        self.up3 = _deconv(4 * WIDTH, WIDTH)
        self.conv = nn.Conv2d(WIDTH, 3, 3, 1, 1)

    def forward(self, seen: Tensor, first: list[Tensor], second: list[Tensor]) -> Tensor:
        s0 = self.down0(seen)
        s1 = self.down1(torch.cat([s0, first[0], second[0]], 1))
        s2 = self.down2(torch.cat([s1, first[1], second[1]], 1))
        s3 = self.down3(torch.cat([s2, first[2], second[2]], 1))
        up = self.up0(torch.cat([s3, first[3], second[3]], 1))
        up = self.up1(torch.cat([up, s2], 1))
        up = self.up2(torch.cat([up, s1], 1))
        up = self.up3(torch.cat([up, s0], 1))
        return torch.sigmoid(self.conv(up))


def _conv(given: int, width: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(given, width, 3, stride, 1), nn.PReLU(width))


def _leaky(given: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(given, width, 3, 2, 1), nn.LeakyReLU(0.2))


def _deconv(given: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.ConvTranspose2d(given, width, 4, 2, 1), nn.PReLU(width))


def _shrunk(seen: Tensor, flow: Tensor | None, scale: int) -> Tensor:
    """What a block sees, ``scale`` times smaller; a flow's pixels shrink with the picture's."""
    small = _resized(seen, 1 / scale)
    return small if flow is None else torch.cat([small, _resized(flow, 1 / scale) / scale], 1)


def _resized(values: Tensor, factor: float) -> Tensor:
    if factor == 1:
        return values
    return interpolate(values, scale_factor=factor, mode="bilinear", align_corners=False, recompute_scale_factor=False)


def _moved(first: Tensor, second: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
    return backward_warp(first, flow[:, :2]), backward_warp(second, flow[:, 2:])


def _blend(first: Tensor, second: Tensor, flow: Tensor, share: Tensor) -> Tensor:
    from_first, from_second = _moved(first, second, flow)
    return share * from_first + (1 - share) * from_second
