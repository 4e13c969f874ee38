"""What a stress case is, and how the kernels are held against their float64 twin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from rsavatar.render import native, reference
from rsavatar.render.base import Gaussians, Rendering, Scene

Measured = tuple[str, bool]  # what was found, and whether the promise was held
FIELDS = tuple(f.name for f in fields(Gaussians))
CUTOFF = 1 / 255  # a contribution that rounding puts on the other side of the cutoff
RMS, GRADIENT = 1e-4, 1e-3
NOISE = 1e-6  # of the largest gradient's norm: what a gradient that vanishes in exact arithmetic may come to


@dataclass(frozen=True)
class Case:
    """Something hard, what is promised of it, and the experiment."""

    name: str
    promise: str
    run: Callable[[], Measured]


@dataclass(frozen=True)
class Outcome:
    """An image and the gradients of a fixed functional of it."""

    image: Rendering
    gradients: dict[str, Tensor]

    @property
    def finite(self) -> bool:
        """Whether nothing of it is NaN or infinite."""
        return all(
            bool(torch.isfinite(t).all()) for t in (self.image.rgb, self.image.transmittance, *self.gradients.values())
        )

    @property
    def physical(self) -> bool:
        """Whether it is finite, colours are not negative and transmittance is a fraction."""
        rgb, t = self.image.rgb, self.image.transmittance
        return self.finite and bool((rgb >= 0).all() and (t >= 0).all() and (t <= 1 + 1e-6).all())


def outcome(render: Callable[[Scene], Rendering], scene: Scene) -> Outcome:
    """Render, and differentiate a random functional of the image, by every input."""
    leaves = {name: getattr(scene.gaussians, name).detach().clone().requires_grad_() for name in FIELDS}
    pose = scene.pose.detach().clone().requires_grad_()
    image = render(replace(scene, gaussians=Gaussians(**leaves), pose=pose))
    g = torch.Generator().manual_seed(0)
    rgb, t = torch.randn(image.rgb.shape, generator=g), torch.randn(image.transmittance.shape, generator=g)
    torch.autograd.backward((image.rgb * rgb).sum() + (image.transmittance * t).sum())
    gradients = {name: leaf.grad for name, leaf in {**leaves, "pose": pose}.items() if leaf.grad is not None}
    detached = replace(image, rgb=image.rgb.detach(), transmittance=image.transmittance.detach())
    return Outcome(detached, gradients)


def against_twin(scene: Scene) -> Measured:
    """Image and gradients of the kernels, float32, against those of the twin, float64."""
    got, truth = outcome(native.render, scene), outcome(reference.render, scene)
    difference = got.image.rgb.double() - truth.image.rgb
    most, rms = float(difference.abs().max()), float(difference.square().mean().sqrt())
    worst, name = gradient_error(got.gradients, truth.gradients, scene)
    held = got.physical and most < CUTOFF and rms < RMS and worst < GRADIENT
    return f"image max {most:.1e}, RMS {rms:.1e}; gradient {worst:.1e} ({name})", held


def gradient_error(got: dict[str, Tensor], truth: dict[str, Tensor], scene: Scene) -> tuple[float, str]:
    """Largest relative error of a gradient, and whose; of weights that are 0 only the twin gives one."""
    bound = {"skin_weights": scene.gaussians.skin_weights != 0}
    exact = {name: t.double() * bound.get(name, 1) for name, t in truth.items()}
    floor = NOISE * max(float(t.norm()) for t in exact.values()) + 1e-30
    errors = [(float((got[n].double() - t).norm()) / max(float(t.norm()), floor), n) for n, t in exact.items()]
    return max(errors)


def stays_physical(scene: Scene) -> Measured:
    """For scenes where the twin has another convention: finite, and an image that could be one."""
    got = outcome(native.render, scene)
    t = got.image.transmittance
    largest = max(float(g.abs().max()) for g in got.gradients.values())
    return f"T in [{float(t.min()):.3g}, {float(t.max()):.6g}], largest gradient {largest:.1e}", got.physical
