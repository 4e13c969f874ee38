"""The truth of a moving body's image: float64, row by row, each row at its own pose, from the formulas alone.

Written apart from both renderers, in numpy, with no own time, no polynomial, no shear, no strips: what they are
measured against must not share their shortcuts. Only 3D Gaussian splatting's cutoffs (``Options``) are the same, being
part of the image's definition. Scene P13 takes about half a minute; results are kept in the cache folder.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.special import expit

from rsavatar.bench.scene import MovingBody
from rsavatar.body.cache import cache_dir
from rsavatar.geometry.cameras import Camera
from rsavatar.render.base import Options
from rsavatar.render.reference import C0

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """An image on black, and how many splats each pixel blended."""

    rgb: Array  # [3, H, W]
    transmittance: Array  # [H, W]
    blended: Array  # [H, W]

    @property
    def foreground(self) -> npt.NDArray[np.bool_]:
        """Pixels [H, W] that anything was blended into."""
        return self.blended > 0


@dataclass(frozen=True)
class _Canonical:
    """Activated Gaussians, row-major, float64."""

    means: Array  # [M, 4], homogeneous
    axes: Array  # [M, 3, 3]: R(q) diag(s), metres
    opacity: Array  # [M]
    colour: Array  # [M, 3]
    weights: Array  # [M, 24]


def truth_of(body: MovingBody, options: Options) -> Truth:
    """``expose`` through the cache, whose key is everything that the image depends on."""
    digest = hashlib.sha256(repr((options, body.camera)).encode())
    for tensor in (*(getattr(body.gaussians, f.name) for f in fields(body.gaussians)), body.motion.control):
        digest.update(tensor.detach().numpy().tobytes())
    path = cache_dir() / f"truth-1-{digest.hexdigest()[:20]}.npz"
    names = [f.name for f in fields(Truth)]
    if path.exists():
        with np.load(path) as kept:
            return Truth(*(kept[name].astype(np.float64) for name in names))
    truth = expose(body, options)
    partial = path.with_suffix(f".{id(truth):x}.part.npz")
    np.savez_compressed(partial, **{name: getattr(truth, name).astype(np.float32) for name in names})
    partial.replace(path)
    return truth


def expose(body: MovingBody, options: Options) -> Truth:
    """Render every row on its own, at the instant when it is exposed (paper, eq. rs). Constant colours only."""
    camera, canonical = body.camera, _activate(body)
    transforms = body.exact_transforms(body.row_offsets()).numpy()
    shape = (camera.height, camera.width)
    truth = Truth(np.zeros((3, *shape)), np.ones(shape), np.zeros(shape))
    for row, of_joints in enumerate(transforms):
        _expose_row(canonical, of_joints, camera, options, (row, truth))
    return truth


def _activate(body: MovingBody) -> _Canonical:
    g = body.gaussians
    tensors = (g.means, g.rotations, g.log_scales, g.opacity_logits, g.sh, g.skin_weights)
    means, rotations, log_scales, logits, sh, weights = (t.double().numpy() for t in tensors)
    turns = Rotation.from_quat(rotations.T, scalar_first=True).as_matrix()
    return _Canonical(
        means=np.concatenate([means.T, np.ones((means.shape[1], 1))], 1),
        axes=turns * np.exp(log_scales.T)[:, None, :],
        opacity=expit(logits),
        colour=np.maximum(0.5 + C0 * sh[0].T, 0),
        weights=weights.T.copy(),
    )


def _expose_row(g: _Canonical, of_joints: Array, camera: Camera, options: Options, place: tuple[int, Truth]) -> None:
    """Composite one row [W] of the Gaussians under joint transforms [24, 3, 4] into its place."""
    row, truth = place
    affine = (g.weights @ of_joints.reshape(len(of_joints), -1)).reshape(-1, 3, 4)
    local = np.einsum("mrc,mc->mr", affine, g.means) @ camera.rotation.T + camera.translation
    front = np.flatnonzero(local[:, 2] >= options.near)
    dy = row + 0.5 - (camera.fy * local[front, 1] / local[front, 2] + camera.cy)
    extent = np.linalg.norm(g.axes[front], axis=(1, 2)) * camera.fy / local[front, 2]  # at least the largest sigma
    near = np.abs(dy) <= 4 * (3 * extent + 1)  # generous: alpha is under 1/255 beyond 3.4 sigma for any opacity
    kept, dy = front[near], dy[near]
    u, quadratic, half = _footprints(affine[kept], g.axes[kept], local[kept], g.opacity[kept], (camera, options))
    touched = np.flatnonzero(np.abs(dy) <= half[1])
    touched = touched[np.argsort(local[kept[touched], 2], kind="stable")]
    lo = max(int(np.floor((u - half[0])[touched].min(initial=camera.width))), 0)
    hi = min(int(np.ceil((u + half[0])[touched].max(initial=0))), camera.width)
    if lo >= hi:
        return
    dx = np.arange(lo, hi) + 0.5 - u[touched, None]
    A, B, C = quadratic[:, touched, None]
    down = dy[touched, None]
    alpha = g.opacity[kept[touched], None] * np.exp(-0.5 * (A * dx * dx + C * down * down) - B * dx * down)
    alpha = np.where(alpha < options.alpha_min, 0.0, np.minimum(alpha, options.alpha_max))
    alpha[np.cumprod(1 - alpha, axis=0) < options.transmittance_min] = 0.0  # stopped, for good
    after = np.cumprod(1 - alpha, axis=0)
    before = np.concatenate([np.ones((1, hi - lo)), after[:-1]])
    truth.rgb[:, row, lo:hi] = g.colour[kept[touched]].T @ (before * alpha)
    truth.transmittance[row, lo:hi] = after[-1]
    truth.blended[row, lo:hi] = (alpha > 0).sum(0)


def _footprints(
    affine: Array, axes: Array, local: Array, opacity: Array, view: tuple[Camera, Options]
) -> tuple[Array, Array, Array]:
    """Columns u [m], conics [3, m], and half sizes [2, m] of the boxes outside of which alpha is under alpha_min."""
    camera, options = view
    X, Y, Z = local.T
    zero = np.zeros_like(Z)
    jacobian = np.array([[camera.fx / Z, zero, -camera.fx * X / Z**2], [zero, camera.fy / Z, -camera.fy * Y / Z**2]])
    K = jacobian.transpose(2, 0, 1) @ camera.rotation @ affine[:, :, :3] @ axes
    covariance = K @ K.transpose(0, 2, 1) + options.dilation * np.eye(2)
    inverse: Array = np.asarray(np.linalg.inv(covariance), np.float64)
    reach = 2 * np.log(np.maximum(opacity / options.alpha_min, 1.0))
    half: Array = np.sqrt(reach * covariance[:, [0, 1], [0, 1]].T)
    return camera.fx * X / Z + camera.cx, inverse[:, [0, 0, 1], [0, 1, 1]].T, half
