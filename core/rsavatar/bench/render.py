"""``rsavatar bench render``: run time against error of every way to render a rolling shutter (scene P13).

**Protocol.** Float32 kernels, all cores. A timing is the median over rounds in which every way takes its turn, after a
warm-up; "forward and backward" computes the gradients of all eight inputs of the renderer, poses and skinning weights
included, and excludes kinematics, loss and optimiser. Error is against ``truth``, in its foreground, the median over
seeds. The motion gradient is the gradient with respect to the spline's control points of the fixed linear functional
<G, image>, where G = truth - truth shifted by 3 pixels down and right (what a squared error against a misaligned image
sends back); its error is |g - g_H| / |g_H| with g_H that of bands with T = H.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median

import torch

from rsavatar import kernels
from rsavatar.bench import page, results, tables
from rsavatar.bench.accuracy import compare, misaligned, order_of, over_seeds
from rsavatar.bench.machine import describe
from rsavatar.bench.results import Order, Ratio, RenderResult, SceneFacts, Target, WayFigures
from rsavatar.bench.scene import MovingBody, Size, build
from rsavatar.bench.timing import interleave, milliseconds, narrate, ratio
from rsavatar.bench.truth import Truth, truth_of
from rsavatar.bench.ways import Exposure, all_ways, scan
from rsavatar.render import reference
from rsavatar.render.base import Options

Taken = dict[str, list[float]]


@dataclass(frozen=True)
class Plan:
    """How much to measure. Timings, ratios and scene facts are those of the first seed."""

    size: Size = field(default_factory=Size)
    seeds: tuple[int, ...] = (0, 1, 2)
    motions_px: tuple[float, ...] = (25.0, 50.0, 100.0, 200.0)
    main_px: float = 50.0  # the motion that ratios and targets speak of; one of ``motions_px``
    K: int = 11  # source frames per frame: the paper's T
    rounds: int = 31
    twin: bool = True


ONE_PASS = "scanline, in one pass"  # what training takes: the image, its L1 and the gradients


@dataclass(frozen=True)
class _AtMotion:
    """What was found at one speed of the body."""

    ways: list[WayFigures]
    taken: Taken  # ms of forward and backward in each round, by the way's name
    order: Order
    facts: SceneFacts
    body: MovingBody
    truth: Truth


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


def measure(plan: Plan) -> RenderResult:
    """All of it."""
    machine = describe()
    found = {motion: _at(motion, plan) for motion in plan.motions_px}
    main_motion = found[plan.main_px]
    twin = _twin(main_motion, plan) if plan.twin else None
    ways = [figures for at in found.values() for figures in at.ways]
    ratios = _ratios(main_motion.taken, plan, twin)
    return RenderResult(
        machine=machine,
        command="rsavatar bench render --json docs/benchmarks/render.json",
        scene=main_motion.facts,
        main_px=plan.main_px,
        seeds=list(plan.seeds),
        twin_ms=twin[0] if twin else None,
        ways=ways,
        ratios=ratios,
        orders=[at.order for at in found.values()],
        targets=_targets(ways, median(main_motion.taken[ONE_PASS]), ratios, plan),
    )


def _at(motion: float, plan: Plan) -> _AtMotion:
    """Errors of all seeds and times of the first, at one speed."""
    narrate(f"{motion:g} px of motion")
    sizes = [replace(plan.size, motion_px=motion, seed=seed) for seed in plan.seeds]
    bodies = [build(size) for size in sizes]
    truths = [truth_of(body, Options()) for body in bodies]
    ways = all_ways(plan.size.pixels, plan.K)
    accuracies = [compare(body, truth, ways) for body, truth in zip(bodies, truths, strict=True)]
    shots = {way.name: Exposure(bodies[0], way, misaligned(truths[0])) for way in ways}
    forward = interleave({name: shot.forward for name, shot in shots.items()}, plan.rounds)
    actions = {name: shot.total for name, shot in shots.items()} | {ONE_PASS: shots["scanline"].one_pass}
    total = interleave(actions, plan.rounds)
    figures = [
        WayFigures(
            way=way.name,
            label=way.label,
            bands=way.bands,
            motion_px=motion,
            accuracy=over_seeds([accuracy[way.name] for accuracy in accuracies]),
            forward_ms=median(forward[way.name]),
            total_ms=median(total[way.name]),
            rounds=len(total[way.name]),
        )
        for way in ways
    ]
    converging = [f for f in figures if 1 < f.bands < plan.size.pixels]  # T = 1 and T = H are special
    order = order_of([f.bands for f in converging], [f.accuracy.psnr_db for f in converging], motion)
    return _AtMotion(figures, total, order, _facts(sizes[0], truths[0]), bodies[0], truths[0])


def _facts(size: Size, truth: Truth) -> SceneFacts:
    pixels = int(truth.foreground.sum())
    return SceneFacts(
        gaussians=size.gaussians,
        pixels=size.pixels,
        foreground_px=pixels,
        blended_per_px=float(truth.blended.sum()) / pixels,
    )


def _twin(at: _AtMotion, plan: Plan) -> tuple[float, float]:
    """Forward and backward of the torch twin on the same scene with the same gradients, float64.

    The median of three, between rounds of the kernels: returns its time, and by how much theirs is shorter.
    """
    narrate("the torch twin")
    scanline, upstream = scan(plan.size.pixels), misaligned(at.truth)
    twin, kernel = Exposure(at.body, scanline, upstream, reference.render), Exposure(at.body, scanline, upstream)
    before = interleave({"kernels": kernel.total}, plan.rounds)["kernels"]
    taken = median(milliseconds(twin.total) for _ in range(3))
    after = interleave({"kernels": kernel.total}, plan.rounds)["kernels"]
    return taken, taken / median(before + after)


def _ratios(taken: Taken, plan: Plan, twin: tuple[float, float] | None) -> list[Ratio]:
    K, H = plan.K, plan.size.pixels
    pairs = [
        ("scanline", "global"),
        (f"bands-{min(4 * K, H)}", f"bands-{K}"),
        ("scanline", f"bands-{K}"),
        (ONE_PASS, "scanline"),
        ("bands-all", f"bands-{K}"),
        ("paper", "scanline"),
        (f"bands-{H}", "scanline"),
    ]
    found = [Ratio(above=a, below=b, value=ratio(taken[a], taken[b])) for a, b in pairs]
    if twin is not None:
        found.append(Ratio(above="torch twin", below="scanline", value=twin[1]))
    return found


def _targets(ways: list[WayFigures], one_pass_ms: float, ratios: list[Ratio], plan: Plan) -> list[Target]:
    at = {(f.way, f.motion_px): f for f in ways}
    value = {(r.above, r.below): r.value for r in ratios}
    K, H, px = plan.K, plan.size.pixels, plan.main_px
    scanline = at["scanline", px]
    coarse, fine = f"bands-{K}", f"bands-{min(4 * K, H)}"
    found = [
        Target.at_most(5.0, scanline.total_ms, "scanline, forward and backward", "ms"),
        Target.at_most(5.0, one_pass_ms, "scanline, forward, L1 and backward in one pass", "ms"),
        Target.at_most(1.2, value["scanline", "global"], "scanline / global shutter"),
        Target.at_most(3.0, value[fine, coarse], "bands T = 4K / bands T = K"),
        Target.at_most(1.0, value["scanline", coarse], "scanline / bands T = K"),
        Target.at_least(80.0, scanline.accuracy.psnr_db, f"scanline at {px:g} px of motion", "dB"),
        Target.at_most(2e-4, scanline.accuracy.motion_gradient_error, f"error of the motion gradient at {px:g} px"),
    ]
    if ("scanline", 200.0) in at:
        fast = at["scanline", 200.0].accuracy.psnr_db
        found.append(Target.at_least(74.0, fast, "scanline at 200 px of motion", "dB"))
    if ("torch twin", "scanline") in value:
        found.append(Target.at_least(500.0, value["torch twin", "scanline"], "torch twin / scanline"))
    return found
