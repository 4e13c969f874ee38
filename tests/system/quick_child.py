"""A real child process with a quick computation in place of training: it counts, and its count is checkable.

It keeps the contract of ``rsavatar.experiment.run``: progress, checkpoints by rename, resume, SIGTERM. What it does
on the way is chosen by the spec's seed, so that one program serves all tests.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsavatar import errors, events
from rsavatar.spec import JobSpec
from services.worker.child import serve

STEP_SECONDS = 0.01
KILLS_ITSELF_ONCE, DIVERGES, HAS_A_BUG, HANGS, ALWAYS_DIES, EATS_MEMORY, FILLS_DISK = 101, 102, 103, 104, 105, 106, 107
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010804000000b51c0c02"
    "0000000b4944415478da6364f80f00010501012718e3660000000049454e44ae426082"
)


def chain(state: str, step: int) -> str:
    """A value that depends on every step before: a resumed job that lost or repeated one ends elsewhere."""
    return hashlib.sha256(f"{state}:{step}".encode()).hexdigest()


def misbehave(spec: JobSpec, out: Path, step: int) -> None:
    if step != spec.iterations // 2:
        return
    if spec.seed == ALWAYS_DIES:
        os.kill(os.getpid(), signal.SIGKILL)
    if spec.seed == KILLS_ITSELF_ONCE and not (out / "died").exists():
        (out / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if spec.seed == DIVERGES:
        raise errors.DivergedError("loss: expected a finite number, got nan")
    if spec.seed == HAS_A_BUG:
        raise ZeroDivisionError("division by zero")
    if spec.seed == HANGS:
        time.sleep(600)
    if spec.seed == EATS_MEMORY:
        hoard = bytearray(300 << 20)
        hoard[::4096] = b"x" * len(hoard[::4096])
        time.sleep(600)
    if spec.seed == FILLS_DISK and not (out / "filled").exists():
        (out / "filled").touch()
        resource.setrlimit(
            resource.RLIMIT_FSIZE, (16, resource.RLIM_INFINITY)
        )  # the next file breaks off, as on a full disk


def newest(*checkpoints: Path) -> tuple[int, str]:
    found = [json.loads(path.read_text()) for path in checkpoints if path.exists()]
    step, state = max(found, default=(0, "start"))
    return step, state


def count(
    spec: JobSpec, out: Path, subject_dir: Path | None, report: events.Report, should_stop: Callable[[], bool]
) -> Count:
    checkpoint = out / "checkpoint.json"
    step, state = newest(checkpoint, out / "checkpoint.before.json", out / "checkpoint.stored")
    print("a stray print must not break the protocol")
    report(events.Note(f"starting at step {step}"))
    started = time.monotonic()
    while step < spec.iterations:
        step, state = step + 1, chain(state, step + 1)
        misbehave(spec, out, step)
        time.sleep(STEP_SECONDS)
        report(events.Progress("train", step, spec.iterations, time.monotonic() - started, loss=1.0 / step))
        if step % spec.checkpoint_every == 0 or should_stop():
            partial = out / "checkpoint.part"
            partial.write_text(json.dumps([step, state]))
            if checkpoint.exists():
                checkpoint.replace(out / "checkpoint.before.json")
            partial.replace(checkpoint)
            report(events.Checkpointed(step, str(checkpoint), hashlib.sha256(checkpoint.read_bytes()).hexdigest()))
        if should_stop():
            raise errors.Interrupted("asked to stop")
    return finish(spec, out, state, report)


@dataclass(frozen=True)
class Count:
    """As ``rsavatar.experiment.Result``, whose import alone takes longer than a count."""

    found: dict[str, Any]
    artifacts: Mapping[str, Path]

    def to_json(self) -> dict[str, Any]:
        return self.found


def finish(spec: JobSpec, out: Path, state: str, report: events.Report) -> Count:
    picture = out / "preview.png"
    picture.write_bytes(PNG)
    report(events.Preview(spec.iterations, str(picture), "one pixel"))
    psnr = int(state[:6], 16) / 2**20
    (out / "final.json").write_text(json.dumps({"state": state}))
    found = {
        "spec": spec.model_dump(mode="json", by_alias=True),
        "means": {"psnr": psnr, "ssim": 0.5, "flip": None, "lpips": float("nan")},
        "per_camera": {"01": {"psnr": psnr - 1}, "02": {"psnr": psnr + 1}},
        "scores": [
            {"camera": "01", "frame": 1, "psnr": psnr - 1, "ssim": 0.5},
            {"camera": "02", "frame": 1, "psnr": psnr + 1, "ssim": None},
        ],
        "protocol": {"dilation": 5},
        "gaussians": 7,
        "train_seconds": 1.0,
        "evaluate_seconds": 0.5,
        "provenance": {"commit": "0" * 40, "data_sha256": "1" * 64},
    }
    return Count(found, {"final": out / "final.json", "preview": picture})


if __name__ == "__main__":
    sys.exit(serve(count))
