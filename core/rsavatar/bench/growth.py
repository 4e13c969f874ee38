"""``rsavatar bench growth``: how time and memory grow with Gaussians, pixels, bands, frames and threads (scene P13).

Curves of forward and of forward and backward as in ``rsavatar.bench.render``; of the whole training step (kinematics,
pose and skinning networks, render, L1, backward, Adam; crop of the body; the skinning network's refresh shared out over
its block); of the peak memory of a render. More Gaussians are smaller ones: the body stays covered as it is.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

import torch

from rsavatar import kernels
from rsavatar.bench import page, results, tables
from rsavatar.bench.machine import describe
from rsavatar.bench.memory import render_mb, training_mb
from rsavatar.bench.results import Curve, GrowthResult, Point, Ratio, Target
from rsavatar.bench.scene import Size, build
from rsavatar.bench.timing import interleave, narrate, ratio
from rsavatar.bench.training import Training
from rsavatar.bench.ways import Exposure, Way, in_bands, paper, scan


@dataclass(frozen=True)
class Plan:
    """Which points to measure; one axis at a time, the others as in ``size``."""

    size: Size = field(default_factory=Size)
    gaussians: tuple[int, ...] = (3_000, 10_000, 30_000, 100_000, 300_000)
    pixels: tuple[int, ...] = (128, 256, 512, 1024, 2048)
    bands: tuple[int, ...] = (1, 2, 5, 11, 22, 44, 88, 176, 352, 1024)
    whole: tuple[int, ...] = (1, 2, 5, 11, 22)  # bands of the paper's way
    frames: tuple[int, ...] = (4, 20, 100, 500)
    memory_bands: tuple[int, ...] = (1, 11, 44, 176, 1024)  # none: memory is not measured
    memory_steps: tuple[int, ...] = (200, 500, 1000, 2000)  # of training
    K: int = 11
    rounds: int = 11
    step_rounds: int = 41


def main(json: Path | None) -> int:
    """Measure, print, and write the JSON file with its page and plots beside it."""
    kernels.keep_memory()
    kernels.use_threads(len(os.sched_getaffinity(0)))
    torch.set_num_threads(1)
    result = measure(Plan())
    tables.show(result)
    if json:
        results.write(result, json)
        page.write(json.parent)
    return 0


def measure(plan: Plan) -> GrowthResult:
    """All of it."""
    machine, most = describe(), kernels.threads()
    curves: list[Curve] = []
    for threads in sorted({1, most}):
        kernels.use_threads(threads)
        curves += [_gaussians(plan, threads), _pixels(plan, threads)]
    kernels.use_threads(most)
    curves += [*_bands(plan), *_memory(plan), _frames(plan)]
    steps = _steps(plan)
    ratios = [
        Ratio(above="step, the paper's way", below="step, scanline", value=ratio(steps["paper"], steps["scanline"]))
    ]
    return GrowthResult(
        machine=machine,
        command="rsavatar bench growth --json docs/benchmarks/growth.json",
        step_ms={name: median(taken) for name, taken in steps.items()},
        curves=curves,
        ratios=ratios,
        targets=_targets(steps, ratios, curves),
    )


def _gaussians(plan: Plan, threads: int) -> Curve:
    points = [_point(count, replace(plan.size, gaussians=count), plan) for count in plan.gaussians]
    fixed = f"{plan.size.pixels} x {plan.size.pixels} px"
    return Curve(axis="gaussians", name=_name("scanline", threads), fixed=fixed, points=points)


def _pixels(plan: Plan, threads: int) -> Curve:
    points = [_point(side, replace(plan.size, pixels=side), plan) for side in plan.pixels]
    return Curve(
        axis="pixels", name=_name("scanline", threads), fixed=f"{plan.size.gaussians} Gaussians", points=points
    )


def _name(way: str, threads: int) -> str:
    return f"{way}, {threads} thread{'s' if threads > 1 else ''}"


def _point(x: float, size: Size, plan: Plan) -> Point:
    """Render and training step of the scanline at a size."""
    narrate(f"{size.gaussians} Gaussians, {size.pixels} px, {kernels.threads()} threads")
    way = _scanline(size)
    shot = _exposure(size, way)
    taken = interleave({"forward": shot.forward, "total": shot.total}, plan.rounds)
    step = _step(Training(size, way), plan.rounds)
    return Point(x=x, forward_ms=median(taken["forward"]), total_ms=median(taken["total"]), step_ms=median(step))


def _scanline(size: Size) -> Way:
    return scan(size.pixels)


def _exposure(size: Size, way: Way) -> Exposure:
    """Ready to be timed; the upstream gradients are noise, which no pixel escapes."""
    noise = torch.Generator().manual_seed(size.seed)
    shape = (size.pixels, size.pixels)
    upstream = torch.randn(3, *shape, generator=noise), torch.randn(*shape, generator=noise)
    return Exposure(build(size), way, upstream)


def _step(training: Training, rounds: int) -> list[float]:
    """Milliseconds of a step in each round, its share of a refresh included."""
    taken = interleave({"step": training.step}, rounds)["step"]
    refresh = median(interleave({"refresh": training.refresh}, rounds=3)["refresh"])
    return [Training.amortised(ms, refresh) for ms in taken]


def _bands(plan: Plan) -> list[Curve]:
    """Render time by T: bands, the paper's way, and, measured once, the scanline, which has no T."""
    narrate("bands")
    height = plan.size.pixels
    ways = [in_bands(height, T) for T in plan.bands] + [_scanline(plan.size)]
    ways += [replace(paper(height, T), name=f"paper-{T}") for T in plan.whole]
    shots = {way.name: _exposure(plan.size, way) for way in ways}
    forward = interleave({name: shot.forward for name, shot in shots.items()}, plan.rounds)
    total = interleave({name: shot.total for name, shot in shots.items()}, plan.rounds)

    def curve(name: str, places: dict[int, str]) -> Curve:
        points = [Point(x=T, forward_ms=median(forward[way]), total_ms=median(total[way])) for T, way in places.items()]
        fixed = f"{plan.size.gaussians} Gaussians, {height} x {height} px, threads: {kernels.threads()}"
        return Curve(axis="bands", name=name, fixed=fixed, points=points)

    return [
        curve("bands", {T: f"bands-{T}" for T in plan.bands}),
        curve("the paper's way", {T: f"paper-{T}" for T in plan.whole}),
        curve("scanline", {plan.bands[0]: "scanline", plan.bands[-1]: "scanline"}),
    ]


def _memory(plan: Plan) -> list[Curve]:
    """Peak memory by T."""
    if not plan.memory_bands:
        return []
    narrate("memory")
    scanline = render_mb(plan.size, None)
    fixed = f"{plan.size.gaussians} Gaussians, {plan.size.pixels} x {plan.size.pixels} px, forward and backward"
    bands = [Point(x=T, memory_mb=render_mb(plan.size, T)) for T in plan.memory_bands]
    flat = [Point(x=T, memory_mb=scanline) for T in (plan.memory_bands[0], plan.memory_bands[-1])]
    return [
        Curve(axis="memory", name="bands", fixed=fixed, points=bands),
        Curve(axis="memory", name="scanline", fixed=fixed, points=flat),
        *_memory_of_steps(plan),
    ]


def _memory_of_steps(plan: Plan) -> list[Curve]:
    """Memory of a process by the number of training steps that it has taken."""
    narrate("memory over training steps")
    held = training_mb(plan.size, plan.memory_steps)
    fixed = f"the whole process, {plan.size.gaussians} Gaussians, {plan.size.pixels} x {plan.size.pixels} px"

    def curve(name: str, taken: list[float]) -> Curve:
        points = [Point(x=steps, memory_mb=mb) for steps, mb in zip(plan.memory_steps, taken, strict=True)]
        return Curve(axis="steps", name=name, fixed=fixed, points=points)

    return [curve("resident", [h.resident for h in held]), curve("in use", [h.in_use for h in held])]


def _frames(plan: Plan) -> Curve:
    """The training step by the number of frames, whose control points all belong to one optimiser."""
    narrate("frames")
    way = _scanline(plan.size)
    points = [
        Point(x=frames, step_ms=median(_step(Training(plan.size, way, frames), plan.rounds))) for frames in plan.frames
    ]
    fixed = f"{plan.size.gaussians} Gaussians, {plan.size.pixels} x {plan.size.pixels} px"
    return Curve(axis="frames", name=_name("scanline", kernels.threads()), fixed=fixed, points=points)


def _steps(plan: Plan) -> dict[str, list[float]]:
    """The training step of the scanline, of bands with T = K, and of the paper's way, in turns."""
    narrate("training steps")
    height = plan.size.pixels
    ways = {"scanline": _scanline(plan.size), "bands": in_bands(height, plan.K), "paper": paper(height, plan.K)}
    trainings = {name: Training(plan.size, way) for name, way in ways.items()}
    taken = interleave({name: t.step for name, t in trainings.items()}, plan.step_rounds, slow_rounds=7)
    refresh = interleave({name: t.refresh for name, t in trainings.items()}, rounds=3)
    return {name: [Training.amortised(ms, median(refresh[name])) for ms in taken[name]] for name in ways}


def _targets(steps: dict[str, list[float]], ratios: list[Ratio], curves: list[Curve]) -> list[Target]:
    scanline = median(steps["scanline"])
    memory = {c.name: [p.memory_mb or 0.0 for p in c.points] for c in curves if c.axis == "memory"}
    found = [
        Target.at_most(10.0, scanline, "training step, scanline", "ms"),
        Target.at_least(8.0, ratios[0].value, "training step, the paper's way / scanline"),
        Target.at_most(4.0, 20_000 * scanline / 60_000, "20 000 steps", "min"),
    ]
    if memory:
        whole, most = memory["bands"][0], memory["bands"][-1]
        found.append(Target.at_most(1.2, memory["scanline"][0] / whole, "peak memory, scanline / one whole image"))
        held = {c.name: [p.memory_mb or 0.0 for p in c.points] for c in curves if c.axis == "steps"}
        for name, taken in held.items():
            found.append(Target.at_most(1.02, taken[-1] / taken[0], f"memory {name}, last training step / 200th"))
        found.append(Target.at_most(1.2, most / whole, "peak memory, bands T = H / one whole image"))
    return found
