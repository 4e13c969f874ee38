"""Training images that contradict all others (a wrong mask, a wrong frame): found by their residual, then left out.

The avatar explains what the images agree on. An image whose loss stays far above the others' holds something else, and
learning from it does harm everywhere.
"""

from __future__ import annotations

import torch
from torch import Tensor

FACTOR = 2.0  # times the median loss
SHARE = 0.25  # at most this part of the images is left out: beyond it, it is the avatar that is wrong


class Doubt:
    """The last loss of every training image, and which images are no longer believed."""

    def __init__(self, count: int) -> None:
        self.losses = torch.full((count,), torch.nan, dtype=torch.float64)
        self.doubted = torch.zeros(count, dtype=torch.bool)

    @property
    def trusted(self) -> list[int]:
        """Indices of the images to learn from."""
        indices: list[int] = torch.nonzero(~self.doubted)[:, 0].tolist()
        return indices

    def note(self, index: int, loss: float) -> None:
        """Remember what image ``index`` lost; numbers that are none are left to others."""
        self.losses[index] = loss

    def judge(self, cameras: Tensor) -> list[int]:
        """Doubt every image whose loss is above ``FACTOR`` times its camera's median; returns the new ones.

        Args:
            cameras: [count] index of each image's camera: what cameras see differs in size and detail.
        """
        ratio = torch.full_like(self.losses, torch.nan)
        for camera in set(cameras.tolist()):
            of = (cameras == camera) & ~self.doubted & self.losses.isfinite()
            ratio[of] = self.losses[of] / self.losses[of].median() if bool(of.any()) else torch.nan
        room = int(SHARE * len(self.losses)) - int(self.doubted.sum())
        worst = torch.argsort(ratio.nan_to_num(0.0), descending=True, stable=True)[: max(room, 0)]
        found: list[int] = worst[ratio[worst] > FACTOR].tolist()
        self.doubted[found] = True
        return sorted(found)
