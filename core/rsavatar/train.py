"""Training: one visible loop that knows neither which motion nor which shutter it holds (paper, section 3.4)."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from rsavatar.avatar.density import DensityRules, decide, prune
from rsavatar.errors import DivergedError, Interrupted, expected
from rsavatar.events import Note, Progress, Report
from rsavatar.geometry.cameras import Camera
from rsavatar.imaging import Actor, Schedule, expose
from rsavatar.losses import compare, dissimilarity, render_l1
from rsavatar.optimization import BLOCK, Saver, Settings, SkinBlock, State
from rsavatar.painting import paint
from rsavatar.render.base import Comparison, Scene
from rsavatar.skipping import Work

REPORT_EVERY = 25  # steps


@dataclass(frozen=True)
class Observation:
    """A training image, cut to its body: bytes, mask, and how its rows were exposed."""

    frame: int
    camera: Camera
    schedule: Schedule
    rgb: Tensor  # [3, h, w] uint8
    mask: Tensor  # [h, w] uint8 coverage
    full_size: tuple[int, int]  # height and width of the uncut image
    label: str = ""  # camera and frame, for people
    weight: float = 1.0  # of its loss: image area by that of the body's box, so that losses are means over the box


@dataclass(frozen=True)
class Trained:
    """What training leaves behind, besides the actor itself."""

    seconds: float
    rejected: int
    checkpoint: Path
    doubted: tuple[str, ...] = ()  # labels of the images that were left out


def fit(
    actor: Actor,
    observations: Sequence[Observation],
    settings: Settings,
    saver: Saver,
    report: Report,
    should_stop: Callable[[], bool],
) -> Trained:
    """Minimise |image - observation| + lambda L_reg over everything that ``actor`` holds (paper, eq. loss).

    One observation a step, each once an epoch in a new order. Every random choice is a function of the seed and the
    step, so a run resumed from a checkpoint ends bit-identical to one that was never disturbed. Skinning weights are
    refreshed, Gaussians come and go, images are doubted where that is asked for, and checkpoints are written
    between blocks of steps.

    Raises:
        DivergedError: if many steps in a row gave no finite loss and gradient, the loss is far above its best, or no
            Gaussians are left. The last good checkpoint is kept.
        Interrupted: if ``should_stop`` asked for it; the checkpoint is on disk.
    """
    state = _begin(actor, observations, settings, saver)
    gc.freeze()  # what is alive now lives to the end: the collector need not walk it again and again
    begun = time.perf_counter() - state.seconds
    skin, chosen, work = SkinBlock(actor), _chosen(state, settings), Work()
    while state.step < settings.iterations:
        index = chosen[pick(settings.seed, state.step, len(chosen))]
        seen = observations[index]
        state.set_rates(settings)

        schedule = actor.timed(state.nodes.choose(index, seen.schedule) if settings.skips("nodes") else seen.schedule)
        scene = actor.scene(seen.frame, seen.camera, schedule, skin.weights, settings.degree(state.step))
        found = _compare(scene, seen, settings)
        loss = seen.weight * found.loss
        state.note(index, float(loss.detach()), scene)
        work.add(scene, found, seen.full_size)
        if settings.lambda_reg:
            loss = loss + settings.lambda_reg * actor.motion.penalty(settings.continuity)
        torch.autograd.backward(loss)

        state.advance(actor, scene.gaussians.screen, loss.detach(), seen.full_size)
        state.seconds = time.perf_counter() - begun
        last = state.step == settings.iterations
        if last or state.step % REPORT_EVERY == 0:
            saved = work.means(resting=len(state.doubt.trusted) - len(chosen))
            report(replace(_progress(state, settings, float(loss.detach()), found.squared_error), work=saved))
        if last or settings.closes_block(state.step):
            skin.close(state.skin_optimizer)
            if rejected := state.close_block(actor):
                report(Note(f"step {state.step}: {rejected} steps of this block rejected, no finite loss and gradient"))
            if settings.doubts(state.step) and (left := state.doubt.judge(_cameras(observations))):
                report(Note(f"step {state.step}: left out as contradicting all others: {_labels(observations, left)}"))
            if settings.density and settings.density.due(state.step):
                report(Note(_control_density(actor, state, settings, settings.density)))
            stop = not last and should_stop()
            if stop or saver.due(state.step, settings):
                report(saver.save(actor, state))
            if stop:
                raise Interrupted(f"stopped at step {state.step} of {settings.iterations}; run again to go on")
            skin, chosen = SkinBlock(actor), _chosen(state, settings)
        elif not settings.skips("networks"):
            skin.close(state.skin_optimizer)
            skin = SkinBlock(actor)
    doubted = tuple(seen.label for seen, bad in zip(observations, state.doubt.doubted.tolist(), strict=True) if bad)
    return Trained(state.seconds, state.rejected, saver.path, doubted)


def _compare(scene: Scene, seen: Observation, settings: Settings) -> Comparison:
    """How far the image of a scene is from what was seen. Without SSIM, no image is kept."""
    if not settings.ssim_weight:
        return render_l1(scene, seen.rgb, seen.mask, 0.0, settings.mask_weight)
    image = expose(scene)
    found = compare(image, seen.rgb, seen.mask, 0.0, settings.mask_weight)
    return replace(found, loss=found.loss + settings.ssim_weight * dissimilarity(image, seen.rgb))


def _begin(actor: Actor, observations: Sequence[Observation], settings: Settings, saver: Saver) -> State:
    """The checkpoint's state, or that of a new run, whose Gaussians take their first colours from the pictures."""
    if settings.paint and not saver.path.exists():
        paint(actor, observations)
    return saver.restore(actor, settings, len(observations))


def pick(seed: int, step: int, count: int) -> int:
    """Which of ``count`` observations step ``step`` looks at: a new permutation each epoch, a function of both."""
    epoch, place = divmod(step, count)
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed * 1_000_003 + epoch))
    return int(order[place])


def _chosen(state: State, settings: Settings) -> list[int]:
    """Which observations the next block of steps looks at."""
    trusted = state.doubt.trusted
    return state.settled.awake(trusted, state.step // BLOCK) if settings.skips("settled") else trusted


def _cameras(observations: Sequence[Observation]) -> Tensor:
    return torch.tensor([seen.schedule.camera for seen in observations])


def _labels(observations: Sequence[Observation], chosen: Sequence[int]) -> str:
    return ", ".join(observations[i].label for i in chosen)


def _control_density(actor: Actor, state: State, settings: Settings, rules: DensityRules) -> str:
    """One round of density control, and what it did."""
    seed = settings.seed * 1_000_003 + state.step
    before = actor.avatar.count
    edit, done = decide(actor.avatar, state.gradients.mean(), settings.extent, rules, seed)
    state.edit(actor, edit)
    state.require_finite(actor)
    grown = actor.avatar.count
    state.edit(actor, prune(actor.avatar, actor.avatar.bind(), rules))
    actor.avatar.bind()
    if actor.avatar.count < 2:
        raise DivergedError(f"diverged at step {state.step}: {expected('Gaussians', '2 or more', actor.avatar.count)}")
    changes = f"{done.cloned} cloned, {done.split} split, {done.merged} merged, {grown - actor.avatar.count} pruned"
    return f"step {state.step}: {before} -> {actor.avatar.count} Gaussians ({changes})"


def _progress(state: State, settings: Settings, loss: float, squared_error: float) -> Progress:
    psnr = -10 * math.log10(max(squared_error, 1e-12))
    count = len(state.gradients.total)
    return Progress("train", state.step, settings.iterations, state.seconds, loss, psnr, count)
