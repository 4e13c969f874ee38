"""RIFE as an interpolator: the authors' weights, read without running what a pickle may carry.

RIFE finds the picture half-way; other instants come by halving again and again, e times: 2**e intervals. Version 4
finds any instant directly. The masks are moved with the flows and the blend that the network found for the colours.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from rsavatar.errors import DataError, expected
from rsavatar.restore.interpolate import AbstractInterpolator, Array, Floats, Indices, Shots, pick_rows
from rsavatar.restore.rife_nets import Between, IFNet, IFNetV4

_MULTIPLE = 32  # of which height and width must be: the networks shrink a picture by as much


class Rife(AbstractInterpolator):
    """The published network, by recursion."""

    name = "rife"
    whole_body = True

    def __init__(self, weights: Path, recursion: int) -> None:
        self._network = IFNet()
        load_weights(self._network, weights, ignored=("block_tea.",))
        _use(self._network)
        self._steps = 2**recursion
        self.settings = f"2**{recursion} steps, weights {_digest(weights)}"

    @torch.no_grad()
    def rows(self, shots: Shots, rows: Indices, times: Array) -> Floats:
        """See ``AbstractInterpolator``; times are taken to the nearest multiple of 2**-e."""
        known = {0: _tensor(shots.first), self._steps: _tensor(shots.second)}

        def at(time: float) -> Floats:
            return _pixels(self._picture(known, round(time * self._steps)), shots)

        return pick_rows(at, rows, np.round(times * self._steps) / self._steps)

    def _picture(self, known: dict[int, Tensor], step: int) -> Tensor:
        if step not in known:
            half = step & -step  # the lowest bit: its neighbours at that distance lie on coarser levels
            first, second = (self._picture(known, step + side) for side in (-half, half))
            known[step] = _four_channels(self._network(first[:, :3], second[:, :3]), first, second)
        return known[step]


class RifeV4(AbstractInterpolator):
    """Version 4.6, at any instant."""

    name = "rife-v4"
    whole_body = True

    def __init__(self, weights: Path) -> None:
        self._network = IFNetV4()
        load_weights(self._network, weights)
        _use(self._network)
        self.settings = f"4.6, weights {_digest(weights)}"

    @torch.no_grad()
    def rows(self, shots: Shots, rows: Indices, times: Array) -> Floats:
        """See ``AbstractInterpolator``."""
        first, second = _tensor(shots.first), _tensor(shots.second)

        def at(time: float) -> Floats:
            if time in (0.0, 1.0):
                return _pixels(second if time else first, shots)
            found = self._network(first[:, :3], second[:, :3], time)
            return _pixels(_four_channels(found, first, second), shots)

        return pick_rows(at, rows, times)


def load_weights(network: nn.Module, path: Path, ignored: tuple[str, ...] = ()) -> None:
    """Fill a network from a state dictionary whose names may begin with ``module.``; those in ``ignored`` are left out.

    Only tensors and plain containers come out of the file; anything else in it is refused and not run.

    Raises:
        DataError: if the file is missing or no state dictionary, or a name or a shape is not the network's.
    """
    held = _read(path)
    given = {name.removeprefix("module."): value for name, value in held.items()}
    given = {name: value for name, value in given.items() if not name.startswith(ignored or ("\0",))}
    wanted = network.state_dict()
    for what, names in (("names", wanted.keys() - given.keys()), ("no other names", given.keys() - wanted.keys())):
        if names:
            some = ", ".join(sorted(names)[:3])
            got = f"without {some}" if what == "names" else f"{some}, of {len(names)} others"
            raise DataError(expected(f"{path} ({type(network).__name__})", f"{what} of that network", got))
    for name, value in wanted.items():
        if given[name].shape != value.shape:
            raise DataError(expected(f"{path} {name}", f"shape {tuple(value.shape)}", tuple(given[name].shape)))
        if not torch.isfinite(given[name]).all():
            raise DataError(expected(f"{path} {name}", "finite numbers", "NaN or infinity"))
    network.load_state_dict(given)


def _read(path: Path) -> Mapping[str, Tensor]:
    if not path.is_file():
        raise DataError(expected(str(path), "a file of weights", "nothing there"))
    try:
        held = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError, KeyError, OSError) as error:
        raise DataError(expected(str(path), "a complete state dictionary of tensors", error)) from error
    if not isinstance(held, dict) or not all(isinstance(value, Tensor) for value in held.values()):
        raise DataError(expected(str(path), "a state dictionary of tensors", type(held).__name__))
    return {str(name): value for name, value in held.items()}


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _use(network: nn.Module) -> None:
    network.eval().requires_grad_(False).to(_device())


def _device() -> torch.device:
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _tensor(picture: Floats | np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> Tensor:
    """[1, 4, H', W'] in 0..1, black and uncovered beyond the picture."""
    height, width = picture.shape[:2]
    values = torch.from_numpy(picture.astype(np.float32)).permute(2, 0, 1)[None].to(_device()) / 255
    return pad(values, (0, -width % _MULTIPLE, 0, -height % _MULTIPLE))


def _four_channels(found: Between, first: Tensor, second: Tensor) -> Tensor:
    return torch.cat([found.picture, found.blend(first[:, 3:], second[:, 3:])], 1)


def _pixels(picture: Tensor, shots: Shots) -> Floats:
    height, width = shots.first.shape[:2]
    out: Floats = (picture[0, :, :height, :width].permute(1, 2, 0) * 255).cpu().numpy()
    return out
