"""The ways to render a rolling shutter that the benchmarks compare, all on the same kernels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import torch
from torch import Tensor

from rsavatar.bench.scene import READOUT, MovingBody
from rsavatar.imaging import NODES
from rsavatar.render import native
from rsavatar.render.base import Correction, Gaussians, Options, Rendering, Scene
from rsavatar.shutter.base import Slot
from rsavatar.shutter.rolling import Bands, Instant, Scanline


@dataclass(frozen=True)
class Way:
    """Slots, and how they are rendered; ``bands``: T of a way in bands, 0 for others."""

    name: str
    label: str
    slots: tuple[Slot, ...]
    options: Options = field(default_factory=Options)
    nodes: int = NODES  # of a scanned slot's pose polynomial
    bands: int = 0
    whole: bool = False  # each slot is rendered as an image of its own, of which its rows are taken


def global_shutter(height: int) -> Way:
    """The whole image at the mid time."""
    return Way("global", "global shutter (T = 1)", Instant().slots(height, READOUT, 0.0), bands=1)


def in_bands(height: int, bands: int) -> Way:
    """T bands, of which only their own rows are rendered."""
    return Way(f"bands-{bands}", f"bands, T = {bands}", Bands(bands).slots(height, READOUT, 0.0), bands=bands)


def paper(height: int, bands: int) -> Way:
    """The paper's operator as it is written: T full renders, of which each gives its band of rows."""
    label = f"the paper's way: {bands} full renders"
    return replace(in_bands(height, bands), name="paper", label=label, whole=True, bands=0)


def scan(height: int, name: str = "scanline", label: str = "scanline", *without: Correction) -> Way:
    """Each Gaussian at its own time. Rows are exposed at their middles, as the bands' limit is (``MovingBody``)."""
    slots = Scanline().slots(height, READOUT, READOUT / height / 2)
    return Way(name, label, slots, Options(without=frozenset(without)))


def all_ways(height: int, K: int) -> list[Way]:
    """Every way for K source frames per frame: T = 1, the paper's, bands from K to H, and own time step by step.

    The last three have one thing changed: bands for which every Gaussian is projected; the scanline with a pose node
    less, and with strips of a single row.
    """
    label, everything = f"bands, T = {K}, nothing culled", Options(without=frozenset({"cull"}))
    unculled = replace(in_bands(height, K), name="bands-all", label=label, bands=0, options=everything)
    fewer = replace(scan(height, "scanline-4", "scanline, four pose nodes"), nodes=4)
    single = replace(scan(height, "scanline-row", "scanline, strips of one row"), options=Options(strip_rows=1))
    finer = sorted({min(T, height) for T in (K, 2 * K, 4 * K, 16 * K, height)})
    return [
        global_shutter(height),
        paper(height, K),
        *(in_bands(height, T) for T in finer),
        scan(height, "own-time", "own time only", "shear", "implicit", "resort"),
        scan(height, "own-time+shear", "+ shear, implicit derivative", "resort"),
        scan(height, "scanline", "+ depth re-sort (scanline)"),
        unculled,
        fewer,
        single,
    ]


def compose_whole(scene: Scene) -> Rendering:
    """Render every slot as a whole image of its own, and put the slots' rows together (paper, eq. rs_discrete)."""
    images = []
    for t, rows in enumerate(scene.rows):
        alone = (replace(rows, lo=0, hi=scene.camera.height),)
        images.append(native.render(replace(scene, pose=scene.pose[t : t + 1], rows=alone)))
    bands = list(zip(images, scene.rows, strict=True))
    rgb = torch.cat([image.rgb[:, r.lo : r.hi] for image, r in bands], 1)
    transmittance = torch.cat([image.transmittance[r.lo : r.hi] for image, r in bands])
    counted = (sum(getattr(image, name) for image in images) for name in ("projected", "splats", "pairs", "broken"))
    return Rendering(rgb, transmittance, *counted)


class Exposure:
    """One way's image of one body, ready to be rendered again and again, with gradients of everything."""

    def __init__(
        self,
        body: MovingBody,
        way: Way,
        upstream: tuple[Tensor, Tensor],
        render: Callable[[Scene], Rendering] = native.render,
    ) -> None:
        """``upstream``: gradients [3, H, W] and [H, W], float32, that every backward starts from."""
        scene = body.scene(way.slots, way.options, way.nodes)
        self._control = body.motion.control
        self._pose = scene.pose  # a function of the control points
        leaves = {f.name: getattr(scene.gaussians, f.name).detach().requires_grad_() for f in fields(Gaussians)}
        pose = scene.pose.detach().requires_grad_()
        self.scene = replace(scene, gaussians=Gaussians(**leaves), pose=pose)
        self._leaves = [*leaves.values(), pose]
        self._render = compose_whole if way.whole else render
        self._upstream = upstream

    def forward(self) -> Rendering:
        """The image alone."""
        with torch.no_grad():
            return self._render(self.scene)

    def total(self) -> tuple[Tensor, ...]:
        """The image and the gradients of all eight inputs of the renderer, in the order of ``Gaussians``, pose last."""
        image = self._render(self.scene)
        upstream = [g.to(image.rgb.dtype) for g in self._upstream]
        return torch.autograd.grad([image.rgb, image.transmittance], self._leaves, upstream)

    @cached_property
    def _seen(self) -> tuple[Tensor, Tensor]:
        """The image itself as bytes [3, H, W], and its mask."""
        image = self.forward()
        return (255 * image.rgb.clamp(0, 1)).byte(), (255 * (1 - image.transmittance)).byte()

    def one_pass(self) -> tuple[Tensor, ...]:
        """The gradients of an L1 loss, as training takes them: strips are drawn, compared and walked back at once."""
        loss = native.render_l1(self.scene, *self._seen, background=0.0, mask_weight=0.1).loss
        return torch.autograd.grad(loss, self._leaves)

    def motion_gradient(self) -> Tensor:
        """Gradient [1, P, 25, 3] of the motion's control points, float64."""
        (found,) = torch.autograd.grad(self._pose, self._control, self.total()[-1], retain_graph=True)
        return found.double()
