"""Training of the correction networks. Needs torch, numpy, OpenCV and safetensors, no renderer and no kernels."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from rsavatar.errors import DataError, DivergedError, Interrupted, expected
from rsavatar.events import Note, Progress, Report, silent
from rsavatar.restore.beginnings import begin
from rsavatar.restore.cvr import CVR
from rsavatar.restore.jamnet import JAMNet
from rsavatar.restore.losses import Perception, cvr_loss, flow_loss, jamnet_loss
from rsavatar.restore.pairs import Take, shrunk
from rsavatar.restore.sampling import Batch, Sampler
from rsavatar.restore.weights import NAMES, Name, Shape, header_of, load_state, read_header, read_state

FINAL_RATE = 0.02  # of the learning rate, at the end of its cosine
BODY_MARGIN = 2  # pixels that the body region of the validation grows by


@dataclass(frozen=True)
class Recipe:
    """Everything that decides the weights, besides the pairs."""

    model: Name
    width: float = 1.0
    star: bool = False
    steps: int = 20_000
    minutes: float = math.inf  # stop here if the steps are not done; the rate falls by whichever ends first
    batch: int = 8
    columns: int = 192
    shrink: int = 1  # times smaller than the pairs are: fast first steps
    rate: float = 1e-4
    instants: int = 3  # of CVR's in a step: all that the data know, or a draw of fewer
    warmup: float = 0.25  # CVR from nothing: part of the training that teaches its flow alone
    slow: float = 0.1  # of the rate, for CVR's flow and scale networks when they start from weights (the authors')
    seed: int = 0
    held_out: int = 8  # takes at the end that are validated on
    every: int = 500  # steps between looks at these
    data: str = "a pack"  # in words

    def __post_init__(self) -> None:
        if self.model not in NAMES:
            raise DataError(expected("model", f"one of {', '.join(NAMES)}", repr(self.model)))
        counts = (self.steps, self.batch, self.every, self.shrink, self.instants)
        if self.columns % 64 or not 0 < self.width <= 1 or min(counts) < 1:
            wanted = "columns a multiple of 64, width in (0, 1], steps, batch, every, shrink and instants of at least 1"
            raise DataError(expected("recipe", wanted, (self.columns, self.width, *counts)))
        shares = 0 <= self.warmup < 1 and 0 <= self.slow <= 1
        if not (self.rate > 0 and self.minutes > 0 and shares and self.held_out >= 0):
            wanted = "rate and minutes above 0, warmup in [0, 1), slow in [0, 1], held_out not below 0"
            raise DataError(
                expected("recipe", wanted, (self.rate, self.minutes, self.warmup, self.slow, self.held_out))
            )

    @property
    def shape(self) -> Shape:
        """Of the network."""
        return Shape(self.model, self.width, self.star)


@dataclass(frozen=True)
class Start:
    """Where training starts from and what it may use."""

    device: str = "cpu"
    init: Path | None = None  # a file of ours
    vgg: Path | None = None  # VGG19 weights: adds the authors' perceptual terms


class Trainer:
    """One run: ``run`` trains to the end, resuming what ``out`` with the suffix ``.resume`` holds of the same recipe.

    Raises:
        DataError: if the pairs do not suffice, or ``start`` names what cannot be used.
    """

    def __init__(self, recipe: Recipe, takes: Sequence[Take], out: Path, start: Start) -> None:
        if len(takes) <= recipe.held_out:
            raise DataError(expected("training pairs", f"more than the {recipe.held_out} takes held out", len(takes)))
        device = _device(start.device)
        torch.backends.cudnn.benchmark = True  # every batch has one shape
        takes = [shrunk(take, recipe.shrink) for take in takes]
        cut = len(takes) - recipe.held_out
        self.recipe, self.out, self.start = recipe, out, start
        self.train_set = Sampler(takes[:cut], recipe.columns, device, recipe.seed)
        held_out = takes[cut:]
        self.checks = Sampler(held_out, recipe.columns, device, recipe.seed).pairs() if held_out else []
        torch.manual_seed(recipe.seed)
        self.network = recipe.shape.build().to(device)
        if start.init is None:
            begin(self.network)
        else:
            load_state(self.network, read_state(start.init), f"weights {start.init}")
        self.perception = Perception(start.vgg).to(device) if start.vgg else None
        self.optimizer = torch.optim.Adam(_groups(self.network, recipe, start.init is not None))
        self.curve: list[dict[str, float]] = []
        self.step, self.seconds = 0, 0.0

    def run(self, report: Report = silent, should_stop: Callable[[], bool] = lambda: False) -> Path:
        """Train, and write ``out`` and its recipe beside it as JSON; returns ``out``.

        Raises:
            DivergedError: if a loss is not finite.
            Interrupted: when ``should_stop`` asked for it; the state is on disk.
        """
        self._resume(report)
        begun = time.monotonic() - self.seconds
        while self.step < self.recipe.steps and self._share() < 1:
            loss = self._update()
            self.step += 1
            self.seconds = time.monotonic() - begun
            if self.step % self.recipe.every == 0:
                self._look(float(loss), report)
                self._save_state()
            if should_stop():
                self._save_state()
                raise Interrupted(f"stopped at step {self.step}; the state is in {self._state_file()}")
        if not self.curve or self.curve[-1]["step"] != self.step:
            self._look(float("nan"), report)
        return self._write()

    def _share(self) -> float:
        """How much of the training is done, by steps or by time."""
        return max(self.step / self.recipe.steps, self.seconds / (60 * self.recipe.minutes))

    def _update(self) -> Tensor:
        share = self._share()
        fall = FINAL_RATE + (1 - FINAL_RATE) * (1 + math.cos(math.pi * share)) / 2
        for group in self.optimizer.param_groups:
            group["lr"] = group["share"] * self.recipe.rate * fall * min(1.0, (self.step + 1) / 100)
        loss = self._loss(self.train_set.batch(self.step, self.recipe.batch), share)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = nn.utils.clip_grad_norm_(self.network.parameters(), _LARGEST_GRADIENT[self.recipe.model])
        if self.step % 50 == 0 and not bool(torch.isfinite(norm)):  # asking waits for the device
            raise DivergedError(expected(f"gradient at step {self.step}", "finite", float(norm)))
        self.optimizer.step()
        return loss.detach()

    def _loss(self, batch: Batch, share: float) -> Tensor:
        frames, network = batch.frames, self.network
        if isinstance(network, JAMNet):
            return jamnet_loss(network(frames), frames, batch.truths[1.0], self.perception)
        assert isinstance(network, CVR)
        if self.start.init is None and share < self.recipe.warmup:
            return flow_loss(network, frames)
        flows = network.motion(frames)
        rng = np.random.default_rng([self.recipe.seed, self.step, 1])
        count = min(self.recipe.instants, len(batch.truths))
        chosen = sorted(float(time) for time in rng.choice(sorted(batch.truths), count, replace=False))
        made = {time: network.at(frames, flows, time) for time in chosen}
        return cvr_loss(made, batch.truths, self.perception)

    def _look(self, loss: float, report: Report) -> None:
        """Validate, note and report."""
        point = {"step": float(self.step), "seconds": round(self.seconds, 1), "loss": loss}
        point |= validate(self.network, self.checks) if self.checks else {}
        self.curve.append(point)
        steps = min(self.recipe.steps, round(self.step / max(self._share(), 1e-9)))
        psnr = point.get("body_db")
        report(Progress("restore", self.step, max(steps, self.step), self.seconds, loss=loss, psnr=psnr))

    def _state_file(self) -> Path:
        return self.out.with_suffix(".resume")

    def _save_state(self) -> None:
        state = {
            "recipe": json.dumps(asdict(self.recipe), sort_keys=True),
            "network": self.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "curve": self.curve,
            "step": self.step,
            "seconds": self.seconds,
        }
        part = self._state_file().with_suffix(".resume.part")
        part.parent.mkdir(parents=True, exist_ok=True)
        torch.save(state, part)
        part.replace(self._state_file())

    def _resume(self, report: Report) -> None:
        path = self._state_file()
        if not path.is_file():
            return
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        if state["recipe"] != json.dumps(asdict(self.recipe), sort_keys=True):
            raise DataError(expected(str(path), "the state of this recipe (or no such file)", state["recipe"]))
        self.network.load_state_dict(state["network"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.curve, self.step, self.seconds = state["curve"], state["step"], state["seconds"]
        report(Note(f"Resuming from step {self.step}."))

    def _write(self) -> Path:
        """Half-precision weights with their recipe inside, and the recipe with the curve beside them."""
        recipe = {
            **asdict(self.recipe),
            "minutes": None if math.isinf(self.recipe.minutes) else self.recipe.minutes,
            "steps_done": self.step,
            "perceptual_terms": self.start.vgg is not None,
            "before": None if self.start.init is None else json.loads(read_header(self.start.init)["recipe"]),
            "torch": torch.__version__,
            "device": self.start.device,
        }
        tensors = {name: value.half().cpu().contiguous() for name, value in self.network.state_dict().items()}
        self.out.parent.mkdir(parents=True, exist_ok=True)
        save_file(tensors, self.out, header_of(self.recipe.shape, recipe))
        sha256 = hashlib.sha256(self.out.read_bytes()).hexdigest()
        curve = [{k: v for k, v in point.items() if not math.isnan(v)} for point in self.curve]
        beside = {"sha256": sha256, "recipe": recipe, "curve": curve}
        self.out.with_suffix(".json").write_text(json.dumps(beside, indent=1) + "\n")
        self._state_file().unlink(missing_ok=True)
        return self.out


def validate(network: nn.Module, batches: Sequence[Batch]) -> dict[str, float]:
    """How well the second frame's middle row is restored: PSNR in the body region and its gain over the rolling frame.

    The body region is where either sharp or rolling frame is not black, grown by ``BODY_MARGIN``; means over takes.
    """
    found = []
    with torch.no_grad():
        for batch in batches:
            truth, rolling = batch.truths[1.0], batch.frames[:, 3:]
            made = middle_of_second(network, batch.frames).clamp(0, 1)
            seen = torch.maximum(truth, rolling).amax(1, keepdim=True)
            size = 2 * BODY_MARGIN + 1
            body = nn.functional.max_pool2d((seen > 0).float(), size, 1, BODY_MARGIN)
            found.append([_psnr(made, truth, body), _psnr(rolling, truth, body)])
    body_db, before_db = np.mean(found, 0).tolist()
    return {"body_db": round(body_db, 3), "gain_db": round(body_db - before_db, 3)}


def middle_of_second(network: nn.Module, frames: Tensor) -> Tensor:
    """The sharp second frame [B, 3, H, W] of pairs [B, 6, H, W]."""
    if isinstance(network, JAMNet):
        return network(frames).image  # type: ignore[no-any-return]
    assert isinstance(network, CVR)
    return network.at(frames, network.motion(frames), 1.0).image


def _psnr(image: Tensor, truth: Tensor, mask: Tensor) -> float:
    error = ((image - truth).square() * mask).sum((1, 2, 3)) / (3 * mask.sum((1, 2, 3))).clamp(min=1)
    return float((-10 * (error + 1e-12).log10()).mean())


_LARGEST_GRADIENT: dict[Name, float] = {"jamnet": 50.0, "cvr": 5.0}


def _groups(network: nn.Module, recipe: Recipe, started: bool) -> list[dict[str, Any]]:
    """CVR's flow and scale networks learn more slowly once they are good."""
    slow = [p for name, p in network.named_parameters() if name.startswith(("net_flow", "net_scale")) and started]
    known = set(map(id, slow))
    fast = [p for p in network.parameters() if id(p) not in known]
    groups = [{"params": fast, "share": 1.0}, {"params": slow, "share": recipe.slow}]
    return [{**group, "lr": recipe.rate} for group in groups if group["params"]]


def _device(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise DataError(expected("device cuda", "a GPU that torch can use", "none"))
    if name not in ("cpu", "cuda"):
        raise DataError(expected("device", "cpu or cuda", repr(name)))
    return torch.device(name)
