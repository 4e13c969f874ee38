"""The slow float64 twin of the native kernels, in plain torch autograd: their oracle, and the page to read first.

An image is rendered slot by slot (``TimedRows``). For a slot whose row y is exposed at tau(y) = rate y + start:

1. **Blend.** Linear blend skinning of the pose polynomial gives each Gaussian its own affine map in time,
   B(tau) = sum_d tau^d sum_j w_j A_dj, so that its posed mean is p(tau) = B(tau) [x; 1].
2. **Own time.** A Gaussian is seen when the scan meets it: tau solves f(tau) = tau - (rate v(tau) + start) = 0, with
   v the projected row of its mean. Newton's method finds it; clamped to [-1, 1], where the polynomial is meant to hold.
   By the implicit function theorem d tau = rate dv / (1 - rate v'), dv at fixed tau. One Newton step whose
   denominator is held constant has exactly that derivative, and leaves the value where it is.
3. **Shear.** Inside its footprint the Gaussian goes on moving: the row dy below the mean is exposed rate dy later, when
   the mean has moved by (a, b) dy, a = rate u', b = rate v'. With dx' = dx - a dy and dy' = (1 - b) dy the exponent
   A dx'^2 + 2 B dx' dy' + C dy'^2 is again a quadratic form in (dx, dy): only the conic changes. Near scan speed, where
   first order no longer holds, 1 - b is held at ``LEAST_SLACK`` here and in the derivative of 2.
4. **Depth order.** Gaussians are posed at different instants, so each row orders them by their depths extrapolated to
   the row's own instant.
5. **Composite.** Front to back, alpha blending with 3D Gaussian splatting's cutoffs (``Options``).

A slot of rate 0 is the usual renderer: every Gaussian at tau = start, no shear, plain depth order.

**Convention**: pixel centres at half integers; camera axes x right, y down, z forward; row 0 at the top.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from rsavatar.geometry.cameras import Camera
from rsavatar.geometry.rotations import quaternion_to_matrix
from rsavatar.render.base import Gaussians, Options, Rendering, Scene, TimedRows

C0 = 0.28209479177387814  # real spherical harmonics of degree 0 and 1: sqrt(1 / 4 pi) and sqrt(3 / 4 pi)
C1 = 0.4886025119029199
NEWTON_STEPS = 8
LEAST_SLACK = 0.1  # as the kernels': docs/decisions/0019
TILE_COLUMNS = 64  # bounds the memory of one [splats, rows, columns] block; no effect on the result


@dataclass(frozen=True)
class Splats:
    """Gaussians as one slot's rasteriser sees them, each at its own ``tau``."""

    u: Tensor  # [M] pixels, screen offset included
    v: Tensor  # [M]
    conic: Tensor  # [3, M] A, B, C of alpha = opacity exp(-(A dx^2 + 2 B dx dy + C dy^2) / 2), sheared
    opacity: Tensor  # [M]
    colour: Tensor  # [3, M]
    depth: Tensor  # [M] camera z, metres
    depth_rate: Tensor  # [M] metres per unit of tau
    tau: Tensor  # [M]

    def take(self, index: Tensor) -> Splats:
        """The splats that ``index`` names, in its order."""
        return Splats(**{f.name: getattr(self, f.name)[..., index] for f in fields(self)})


@dataclass(frozen=True)
class Posed:
    """Gaussians at an instant each: skinning transforms, means, and rates of change per unit of tau."""

    affine: Tensor  # [M, 3, 4] B(tau)
    world: Tensor  # [M, 3] metres
    local: Tensor  # [M, 3] camera coordinates X, Y, Z, metres
    u: Tensor  # [M] pixels
    v: Tensor
    u_rate: Tensor  # [M] du / dtau
    v_rate: Tensor
    z_rate: Tensor  # [M] dZ / dtau


def render(scene: Scene) -> Rendering:
    """Render a scene in float64, exactly as this module's page describes; every backend is held against it.

    A slot adds ``weight`` times its image and its transmittance to its rows. Rows that no slot covers are black with
    transmittance 1.

    Returns:
        ``Rendering`` in float64. Differentiable, by autograd, in all fields of ``scene.gaussians`` and in
        ``scene.pose``, through each splat's own time and the shear. Cutoffs, culling and depth order are constants.
    """
    camera, means = scene.camera, scene.gaussians.means
    rgb = torch.zeros(3, camera.height, camera.width, dtype=torch.float64, device=means.device)
    transmittance = torch.zeros_like(rgb[0])
    covered = torch.zeros(camera.height, 1, dtype=torch.bool, device=means.device)
    gaussians = _select(scene.gaussians, torch.arange(means.shape[1], device=means.device))
    for pose, rows in zip(scene.pose.double(), scene.rows, strict=True):
        splats = project(gaussians, pose, rows, camera, scene.options)
        slot_rgb, slot_transmittance = rasterise(splats, rows, camera.width, scene.options)
        rgb[:, rows.lo : rows.hi] += rows.weight * slot_rgb
        transmittance[rows.lo : rows.hi] += rows.weight * slot_transmittance
        covered[rows.lo : rows.hi] = True
    return Rendering(rgb, torch.where(covered, transmittance, 1.0))


def render_rows(
    gaussians: Gaussians,
    transforms_at: Callable[[float], Tensor],
    camera: Camera,
    options: Options | None = None,
) -> Rendering:
    """The truth by brute force: each row rendered on its own, at its own pose (paper, eq. rs).

    ``transforms_at(y)`` gives the joint transforms [24, 3, 4] (canonical to world) at the instant when the row with
    centre ``y`` (row index + 1/2) is exposed; no polynomial in time comes into it.
    """
    pose = torch.stack([transforms_at(row + 0.5) for row in range(camera.height)])[:, None]
    rows = tuple(TimedRows(row, row + 1, rate=0.0, start=0.0) for row in range(camera.height))
    return render(Scene(gaussians, pose, rows, camera, options or Options()))


def project(gaussians: Gaussians, pose: Tensor, rows: TimedRows, camera: Camera, options: Options) -> Splats:
    """Pose the Gaussians at their own times and project them; those nearer than ``options.near`` are left out.

    ``pose`` [D, 24, 3, 4] are the slot's coefficients in tau. Everything in float64.
    """
    with torch.no_grad():
        coefficients = torch.einsum("jm,djrc->dmrc", gaussians.skin_weights, pose)
        tau = _solve_own_time(coefficients, gaussians.means, rows, camera, options)
        in_front = _pose(coefficients, gaussians.means, tau, camera, options).local[:, 2] >= options.near
    kept = in_front.nonzero()[:, 0]  # culled before any division that autograd sees: 0 * NaN is NaN
    gaussians, tau = _select(gaussians, kept), tau[kept]

    coefficients = torch.einsum("jm,djrc->dmrc", gaussians.skin_weights, pose)
    if rows.rate != 0 and "implicit" not in options.without:
        at_root = _pose(coefficients, gaussians.means, tau, camera, options)
        residual = tau - (rows.rate * at_root.v + rows.start)
        step = residual / _slack(rows.rate, at_root.v_rate).detach()
        tau = torch.where(tau.abs() < 1, tau - step, tau)  # value unchanged; derivative of the implicit function
    posed = _pose(coefficients, gaussians.means, tau, camera, options)
    moving = 0.0 if "shear" in options.without else rows.rate
    return Splats(
        u=posed.u + gaussians.screen[0],
        v=posed.v + gaussians.screen[1],
        conic=_shear(_conic(gaussians, posed, camera, options), moving * posed.u_rate, _slack(moving, posed.v_rate)),
        opacity=gaussians.opacity_logits.sigmoid(),
        colour=_colour(gaussians.sh, posed.world, camera),
        depth=posed.local[:, 2],
        depth_rate=posed.z_rate,
        tau=tau,
    )


def rasterise(splats: Splats, rows: TimedRows, width: int, options: Options) -> tuple[Tensor, Tensor]:
    """Composite a slot's rows: colour [3, hi - lo, W] and transmittance [hi - lo, W], strip by strip."""
    strips = []
    for top in range(rows.lo, rows.hi, options.strip_rows):
        bottom = min(top + options.strip_rows, rows.hi)
        tiles = [
            _composite(splats, rows, (top, bottom), (left, min(left + TILE_COLUMNS, width)), options)
            for left in range(0, width, TILE_COLUMNS)
        ]
        strips.append(torch.cat(tiles, -1))
    image = torch.cat(strips, -2)
    return image[:3], image[3]


def _select(gaussians: Gaussians, index: Tensor) -> Gaussians:
    return Gaussians(**{f.name: getattr(gaussians, f.name).double()[..., index] for f in fields(gaussians)})


def _solve_own_time(coefficients: Tensor, means: Tensor, rows: TimedRows, camera: Camera, options: Options) -> Tensor:
    """The fixed point of tau = rate v(tau) + start in [-1, 1], [M]; tau = start for a slot of rate 0."""
    if rows.rate == 0:
        return torch.full_like(means[0], rows.start)
    tau = torch.zeros_like(means[0])
    for _ in range(NEWTON_STEPS):
        posed = _pose(coefficients, means, tau, camera, options)
        residual = tau - (rows.rate * posed.v + rows.start)
        tau = (tau - residual / (1 - rows.rate * posed.v_rate)).clamp(-1, 1)
    return tau


def _pose(coefficients: Tensor, means: Tensor, tau: Tensor, camera: Camera, options: Options) -> Posed:
    """Means [3, M] under B(tau) = sum_d tau^d coefficients[d], coefficients [D, M, 3, 4], and their image motion."""
    powers = torch.stack([tau**d for d in range(len(coefficients))])
    rates = torch.stack([d * tau ** max(d - 1, 0) for d in range(len(coefficients))])
    affine = torch.einsum("dm,dmrc->mrc", powers, coefficients)
    affine_rate = torch.einsum("dm,dmrc->mrc", rates, coefficients)

    homogeneous = torch.cat([means, torch.ones_like(means[:1])])
    rotation, translation = means.new_tensor(camera.rotation), means.new_tensor(camera.translation)
    world = torch.einsum("mrc,cm->mr", affine, homogeneous)
    local = world @ rotation.T + translation
    local_rate = torch.einsum("mrc,cm->mr", affine_rate, homogeneous) @ rotation.T

    X, Y, Z = local[:, 0], local[:, 1], local[:, 2].clamp_min(options.near)  # the bound acts on culled splats only
    X_rate, Y_rate, Z_rate = local_rate.unbind(-1)
    return Posed(
        affine=affine,
        world=world,
        local=local,
        u=camera.fx * X / Z + camera.cx,
        v=camera.fy * Y / Z + camera.cy,
        u_rate=camera.fx * (X_rate - X / Z * Z_rate) / Z,
        v_rate=camera.fy * (Y_rate - Y / Z * Z_rate) / Z,
        z_rate=Z_rate,
    )


def _conic(gaussians: Gaussians, posed: Posed, camera: Camera, options: Options) -> Tensor:
    """Inverse [3, M] of the projected covariance K K^T + dilation I, K = J R_camera B R(q) diag(s) [M, 2, 3].

    The determinant is |k1 x k2|^2 + eps (|k1|^2 + |k2|^2) + eps^2 with k1, k2 the rows of K: a sum of squares, where
    ac - b^2 of a needle cancels (20 % error at an aspect of 1000 in float32).
    """
    X, Y, Z = posed.local.unbind(-1)
    zero = torch.zeros_like(Z)
    jacobian = torch.stack(
        [camera.fx / Z, zero, -camera.fx * X / Z**2, zero, camera.fy / Z, -camera.fy * Y / Z**2], -1
    ).reshape(-1, 2, 3)
    axes = quaternion_to_matrix(gaussians.rotations.T) * gaussians.log_scales.exp().T[:, None, :]
    K = jacobian @ Z.new_tensor(camera.rotation) @ posed.affine[:, :, :3] @ axes
    k1, k2 = K.unbind(1)
    eps = options.dilation
    squares = (k1 * k1).sum(-1), (k2 * k2).sum(-1)
    determinant = torch.cross(k1, k2, dim=-1).square().sum(-1) + eps * (squares[0] + squares[1]) + eps * eps
    return torch.stack([squares[1] + eps, -(k1 * k2).sum(-1), squares[0] + eps]) / determinant


def _slack(rate: float, v_rate: Tensor) -> Tensor:
    """1 - rate dv/dtau [M], held at ``LEAST_SLACK``: near scan speed, first-order terms over it hold no longer."""
    slack = 1 - rate * v_rate
    return torch.where(slack.abs() < LEAST_SLACK, torch.where(slack < 0, -LEAST_SLACK, LEAST_SLACK), slack)


def _shear(conic: Tensor, a: Tensor, slack: Tensor) -> Tensor:
    """The conic [3, M] of a splat that moves by (a, 1 - slack) pixels per row while it is scanned."""
    A, B, C = conic
    return torch.stack([A, slack * B - a * A, a * a * A - 2 * a * slack * B + slack**2 * C])


def _colour(sh: Tensor, world: Tensor, camera: Camera) -> Tensor:
    """Colour [3, M] seen from the camera; ``sh`` [B, 3, M], B = 1 or 4. Zero gradient where it is cut off at 0."""
    colour = 0.5 + C0 * sh[0]
    if len(sh) > 1:
        direction = torch.nn.functional.normalize(world - world.new_tensor(camera.centre), dim=-1)
        x, y, z = direction.unbind(-1)
        colour = colour + C1 * (-y * sh[1] + z * sh[2] - x * sh[3])
    return torch.relu(colour)


def _depth_order(splats: Splats, rows: TimedRows, y: Tensor, options: Options) -> Tensor:
    """Indices [M, rows], front to back when the row coordinates ``y`` are exposed; ties in the order of the index."""
    depth = splats.depth.detach()[:, None].expand(-1, len(y))
    if rows.rate != 0 and "resort" not in options.without:
        depth = depth + splats.depth_rate.detach()[:, None] * (
            rows.rate * y + rows.start - splats.tau.detach()[:, None]
        )
    return depth.argsort(dim=0, stable=True)


def _composite(
    splats: Splats, timed: TimedRows, rows: tuple[int, int], columns: tuple[int, int], options: Options
) -> Tensor:
    """Red, green, blue and transmittance [4, rows, columns] of the splats in one block of pixels."""
    splats = splats.take(_touching(splats, rows, columns, options))
    x, y = (splats.u.new_tensor(range(*pixels)) + 0.5 for pixels in (columns, rows))
    order = _depth_order(splats, timed, y, options)
    dx, dy = x[None, None, :] - splats.u[order, None], (y - splats.v[order])[:, :, None]
    A, B, C = splats.conic[:, order, None]
    falloff = torch.exp(-0.5 * (A * dx * dx + 2 * B * dx * dy + C * dy * dy))
    alpha = splats.opacity[order, None] * falloff
    alpha = torch.where(alpha < options.alpha_min, 0.0, alpha.clamp(max=options.alpha_max))

    # A pixel stops for good before its transmittance would fall under the limit. Running products never rise again,
    # so "all products up to here are above the limit" and "this one is" are the same statement.
    going = (1 - alpha.detach()).cumprod(0) >= options.transmittance_min
    alpha = torch.where(going, alpha, 0.0)
    passed = (1 - alpha).cumprod(0)
    transmittance = torch.cat([passed.new_ones(1, *passed.shape[1:]), passed])  # before splat k; the last: after all
    rgb = torch.einsum("khw,ckh->chw", transmittance[:-1] * alpha, splats.colour[:, order])
    return torch.cat([rgb, transmittance[-1:]])


def _touching(splats: Splats, rows: tuple[int, int], columns: tuple[int, int], options: Options) -> Tensor:
    """Indices of the splats whose alpha may reach ``alpha_min`` in the block: its pixels meet their bounding box.

    opacity exp(-q / 2) >= alpha_min is an ellipse q <= 2 ln(opacity / alpha_min), whose half extents are the roots of
    that bound times the diagonal of the conic's inverse. NaN (a body that moves at the scan's speed) counts as met.
    """
    u, v, opacity = splats.u.detach(), splats.v.detach(), splats.opacity.detach()
    A, B, C = splats.conic.detach()
    bound = 2 * (opacity / options.alpha_min).log() / (A * C - B * B) * (1 + 1e-6)
    half_width, half_height = (bound * C).sqrt(), (bound * A).sqrt()
    missed = (u + half_width < columns[0]) | (u - half_width > columns[1]) | (opacity < options.alpha_min)
    missed |= (v + half_height < rows[0]) | (v - half_height > rows[1])
    return torch.nonzero(~missed)[:, 0]
