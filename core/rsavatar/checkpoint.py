"""Checkpoints: one safetensors file of named tensors, with who they belong to in its header."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from rsavatar.errors import CheckpointError, expected

FORMAT = 1


@dataclass(frozen=True)
class Owner:
    """What a checkpoint belongs to. Training resumes only where all of it is the same."""

    spec: str  # JobSpec.sha256
    data: str  # Subject.fingerprint
    body: str  # BodyModel.sha256
    code: str  # version of this package


def write(path: Path, tensors: Mapping[str, Tensor], owner: Owner, step: int) -> str:
    """Write so that a crash leaves the old file or the new one, never a part: temporary file, fsync, rename.

    Returns:
        sha256 of the file.
    """
    header = {"format": str(FORMAT), "step": str(step), "owner": json.dumps(asdict(owner))}
    data = save({name: t.detach().contiguous() for name, t in tensors.items()}, header)
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    return hashlib.sha256(data).hexdigest()


def read(path: Path) -> tuple[dict[str, Tensor], Owner, int]:
    """Tensors, owner and step of a checkpoint.

    Raises:
        CheckpointError: if the file is damaged or of another format.
    """
    try:
        with safe_open(path, "pt") as file:
            header = file.metadata() or {}
            if header.get("format") != str(FORMAT):
                raise CheckpointError(expected(f"{path.name} format", FORMAT, header.get("format")))
            # cloned: the file's own memory is not aligned, and vector code rounds unaligned sums differently
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118 - no mapping
            return tensors, Owner(**json.loads(header["owner"])), int(header["step"])
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise CheckpointError(expected(str(path), "a whole checkpoint file", error)) from None


def read_own(path: Path, owner: Owner) -> tuple[dict[str, Tensor], int]:
    """Tensors and step of a checkpoint that belongs to ``owner``.

    Raises:
        CheckpointError: if it is damaged, or belongs to another spec, data, body or code version.
    """
    tensors, found, step = read(path)
    for name, wanted in asdict(owner).items():
        if getattr(found, name) != wanted:
            raise CheckpointError(expected(f"{path.name} {name}", wanted, getattr(found, name)))
    return tensors, step
