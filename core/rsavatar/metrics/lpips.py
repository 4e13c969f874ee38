"""LPIPS v0.1 with VGG16 (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features"), weights by the user.

``RSAVATAR_LPIPS_WEIGHTS`` names one ``.pth`` or ``.safetensors`` file that holds VGG16's 13 convolutions
(``features.0.weight`` or ``net.slice1.0.weight``, ...) and the five linear heads (``lin0.model.1.weight``, ...): for
instance the saved ``state_dict()`` of the reference implementation's ``LPIPS(net="vgg")``.
"""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F  # noqa: N812

from rsavatar.errors import DataError, expected

WEIGHTS_VARIABLE = "RSAVATAR_LPIPS_WEIGHTS"
ABSENT = f"weights absent (set {WEIGHTS_VARIABLE})"

# VGG16: (index in torchvision's `features`, channels in, channels out), in five stages with a 2 x 2 max pool between.
STAGES: tuple[tuple[tuple[int, int, int], ...], ...] = (
    ((0, 3, 64), (2, 64, 64)),
    ((5, 64, 128), (7, 128, 128)),
    ((10, 128, 256), (12, 256, 256), (14, 256, 256)),
    ((17, 256, 512), (19, 512, 512), (21, 512, 512)),
    ((24, 512, 512), (26, 512, 512), (28, 512, 512)),
)
SMALLEST = 16  # pixels; four pools halve a side four times
SHIFT = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)  # ImageNet's mean and deviation, for inputs in [-1, 1]
SCALE = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)
NORM_FLOOR = 1e-10


@dataclass(frozen=True)
class Weights:
    """A checked weights file: ``convolutions`` by stage as (weight, bias), ``heads`` [1, C, 1, 1] by stage."""

    convolutions: tuple[tuple[tuple[torch.Tensor, torch.Tensor], ...], ...]
    heads: tuple[torch.Tensor, ...]
    sha256: str


def weights_path() -> Path | None:
    """The file that the user named, or None.

    Raises:
        DataError: if it is named but is not there.
    """
    named = os.environ.get(WEIGHTS_VARIABLE)
    if not named:
        return None
    if not Path(named).is_file():
        raise DataError(expected(WEIGHTS_VARIABLE, "a weights file", f"{named!r}, which is not there"))
    return Path(named)


def lpips_state() -> str:
    """What a table says about LPIPS: ``weights absent (...)``, or ``sha256 <first 12 digits of the file's hash>``.

    Raises:
        DataError: if the named file cannot be used.
    """
    path = weights_path()
    return ABSENT if path is None else f"sha256 {load_weights(path).sha256[:12]}"


def distance(path: Path, image: npt.NDArray[np.float32], truth: npt.NDArray[np.float32]) -> float:
    """LPIPS between two images [H, W, 3] in [0, 1], brought to [-1, 1]; black is added below and right up to 16 pixels.

    Raises:
        DataError: if the weights file cannot be used.
    """
    weights = load_weights(path)
    with torch.inference_mode():
        x, y = (_stages(weights, _input(i)) for i in (image, truth))
        maps = (F.conv2d((a - b) ** 2, head) for a, b, head in zip(x, y, weights.heads, strict=True))
        return float(sum(m.mean(dtype=torch.float64) for m in maps))


@functools.lru_cache(maxsize=1)
def load_weights(path: Path) -> Weights:
    """Read and check a weights file; nothing in it is executed.

    Raises:
        DataError: if it cannot be read, or a tensor is missing or has another shape.
    """
    state = _read(path)
    convolutions = tuple(
        tuple(
            (
                _tensor(state, _names(s, i, "weight"), (channels, into, 3, 3)),
                _tensor(state, _names(s, i, "bias"), (channels,)),
            )
            for i, into, channels in stage
        )
        for s, stage in enumerate(STAGES)
    )
    heads = tuple(
        _tensor(state, (f"lin{s}.model.1.weight", f"lins.{s}.model.1.weight"), (1, stage[-1][2], 1, 1))
        for s, stage in enumerate(STAGES)
    )
    return Weights(convolutions, heads, hashlib.sha256(path.read_bytes()).hexdigest())


def _names(stage: int, index: int, kind: str) -> tuple[str, ...]:
    return (f"features.{index}.{kind}", f"net.slice{stage + 1}.{index}.{kind}")


def _read(path: Path) -> Mapping[str, object]:
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return dict(load_file(path))
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError) as error:
        raise DataError(expected(f"LPIPS weights {path}", "a .pth or .safetensors state dict", error)) from error
    except Exception as error:  # SafetensorError derives from Exception alone
        if type(error).__module__.startswith("safetensors"):
            raise DataError(expected(f"LPIPS weights {path}", "a .safetensors file", error)) from error
        raise
    if not isinstance(state, Mapping):
        raise DataError(expected(f"LPIPS weights {path}", "a state dict", type(state).__name__))
    return state


def _tensor(state: Mapping[str, object], names: tuple[str, ...], shape: tuple[int, ...]) -> torch.Tensor:
    found = next((state[n] for n in names if n in state), None)
    if not isinstance(found, torch.Tensor) or tuple(found.shape) != shape:
        got = "nothing" if found is None else getattr(found, "shape", type(found).__name__)
        raise DataError(expected(f"LPIPS weights: {' or '.join(names)}", f"shape {list(shape)}", got))
    return found.to(torch.float32)


def _input(image: npt.NDArray[np.float32]) -> torch.Tensor:
    height, width = image.shape[:2]
    missing = ((0, max(SMALLEST - height, 0)), (0, max(SMALLEST - width, 0)), (0, 0))
    x = torch.from_numpy(np.pad(image.astype(np.float32), missing)).permute(2, 0, 1)[None]
    return (2.0 * x - 1.0 - SHIFT) / SCALE


def _stages(weights: Weights, x: torch.Tensor) -> list[torch.Tensor]:
    """Features after the last ReLU of every stage, each pixel's vector brought to length 1."""
    features: list[torch.Tensor] = []
    for number, stage in enumerate(weights.convolutions):
        x = F.max_pool2d(x, 2) if number else x
        for weight, bias in stage:
            x = F.relu(F.conv2d(x, weight, bias, padding=1))
        features.append(x / (x.square().sum(dim=1, keepdim=True).sqrt() + NORM_FLOOR))
    return features
