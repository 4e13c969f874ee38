"""The native kernels against the float64 twin: every shutter, every input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import pytest
import torch
from torch import Tensor

from rsavatar import kernels
from rsavatar.errors import KernelError
from rsavatar.losses import compare
from rsavatar.render import native, reference
from rsavatar.render.base import Comparison, Gaussians, Options, Rendering, Scene, TimedRows
from tests.core import scenes

pytestmark = pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")


def leaves(s: Scene) -> tuple[Scene, dict[str, Tensor]]:
    tensors = {f.name: getattr(s.gaussians, f.name).clone().requires_grad_() for f in fields(Gaussians)}
    pose = s.pose.clone().requires_grad_()
    return replace(s, gaussians=Gaussians(**tensors), pose=pose), {**tensors, "pose": pose}


def gradients(render: object, s: Scene, seed: int = 5) -> tuple[Rendering, dict[str, Tensor]]:
    s, tensors = leaves(s)
    image: Rendering = render(s)  # type: ignore[operator]
    g = torch.Generator().manual_seed(seed)
    rgb = torch.randn(image.rgb.shape, generator=g, dtype=torch.float64).to(image.rgb.dtype)
    t = torch.randn(image.transmittance.shape, generator=g, dtype=torch.float64).to(image.rgb.dtype)
    ((image.rgb * rgb).sum() + (image.transmittance * t).sum()).backward()
    return image, {name: x.grad.double() for name, x in tensors.items() if x.grad is not None}


@pytest.mark.parametrize("bases", [1, 4])
@pytest.mark.parametrize("kind", scenes.KINDS)
def test_image_and_gradients_of_every_input_equal_the_twin(kind: str, bases: int) -> None:
    truth, expected = gradients(reference.render, scenes.scene(kind, bases=bases))
    image, got = gradients(native.render, scenes.scene(kind, bases=bases, dtype=torch.float32))
    # A pixel whose alpha lies within float32 rounding of the 1/255 cutoff may fall on either side: at most one such
    # contribution, 1/255 of a colour, is let pass.
    assert (image.rgb.double() - truth.rgb).abs().max() < 1 / 255
    assert (image.rgb.double() - truth.rgb).square().mean().sqrt() < 2e-5
    assert set(got) == set(expected)
    # of weights that are 0 only the twin gives a gradient
    expected["skin_weights"] *= scenes.scene(kind).gaussians.skin_weights != 0
    for name, want in expected.items():
        error = (got[name] - want).norm() / want.norm()
        assert error < 1e-4, f"gradient of {name}: relative error {error:.1e}"


Compare = Callable[[Scene, Tensor, Tensor, float, float], Comparison]


def in_two_passes(s: Scene, target: Tensor, mask: Tensor, background: float, mask_weight: float) -> Comparison:
    return compare(native.render(s), target, mask, background, mask_weight)


def losses(through: Compare, kind: str) -> tuple[Comparison, dict[str, Tensor]]:
    """A scene against noise, over grey, with the gradients of three times the loss."""
    s, tensors = leaves(scenes.scene(kind, count=400, dtype=torch.float32))
    noise = torch.Generator().manual_seed(1)
    target = torch.randint(0, 256, (4, scenes.HEIGHT, scenes.WIDTH), generator=noise, dtype=torch.uint8)
    found = through(s, target[:3], target[3], 0.3, 0.1)
    torch.autograd.backward(3 * found.loss)
    return found, {name: x.grad for name, x in tensors.items() if x.grad is not None}


@pytest.mark.parametrize("kind", scenes.KINDS)
def test_one_pass_through_the_loss_equals_two(kind: str) -> None:
    wanted, expected = losses(in_two_passes, kind)
    found, got = losses(native.render_l1, kind)
    assert float(found.loss.detach()) == pytest.approx(float(wanted.loss.detach()), rel=1e-6)
    assert found.squared_error == pytest.approx(wanted.squared_error, rel=1e-5)
    assert (found.splats, found.pairs, found.broken) == (wanted.splats, wanted.pairs, wanted.broken)
    assert set(got) == set(expected)
    for name, want in expected.items():
        torch.testing.assert_close(got[name], want, rtol=1e-4, atol=1e-6 * float(want.abs().max()))


@pytest.mark.parametrize("kind", scenes.KINDS)
def test_one_pass_gives_the_same_bits_with_any_number_of_threads(kind: str) -> None:
    before, runs = kernels.threads(), []
    try:
        for threads in (1, 2, 3):
            kernels.use_threads(threads)
            runs.append(losses(native.render_l1, kind))
    finally:
        kernels.use_threads(before)
    for found, grads in runs[1:]:
        assert float(found.loss.detach()) == float(runs[0][0].loss.detach())
        assert all(torch.equal(grads[name], runs[0][1][name]) for name in grads)


def test_one_pass_over_nothing_to_see() -> None:
    s = scenes.scene("part", dtype=torch.float32)
    away = replace(s, gaussians=replace(s.gaussians, means=s.gaussians.means + 100.0))
    target = torch.full((4, scenes.HEIGHT, scenes.WIDTH), 51, dtype=torch.uint8)
    found = native.render_l1(away, target[:3], target[3], 0.5, 2.0)
    assert float(found.loss) == pytest.approx(0.1 + 2.0 * 0.2, rel=1e-6)  # |0 - 0.2 + 0.5 * 0.2|, and |0 - 0.2|
    assert found.squared_error == pytest.approx(0.01, rel=1e-6)


def test_a_target_of_another_size_is_refused() -> None:
    s = scenes.scene("global", dtype=torch.float32)
    target = torch.zeros(3, scenes.HEIGHT, scenes.WIDTH - 1, dtype=torch.uint8)
    with pytest.raises(KernelError, match="target: expected"):
        native.render_l1(s, target, target[0], 0.0, 0.0)


@pytest.mark.parametrize("kind", scenes.KINDS)
def test_any_number_of_threads_gives_the_same_bits(kind: str) -> None:
    s = scenes.scene(kind, count=400, dtype=torch.float32)
    before = kernels.threads()
    runs = []
    try:
        for threads in (1, 2, 3, 2):
            kernels.use_threads(threads)
            runs.append(gradients(native.render, s))
    finally:
        kernels.use_threads(before)
    for image, grads in runs[1:]:
        assert torch.equal(image.rgb, runs[0][0].rgb)
        assert all(torch.equal(grads[name], runs[0][1][name]) for name in grads)


@pytest.mark.parametrize("kind", ["bands", "rows"])
def test_blocks_that_cannot_reach_a_slot_are_left_out_without_a_trace(kind: str) -> None:
    s = scenes.orderly(scenes.scene(kind, count=400, dtype=torch.float32))
    image, got = gradients(native.render, s)
    whole, wanted = gradients(native.render, replace(s, options=Options(without=frozenset({"cull"}))))
    assert torch.equal(image.rgb, whole.rgb)
    assert torch.equal(image.transmittance, whole.transmittance)
    assert all(torch.equal(got[name], wanted[name]) for name in wanted)
    assert (image.splats, whole.projected) == (whole.splats, 400 * len(s.rows))
    assert image.projected < 0.9 * whole.projected  # half of the slots of "rows" scan, and are not culled


def beyond_the_hull(s: Scene) -> Scene:
    """Weights 2 and -1 of two joints that are 40 cm apart: the mean is outside of what either makes of it."""
    weights, pose = torch.zeros_like(s.gaussians.skin_weights), s.pose.clone()
    weights[0], weights[1] = 2.0, -1.0
    pose[:, 0, 1, 1, 3] += 0.4
    return replace(s, gaussians=replace(s.gaussians, skin_weights=weights), pose=pose)


def off_one(s: Scene) -> Scene:
    return replace(s, gaussians=replace(s.gaussians, skin_weights=1.5 * s.gaussians.skin_weights))


def broken_joint(s: Scene) -> Scene:
    pose = s.pose.clone()
    pose[1, 0, 3, 1, 3] = torch.nan
    return replace(s, pose=pose)


def at_the_camera(s: Scene) -> Scene:
    pose = s.pose.clone()
    pose[..., 2, 3] -= 2.3
    return replace(s, pose=pose)


@pytest.mark.parametrize("change", [beyond_the_hull, off_one, broken_joint, at_the_camera], ids=lambda f: f.__name__)
def test_blocks_that_nothing_bounds_are_not_left_out(change: Callable[[Scene], Scene]) -> None:
    s = change(scenes.orderly(scenes.scene("bands", count=400, dtype=torch.float32)))
    image, whole = native.render(s), native.render(replace(s, options=Options(without=frozenset({"cull"}))))
    assert torch.equal(image.rgb, whole.rgb)
    assert (image.splats, image.broken) == (whole.splats, whole.broken)


@pytest.mark.parametrize("speed", [0.5, 0.95, 1.05, 2.0], ids="{} of scan speed".format)
def test_motion_near_scan_speed_equals_the_twin(speed: float) -> None:
    falling = scenes.orderly(scenes.scene("scanline", count=60))
    pose = falling.pose.clone()
    pose[:, 1:, :, :, :] = 0.0
    pose[:, 1, :, 1, 3] = speed * 2.4 / 74.0 * scenes.HEIGHT / 2  # metres a unit of tau, at the body's distance

    def drawn(render: object, dtype: torch.dtype) -> tuple[Rendering, dict[str, Tensor]]:
        g = scenes.cast(falling.gaussians, dtype)
        return gradients(render, replace(falling, gaussians=g, pose=pose.float().to(dtype)))

    truth, expected = drawn(reference.render, torch.float64)
    image, got = drawn(native.render, torch.float32)
    assert (image.rgb.double() - truth.rgb).square().mean().sqrt() < 1e-4
    for name in ("means", "log_scales", "pose"):
        error = (got[name] - expected[name]).norm() / expected[name].norm()
        assert error < 1e-3, f"gradient of {name}: relative error {error:.1e}"


@pytest.mark.parametrize("kind", ["scanline", "exposed"])
@pytest.mark.parametrize("speed", [0.05, 2.0], ids=["few swaps", "more swaps than insertion sorts"])
def test_every_row_has_its_own_depth_order(kind: str, speed: float) -> None:
    """Splats that fly past each other: strips of any height give the image of strips of one row."""
    s = scenes.scene(kind, count=400, dtype=torch.float32)
    pose = s.pose.clone()
    pose[:, 1, :12, 2, 3] += speed
    pose[:, 1, 12:, 2, 3] -= speed

    def drawn(options: Options) -> tuple[Rendering, dict[str, Tensor]]:
        return gradients(native.render, replace(s, pose=pose, options=options))

    rows, wanted = drawn(Options(strip_rows=1))
    for height in (7, 16, scenes.HEIGHT):
        image, got = drawn(Options(strip_rows=height))
        assert torch.equal(image.rgb, rows.rgb)
        assert all((got[name] - g).norm() < 1e-5 * g.norm() for name, g in wanted.items())
    one_order, _ = drawn(Options(without=frozenset({"resort"})))
    assert (one_order.rgb - rows.rgb).abs().max() > 0.1


def test_gradients_that_nobody_wants_are_not_computed() -> None:
    s = scenes.scene("scanline", dtype=torch.float32)
    pose = s.pose.clone().requires_grad_()
    native.render(replace(s, pose=pose)).rgb.sum().backward()
    _, full = gradients(native.render, s)
    assert pose.grad is not None
    assert set(full) == {"means", "rotations", "log_scales", "opacity_logits", "sh", "skin_weights", "screen", "pose"}


def test_nothing_to_see_is_black_and_transparent() -> None:
    s = scenes.scene("scanline", dtype=torch.float32)
    behind = s.pose.clone()
    behind[:, 0, :, 2, 3] -= 50.0
    image = native.render(replace(s, pose=behind))
    assert image.splats == 0
    assert torch.equal(image.rgb, torch.zeros_like(image.rgb))
    assert torch.equal(image.transmittance, torch.ones_like(image.transmittance))


def test_rows_without_a_slot_are_empty() -> None:
    s = scenes.scene("part", dtype=torch.float32)
    image = native.render(s)
    assert torch.equal(image.transmittance[:7], torch.ones(7, scenes.WIDTH))
    assert image.transmittance[7:41].min() < 1
    assert torch.equal(image.rgb[:, 41:], torch.zeros(3, scenes.HEIGHT - 41, scenes.WIDTH))


@pytest.mark.parametrize(
    "rows",
    [
        (TimedRows(0, 61, 0.0, 0.0),),
        (TimedRows(0, 30, 0.0, 0.0), TimedRows(20, 40, 0.0, 0.0)),
        (TimedRows(30, 30, 0.0, 0.0),),
    ],
)
def test_rows_outside_the_image_or_partly_overlapping_are_refused(rows: tuple[TimedRows, ...]) -> None:
    s = scenes.scene("global", dtype=torch.float32)
    with pytest.raises(KernelError, match="limits"):
        native.render(replace(s, rows=rows, pose=s.pose.expand(len(rows), -1, -1, -1, -1)))


def test_a_wrong_type_or_shape_is_named() -> None:
    s = scenes.scene("global", dtype=torch.float32)
    with pytest.raises(KernelError, match=r"means: expected torch.float32 \(3, 150\) on cpu, got torch.float64"):
        native.render(replace(s, gaussians=replace(s.gaussians, means=s.gaussians.means.double())))
    with pytest.raises(KernelError, match="pose: expected"):
        native.render(replace(s, pose=s.pose[:, :, :23]))


def test_a_second_backward_is_refused() -> None:
    s, _ = leaves(scenes.scene("global", dtype=torch.float32))
    loss = native.render(s).rgb.sum()
    loss.backward(retain_graph=True)
    with pytest.raises(KernelError, match="second backward"):
        loss.backward()
