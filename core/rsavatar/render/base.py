"""What a renderer takes and gives. One entry point, whatever the shutter, the method or the backend.

Layouts are channel-first (structure of arrays) so that the kernels read them without a copy:

    M Gaussians, J = 24 joints, T slots, D pose coefficients, H rows, W columns
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rsavatar.geometry.cameras import Camera

# Of own time: footprint, derivative, depth order (reference.py). And leaving out what cannot reach a slot (cull.cpp).
Correction = Literal["shear", "implicit", "resort", "cull"]


@dataclass(frozen=True)
class Gaussians:
    """Canonical Gaussians as the optimiser holds them; activations happen inside the renderer.

    Colour is ``max(0, 1/2 + sum_b Y_b(direction) sh_b)`` with the real spherical harmonics of 3D Gaussian splatting,
    direction = posed mean minus camera centre, in the world.
    """

    means: Tensor  # [3, M] metres, canonical space
    rotations: Tensor  # [4, M] quaternions (w, x, y, z), of any length > 0
    log_scales: Tensor  # [3, M] natural log of metres
    opacity_logits: Tensor  # [M]
    sh: Tensor  # [B, 3, M], B = (degree + 1)^2
    skin_weights: Tensor  # [24, M], columns sum to 1
    screen: Tensor  # [2, M] pixels added to the projected means; zeros whose gradient drives density control

    @property
    def count(self) -> int:
        """M."""
        return self.means.shape[1]


@dataclass(frozen=True)
class TimedRows:
    """A slot in the renderer's clock: rows [lo, hi) at tau = ``rate * y + start``, y = row centre = row index + 1/2.

    ``rate`` 0 is an instant: every splat is posed at tau = ``start``. Otherwise each splat is posed at its own
    tau, the fixed point of tau = rate * v(tau) + start with v its projected row, clamped to [-1, 1].
    """

    lo: int
    hi: int
    rate: float
    start: float
    weight: float = 1.0


@dataclass(frozen=True)
class Rendering:
    """An image on black: ``rgb`` [3, H, W] and ``transmittance`` [H, W] (1 where nothing was hit).

    ``projected`` Gaussians lay in blocks that might reach a slot, ``splats`` of them survived (both summed over slots)
    and made ``pairs`` (splat, strip) pairs; 0 = not counted.
    ``broken`` Gaussians had NaN or infinity in them or in their pose: the kernels do not draw them and give them no
    gradient; the twin draws what it may.
    """

    rgb: Tensor
    transmittance: Tensor
    projected: int = 0
    splats: int = 0
    pairs: int = 0
    broken: int = 0

    def over(self, background: float) -> Tensor:
        """Composited over a grey background, [3, H, W]."""
        return self.rgb + background * self.transmittance


@dataclass(frozen=True)
class Comparison:
    """How far an image is from another; the image itself is not kept.

    ``loss`` is a differentiable scalar, ``squared_error`` the mean over the colours; counters as in ``Rendering``.
    """

    loss: Tensor
    squared_error: float
    projected: int = 0
    splats: int = 0
    pairs: int = 0
    broken: int = 0


@dataclass(frozen=True)
class Options:
    """Constants of the image formation, the same for every backend."""

    near: float = 0.05  # metres; splats nearer than this are culled
    dilation: float = 0.3  # px^2 added to the projected covariance's diagonal (3D Gaussian splatting's low-pass)
    alpha_min: float = 1 / 255  # contributions under this are skipped
    alpha_max: float = 0.99  # cap of one splat's opacity; the gradient is zero where it acts
    transmittance_min: float = 1e-4  # a pixel stops before its transmittance would fall under this
    strip_rows: int = 16  # rows drawn together, from each slot's first; no effect on the image
    without: frozenset[Correction] = frozenset()  # left out, to measure what each is worth


@dataclass(frozen=True)
class Scene:
    """Everything one image needs.

    ``pose`` [T, D, 24, 3, 4]: for slot t, joint transforms (canonical to world) as a polynomial in tau,
    sum_d pose[t, d] tau^d.
    """

    gaussians: Gaussians
    pose: Tensor
    rows: tuple[TimedRows, ...]
    camera: Camera
    options: Options = Options()


def require_finite(name: str, value: Tensor) -> None:
    """Raise ``DataError`` naming ``name`` if ``value`` holds NaN or infinity."""
    if not torch.isfinite(value).all():
        from rsavatar.errors import DataError, expected

        raise DataError(expected(name, "finite numbers", f"{int((~torch.isfinite(value)).sum())} non-finite values"))
