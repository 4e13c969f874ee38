"""JAMNet (Fan, Mao, Dai, CVPR 2023): one network that finds motion and picture together, coarse to fine.

Written from a description of the published architecture; parameters have its authors' names (``decorder`` is
theirs), so their checkpoints load. Two consecutive rolling-shutter frames in, the sharp frame at the second one's
middle row out.
**Convention**: the readout fills the frame period; rows are those of the whole sensor, so a crop may lose columns only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from rsavatar.errors import DataError, expected
from rsavatar.restore.warp import backward_warp

CHANNELS = (16, 28, 40, 64, 96)  # of the encoder's levels, fine to coarse
MULTIPLE = 16  # of the input's height and width
LEVELS = ("2nd", "3rd", "4nd", "5nd")  # the levels with a flow, fine to coarse
FFN_BIAS = "transformer.layers.0.cross_attn_ffn.mlp.0.bias"


def channels_of(width: float) -> tuple[int, ...]:
    """Channels of the encoder at a part of the published width, in fours."""
    return tuple(max(4, 4 * round(width * c / 4)) for c in CHANNELS) if width != 1 else CHANNELS


@dataclass(frozen=True, eq=False)
class Motion:
    """What a level believes. ``flow`` [B, 4, h, w]: pixels of this level in a frame period, for frame 0, then 1, (x, y)
    each; ``moved`` is the same brought to each row's distance from the target, along which frames are fetched.
    """

    flow: Tensor
    moved: Tensor
    image: Tensor  # [B, 3, h, w]


@dataclass(frozen=True, eq=False)
class Restored:
    """The result, not clamped, and what every level with a flow made, fine (half resolution) to coarse."""

    image: Tensor  # [B, 3, H, W]
    moved: Tensor  # [B, 4, H, W] pixels: where frame 0 and frame 1 show what the result shows
    levels: tuple[Motion, ...]


class JAMNet(nn.Module):
    """``forward``: two frames [B, 6, H, W] in [0, 1] to ``Restored``.

    Args:
        width: part of the published number of channels; 1 is the published network.
        ffn_bias: whether the transformer's feed-forward layers have biases.
    """

    def __init__(self, width: float = 1.0, ffn_bias: bool = True) -> None:
        super().__init__()
        c = channels_of(width)
        self.encoder = Encoder(c)
        self.transformer = Transformer(c[4], ffn_bias)
        self.decorder_5nd = TopDecoder(2 * c[4])
        self.decorder_4nd = Decoder(2 * c[4], c[3], 2 * c[3])
        self.decorder_3rd = Decoder(2 * c[3], c[2], 2 * c[2])
        self.decorder_2nd = Decoder(2 * c[2], c[1], 2 * c[1])
        self.decorder_1st = Decoder(2 * c[1], 3, 6, last=True)

    def forward(self, frames: Tensor, rows: int | None = None) -> Restored:
        """See the class; ``rows`` of the sensor, if the input was padded below.

        Raises:
            DataError: if the shape is wrong.
        """
        if frames.dim() != 4 or frames.shape[1] != 6 or frames.shape[2] % MULTIPLE or frames.shape[3] % MULTIPLE:
            raise DataError(expected("JAMNet input", f"[B, 6, H, W], multiples of {MULTIPLE}", tuple(frames.shape)))
        share = (rows or frames.shape[2]) / frames.shape[2]
        both = torch.cat([frames[:, :3], frames[:, 3:]])
        features = self.encoder(both)
        top = self.transformer(features[4])
        hidden, motion = self.decorder_5nd(torch.cat(top.chunk(2), 1), share)
        levels = [motion]
        for decoder, feature in ((self.decorder_4nd, 3), (self.decorder_3rd, 2), (self.decorder_2nd, 1)):
            hidden, motion = decoder(hidden, motion, features[feature], share)
            levels.insert(0, motion)
        _, last = self.decorder_1st(hidden, motion, both, share)
        return Restored(last.image, last.moved, tuple(levels))


def row_offsets(height: int, share: float, like: Tensor) -> Tensor:
    """Time [1, 1, height, 1] of every row in frame periods after the middle row's: never exactly 0, as published.

    ``share`` of the height is the sensor's, the rest is padding below.
    """
    rows = torch.arange(height, dtype=like.dtype, device=like.device)
    sensor = share * height
    return ((rows - sensor // 2) / sensor + 1e-4).view(1, 1, height, 1)


def moved_to_target(flow: Tensor, share: float = 1.0) -> Tensor:
    """Flow a frame period [B, 4, h, w] to the way from the target to each frame's own instant of the row."""
    late = row_offsets(flow.shape[2], share, flow)
    return torch.cat([flow[:, :2] * (1 - late), flow[:, 2:] * -late], 1)


class Conv(nn.Module):
    """Convolution that keeps the size, or halves it; ``net.0`` is the convolution."""

    def __init__(self, before: int, after: int, size: int = 3, stride: int = 1, act: nn.Module | None = None) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(before, after, size, stride, size // 2)]
        self.net = nn.Sequential(*layers, *([act] if act else []))

    def forward(self, x: Tensor) -> Tensor:
        """[B, before, h, w] to [B, after, h / stride, w / stride]."""
        out: Tensor = self.net(x)
        return out


class ResidualBlock(nn.Module):
    """x + conv(relu(conv(x)))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv_block = nn.Sequential(Conv(channels, channels, act=nn.ReLU()), Conv(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        """The same shape."""
        out: Tensor = x + self.conv_block(x)
        return out


class ResidualBlocks(nn.Module):
    """Residual blocks in a row."""

    def __init__(self, channels: int, count: int) -> None:
        super().__init__()
        self.net = nn.Sequential(*(ResidualBlock(channels) for _ in range(count)))

    def forward(self, x: Tensor) -> Tensor:
        """The same shape."""
        out: Tensor = self.net(x)
        return out


class Encoder(nn.Module):
    """Features of each frame on five levels, from full resolution to a sixteenth."""

    def __init__(self, channels: tuple[int, ...]) -> None:
        super().__init__()
        before = 3
        for level, after in enumerate(channels):
            size, stride = (7, 1) if level == 0 else (3, 2)
            self.add_module(f"conv{level}", Conv(before, after, size, stride, nn.PReLU()))
            self.add_module(f"resblocks{level}", ResidualBlocks(after, 1))
            before = after

    def forward(self, x: Tensor) -> list[Tensor]:
        """[B, 3, H, W] to features, fine to coarse."""
        found = []
        for level in range(len(CHANNELS)):
            x = self.get_submodule(f"resblocks{level}")(self.get_submodule(f"conv{level}")(x))
            found.append(x)
        return found


class Attention(nn.Module):
    """Single-head attention with a residual; with a feed-forward layer where ``ffn``."""

    def __init__(self, channels: int, ffn: bool, bias: bool) -> None:
        super().__init__()
        self.q_proj, self.k_proj, self.v_proj, self.merge = (
            nn.Linear(channels, channels, bias=False) for _ in range(4)
        )
        self.norm1 = nn.LayerNorm(channels)
        self.ffn = ffn
        if ffn:
            wide = 4 * channels
            self.mlp = nn.Sequential(
                nn.Linear(2 * channels, wide, bias=bias), nn.GELU(), nn.Linear(wide, channels, bias=bias)
            )
            self.norm2 = nn.LayerNorm(channels)

    def forward(self, source: Tensor, target: Tensor) -> Tensor:
        """What ``source`` [B, L, C] learns from ``target`` [B, L, C]."""
        query, key, value = self.q_proj(source), self.k_proj(target), self.v_proj(target)
        message = self.norm1(self.merge(F.scaled_dot_product_attention(query, key, value)))
        if self.ffn:
            message = self.norm2(self.mlp(torch.cat([source, message], -1)))
        out: Tensor = source + message
        return out


class TransformerLayer(nn.Module):
    """Each frame looks at itself, then at the other."""

    def __init__(self, channels: int, bias: bool) -> None:
        super().__init__()
        self.self_attn = Attention(channels, ffn=False, bias=bias)
        self.cross_attn_ffn = Attention(channels, ffn=True, bias=bias)

    def forward(self, both: Tensor) -> Tensor:
        """Tokens [2 B, L, C]; the second half of the batch are the second frames."""
        both = self.self_attn(both, both)
        out: Tensor = self.cross_attn_ffn(both, torch.cat(both.chunk(2)[::-1]))
        return out


class Transformer(nn.Module):
    """Full attention over the coarsest features, with sine positions."""

    def __init__(self, channels: int, bias: bool) -> None:
        super().__init__()
        self.layers = nn.ModuleList([TransformerLayer(channels, bias)])

    def forward(self, x: Tensor) -> Tensor:
        """[2 B, C, h, w] to the same."""
        height, width = x.shape[2:]
        tokens = (x + sine_positions(x)).flatten(2).transpose(1, 2)
        for layer in self.layers:
            tokens = layer(tokens)
        return tokens.transpose(1, 2).reshape(len(x), -1, height, width)


def sine_positions(x: Tensor, temperature: float = 10_000.0) -> Tensor:
    """Positions [1, C, h, w]: half of the channels for y, half for x, each counted from 1 and brought to 2 pi."""
    channels, height, width = x.shape[1:]
    half = channels // 2
    step = torch.arange(half, dtype=x.dtype, device=x.device)
    period = temperature ** (2 * torch.div(step, 2, rounding_mode="floor") / half)

    def waves(count: int) -> Tensor:  # [count, half]: sine, cosine, sine, ...
        place = torch.arange(1, count + 1, dtype=x.dtype, device=x.device) / (count + 1e-6) * (2 * math.pi)
        angle = place[:, None] / period
        return torch.stack([angle[:, 0::2].sin(), angle[:, 1::2].cos()], 2).flatten(1)

    rows = waves(height).T[:, :, None].expand(half, height, width)
    columns = waves(width).T[:, None, :].expand(half, height, width)
    return torch.cat([rows, columns])[None]


class TopDecoder(nn.Module):
    """The coarsest level: nothing to refine yet."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convrelu = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1), nn.PReLU())
        self.resblocks = ResidualBlocks(channels, 3)
        self.predict_flow = nn.Conv2d(channels, 4, 3, 1, 1)
        self.predict_img = nn.Conv2d(channels, 3, 3, 1, 1)

    def forward(self, x: Tensor, share: float) -> tuple[Tensor, Motion]:
        """Both frames' features [B, C, h, w] to hidden features and the first motion."""
        hidden = self.resblocks(self.convrelu(x))
        flow = self.predict_flow(hidden)
        return hidden, Motion(flow, moved_to_target(flow, share), self.predict_img(hidden))


class Decoder(nn.Module):
    """Doubles the resolution: fetches both frames along the motion so far, and mends it and the picture.

    Args:
        above: channels of the hidden features of the level above.
        features: channels of the frames' features.
        hidden: channels of this level's hidden features.
        last: the picture is all that is asked for.
    """

    def __init__(self, above: int, features: int, hidden: int, last: bool = False) -> None:
        super().__init__()
        self.deconv_flow = nn.ConvTranspose2d(4, 4, 4, 2, 1)
        self.deconv_hidden = nn.ConvTranspose2d(above, 16, 4, 2, 1)
        self.convrelu = nn.Sequential(nn.Conv2d(3 + 2 * features + 16 + 4, hidden, 3, 1, 1), nn.PReLU())
        self.resblocks = ResidualBlocks(hidden, 3)
        if not last:
            self.predict_flow = nn.Conv2d(hidden, 4, 3, 1, 1)
        self.predict_img = nn.Conv2d(hidden, 3, 3, 1, 1)
        self.last = last

    def forward(self, hidden: Tensor, motion: Motion, features: Tensor, share: float) -> tuple[Tensor, Motion]:
        """``features`` [2 B, C, h, w] are this level's; returns its hidden features and motion."""
        flow = self.deconv_flow(motion.flow)
        moved = moved_to_target(flow, share)
        image = F.interpolate(motion.image, scale_factor=2.0, mode="bilinear", align_corners=False)
        first, second = features.chunk(2)
        fetched = [backward_warp(second, moved[:, 2:]), backward_warp(first, moved[:, :2])]
        hidden = self.convrelu(torch.cat([image, *fetched, self.deconv_hidden(hidden), moved], 1))
        hidden = self.resblocks(hidden)
        if not self.last:
            flow = flow + self.predict_flow(hidden)
            moved = moved_to_target(flow, share)
        return hidden, Motion(flow, moved, self.predict_img(hidden))
