"""What a benchmark's JSON file holds. Units are in the names."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from rsavatar.bench.machine import Machine


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class SceneFacts(_Record):
    """What was rendered."""

    gaussians: int
    pixels: int  # height and width
    foreground_px: int
    blended_per_px: float  # splats, mean over the foreground


class Accuracy(_Record):
    """Against the row-by-row truth, over seeds; see ``rsavatar.bench.accuracy``."""

    psnr_db: float  # in the foreground; median
    psnr_by_seed_db: list[float]
    max_abs: float  # anywhere in the image; of the worst seed
    off_px: int  # foreground pixels that are wrong by more than 1/255; of the worst seed
    psnr_rest_db: float  # without these; median
    motion_gradient_error: float  # relative, against bands with T = H; median


class WayFigures(_Record):
    """One way to render at one speed of the body."""

    way: str
    label: str
    bands: int  # T of a way in bands; 0 for others
    motion_px: float  # path of the fastest Gaussian during the readout
    accuracy: Accuracy
    forward_ms: float
    total_ms: float  # forward and backward
    rounds: int


class Ratio(_Record):
    """Time of forward and backward of ``above`` by that of ``below``: median over the rounds."""

    above: str
    below: str
    value: float


class Order(_Record):
    """Least-squares slope of log error against log T: the error of bands falls like T^-order."""

    motion_px: float
    bands: list[int]
    rms_error: list[float]
    order: float


class Target(_Record):
    """A promise, and whether this run kept it."""

    name: str
    bound: float
    sense: Literal["at most", "at least"]
    measured: float
    unit: str = ""

    @classmethod
    def at_most(cls, bound: float, measured: float, name: str, unit: str = "") -> Target:
        """An upper bound."""
        return cls(name=name, bound=bound, sense="at most", measured=measured, unit=unit)

    @classmethod
    def at_least(cls, bound: float, measured: float, name: str, unit: str = "") -> Target:
        """A lower bound."""
        return cls(name=name, bound=bound, sense="at least", measured=measured, unit=unit)

    @property
    def met(self) -> bool:
        """Whether the measurement lies on the right side of the bound."""
        return self.measured <= self.bound if self.sense == "at most" else self.measured >= self.bound


class RenderResult(_Record):
    """``rsavatar bench render``."""

    kind: Literal["render"] = "render"
    machine: Machine
    command: str
    scene: SceneFacts  # of the first seed at ``main_px``
    main_px: float  # the motion that ratios and targets speak of
    seeds: list[int]
    twin_ms: float | None  # forward and backward of the torch twin, once; None where it was left out
    ways: list[WayFigures]
    ratios: list[Ratio]
    orders: list[Order]
    targets: list[Target]


class Point(_Record):
    """One place on a curve; what was not measured there is None."""

    x: float
    forward_ms: float | None = None
    total_ms: float | None = None
    step_ms: float | None = None
    memory_mb: float | None = None


class Curve(_Record):
    """Growth along one axis with everything else fixed."""

    axis: str  # gaussians, pixels (of a side), bands (T), memory (by T), steps, frames
    name: str  # which way, how many threads
    fixed: str  # in words
    points: list[Point]


class GrowthResult(_Record):
    """``rsavatar bench growth``."""

    kind: Literal["growth"] = "growth"
    machine: Machine
    command: str
    step_ms: dict[str, float]  # whole training step by way: scanline, bands (T = K), paper (K full renders)
    curves: list[Curve]
    ratios: list[Ratio]
    targets: list[Target]


def write(result: RenderResult | GrowthResult, path: Path) -> None:
    """As indented JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(result.model_dump_json(indent=1) + "\n")
