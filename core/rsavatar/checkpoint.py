"""Checkpoints: one safetensors file of named tensors, with who they belong to and their hash in its header.

The newest lies at its path, the one before beside it. ``settle`` finds the newest that is whole and belongs to the job;
so a file that a disk or a crash has damaged costs the steps since the one before, never the job.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from rsavatar.errors import CheckpointError, expected

FORMAT = 2
STORED = "checkpoint.stored"  # beside the file at a path: a copy that came from elsewhere


@dataclass(frozen=True)
class Owner:
    """What a checkpoint belongs to. Training resumes only where all of it is the same."""

    spec: str  # JobSpec.sha256
    data: str  # Subject.fingerprint
    body: str  # BodyModel.sha256
    code: str  # version of this package


def write(path: Path, tensors: Mapping[str, Tensor], owner: Owner, step: int) -> str:
    """Write so that a crash leaves the old file or the new one, never a part: temporary file, fsync, rename.

    The file that was at ``path`` becomes the one before; a full disk leaves both as they were.

    Returns:
        sha256 of the file.

    Raises:
        OSError: if it cannot be written whole.
    """
    plain = {name: t.detach().contiguous() for name, t in tensors.items()}
    header = {"format": str(FORMAT), "step": str(step), "owner": json.dumps(asdict(owner))}
    data = save(plain, header | {"content": _digest(plain, header)})
    temporary = path.with_name(path.name + ".tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            path.replace(before(path))
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    _sync_folder(path.parent)
    return hashlib.sha256(data).hexdigest()


def before(path: Path) -> Path:
    """Where the checkpoint before the one at ``path`` lies."""
    return path.with_suffix(".before" + path.suffix)


def _digest(tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> str:
    """Hash of everything that a reader trusts: names, types, shapes and bytes of the tensors, and the header."""
    digest = hashlib.sha256(json.dumps([header[name] for name in ("format", "step", "owner")]).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _sync_folder(folder: Path) -> None:
    """A rename is durable once its folder is."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


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
            if _digest(tensors, header) != header["content"]:
                raise CheckpointError(expected(f"{path.name} content", header["content"], "other bytes: damaged"))
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


def settle(path: Path, owner: Owner) -> tuple[int | None, list[str]]:
    """Bring the newest whole checkpoint of ``owner`` to ``path``; those that cannot be used are set aside.

    Looked at are the file at ``path``, the one before, and one that somebody has fetched from elsewhere (``STORED``).

    Returns:
        Its step, None where there is none; and sentences about what was found.
    """
    said: list[str] = []
    whole: dict[int, Path] = {}
    for candidate in (path, before(path), path.with_name(STORED)):
        if candidate.exists():
            try:
                whole.setdefault(read_own(candidate, owner)[1], candidate)
            except CheckpointError as error:
                aside = path.with_suffix(".other" + path.suffix)
                candidate.replace(aside)
                said.append(f"Checkpoint not used, kept as {aside.name}: {error}")
    if not whole:
        return None, [*said, "Starting anew."] if said else []
    step = max(whole)
    if whole[step] != path:
        said.append(f"Going on from {whole[step].name}.")
        whole[step].replace(path)
    path.with_name(STORED).unlink(missing_ok=True)
    return step, [*said, f"Resuming from step {step}."]
