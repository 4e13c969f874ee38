"""CVR and JAMNet as correctors: frames in, the sharp frame at the middle row out, on the CPU.

Both were made for pairs, and restore the second of two. The first frame of a sequence is restored from a film that runs
backwards past a sensor that is read from below, which is the same picture; training shows them both.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from rsavatar.restore.base import AbstractCorrector, Bytes, Picture, Shot, on_black
from rsavatar.restore.cvr import CVR
from rsavatar.restore.jamnet import JAMNet
from rsavatar.restore.warp import backward_warp
from rsavatar.restore.weights import Name, Origin, files_of, find, load

MARGIN = 32  # columns around the person that a network sees: outside, the picture is black
MULTIPLES: dict[Name, int] = {"cvr": 64, "jamnet": 16}
FORMAT = 1  # raise it when the result changes: it is part of the identity


class NetworkCorrector(AbstractCorrector):
    """A correction network with its weights.

    Args:
        model: which.
        network: with its weights, for evaluation.
        origin: of the weights.
    """

    def __init__(self, model: Name, network: nn.Module, origin: Origin) -> None:
        self._model, self._network, self._origin = model, network, origin

    @property
    def identity(self) -> str:
        """Network and weights."""
        return f"{self._model} version {FORMAT}, {self._origin}"

    def restore(self, shot: Shot) -> Picture:
        """See the contract."""
        if shot.gamma == 0 or not shot.frame[1].any():
            return shot.frame
        if shot.before is not None:
            return self._second(shot.before, shot.frame)
        assert shot.after is not None  # a shot has a neighbour
        return _upside_down(self._second(_upside_down(shot.after), _upside_down(shot.frame)))

    def _second(self, first: Picture, second: Picture) -> Picture:
        """The second of two frames, restored."""
        rows, columns = second[1].shape
        seen = np.flatnonzero(((first[1] != 0) | (second[1] != 0)).any(0))
        lo, hi = max(int(seen[0]) - MARGIN, 0), min(int(seen[-1]) + 1 + MARGIN, columns)
        multiple = MULTIPLES[self._model]
        high, wide = (-(-size // multiple) * multiple for size in (rows, hi - lo))
        stacked = np.concatenate([first[0], second[0], first[1][..., None], second[1][..., None]], -1)[:, lo:hi]
        padded = np.pad(stacked, ((0, high - rows), (0, wide - (hi - lo)), (0, 0)))
        tensor = torch.from_numpy(padded).permute(2, 0, 1)[None].float() / 255
        with torch.inference_mode():
            image, coverage = self._apply(tensor[:, :6], tensor[:, 6:7], tensor[:, 7:8], rows)
        made = np.zeros((rows, columns, 4), np.uint8)
        made[:, lo:hi] = _bytes(torch.cat([image, coverage], 1))[:rows, : hi - lo]
        return on_black(made[..., :3], made[..., 3])

    def _apply(self, frames: Tensor, first: Tensor, second: Tensor, rows: int) -> tuple[Tensor, Tensor]:
        """The picture [1, 3, H, W] and the coverage [1, 1, H, W], moved along the same flows."""
        if isinstance(self._network, JAMNet):
            made = self._network(frames, rows)
            return made.image, backward_warp(second, made.moved[:, 2:], "zeros")
        assert isinstance(self._network, CVR)
        flows = self._network.motion(frames)
        result = self._network.at(frames, flows, 1.0, rows)
        return result.image, result.carried(first, second)


def network_corrector(model: Name, weights: Path | None = None) -> NetworkCorrector:
    """With ``weights`` (a file or folder), else the user's, else those that come with the package.

    Raises:
        DataError: if they cannot be used.
    """
    network, origin = load(model, find(model) if weights is None else files_of(model, weights))
    return NetworkCorrector(model, network, origin)


def _upside_down(picture: Picture) -> Picture:
    return np.ascontiguousarray(picture[0][::-1]), np.ascontiguousarray(picture[1][::-1])


def _bytes(image: Tensor) -> Bytes:
    """[1, C, H, W] in [0, 1] to [H, W, C]."""
    scaled = image[0].permute(1, 2, 0).clamp(0, 1) * 255 + 0.5
    return np.asarray(scaled.to(torch.uint8).numpy())
