"""Batches of training pairs: columns around the person, mirrored, run backwards, recoloured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rsavatar.errors import DataError, expected
from rsavatar.restore.pairs import Take


@dataclass(frozen=True, eq=False)
class Batch:
    """Pairs of rolling frames [B, 6, H, W] in [0, 1], and the sharp frames [B, 3, H, W] by instant: 0 and 1 are the
    frames' middle rows, 0.5 the second's first row, where the data know it.
    """

    frames: Tensor
    truths: dict[float, Tensor]


@dataclass(frozen=True, eq=False)
class _Clip:
    """A take on the device: kinds x frames x 3 x H x W bytes, and the columns that the person is in."""

    images: Tensor
    left: int
    right: int


class Sampler:
    """Draws batches; the same (seed, step) gives the same batch.

    Args:
        takes: all of one height, at least ``columns`` wide.
        columns: width of what is cut; rows are never cut, a row's place is its time.
        device: where the pictures are kept and the batches made.
        seed: of every choice.

    Raises:
        DataError: if the takes do not fit together.
    """

    def __init__(self, takes: Sequence[Take], columns: int, device: torch.device, seed: int) -> None:
        heights = {take.rolling.shape[1] for take in takes}
        narrowest = min((take.rolling.shape[2] for take in takes), default=0)
        if len(heights) != 1 or columns > narrowest:
            got = f"heights {sorted(heights)}, narrowest {narrowest}"
            raise DataError(expected("training pairs", f"one height and at least {columns} columns", got))
        self._clips = [_clip(take, device) for take in takes]
        self._half = all(take.first is not None for take in takes)
        self._columns, self._seed = columns, seed

    def batch(self, step: int, size: int) -> Batch:
        """``size`` pairs with every augmentation."""
        rng = np.random.default_rng([self._seed, step])
        return _stacked([self._pair(rng) for _ in range(size)], self._half)

    def pairs(self) -> list[Batch]:
        """Every pair once, as it is, columns centred on the person; a batch for each take."""
        found = []
        for clip in self._clips:
            lo = self._clamped(clip, (clip.left + clip.right - self._columns) // 2)
            cut = clip.images[..., lo : lo + self._columns]
            found.append(_stacked([_pair(cut, n, self._half) for n in range(cut.shape[1] - 1)], self._half))
        return found

    def _pair(self, rng: np.random.Generator) -> Tensor:
        """[4 or 5, 3, H, columns] bytes: both rolling frames, the sharp ones at 0 and 1, and at 0.5."""
        clip = self._clips[rng.integers(len(self._clips))]
        n = int(rng.integers(clip.images.shape[1] - 1))
        slack = abs(self._columns - (clip.right - clip.left)) // 2 + 8
        centre = (clip.left + clip.right - self._columns) // 2 + int(rng.integers(-slack, slack + 1))
        lo = self._clamped(clip, centre)
        pair = _pair(clip.images[..., lo : lo + self._columns], n, self._half)
        if rng.random() < 0.5:
            pair = pair.flip(-1)
        if rng.random() < 0.5:  # time runs backwards where the sensor is read from below
            pair = pair.flip(-2)[[1, 0, 3, 2, 4][: len(pair)]]
        pair = pair[:, torch.from_numpy(rng.permutation(3))]
        return (pair.float() * float(rng.uniform(0.6, 1.25))).clamp(0, 255)

    def _clamped(self, clip: _Clip, column: int) -> int:
        return min(max(column, 0), clip.images.shape[-1] - self._columns)


def _clip(take: Take, device: torch.device) -> _Clip:
    stacks = [stack for stack in (take.rolling, take.middle, take.first) if stack is not None]
    seen = np.flatnonzero(take.rolling.any((0, 1, 3)))
    left, right = (int(seen[0]), int(seen[-1]) + 1) if len(seen) else (0, take.rolling.shape[2])
    images = torch.from_numpy(np.stack(stacks)).permute(0, 1, 4, 2, 3).contiguous()
    return _Clip(images.to(device), left, right)


def _pair(images: Tensor, n: int, half: bool) -> Tensor:
    rolling, middle = images[0], images[1]
    chosen = [rolling[n], rolling[n + 1], middle[n], middle[n + 1]]
    return torch.stack([*chosen, images[2, n + 1]] if half else chosen)


def _stacked(pairs: Sequence[Tensor], half: bool) -> Batch:
    stacked = torch.stack(list(pairs)).float() / 255
    truths = {0.0: stacked[:, 2], 1.0: stacked[:, 3]}
    if half:
        truths[0.5] = stacked[:, 4]
    return Batch(stacked[:, :2].flatten(1, 2), truths)
