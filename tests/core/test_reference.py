"""The reference renderer against closed forms, brute force over rows, and finite differences."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rsavatar.geometry.cameras import Camera
from rsavatar.geometry.rotations import exp_so3, quaternion_to_matrix
from rsavatar.render.base import Gaussians, Options, Rendering, Scene, TimedRows
from rsavatar.render.reference import C0, C1, project, render, render_rows
from rsavatar.shutter.base import AbstractShutter
from rsavatar.shutter.rolling import Bands, Scanline

H, W, F = 24, 32, 40.0
ROUNDING = 1e-12
CAMERA = Camera(np.eye(3), np.array([0.0, 0.0, 0.0]), F, F, W / 2 + 0.5, H / 2 + 0.5, H, W)  # axis on a pixel centre
CENTRE = (H // 2, W // 2)
WHOLE = TimedRows(0, H, rate=2 / H, start=-1.0)  # the full readout is tau in [-1, 1]
NO_READOUT = TimedRows(0, H, rate=0.0, start=0.0)
SMOOTH = Options(alpha_min=1e-300, alpha_max=1.0, transmittance_min=0.0)  # no cutoffs, so finite differences agree


def double(*values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def gaussians(means: Tensor, scale: float = 0.1, opacity: float = 0.5, colours: Tensor | None = None) -> Gaussians:
    """Isotropic Gaussians [3, M] of one opacity, skinned to joint 0, of constant colour [3, M] (default white)."""
    count = means.shape[1]
    colours = torch.ones(3, count, dtype=torch.float64) if colours is None else colours
    return Gaussians(
        means=means,
        rotations=double(1.0, 0.0, 0.0, 0.0)[:, None].expand(4, count).contiguous(),
        log_scales=torch.full((3, count), math.log(scale), dtype=torch.float64),
        opacity_logits=torch.full((count,), math.log(opacity / (1 - opacity)), dtype=torch.float64),
        sh=((colours - 0.5) / C0)[None],
        skin_weights=torch.cat([torch.ones(1, count), torch.zeros(23, count)]).double(),
        screen=torch.zeros(2, count, dtype=torch.float64),
    )


def random_gaussians(count: int, seed: int = 0) -> Gaussians:
    """An opaque-ish cloud half a metre across, 2 metres away, with view-dependent colours, skinned to all joints."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return Gaussians(
        means=0.25 * normal(3, count) + double(0.0, 0.0, 2.0)[:, None],
        rotations=normal(4, count),
        log_scales=0.4 * normal(3, count) + math.log(0.06),
        opacity_logits=normal(count),
        sh=0.7 * normal(4, 3, count),
        skin_weights=torch.softmax(2 * normal(24, count), 0),
        screen=torch.zeros(2, count, dtype=torch.float64),
    )


def still(degree: int = 1) -> Tensor:
    """The identity pose as a polynomial [degree, 24, 3, 4]."""
    pose = torch.zeros(degree, 24, 3, 4, dtype=torch.float64)
    pose[0, :, :, :3] = torch.eye(3)
    return pose


def moving(velocity: Tensor) -> Tensor:
    """Every joint translating by ``velocity`` [3] metres per unit of tau, [2, 24, 3, 4]."""
    pose = still(2)
    pose[1, :, :, 3] = velocity
    return pose


def turning(joints: int = 24, speed: float = 0.1, seed: int = 5) -> Tensor:
    """A cubic pose [4, 24, 3, 4]: joints turning and shifting smoothly, about the cloud's middle."""
    generator = torch.Generator().manual_seed(seed)
    pose, middle = still(4), double(0.0, 0.0, 2.0)
    for d, size in ((1, speed), (2, speed / 3), (3, speed / 10)):
        spin = size * torch.randn(joints, 3, generator=generator, dtype=torch.float64)
        linear = exp_so3(spin) - torch.eye(3, dtype=torch.float64)
        pose[d, :joints, :, :3] = linear
        pose[d, :joints, :, 3] = 0.5 * spin - linear @ middle
    return pose


def evaluate(pose: Tensor, tau: float) -> Tensor:
    return sum((tau**d * pose[d] for d in range(len(pose))), torch.zeros_like(pose[0]))


def row_clock(pose: Tensor, rate: float = 2 / H, start: float = -1.0) -> Callable[[float], Tensor]:
    return lambda y: evaluate(pose, rate * y + start)


def scene(splats: Gaussians, pose: Tensor, rows: TimedRows = WHOLE, options: Options | None = None) -> Scene:
    return Scene(splats, pose[None], (rows,), CAMERA, options or Options())


def timed(shutter: AbstractShutter, readout: float = 11.0) -> tuple[TimedRows, ...]:
    """A shutter's slots in the renderer's clock: tau = time / (readout / 2), and y = row + 1/2."""
    half = readout / 2
    slots = shutter.slots(H, readout, 0.0)
    return tuple(TimedRows(s.lo, s.hi, s.rate / half, (s.start - s.rate / 2) / half, s.weight) for s in slots)


def psnr(image: Rendering, truth: Rendering) -> float:
    return -10 * math.log10(float((image.rgb - truth.rgb).detach().square().mean()))


def pixel_distances() -> Tensor:
    y, x = torch.meshgrid(torch.arange(H) - CENTRE[0], torch.arange(W) - CENTRE[1], indexing="ij")
    return (x * x + y * y).double()


# --- closed forms -----------------------------------------------------------------------------------------------------


def test_one_isotropic_gaussian_on_the_axis() -> None:
    depth, scale, opacity = 2.0, 0.1, 0.5
    colour = double(0.2, 0.5, 0.9)
    image = render(scene(gaussians(double(0, 0, depth)[:, None], scale, opacity, colour[:, None]), still(), NO_READOUT))
    variance = (F * scale / depth) ** 2 + 0.3
    alpha = opacity * torch.exp(-pixel_distances() / (2 * variance))
    alpha = torch.where(alpha < 1 / 255, 0.0, alpha)
    torch.testing.assert_close(image.rgb, colour[:, None, None] * alpha, atol=ROUNDING, rtol=0)
    torch.testing.assert_close(image.transmittance, 1 - alpha, atol=ROUNDING, rtol=0)


RED_BLUE = double([1.0, 0.0], [0.0, 0.0], [0.0, 1.0])


@pytest.mark.parametrize("nearer", [0, 1])
def test_two_gaussians_composite_front_to_back_whatever_their_index(nearer: int) -> None:
    depths = (2.0, 3.0) if nearer == 0 else (3.0, 2.0)
    pair = gaussians(double([0, 0], [0, 0], depths), opacity=0.6, colours=RED_BLUE)
    image = render(scene(pair, still(), NO_READOUT))
    near, far = 0.6, 0.4 * 0.6
    expected = double(near, 0, far) if nearer == 0 else double(far, 0, near)
    torch.testing.assert_close(image.rgb[:, CENTRE[0], CENTRE[1]], expected, atol=ROUNDING, rtol=0)
    assert float(image.transmittance[CENTRE]) == pytest.approx(0.4 * 0.4)


def test_equal_depths_keep_the_order_of_the_index() -> None:
    pair = gaussians(double([0, 0], [0, 0], [2, 2]), opacity=0.6, colours=RED_BLUE)
    for rows in (NO_READOUT, WHOLE):
        image = render(scene(pair, still(), rows))
        torch.testing.assert_close(image.rgb[:, CENTRE[0], CENTRE[1]], double(0.6, 0, 0.24), atol=ROUNDING, rtol=0)


def test_a_pixel_stops_for_good_at_the_first_splat_under_the_limit() -> None:
    """Opacities .95 leave .05, .0025, 1.25e-4; a fourth would leave 6e-6 < 1e-4, and the faint fifth is behind it."""
    stack = gaussians(double([0] * 5, [0] * 5, [2.0, 2.1, 2.2, 2.3, 2.4]), opacity=0.95)
    stack.opacity_logits[4] = -4.0  # alpha .018: alone it would not bring the pixel under the limit
    image = render(scene(stack, still(), NO_READOUT))
    assert float(image.transmittance[CENTRE]) == pytest.approx(0.05**3)
    assert float(image.rgb[0][CENTRE]) == pytest.approx(1 - 0.05**3)


def test_opacity_is_capped_and_its_gradient_there_is_zero() -> None:
    opaque = gaussians(double(0, 0, 2)[:, None], scale=0.5, opacity=0.999)
    opaque.opacity_logits.requires_grad_()
    image = render(scene(opaque, still(), NO_READOUT))
    assert float(image.transmittance[CENTRE].detach()) == pytest.approx(0.01)
    (gradient,) = torch.autograd.grad(image.transmittance[CENTRE], opaque.opacity_logits)
    assert float(gradient) == 0


def test_view_dependent_colour_is_that_of_the_real_spherical_harmonics() -> None:
    mean = double(0.3, -0.2, 1.5)
    one = gaussians(mean[:, None])
    sh = 0.3 * torch.randn(4, 3, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    splats = project(replace(one, sh=sh), still(), NO_READOUT, CAMERA, Options())
    x, y, z = mean / mean.norm()  # the camera sits at the origin
    truth = 0.5 + C0 * sh[0] - C1 * y * sh[1] + C1 * z * sh[2] - C1 * x * sh[3]
    torch.testing.assert_close(splats.colour, truth, atol=ROUNDING, rtol=0)


def test_a_colour_under_zero_is_black_and_has_no_gradient() -> None:
    sh = torch.full((1, 3, 1), -10.0, dtype=torch.float64, requires_grad=True)
    image = render(scene(replace(gaussians(double(0, 0, 2)[:, None]), sh=sh), still(), NO_READOUT))
    (gradient,) = torch.autograd.grad(image.rgb.sum(), sh)
    assert float(image.rgb.detach().abs().max()) == 0
    assert float(gradient.abs().max()) == 0


def test_conic_is_the_inverse_of_the_covariance_pushed_through_the_camera() -> None:
    """J by central differences of ``Camera.project`` in a turned camera; the conic by numpy's inverse."""
    cloud = random_gaussians(20)
    turn = exp_so3(double(0.1, -0.2, 0.3)).numpy()
    camera = replace(CAMERA, rotation=turn, translation=np.array([0.1, 0.2, 0.3]), fx=50.0)
    splats = project(cloud, still(), NO_READOUT, camera, Options())
    for m in range(cloud.count):
        mean, h = cloud.means[:, m].numpy(), 1e-6
        steps = [camera.project(mean + h * e)[0] - camera.project(mean - h * e)[0] for e in np.eye(3)]
        axes = (quaternion_to_matrix(cloud.rotations[:, m]) * cloud.log_scales[:, m].exp()).numpy()
        K = np.stack(steps, 1) / (2 * h) @ axes
        A, B, C = splats.conic[:, m].tolist()
        np.testing.assert_allclose([[A, B], [B, C]], np.linalg.inv(K @ K.T + 0.3 * np.eye(2)), rtol=1e-6, atol=1e-9)


def test_a_needles_conic_stays_positive() -> None:
    needle = gaussians(double(0, 0, 2)[:, None])
    needle.log_scales[:, 0] = double(5.0, -20.0, -20.0)
    A, B, C = project(needle, still(), NO_READOUT, CAMERA, Options()).conic[:, 0]
    assert float(A) > 0
    assert float(A * C - B * B) > 0


# --- slots ------------------------------------------------------------------------------------------------------------


def test_rows_that_no_slot_covers_are_empty() -> None:
    image = render(scene(random_gaussians(30), still(), TimedRows(8, 16, 0.0, 0.0)))
    assert float(image.rgb[:, :8].abs().max()) == 0
    assert float(image.transmittance[16:].min()) == 1
    assert float(image.rgb[:, 8:16].max()) > 0.1
    assert torch.equal(image.over(1.0)[:, :8], torch.ones(3, 8, W, dtype=torch.float64))


def test_overlapping_slots_add_by_weight() -> None:
    cloud, poses = random_gaussians(30), torch.stack([still(), evaluate(turning(), 1.0)[None]])
    slots = (replace(NO_READOUT, weight=0.25), replace(NO_READOUT, weight=0.75))
    both = render(Scene(cloud, poses, slots, CAMERA))
    first, second = (render(scene(cloud, pose, NO_READOUT)) for pose in poses)
    torch.testing.assert_close(both.rgb, 0.25 * first.rgb + 0.75 * second.rgb, atol=ROUNDING, rtol=0)
    expected = 0.25 * first.transmittance + 0.75 * second.transmittance
    torch.testing.assert_close(both.transmittance, expected, atol=ROUNDING, rtol=0)


@pytest.mark.parametrize("rows", [NO_READOUT, WHOLE], ids=["instant", "scanline"])
def test_strips_only_bound_the_work(rows: TimedRows) -> None:
    """Strips decide what is culled and drawn together, which may not show."""
    cloud = random_gaussians(60)
    images = [render(scene(cloud, turning(), rows, Options(strip_rows=n))) for n in (1, 5, 16, 100)]
    for image in images[1:]:
        torch.testing.assert_close(image.rgb, images[0].rgb, atol=ROUNDING, rtol=0)


def test_an_instant_reads_the_polynomial_at_its_start() -> None:
    cloud, pose = random_gaussians(30), turning()
    image = render(scene(cloud, pose, TimedRows(0, H, rate=0.0, start=0.4)))
    truth = render(scene(cloud, evaluate(pose, 0.4)[None], NO_READOUT))
    torch.testing.assert_close(image.rgb, truth.rgb, atol=ROUNDING, rtol=0)


def test_a_slot_per_row_is_the_truth() -> None:
    cloud, pose = random_gaussians(20), turning()
    slots = tuple(TimedRows(r, r + 1, 0.0, 2 / H * (r + 0.5) - 1) for r in range(H))
    image = render(Scene(cloud, pose.expand(H, -1, -1, -1, -1), slots, CAMERA))
    truth = render_rows(cloud, row_clock(pose), CAMERA)
    torch.testing.assert_close(image.rgb, truth.rgb, atol=ROUNDING, rtol=0)
    torch.testing.assert_close(image.transmittance, truth.transmittance, atol=ROUNDING, rtol=0)


# --- the scanline mode ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [WHOLE, TimedRows(0, H, rate=-2 / H, start=1.0)], ids=["down", "up"])
@pytest.mark.parametrize("velocity", [(0.15, 0.0), (0.0, 0.2), (-0.1, -0.3)], ids=str)
def test_constant_image_velocity_is_exact(rows: TimedRows, velocity: tuple[float, float]) -> None:
    """A flat disc facing the camera, moving in its plane: the sheared footprint is the truth, not an approximation."""
    disc = gaussians(double(0, 0, 2)[:, None], scale=0.15, opacity=0.9)
    disc.log_scales[2] = -30.0
    pose = moving(double(*velocity, 0.0))
    image = render(scene(disc, pose, rows))
    truth = render_rows(disc, row_clock(pose, rows.rate, rows.start), CAMERA)
    assert float(truth.rgb.max()) > 0.5
    torch.testing.assert_close(image.rgb, truth.rgb, atol=ROUNDING, rtol=0)


def test_a_still_body_looks_the_same_at_any_readout() -> None:
    cloud = random_gaussians(60)
    rolling, instant = (render(scene(cloud, still(4), rows)) for rows in (WHOLE, NO_READOUT))
    torch.testing.assert_close(rolling.rgb, instant.rgb, atol=ROUNDING, rtol=0)


def test_own_times_are_fixed_points_clamped_to_the_readout() -> None:
    cloud = random_gaussians(200)
    cloud.means[1] *= 3  # some are above or below the image: the scan never meets them
    splats = project(cloud, turning(), WHOLE, CAMERA, Options())
    wanted = (WHOLE.rate * splats.v + WHOLE.start).clamp(-1, 1)
    assert int((wanted.abs() == 1).sum()) > 10
    torch.testing.assert_close(splats.tau, wanted, atol=ROUNDING, rtol=0)


@functools.cache
def brute_force(speed: float, options: Options) -> Rendering:
    """The truth of 60 Gaussians turning at ``speed``."""
    return render_rows(random_gaussians(60), row_clock(turning(speed=speed)), CAMERA, options)


def test_articulated_motion_in_one_scan_beats_a_render_per_three_rows() -> None:
    cloud, pose, truth = random_gaussians(60), turning(), brute_force(0.1, Options())
    instant = psnr(render(scene(cloud, pose, NO_READOUT)), truth)
    assert psnr(render(scene(cloud, pose, WHOLE)), truth) > max(instant + 15, 48.3)  # 48.25 dB: eight bands, below


def test_scanline_error_falls_with_the_motion() -> None:
    """What is left is the change of shape and colour while a footprint is scanned: first order, 6 dB per halving."""
    cloud, scores = random_gaussians(60), []
    for speed in (0.1, 0.05, 0.025):
        pose = turning(speed=speed)
        scores.append(psnr(render(scene(cloud, pose, WHOLE, SMOOTH)), brute_force(speed, SMOOTH)))
    assert float(np.diff(scores).min()) > 5.5
    assert scores[0] > 55  # measured


def test_bands_converge_on_the_truth_at_the_rate_of_their_quantised_time() -> None:
    """Rows of a band of n lie (n^2 - 1) / 12 rows^2 from its instant in the mean, and the error follows."""
    cloud, pose, truth = random_gaussians(60), turning(), brute_force(0.1, SMOOTH)
    scores = [
        psnr(render(Scene(cloud, pose.expand(bands, -1, -1, -1, -1), timed(Bands(bands)), CAMERA, SMOOTH)), truth)
        for bands in (2, 4, 8)
    ]
    variances = np.array([(H / bands) ** 2 - 1 for bands in (2, 4, 8)])
    assert np.diff(scores) == pytest.approx(-np.diff(10 * np.log10(variances)), abs=0.6)


def test_exposure_is_the_mean_of_shifted_scans() -> None:
    cloud, pose, shutter = random_gaussians(30), turning(), Scanline(exposure=0.3, samples=2)
    slots = timed(shutter)
    soft = render(Scene(cloud, pose.expand(2, -1, -1, -1, -1), slots, CAMERA))
    truths = [render_rows(cloud, row_clock(pose, s.rate, s.start), CAMERA).rgb for s in slots]
    assert psnr(soft, Rendering(torch.stack(truths).mean(0), soft.transmittance)) > 45  # measured


def test_upward_readout_of_the_mirrored_motion_is_the_downward_readout() -> None:
    """Reading upwards is reading downwards with time reversed, tau -> -tau."""
    cloud, pose = random_gaussians(40), turning()
    reversed_pose = pose * double(1, -1, 1, -1)[:, None, None, None]
    down = render(scene(cloud, pose, WHOLE))
    up = render(scene(cloud, reversed_pose, TimedRows(0, H, rate=-2 / H, start=1.0)))
    torch.testing.assert_close(up.rgb, down.rgb, atol=1e-10, rtol=0)


def test_rows_order_depths_at_their_own_instants() -> None:
    """Two discs side by side in depth change places in mid-readout: above one is in front, below the other."""
    pair = gaussians(double([0, 0], [0, 0], [2, 2]), scale=1.0, opacity=0.9, colours=RED_BLUE)
    pair.skin_weights[:2] = torch.eye(2)
    pose = still(2)
    pose[1, 0, 2, 3], pose[1, 1, 2, 3] = 0.02, -0.02  # red moves away, blue comes nearer
    image = render(scene(pair, pose, WHOLE))
    truth = render_rows(pair, row_clock(pose), CAMERA)
    for picture in (image, truth):
        red, _, blue = picture.rgb[:, :, CENTRE[1]]
        assert bool((red[:12] > 2 * blue[:12]).all())
        assert bool((blue[-12:] > 2 * red[-12:]).all())


# --- gradients --------------------------------------------------------------------------------------------------------

FIELDS = ("means", "rotations", "log_scales", "opacity_logits", "sh", "skin_weights", "screen")


@pytest.mark.parametrize("rows", [NO_READOUT, WHOLE], ids=["instant", "scanline"])
def test_gradients_by_finite_differences(rows: TimedRows) -> None:
    cloud, pose = random_gaussians(3), turning(joints=2)
    camera = CAMERA.cropped(13, 9, 18, 13)
    rows = TimedRows(0, camera.height, rows.rate and 2 / camera.height, rows.rate and -1.0)
    cloud = replace(cloud, means=cloud.means * double(0.3, 0.3, 1.0)[:, None])

    def image(moved: Tensor, *values: Tensor) -> tuple[Tensor, Tensor]:
        whole = torch.cat([moved, pose[:, 2:]], 1)
        splats = Gaussians(**dict(zip(FIELDS, values, strict=True)))
        result = render(Scene(splats, whole[None], (rows,), camera, SMOOTH))
        return result.rgb, result.transmittance

    inputs = [pose[:, :2].clone(), *(getattr(cloud, name).clone() for name in FIELDS)]
    assert torch.autograd.gradcheck(image, [x.requires_grad_() for x in inputs], fast_mode=True)


def test_scanline_gradient_of_constant_image_velocity_is_exact() -> None:
    """The flat disc again: the image is the truth for every position and velocity, so the gradients agree as well."""
    target = torch.rand(3, H, W, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    plane = double([0.05, -0.1], [0.1, 0.25]).requires_grad_()  # position, velocity
    gradients = []
    for truth in (False, True):
        mean = torch.cat([plane[0], double(2.0)])[:, None]
        disc = gaussians(mean, scale=0.15, opacity=0.9)
        disc.log_scales[2] = -30.0
        pose = torch.stack([still()[0], torch.zeros_like(still()[0])])
        pose[1, :, :2, 3] = plane[1]
        image = (
            render_rows(disc, row_clock(pose), CAMERA, SMOOTH) if truth else render(scene(disc, pose, WHOLE, SMOOTH))
        )
        gradients.append(torch.autograd.grad((image.rgb - target).square().sum(), plane)[0])
    assert float(gradients[1].abs().min()) > 1e-2
    torch.testing.assert_close(gradients[0], gradients[1], atol=0, rtol=1e-10)


def test_scanline_gradients_of_articulated_motion_come_near_the_truths() -> None:
    """Through each splat's own time. Without the implicit derivative the first two are three times further off."""
    cloud, pose = random_gaussians(60), turning(speed=0.05).requires_grad_()
    inputs = [pose, cloud.means.requires_grad_(), cloud.opacity_logits.requires_grad_(), cloud.sh.requires_grad_()]
    target = torch.rand(3, H, W, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    gradients = []
    for image in (render(scene(cloud, pose, WHOLE, SMOOTH)), render_rows(cloud, row_clock(pose), CAMERA, SMOOTH)):
        first, *rest = torch.autograd.grad((image.rgb - target).square().sum(), inputs)
        gradients.append([first[0], *rest])  # of the pose, the coefficient of tau^0
    for got, truth in zip(*gradients, strict=True):
        assert float((got - truth).norm() / truth.norm()) < 0.01  # measured: 0.004 to 0.007


def test_screen_moves_the_picture_but_not_the_time() -> None:
    one, pose = gaussians(double(0, 0, 2)[:, None]), moving(double(0.1, 0.2, 0.0))
    moved = replace(one, screen=double([2.0], [3.0]))
    before, after = render(scene(one, pose)), render(scene(moved, pose))
    torch.testing.assert_close(after.rgb[:, 3:, 2:], before.rgb[:, :-3, :-2], atol=ROUNDING, rtol=0)


def test_what_lies_behind_the_camera_leaves_no_trace() -> None:
    """Culled splats, a zero quaternion among them, neither show nor poison the joints' gradient."""
    cloud, pose = random_gaussians(10), turning().requires_grad_()
    behind = gaussians(double([0.0, 0.1], [0.0, 0.0], [-1.0, 0.0]))
    behind.rotations[:, 1] = 0
    behind = replace(behind, sh=torch.cat([behind.sh, torch.zeros(3, 3, 2, dtype=torch.float64)]))
    joined = Gaussians(**{n: torch.cat([getattr(cloud, n), getattr(behind, n)], -1) for n in FIELDS})
    with_them, without = render(scene(joined, pose)), render(scene(cloud, pose))
    assert torch.equal(with_them.rgb, without.rgb)
    gradient, truth = (torch.autograd.grad(i.rgb.square().sum(), pose)[0] for i in (with_them, without))
    torch.testing.assert_close(gradient, truth, atol=ROUNDING, rtol=0)


def test_nothing_in_view_is_black_and_still_has_gradients() -> None:
    means = double(0, 0, -2)[:, None].requires_grad_()
    image = render(scene(gaussians(means), still(4)))
    (gradient,) = torch.autograd.grad(image.rgb.sum(), means)
    assert float(image.transmittance.detach().min()) == 1
    assert float(gradient.abs().max()) == 0


def test_float32_comes_in_and_float64_goes_out() -> None:
    cloud = Gaussians(**{n: getattr(random_gaussians(5), n).float().requires_grad_() for n in FIELDS})
    image = render(scene(cloud, turning().float()))
    image.rgb.sum().backward()
    assert image.rgb.dtype == torch.float64
    assert cloud.means.grad is not None
    assert cloud.means.grad.dtype == torch.float32
