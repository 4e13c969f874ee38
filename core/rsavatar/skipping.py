"""What a training step leaves out because its scene does not need it. Every skip is a word of ``JobSpec.skip``.

| word | what is left out | what it may change |
|---|---|---|
| body | rows and columns of an image beyond the body's box | nothing: the loss there is the background's |
| nodes | pose nodes of a readout in which the body moves too little to need them | at most ``TOLERANCE_PX`` pixels |
| harmonics | the colours' linear harmonics before step ``sh_from``, when no colour is there to refine | training |
| networks | refreshing the skinning network more often than once a block of steps | training |
| settled | every second visit to an image whose loss no longer changes | training; off unless asked for |

Culled splats, and strips without any, are left out by the kernels always: what they leave out is below the opacity that
they would draw (``Options.alpha_min``). Of several slots, so are blocks of Gaussians that cannot reach a slot's rows,
before they are posed: the image keeps its bits (``core/native/cull.cpp``; ``Options.without`` has a switch).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from rsavatar.imaging import NODES, Schedule, chebyshev_nodes
from rsavatar.render.base import Comparison, Rendering, Scene

TOLERANCE_PX = 0.01  # of image motion; a shift of that much is 60 dB below the steepest edge
REACH = 0.15  # metres: how far a body's surface is from its joints
LOOK_EVERY = 8  # visits to an image between looks at how many nodes it needs
CALM = 0.005  # relative change of a loss between visits that counts as none
CALM_VISITS = 3  # in a row, for an image to be settled


class Nodes:
    """How many pose nodes the slots of every training image need, D in 1 .. ``NODES``.

    The path of a joint over the readout is a sum of Chebyshev polynomials; what D nodes cannot follow is at most the
    sum of the coefficients from the D-th on. Every ``LOOK_EVERY`` visits an image gets all its nodes, and that sum, in
    pixels, decides for the visits until the next look.
    """

    def __init__(self, images: int) -> None:
        self.needed = torch.full((images,), NODES)
        self.visits = torch.zeros(images, dtype=torch.int64)
        self._thinned: dict[tuple[int, int], Schedule] = {}

    def _looks(self, index: int) -> bool:
        return int(self.visits[index]) % LOOK_EVERY == 0

    def choose(self, index: int, schedule: Schedule) -> Schedule:
        """The schedule of image ``index`` with as many nodes as it needs."""
        nodes = schedule.coefficients if self._looks(index) else min(int(self.needed[index]), schedule.coefficients)
        if nodes == schedule.coefficients:
            return schedule
        key = index, nodes
        if key not in self._thinned:
            self._thinned[key] = thinned(schedule, nodes)
        return self._thinned[key]

    def note(self, index: int, scene: Scene) -> None:
        """Count a visit; learn from a look that had all its nodes."""
        if self._looks(index) and scene.pose.shape[1] == NODES:
            self.needed[index] = needed_nodes(scene)
        self.visits[index] += 1


def thinned(schedule: Schedule, nodes: int) -> Schedule:
    """The same slots through fewer nodes; with one, they no longer scan."""

    def moved(instants: Tensor) -> Tensor:
        slots = instants.reshape(-1, schedule.coefficients)  # Chebyshev nodes, symmetric about the slot's middle
        old, new = (torch.tensor(chebyshev_nodes(n), dtype=instants.dtype) for n in (schedule.coefficients, nodes))
        middle = slots.mean(1, keepdim=True)
        half = (slots[:, :1] - middle) / old[0]
        return (middle + half * new).reshape(-1)

    rows = schedule.rows if nodes > 1 else tuple(replace(row, rate=0.0, start=0.0) for row in schedule.rows)
    reading = None if schedule.reading is None else moved(schedule.reading)
    return replace(schedule, offsets=moved(schedule.offsets), rows=rows, coefficients=nodes, reading=reading)


def needed_nodes(scene: Scene) -> int:
    """Fewest nodes whose neglected Chebyshev terms move no joint's surroundings by more than ``TOLERANCE_PX``."""
    weights, means = scene.gaussians.skin_weights.detach(), scene.gaussians.means.detach()
    used = weights.sum(1) > 0
    middles = (weights @ means.T)[used] / weights.sum(1)[used, None]  # [j, 3] of what each joint carries, canonical
    terms = torch.einsum(
        "cd,tdjrk->tcjrk", _to_chebyshev(scene.pose.shape[1]), scene.pose.detach().double()[:, :, used]
    )
    path = torch.einsum("tcjrk,jk->tcjr", terms[..., :3], middles.double()) + terms[..., 3]
    metres = torch.linalg.vector_norm(path, dim=-1) + torch.linalg.matrix_norm(terms[..., :3]) * REACH
    camera = scene.camera
    depth = (path[:, 0] @ torch.from_numpy(camera.rotation[2]) + float(camera.translation[2])).min()
    worst = metres.amax((0, 2)) * max(camera.fx, camera.fy) / depth.clamp(min=scene.options.near)  # [D] pixels
    tail = worst.flip(0).cumsum(0).flip(0)
    fitting = torch.nonzero(tail[1:] <= TOLERANCE_PX)
    return int(fitting[0]) + 1 if len(fitting) else scene.pose.shape[1]


@cache
def _to_chebyshev(count: int) -> Tensor:
    """[D, D] from monomial to Chebyshev coefficients."""
    columns = [np.polynomial.chebyshev.poly2cheb(np.eye(count)[d]) for d in range(count)]
    return torch.from_numpy(np.stack([np.pad(c, (0, count - len(c))) for c in columns], 1))


class Work:
    """What the steps since the last look drew and left out: the counters of every skip."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._steps = 0

    def add(self, scene: Scene, image: Rendering | Comparison, full_size: tuple[int, int]) -> None:
        """Count one step."""
        slots, height, width = len(scene.rows), scene.camera.height, scene.camera.width
        one = {
            "pixels": height * width / (full_size[0] * full_size[1]),
            "nodes": float(scene.pose.shape[1]),
            "projected": image.projected / (slots * max(scene.gaussians.count, 1)),
            "splats": image.splats / (slots * max(scene.gaussians.count, 1)),
            "pairs": float(image.pairs),
            "harmonics": float(scene.gaussians.sh.shape[0]),
        }
        self._sums = {name: self._sums.get(name, 0.0) + value for name, value in one.items()}
        self._steps += 1

    def means(self, resting: int) -> dict[str, float]:
        """Per step since the last call: share of the frame's ``pixels`` that are drawn, pose ``nodes``, share of the
        Gaussians that are ``projected`` and that survive culling (``splats``), (splat, strip) ``pairs``, colour
        ``harmonics``; and the number of images that are ``resting``.
        """
        found = {name: round(value / self._steps, 4) for name, value in self._sums.items()} if self._steps else {}
        self._sums, self._steps = {}, 0
        return found | {"resting": float(resting)}


class Settled:
    """Which images' losses no longer change: they are looked at every second time only."""

    def __init__(self, images: int) -> None:
        self.last = torch.full((images,), torch.nan, dtype=torch.float64)
        self.calm = torch.zeros(images, dtype=torch.int64)

    def note(self, index: int, loss: float) -> None:
        """Remember what image ``index`` lost."""
        change = abs(loss - float(self.last[index]))
        self.calm[index] = int(self.calm[index]) + 1 if change <= CALM * abs(loss) else 0
        self.last[index] = loss

    def awake(self, indices: Sequence[int], block: int) -> list[int]:
        """Of ``indices``, those that block number ``block`` looks at; all, where none would be left."""
        chosen = [i for i in indices if int(self.calm[i]) < CALM_VISITS or (i + block) % 2 == 0]
        return chosen or list(indices)
