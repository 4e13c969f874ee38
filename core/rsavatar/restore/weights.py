"""Weights of the correction networks: the authors' files, our own, and the small ones that come with the package.

``RSAVATAR_WEIGHTS_DIR`` names a folder with, for each network that the user has weights of,

    jamnet/*net_flow.pth                                       the authors' file
    cvr/*net_flow.pth  cvr/*net_scale.pth  cvr/*net_syn.pth    the authors' files; without net_scale it is CVR*
    jamnet/*.safetensors, cvr/*.safetensors                    or one file of `rsavatar restore train`

Files are read without running anything that is in them.
"""

from __future__ import annotations

import hashlib
import json
import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from rsavatar.errors import DataError, expected
from rsavatar.restore.cvr import CVR
from rsavatar.restore.jamnet import FFN_BIAS, JAMNet

Name = Literal["cvr", "jamnet"]
NAMES: tuple[Name, ...] = ("cvr", "jamnet")
VARIABLE = "RSAVATAR_WEIGHTS_DIR"
SHIPPED = Path(__file__).parent / "shipped"
CVR_PARTS = ("net_flow", "net_scale", "net_syn")


@dataclass(frozen=True)
class Origin:
    """Which weights these are: what stands beside every number made with them."""

    label: str  # for a person
    sha256: str  # of all files, in the order of their names

    def __str__(self) -> str:
        return f"{self.label}, sha256 {self.sha256[:12]}"


@dataclass(frozen=True)
class Shape:
    """What decides a network's parameters."""

    model: Name
    width: float = 1.0
    star: bool = False  # CVR without its scale network

    def build(self) -> nn.Module:
        """The network with fresh parameters."""
        return JAMNet(self.width) if self.model == "jamnet" else CVR(self.width, self.star)


def find(model: Name) -> tuple[Path, ...]:
    """The user's files for ``model`` in ``RSAVATAR_WEIGHTS_DIR``, else the package's own.

    Raises:
        DataError: if the folder is named and not there, or holds something else for ``model``.
    """
    named = os.environ.get(VARIABLE)
    if named and not Path(named).is_dir():
        raise DataError(expected(VARIABLE, "a folder", f"{named!r}, which is not there"))
    folder = Path(named) / model if named else None
    if folder is None or not folder.is_dir():
        return (SHIPPED / f"{model}.safetensors",)
    return files_of(model, folder)


def files_of(model: Name, place: Path) -> tuple[Path, ...]:
    """The files that hold ``model``'s weights: ``place`` itself, or what is in it.

    Raises:
        DataError: if there is nothing, or more than one choice.
    """
    if place.is_file():
        return (place,)
    own = sorted(place.glob("*.safetensors"))
    parts = CVR_PARTS if model == "cvr" else ("net_flow",)
    official = [sorted(place.glob(f"*{part}.pth")) for part in parts]
    if len(own) == 1 and not any(official):
        return (own[0],)
    whole = all(
        len(found) == 1 or (part == "net_scale" and not found) for part, found in zip(parts, official, strict=True)
    )
    if own or not whole:
        wanted = f"one .safetensors, or one each of {', '.join(f'*{part}.pth' for part in parts)}"
        there = ", ".join(sorted(path.name for path in place.glob("*"))) if place.is_dir() else "nothing there"
        raise DataError(expected(f"{model} weights {place}", wanted, there or "an empty folder"))
    return tuple(path for found in official for path in found)


def load(model: Name, files: tuple[Path, ...]) -> tuple[nn.Module, Origin]:
    """The network with the weights of ``files``, in float32, for evaluation.

    Raises:
        DataError: if a file cannot be read, or a tensor is missing, left over, of another shape or not finite.
    """
    header = read_header(files[0])
    states = {_part(path): read_state(path) for path in files}
    network = _shaped(model, header, states)
    state = dict(states[""]) if "" in states else _joined(model, states)
    load_state(network, state, f"{model} weights {files[0].parent if len(files) > 1 else files[0]}")
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.read_bytes())
    return network.eval().requires_grad_(False), Origin(_label(files, header), digest.hexdigest())


def which(model: Name) -> str:
    """In words, the weights that ``model`` would be used with; or why it cannot be used."""
    try:
        files = find(model)
        return _label(files, read_header(files[0]))
    except DataError as error:
        return f"none ({error})"


def load_state(network: nn.Module, state: Mapping[str, Tensor], what: str) -> None:
    """Put ``state`` into ``network``; every name and shape must fit.

    Raises:
        DataError: naming the first tensor that does not fit.
    """
    wanted = network.state_dict()
    for name in sorted(wanted.keys() | state.keys()):
        mine, given = wanted.get(name), state.get(name)
        if mine is None or given is None or mine.shape != given.shape:
            shapes = ["nothing" if t is None else list(t.shape) for t in (mine, given)]
            raise DataError(expected(f"{what}: {name}", *shapes))
        if not bool(torch.isfinite(given).all()):
            raise DataError(expected(f"{what}: {name}", "finite numbers", "NaN or infinity"))
    network.load_state_dict({name: value.float() for name, value in state.items()})


def read_state(path: Path) -> dict[str, Tensor]:
    """The tensors of a .safetensors or .pth file by name; a leading ``module.`` is dropped.

    Raises:
        DataError: if the file is missing, damaged, or holds anything but tensors.
    """
    try:
        if path.suffix == ".safetensors":
            with safe_open(path, "pt") as file:
                return {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 - no mapping
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, ValueError, EOFError, pickle.UnpicklingError, SafetensorError) as error:
        raise DataError(expected(f"weights {path}", "a .safetensors or .pth state dict", error)) from error
    if not isinstance(state, Mapping) or not all(isinstance(value, Tensor) for value in state.values()):
        raise DataError(expected(f"weights {path}", "tensors by name", type(state).__name__))
    return {str(name).removeprefix("module."): value for name, value in state.items()}


def read_header(path: Path) -> dict[str, str]:
    """What our own files say of themselves; empty for the authors'.

    Raises:
        DataError: if a .safetensors file is missing, damaged, or not of `rsavatar restore train`.
    """
    if path.suffix != ".safetensors":
        return {}
    try:
        with safe_open(path, "pt") as file:
            header: dict[str, str] = file.metadata() or {}
    except (OSError, SafetensorError) as error:
        raise DataError(expected(f"weights {path}", "a .safetensors file", error)) from error
    if not {"model", "width", "star", "recipe"} <= header.keys():
        raise DataError(expected(f"weights {path}", "a file of `rsavatar restore train`", sorted(header)))
    return header


def header_of(shape: Shape, recipe: Mapping[str, Any]) -> dict[str, str]:
    """What is written into our own files."""
    return {
        "model": shape.model,
        "width": repr(shape.width),
        "star": json.dumps(shape.star),
        "recipe": json.dumps(dict(recipe), sort_keys=True),
    }


def _shaped(model: Name, header: Mapping[str, str], states: Mapping[str, Mapping[str, Tensor]]) -> nn.Module:
    if header:
        if header["model"] != model:
            raise DataError(expected("weights of", model, header["model"]))
        return Shape(model, float(header["width"]), json.loads(header["star"])).build()
    if model == "jamnet":
        return JAMNet(ffn_bias=FFN_BIAS in next(iter(states.values())))
    return CVR(star="net_scale" not in states)


def _part(path: Path) -> str:
    """Which of CVR's three networks a file holds; none where it holds all."""
    return next((part for part in CVR_PARTS if path.name.endswith(f"{part}.pth")), "")


def _joined(model: Name, states: Mapping[str, Mapping[str, Tensor]]) -> dict[str, Tensor]:
    if model == "jamnet":  # the authors call its only file net_flow
        return dict(states["net_flow"])
    return {f"{part}.{name}": value for part, state in states.items() for name, value in state.items()}


def _label(files: tuple[Path, ...], header: Mapping[str, str]) -> str:
    names = " + ".join(path.name for path in files)
    if not header:
        return f"the authors' layout ({names})"
    recipe, width = json.loads(header["recipe"]), float(header["width"])
    size = "full width" if width == 1 else f"reduced width {width:g}"
    source = "shipped, " if files[0].parent == SHIPPED else ""
    rounds = [recipe]
    while rounds[0].get("before"):
        rounds.insert(0, rounds[0]["before"])
    steps = ", then ".join(f"{done['steps_done']} steps on {done['data']}" for done in rounds)
    return f"{source}trained by this project ({names}: {size}, {steps})"
