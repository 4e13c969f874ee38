"""What a job is: one frozen, validated, torch-free ``JobSpec``, and the presets it starts from.

A request names what it cares about (``method``, ``subject``, perhaps ``T``); ``resolve`` lays it over the preset's
file in ``core/experiments`` and returns the complete spec. The complete spec is what is stored, hashed and run.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Mapping
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from rsavatar.catalog import METHODS
from rsavatar.errors import SpecError, expected

Preset = Literal["smoke", "draft", "paper"]
Skip = Literal["body", "nodes", "harmonics", "networks", "settled"]  # what each leaves out: rsavatar.skipping
SKIPS: tuple[Skip, ...] = ("body", "nodes", "harmonics", "networks")  # those that a job uses unless told otherwise
Unknown = Literal["readout", "trigger"]  # of a camera's schedule: rho_c and delta_c
Bands = Annotated[int, Field(ge=1, le=8192)] | Annotated[str, Field(pattern=r"^([2-9]|[1-9][0-9])?K$|^scanline$")]
NOT_OF_RESULT = frozenset(
    {"priority", "memory_limit_mb", "stall_seconds"}
)  # fields that say how a job runs, not what it finds
BANDS_WANTED = "an integer from 1 to 8192, K, 2K to 99K, or scanline"

SELECTING_METHODS = frozenset({"rs-avatar", "oracle"})  # methods whose shutter selects rows
CALIBRATING_METHODS = frozenset({"rs-avatar", "mad-avatar"})  # methods that know of instants within a frame
FLAGS_OF_METHOD: dict[str, frozenset[str]] = {  # the components that a method has, so can lose
    "rs-avatar": frozenset({"no_rs", "no_spline", "no_pose_deformation", "no_lbs_refinement", "no_reg"}),
    "mad-avatar": frozenset({"no_spline", "no_pose_deformation", "no_lbs_refinement", "no_reg"}),
    **dict.fromkeys(
        ("gauhuman", "cvr+gauhuman", "jamnet+gauhuman", "flow+gauhuman"),
        frozenset({"no_pose_deformation", "no_lbs_refinement"}),
    ),
    "oracle": frozenset({"no_lbs_refinement"}),
}


class Ablation(BaseModel):
    """One flag per component of the method; each removes exactly that component (paper, table "Ablations")."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    no_rs: bool = Field(False, description="no rolling-shutter model: the readout time is taken as 0")
    no_spline: bool = Field(False, description="one pose per frame instead of an intra-frame trajectory")
    no_pose_deformation: bool = Field(False, description="no residual pose network")
    no_lbs_refinement: bool = Field(False, description="no learned offset on the skinning weights")
    no_reg: bool = Field(False, description="no inter-frame continuity penalty")

    def flags(self) -> tuple[str, ...]:
        """Names of the flags that are set, in declaration order."""
        return tuple(name for name in type(self).model_fields if getattr(self, name))


class Disturbance(BaseModel):
    """What is given otherwise than the subject has it, to measure what that costs; the truth stays what it was.

    All that is random follows the job's seed.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    readout: float = Field(0.0, gt=-1, le=10, description="the readout is taken to be this much longer, as a fraction")
    trigger: float = Field(0.0, ge=-1, le=1, description="triggers taken late and early by turns, in frame periods")
    fit: float = Field(1.0, ge=0, le=10, description="factor on the initial fit's error; needs a true motion")
    missing: float = Field(0.0, ge=0, lt=1, description="share of the training images that are not there")
    masks: float = Field(0.0, ge=0, lt=1, description="share of the training images whose mask is wrong")
    capture: Literal["as it was", "global shutter"] = Field(
        "as it was", description="train on the sharp mid-row frames that a global shutter would have taken instead"
    )

    def any(self) -> bool:
        """Whether anything is disturbed."""
        return self != Disturbance()


class JobSpec(BaseModel):
    """A reconstruction job, complete. Two equal specs on equal data and code give bit-identical results.

    Raises:
        pydantic.ValidationError: on unknown fields, values out of range, or values that contradict each other;
            ``resolve`` turns it into a ``SpecError``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    method: str = Field(description="reconstruction method; see the catalogue")
    subject: str = Field(min_length=1, max_length=128, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", description="subject")
    preset: Preset = Field("draft", description="where the unnamed values come from")
    K: int | None = Field(None, ge=1, le=1000, description="source frames per output frame; none = the subject's own")
    T: Bands | None = Field(None, description="row bands: an integer, K, 2K, 4K, or scanline; none = K")
    P: int = Field(4, ge=2, le=8, description="control points per frame; the trajectory has degree P - 1")
    lambda_reg: float = Field(1.0, ge=0, le=1e4, alias="lambda", description="weight of the continuity penalty")
    ablation: Ablation = Field(Ablation(), description="components to remove")
    iterations: int = Field(20_000, ge=1, le=1_000_000, description="optimiser steps, one frame of one camera each")
    seed: int = Field(0, ge=0, lt=2**31, description="seed of every random choice")
    priority: int = Field(0, ge=-10, le=10, description="higher runs earlier; does not change the result")
    memory_limit_mb: int | None = Field(
        None, ge=64, le=1 << 24, description="memory of the job's process; none = the service's; not of the result"
    )
    stall_seconds: float | None = Field(
        None, gt=0, le=86_400, description="longest rest without progress; none = the service's; not of the result"
    )

    body: str = Field("auto", max_length=1024, description="auto, anny, or a path to an SMPL-format .npz or .pkl")
    motion: Literal["sequence-spline", "frame-spline"] = Field(
        "sequence-spline", description="one spline over the sequence, or P control points a frame tied by L_reg"
    )
    knots: int = Field(1, ge=1, le=8, description="knots per frame of the one spline over the sequence")
    continuity: Literal["aligned", "paper"] = Field("aligned", description="instants that L_reg compares")
    perturbation: Literal["zero-mean", "positive"] = Field("zero-mean", description="noise on initial control points")
    residual: Literal["composed", "additive"] = Field(
        "composed", description="the pose network's output: composed on SO(3), or added as in the paper's formula"
    )
    regime: Literal["pose-first", "authors"] = Field(
        "pose-first", description="step sizes: the motion fast and the Gaussians slow and small, or the authors' own"
    )
    sh_degree: int = Field(1, ge=0, le=1, description="highest spherical-harmonics degree of the colours")
    mask_weight: float = Field(0.5, ge=0, le=10, description="weight of the L1 between opacity and body mask")
    ssim_weight: float = Field(0.0, ge=0, le=10, description="weight of 1 - SSIM beside the L1")
    densify: bool = Field(True, description="adaptive density control: clone, split, prune")
    checkpoint_every: int = Field(1000, ge=1, description="steps between checkpoints")

    blur_triggers: bool = Field(False, description="mad-avatar is told the triggers, which its formula lacks")
    skip: tuple[Skip, ...] = Field(SKIPS, description="work left out where the scene does not need it")
    calibrate: tuple[Unknown, ...] = Field((), description="what of the schedule is learned: readout, trigger")
    exposure_frames: float | None = Field(
        None, ge=0, le=1000, description="exposure of a row in source frames; none = the subject's own; 0 = ignored"
    )
    exposure_samples: int = Field(4, ge=1, le=64, description="scans that an exposure is the mean of")
    doubt: bool = Field(False, description="leave out training images that contradict all others")
    disturb: Disturbance = Field(Disturbance(), description="what is given otherwise, as an experiment")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.method not in METHODS:
            raise ValueError(expected("method", f"one of {', '.join(METHODS)}", repr(self.method)))
        alien = sorted(set(self.ablation.flags()) - FLAGS_OF_METHOD.get(self.method, frozenset()))
        if alien:
            has = ", ".join(sorted(FLAGS_OF_METHOD.get(self.method, frozenset()))) or "no flags"
            raise ValueError(expected("ablation", f"components that {self.method} has ({has})", ", ".join(alien)))
        if self.ablation.no_reg and self.motion == "sequence-spline":
            raise ValueError(expected("ablation.no_reg", "motion frame-spline, which has a penalty", repr(self.motion)))
        if self.knots != 1 and self.motion != "sequence-spline":
            raise ValueError(expected("knots", "1, or motion sequence-spline", self.knots))
        if self.blur_triggers and self.method != "mad-avatar":
            raise ValueError(expected("blur_triggers", "mad-avatar, whose blur they would move", self.method))
        if self.T == "scanline" and self.method == "mad-avatar":
            raise ValueError(expected("T", "a finite number of renders for mad-avatar to average", "'scanline'"))
        self._check_schedule()
        return self

    def _check_schedule(self) -> None:
        """What is asked of the shutter must be something that the method looks at."""
        blind = self.method not in CALIBRATING_METHODS or self.ablation.no_spline or self.ablation.no_rs
        if self.calibrate and blind:
            wanted = f"none, or {' or '.join(sorted(CALIBRATING_METHODS))} with a spline and its shutter model"
            raise ValueError(expected("calibrate", wanted, ", ".join(self.calibrate)))
        if self.exposure_frames and (self.method not in SELECTING_METHODS or self.T != "scanline"):
            wanted = f"none, or T = scanline of {' or '.join(sorted(SELECTING_METHODS))}"
            raise ValueError(expected("exposure_frames", wanted, self.exposure_frames))
        if self.method == "oracle" and self.disturb.any():
            raise ValueError(expected("disturb", "nothing for oracle, which is given the truth", self.disturb))

    def bands(self, source_frames: int) -> int | Literal["scanline"]:
        """``T`` as a number (or ``"scanline"``) once ``K = source_frames`` is known."""
        if self.T is None:
            return source_frames
        if isinstance(self.T, int):
            return self.T
        return "scanline" if self.T == "scanline" else int(self.T[:-1] or 1) * source_frames

    def sha256(self) -> str:
        """Content hash of everything that decides the result (``NOT_OF_RESULT`` does not)."""
        text = json.dumps(
            self.model_dump(mode="json", exclude=set(NOT_OF_RESULT)), sort_keys=True, separators=(",", ":")
        )
        return hashlib.sha256(text.encode()).hexdigest()


@cache
def presets_dir() -> Path:
    """Folder of the preset files: inside an installed package, or ``core/experiments`` of a checkout."""
    here = Path(__file__).resolve().parent
    return next((d for d in (here / "experiments", here.parent / "experiments") if d.is_dir()), here / "experiments")


def read_preset(name: str) -> dict[str, Any]:
    """The values of one preset file.

    Raises:
        SpecError: if there is no such preset.
    """
    presets = _presets(presets_dir())
    if name not in presets:
        raise SpecError(expected("preset", f"one of {', '.join(presets)}", repr(name)))
    return deepcopy(presets[name])


@cache
def _presets(folder: Path) -> dict[str, dict[str, Any]]:
    """Every preset file of a folder, read once: a grid resolves a thousand requests."""
    return {path.stem: tomllib.loads(path.read_text("utf-8")) for path in sorted(folder.glob("*.toml"))}


def resolve(request: Mapping[str, Any]) -> JobSpec:
    """Lay a partial request over its preset and validate the whole.

    A preset's ``T`` speaks of the rolling-shutter model, so it is not laid under methods that do not select rows. A
    request that names P, lambda, continuity, perturbation or no_reg means the paper's per-frame spline, which alone has
    them.

    Raises:
        SpecError: naming every offending field with what was expected and what was got.
    """
    preset = read_preset(str(request.get("preset", "draft")))
    if request.get("method") not in SELECTING_METHODS:
        preset.pop("T", None)
    named = {_ALIASES.get(k, k): v for k, v in request.items() if v is not None}
    if "motion" not in named and _speaks_of_frames(named):
        named["motion"] = "frame-spline"
    try:
        return JobSpec.model_validate({**preset, **named})
    except ValidationError as error:
        raise SpecError("; ".join(dict.fromkeys(map(_sentence, error.errors())))) from None


_ALIASES = {"lambda_reg": "lambda"}
FRAME_SPLINE_WORDS = ("P", "lambda", "continuity", "perturbation")


def _speaks_of_frames(named: Mapping[str, Any]) -> bool:
    """Whether a request names what only the paper's per-frame spline has."""
    ablation = named.get("ablation")
    no_reg = isinstance(ablation, Mapping) and bool(ablation.get("no_reg"))
    return no_reg or any(word in named for word in FRAME_SPLINE_WORDS)


def _sentence(error: Any) -> str:
    where = [str(part) for part in error["loc"]]
    if not where:  # raised by _consistent: already name, expected, got
        return str(error["msg"]).removeprefix("Value error, ")
    if where[0] == "T":  # a union: pydantic reports each branch
        return expected("T", BANDS_WANTED, repr(error["input"]))
    if error["type"] == "missing":
        return expected(".".join(where), "a value", "none")
    message = str(error["msg"])
    return expected(".".join(where), message[:1].lower() + message[1:], repr(error["input"]))
