"""What training holds besides the actor: Adam's moments, running gradients, the step; and its checkpoints."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from rsavatar import checkpoint
from rsavatar.adam import Adam, Moments
from rsavatar.avatar.density import DensityRules, Edit, ScreenGradients
from rsavatar.avatar.networks import refine
from rsavatar.doubt import Doubt
from rsavatar.errors import DivergedError, expected
from rsavatar.events import Checkpointed
from rsavatar.imaging import Actor
from rsavatar.motion.base import Continuity
from rsavatar.parallel import spread
from rsavatar.render.base import Scene
from rsavatar.skipping import Nodes, Settled
from rsavatar.spec import SKIPS, Skip

BLOCK = 50  # steps between refreshes of the skinning weights; all that saves state happens between blocks
CHUNK = 2048  # Gaussians: what a layer of the skinning network makes of so many stays in a core's cache
MOST_REJECTED = 50  # rejected steps in a row before training is called diverged
DOUBT_AFTER = 500  # steps: before, losses tell how far the avatar has come with an image
FAR = 3.0  # times the best block's mean loss: diverged. Sound runs, density control included, stayed within twice


@dataclass(frozen=True)
class Rates:
    """Adam's step sizes, and how large a Gaussian may grow. These are the authors': GauHuman's and MAD-Avatar's."""

    means: float = 1.6e-4  # times the extent; falls to 1/100 of itself, log-linearly
    colours: float = 2.5e-3
    colours_linear: float = 1.25e-4
    opacities: float = 0.05
    scales: float = 5e-3
    rotations: float = 1e-3
    motion: float = 1e-3  # control points and shape; falls to 1/100 of itself, log-linearly
    pose_residual: float = 5e-5  # falls to 1/100 as the motion's, which the authors' does not (docs/decisions/0019)
    skin_offset: float = 5e-4  # one step a block, on the sum of its gradients
    clock: float = 8e-3  # readouts as a part of themselves, triggers in periods; falls to 1/100 as the motion's
    largest: float = math.inf  # metres


# Four views cannot tell a displaced limb from displaced Gaussians, nor a limb from its visual hull. So the motion moves
# first, and the Gaussians stay where the body puts them, too small to stick out of it between two views.
POSE_FIRST = Rates(means=3e-5, motion=2e-3, largest=0.010)


@dataclass(frozen=True)
class Settings:
    """How long and how to train."""

    iterations: int
    seed: int
    extent: float  # metres: 1.1 times the largest distance of a camera from their centre
    lambda_reg: float
    continuity: Continuity
    mask_weight: float
    sh_degree: int
    checkpoint_every: int
    density: DensityRules | None
    rates: Rates = field(default_factory=Rates)
    paint: bool = False  # give the Gaussians first colours from the pictures
    sh_from: int = 1000  # step at which the colours' linear harmonics start
    ssim_weight: float = 0.0
    skip: frozenset[Skip] = frozenset(SKIPS)
    doubt: bool = False
    doubt_from: float = 0.2  # part of the run after which images that contradict all others are left out,
    doubt_after: int = DOUBT_AFTER  # and steps

    def degree(self, step: int) -> int:
        """Degree of the colours' harmonics at ``step``."""
        return self.sh_degree if step >= self.sh_from or not self.skips("harmonics") else 0

    def skips(self, what: Skip) -> bool:
        """Whether a kind of work is left out."""
        return what in self.skip

    def doubts(self, step: int) -> bool:
        """Whether images are judged after ``step``."""
        return self.doubt and max(self.doubt_from * self.iterations, self.doubt_after) <= step < self.iterations

    def closes_block(self, step: int) -> bool:
        """Whether a block of steps ends at ``step`` (counted from 1)."""
        return step % BLOCK == 0


class SkinBlock:
    """Skinning weights of one block of steps: computed once, their gradient summed, one network step at the end.

    The offset network sees canonical positions only, and those hardly move within a block. It is evaluated, and
    walked back, ``CHUNK`` Gaussians at a time.
    """

    def __init__(self, actor: Actor) -> None:
        self._network = actor.skin_offset
        if self._network is None:
            self.weights = actor.avatar.prior
            return
        count, network = actor.avatar.count, self._network
        means, prior = actor.avatar.means.detach(), actor.avatar.prior
        self._chunks = [slice(first, first + CHUNK) for first in range(0, count, CHUNK)]
        self._refined = spread(lambda part: refine(prior[:, part], network(means[:, part])), self._chunks)
        self.weights = torch.cat([refined.detach() for refined in self._refined], 1).requires_grad_()

    def close(self, optimizer: Adam) -> None:
        """Hand the summed gradient to the network and take its step; non-finite sums are dropped."""
        gradient = self.weights.grad
        if self._network is None or gradient is None or not math.isfinite(float(gradient.sum())):
            return
        parameters = list(self._network.parameters())

        def walk_back(place: int) -> tuple[Tensor, ...]:
            return torch.autograd.grad(self._refined[place], parameters, gradient[:, self._chunks[place]])

        parts = spread(walk_back, range(len(self._chunks)))
        for parameter, *found in zip(parameters, *parts, strict=True):
            parameter.grad = torch.stack(found).sum(0)
        optimizer.advance()
        optimizer.forget()


class State:
    """Everything that changes from step to step, besides the actor's own parameters."""

    def __init__(self, actor: Actor, settings: Settings, images: int = 0) -> None:
        rates, a = settings.rates, actor.avatar
        motion = [*actor.motion.parameters(), actor.shapes]
        groups: list[tuple[str, list[torch.nn.Parameter], float]] = [
            ("means", [a.means], rates.means * settings.extent),
            ("sh_constant", [a.sh_constant], rates.colours),
            ("sh_linear", [a.sh_linear], rates.colours_linear),
            ("opacity_logits", [a.opacity_logits], rates.opacities),
            ("log_scales", [a.log_scales], rates.scales),
            ("rotations", [a.rotations], rates.rotations),
            ("motion", motion, rates.motion),
            (
                "pose_residual",
                list(actor.pose_residual.parameters()) if actor.pose_residual else [],
                rates.pose_residual,
            ),
            ("clock", list(actor.clock.parameters()) if actor.clock else [], rates.clock),
        ]
        adam = [{"name": name, "params": params, "lr": lr, "initial": lr} for name, params, lr in groups if params]
        self.optimizer = Adam(adam, rates.motion, epsilon=1e-15)
        skin = list(actor.skin_offset.parameters()) if actor.skin_offset else [torch.nn.Parameter(torch.zeros(0))]
        self.skin_optimizer = Adam([{"params": skin}], rates.skin_offset)
        self.gradients = ScreenGradients(actor.avatar.count)
        self.doubt = Doubt(images)
        self.nodes = Nodes(images)
        self.settled = Settled(images)
        self.largest = rates.largest
        self.step = 0
        self.rejected = 0
        self.rejected_in_a_row = 0
        self.rejected_in_block = 0
        self.losses: list[float] = []  # of the block's accepted steps
        self.best = math.inf  # least mean loss of a block
        self.seconds = 0.0

    def note(self, index: int, loss: float, scene: Scene) -> None:
        """Remember what looking at image ``index`` showed."""
        self.doubt.note(index, loss)
        self.settled.note(index, loss)
        self.nodes.note(index, scene)

    def advance(self, actor: Actor, screen: Tensor, loss: Tensor, size: tuple[int, int]) -> None:
        """Take the optimiser's step on the gradients at hand, or reject them where they are not finite.

        Raises:
            DivergedError: after ``MOST_REJECTED`` rejections in a row.
        """
        if math.isfinite(float(loss)) and self.optimizer.advance(_grad(screen)):
            actor.avatar.limit_scales(self.largest)
            self.gradients.add(_grad(screen), *size)
            self.rejected_in_a_row = 0
            self.losses.append(float(loss))
        else:
            self.rejected, self.rejected_in_a_row = self.rejected + 1, self.rejected_in_a_row + 1
            self.rejected_in_block += 1
            if self.rejected_in_a_row >= MOST_REJECTED:
                problem = expected("loss and gradients", "finite numbers", f"none in {MOST_REJECTED} steps in a row")
                raise DivergedError(f"diverged at step {self.step}: {problem}")
        self.optimizer.forget()
        self.step += 1

    def require_finite(self, actor: Actor) -> None:
        """Raise ``DivergedError`` naming a parameter that holds NaN or infinity."""
        for name, parameter in actor.named_parameters():
            if not torch.isfinite(parameter).all():
                raise DivergedError(
                    f"diverged at step {self.step}: {expected(name, 'finite numbers', 'NaN or infinity')}"
                )

    def close_block(self, actor: Actor) -> int:
        """Judge the block of steps that ends here, before anything of it is saved; returns how many were rejected.

        Raises:
            DivergedError: if a parameter is not finite, or the mean loss is ``FAR`` times the best block's.
        """
        self.require_finite(actor)
        if self.losses:
            mean = sum(self.losses) / len(self.losses)
            if mean > FAR * self.best:
                wanted = f"at most {FAR:g} times the best so far, {self.best:.3g}"
                raise DivergedError(f"diverged at step {self.step}: {expected('mean loss', wanted, f'{mean:.3g}')}")
            self.best = min(self.best, mean)
        rejected, self.rejected_in_block, self.losses = self.rejected_in_block, 0, []
        return rejected

    def set_rates(self, settings: Settings) -> None:
        """Means, motion, pose network and clock fall to a hundredth of their first rate, log-linearly over the run."""
        decay = 0.01 ** (self.step / settings.iterations)
        for group in self.optimizer.param_groups:
            if group["name"] in ("means", "motion", "pose_residual", "clock"):
                group["lr"] = group["initial"] * decay

    def edit(self, actor: Actor, edit: Edit) -> None:
        """Apply a density edit to the Gaussians, Adam's moments and the running gradients."""
        for group in self.optimizer.param_groups:
            if group["name"] not in edit.added:
                continue
            added = edit.added[group["name"]]
            old = group["params"][0]
            new = torch.nn.Parameter(torch.cat([old.detach()[..., edit.keep], added], -1))
            moments = self.optimizer.state.pop(old, {})
            for key in ("exp_avg", "exp_avg_sq"):
                if key in moments:
                    moments[key] = torch.cat([moments[key][..., edit.keep], torch.zeros_like(added)], -1)
            if moments:
                self.optimizer.state[new] = moments
            group["params"][0] = new
            setattr(actor.avatar, group["name"], new)
        self.gradients = ScreenGradients(actor.avatar.count)


def _grad(tensor: Tensor) -> Tensor:
    return tensor.grad if tensor.grad is not None else torch.zeros_like(tensor)


class Saver:
    """Checkpoints of one training run: a file, and who it belongs to."""

    def __init__(self, path: Path, owner: checkpoint.Owner) -> None:
        self.path = path
        self.owner = owner

    def due(self, step: int, settings: Settings) -> bool:
        """Whether the end of the block that ends at ``step`` is one to save: every so many steps, and the last."""
        every = -(-settings.checkpoint_every // BLOCK) * BLOCK
        return step % every == 0 or step == settings.iterations

    def save(self, actor: Actor, state: State) -> Checkpointed:
        """Write everything that the next step depends on."""
        tensors = {f"actor.{name}": t for name, t in actor.state_dict().items()}
        for prefix, optimizer in (("adam", state.optimizer), ("skin_adam", state.skin_optimizer)):
            for i, moments in optimizer.moments.items():
                tensors |= {f"{prefix}.{i}.{key}": value for key, value in moments.items()}
        tensors |= {"gradients.total": state.gradients.total, "gradients.seen": state.gradients.seen}
        tensors |= {"doubt.losses": state.doubt.losses, "doubt.doubted": state.doubt.doubted}
        tensors |= {"nodes.needed": state.nodes.needed, "nodes.visits": state.nodes.visits}
        tensors |= {"settled.last": state.settled.last, "settled.calm": state.settled.calm}
        tensors["progress"] = torch.tensor([state.rejected, state.seconds, state.best], dtype=torch.float64)
        return Checkpointed(state.step, str(self.path), checkpoint.write(self.path, tensors, self.owner, state.step))

    def restore(self, actor: Actor, settings: Settings, images: int) -> State:
        """The state to go on from, over so many training images: the checkpoint's, or a new one where there is none.

        Raises:
            CheckpointError: if there is one that is damaged or belongs to another job.
        """
        if not self.path.exists():
            return State(actor, settings, images)
        tensors, step = checkpoint.read_own(self.path, self.owner)
        load_actor(actor, tensors)
        state = State(actor, settings, images)
        for prefix, optimizer in (("adam", state.optimizer), ("skin_adam", state.skin_optimizer)):
            saved: dict[int, Moments] = {}
            for name, value in tensors.items():
                if name.startswith(prefix + "."):
                    _, i, key = name.split(".")
                    saved.setdefault(int(i), {})[key] = value
            optimizer.moments = saved
        state.gradients.total, state.gradients.seen = tensors["gradients.total"], tensors["gradients.seen"]
        state.doubt.losses, state.doubt.doubted = tensors["doubt.losses"], tensors["doubt.doubted"]
        state.nodes.needed, state.nodes.visits = tensors["nodes.needed"], tensors["nodes.visits"]
        state.settled.last, state.settled.calm = tensors["settled.last"], tensors["settled.calm"]
        rejected, state.seconds, state.best = tensors["progress"].tolist()
        state.rejected = int(rejected)
        state.step = step
        return state


def load_actor(actor: Actor, tensors: dict[str, Tensor]) -> None:
    """Put a checkpoint's Gaussians, motion and networks into ``actor``, whatever their number."""
    for name, parameter in actor.named_parameters():
        parameter.data = tensors[f"actor.{name}"]
    for name in ("vertex", "prior"):
        setattr(actor.avatar, name, tensors[f"actor.avatar.{name}"])
