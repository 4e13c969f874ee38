"""Properties of scenes as nasty as hypothesis can make them; the long list is ``rsavatar bench stability``."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rsavatar import kernels
from rsavatar.avatar.networks import refine
from rsavatar.bench import stability, stability_numbers
from rsavatar.bench.machine import Machine
from rsavatar.bench.stability_case import FIELDS, against_twin, outcome
from rsavatar.errors import KernelError
from rsavatar.geometry.rotations import exp_so3, geodesic_distance, log_so3, rotvec_distance
from rsavatar.render import native
from rsavatar.render.base import Gaussians, Options, Scene
from tests.core import scenes

pytestmark = pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")

QUICK = settings(max_examples=40, deadline=None, derandomize=True)
COUNT = 12
Number = st.one_of(
    st.floats(-4, 4, width=32),
    st.sampled_from([0.0, 1e-40, -1e-40, 1e-20, 90.0, -90.0, 1e4, -1e4, 1e20, -1e20, 3e38]),
)
Broken = st.sampled_from([math.nan, math.inf, -math.inf])


@st.composite
def nasty_scenes(draw: st.DrawFn, numbers: st.SearchStrategy[float] = Number) -> Scene:
    """A plain scene in which some numbers of some Gaussians, and of the pose, are anything."""
    plain = scenes.scene(
        draw(st.sampled_from(scenes.KINDS)), count=COUNT, seed=draw(st.integers(0, 5)), dtype=torch.float32
    )
    tensors = {name: getattr(plain.gaussians, name).clone() for name in FIELDS}
    for name in draw(st.lists(st.sampled_from(FIELDS), max_size=4)):
        flat = tensors[name].view(-1)
        flat[draw(st.integers(0, len(flat) - 1))] = draw(numbers)
    pose = plain.pose.clone()
    pose[:, 0, :, 2, 3] += draw(st.sampled_from([0.0, 0.0, -2.4, -2.3, -10.0, 1e6]))  # towards and behind the camera
    pose[:, 1:] *= draw(st.sampled_from([0.0, 1.0, 10.0, 1e3]))  # up to and beyond scan speed
    return replace(plain, gaussians=Gaussians(**tensors), pose=pose)


@given(nasty_scenes())
@QUICK
def test_any_finite_scene_gives_finite_colours_fractions_of_light_and_gradients(scene: Scene) -> None:
    got = outcome(native.render, scene)
    assert got.physical


@given(nasty_scenes(Broken))
@QUICK
def test_numbers_that_are_none_stay_with_their_gaussian(scene: Scene) -> None:
    got = outcome(native.render, scene)
    assert got.physical
    broken = {
        i for name in FIELDS for i in torch.nonzero(~torch.isfinite(getattr(scene.gaussians, name)))[:, -1].tolist()
    }
    assert got.image.broken == len(broken) * len(scene.rows)


@given(nasty_scenes(st.one_of(Number, Broken)))
@QUICK
def test_threads_do_not_change_a_bit(scene: Scene) -> None:
    before, runs = kernels.threads(), []
    try:
        for threads in (1, 2):
            kernels.use_threads(threads)
            runs.append(outcome(native.render, scene))
    finally:
        kernels.use_threads(before)
    one, two = runs
    assert torch.equal(one.image.rgb, two.image.rgb)
    assert all(torch.equal(one.gradients[name], two.gradients[name]) for name in one.gradients)


@given(nasty_scenes(st.one_of(Number, Broken)), st.sampled_from(["bands", "rows"]), st.booleans())
@QUICK
def test_culling_blocks_does_not_change_a_bit(nasty: Scene, kind: str, ordered: bool) -> None:
    slots = scenes.scene(kind, count=COUNT, dtype=torch.float32)
    scene = replace(slots, gaussians=nasty.gaussians, pose=slots.pose + nasty.pose[:1, :1] - slots.pose[:1, :1])
    scene = scenes.orderly(scene) if ordered else scene
    culled = outcome(native.render, scene)
    whole = outcome(native.render, replace(scene, options=Options(without=frozenset({"cull"}))))
    assert torch.equal(culled.image.rgb, whole.image.rgb)
    assert (culled.image.splats, culled.image.broken) == (whole.image.splats, whole.image.broken)
    assert all(torch.equal(culled.gradients[name], whole.gradients[name]) for name in whole.gradients)


@given(st.floats(0.1, math.log(1e4)), st.integers(0, 20), st.sampled_from(["global", "scanline"]))
@settings(max_examples=12, deadline=None, derandomize=True)
def test_needles_of_any_aspect_equal_the_twin(thinness: float, seed: int, kind: str) -> None:
    """Of spheres, thinness 0, the rotation's gradient is nothing but rounding."""
    s = scenes.scene(kind, count=COUNT, seed=seed, dtype=torch.float32)
    scales = s.gaussians.log_scales.clone()
    scales[0], scales[1:] = -0.5, -0.5 - thinness
    measured, held = against_twin(replace(s, gaussians=replace(s.gaussians, log_scales=scales)))
    assert held, measured


@given(st.permutations(range(5)))
@QUICK
def test_slots_out_of_order_are_refused(order: list[int]) -> None:
    s = scenes.scene("bands", count=COUNT, dtype=torch.float32)
    shuffled = replace(s, rows=tuple(s.rows[i] for i in order))
    if order == sorted(order):
        native.render(shuffled)
    else:
        with pytest.raises(KernelError, match="limits"):
            native.render(shuffled)


Angle = st.one_of(st.sampled_from([0.0, math.pi, -math.pi, 2 * math.pi, 1e-30, 1e-8]), st.floats(-7, 7))


@given(st.tuples(Angle, Angle, Angle), st.tuples(Angle, Angle, Angle))
@settings(max_examples=200, deadline=None, derandomize=True)
def test_rotations_come_back_and_their_distances_agree(first: tuple[float, ...], second: tuple[float, ...]) -> None:
    a, b = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (first, second))
    A, B = exp_so3(a), exp_so3(b)
    assert torch.allclose(
        exp_so3(log_so3(A)), A, atol=1e-6, rtol=0
    )  # within 1e-6 of pi the logarithm's axis is that sure
    by_matrix, by_vector = geodesic_distance(A, B), rotvec_distance(a, b)
    assert abs(float(by_matrix.detach()) - float(by_vector.detach())) < 1e-6
    torch.autograd.backward(by_matrix + by_vector + log_so3(A).sum())
    assert a.grad is not None
    assert torch.isfinite(a.grad).all()


def test_refined_weights_never_all_vanish() -> None:
    """Before, offsets in favour of joints that the body does not bind could take the whole softmax."""
    prior = torch.tensor([[0.0, 0.5], [1.0, 0.5]])
    offset = torch.tensor([[60.0, 60.0], [-60.0, 0.0]], requires_grad=True)
    weights = refine(prior, offset)
    assert torch.equal(weights.sum(0), torch.ones(2))
    torch.autograd.backward(weights[1].sum())
    assert offset.grad is not None
    assert torch.isfinite(offset.grad).all()


@pytest.mark.parametrize("case", stability_numbers.cases(), ids=lambda case: case.name)
def test_rows_of_the_stability_suite_before_the_renderer(case: stability_numbers.Case) -> None:
    measured, held = case.run()
    assert held, measured


def test_the_page_counts_what_held_and_names_what_did_not() -> None:
    rows = [stability.Row("renderer", f"case {i}", "finite", "1 | 2", i > 0, 0.1) for i in range(3)]
    machine = Machine(
        commit="abc", processor="p", cores=2, threads=2, instructions="avx2", lanes=8, load=0.0, python="3", torch="2"
    )
    page = stability.page(rows, machine)
    assert "2 of 3 promises held." in page
    assert "| case 0 | finite | 1 / 2 | **broken** | 0.1 |" in page
    assert np.char.count(page, "| held |") == 2
