"""Work that is left out: what it may change, and that its switch brings it back."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from rsavatar import kernels
from rsavatar.bench.scene import Size, build
from rsavatar.imaging import NODES, expose, plan, polynomials
from rsavatar.losses import l1
from rsavatar.methods.base import build_actor, observations, settings
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.render.base import Scene
from rsavatar.shutter.base import AbstractShutter
from rsavatar.shutter.rolling import Bands, Scanline
from rsavatar.skipping import LOOK_EVERY, Nodes, Settled, Work, needed_nodes, thinned
from tests.contracts.test_shutters import Upwards
from tests.core import small_subject


def moving(motion_px: float, nodes: int = NODES) -> Scene:
    """Scene P13 made small, its fastest Gaussian moving ``motion_px`` pixels while it is read."""
    body = build(Size(gaussians=1500, pixels=192, motion_px=motion_px))
    schedule = plan(Scanline().slots(192, 1.0, 0.0), 0, 192)
    schedule = thinned(schedule, nodes) if nodes < NODES else schedule
    with torch.no_grad():
        pose = polynomials(body.transforms(schedule.offsets), schedule.coefficients)
    return Scene(body.gaussians, pose, schedule.rows, body.camera)


@pytest.mark.parametrize("nodes", [1, 2, 3, 4])
@pytest.mark.parametrize("shutter", [Scanline(), Scanline(0.3, 3), Upwards(Scanline())])
def test_a_thinned_schedule_is_what_would_have_been_planned(nodes: int, shutter: AbstractShutter) -> None:
    slots = shutter.slots(40, 11.0, 1.5)
    found, wanted = thinned(plan(slots, 3, 31), nodes), plan(slots, 3, 31, nodes)
    assert found.coefficients == nodes
    assert found.offsets.tolist() == pytest.approx(wanted.offsets.tolist(), abs=1e-9)
    assert [(r.lo, r.hi, r.weight) for r in found.rows] == [(r.lo, r.hi, r.weight) for r in wanted.rows]
    assert all(r.rate == 0 for r in found.rows) == (nodes == 1)


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
@pytest.mark.parametrize("motion_px", [1e-4, 0.1, 1.0, 8.0, 30.0])
def test_the_nodes_that_are_needed_leave_60_db(motion_px: float) -> None:
    whole = moving(motion_px)
    nodes = needed_nodes(whole)
    some, full = expose(moving(motion_px, nodes)), expose(whole)
    error = (some.rgb - full.rgb)[:, full.transmittance < 0.5]
    assert -10 * math.log10(max(float(error.square().mean()), 1e-20)) > 60


def test_faster_motion_needs_more_nodes() -> None:
    needed = [needed_nodes(moving(motion)) for motion in (1e-4, 1.0, 100.0)]
    assert needed[0] == 1
    assert needed == sorted(needed)
    assert needed[-1] > needed[0]


def test_every_so_many_visits_an_image_gets_all_its_nodes() -> None:
    nodes, schedule, scene = Nodes(2), plan(Scanline().slots(192, 1.0, 0.0), 0, 192), moving(1e-4)
    found = []
    for _ in range(LOOK_EVERY + 1):
        chosen = nodes.choose(1, schedule)
        found.append(chosen.coefficients)
        nodes.note(1, replace(scene, pose=scene.pose[:, : chosen.coefficients]))
    assert found == [NODES] + [1] * (LOOK_EVERY - 1) + [NODES]
    assert nodes.choose(0, schedule) is schedule
    bands = plan(Bands(3).slots(192, 1.0, 0.0), 0, 192)
    assert nodes.choose(0, bands) is bands


def test_nothing_is_looked_for_between_looks() -> None:
    nodes, still = Nodes(1), moving(1e-4)
    nodes.note(0, moving(100.0))
    fast = int(nodes.needed[0])
    for _ in range(LOOK_EVERY - 1):
        nodes.note(0, still)
        assert nodes.needed[0] == fast > 1
    nodes.note(0, still)
    assert nodes.needed[0] == 1


def test_images_that_no_longer_change_rest_every_second_block() -> None:
    settled = Settled(4)
    for loss in (1.0, 1.001, 1.0, 1.001):
        settled.note(2, loss)
        settled.note(3, 10 * loss if loss > 1 else loss)
    assert settled.awake([0, 1, 2, 3], 0) == [0, 1, 2, 3]
    assert settled.awake([0, 1, 2, 3], 1) == [0, 1, 3]
    settled.note(2, 2.0)  # it changes again
    assert settled.awake([0, 1, 2, 3], 1) == [0, 1, 2, 3]
    settled.calm[:] = 9
    assert settled.awake([0], 1) == [0], "never nothing"


def test_the_body_skip_cuts_what_its_switch_brings_back() -> None:
    case = small_subject.case()
    method = RollingShutterAvatar()
    cut = observations(method, case)
    whole = observations(method, replace(case, spec=case.spec.model_copy(update={"skip": ()})))
    assert all(o.camera.height * o.camera.width <= math.prod(o.full_size) for o in cut)
    assert all((o.camera.height, o.camera.width) == o.full_size for o in whole)
    assert [o.label for o in cut] == [o.label for o in whole]
    actor = build_actor(method, case)
    with torch.no_grad():
        weights = actor.skin_weights()
        for pair in zip(cut, whole, strict=True):
            part, all_of_it = (
                o.weight * l1(expose(actor.scene(o.frame, o.camera, o.schedule, weights, 0)), o.rgb, o.mask, 0.0, 0.1)
                for o in pair
            )
            assert all_of_it == pytest.approx(float(part), rel=0.05), "what lies beyond the box is nearly empty"


def test_the_harmonics_wait_unless_they_are_told_not_to() -> None:
    case = small_subject.case()
    waiting = settings(case)
    at_once = settings(replace(case, spec=case.spec.model_copy(update={"skip": ()})))
    assert [waiting.degree(0), waiting.degree(waiting.sh_from)] == [0, 1]
    assert at_once.degree(0) == 1


@pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")
def test_work_is_counted_per_step() -> None:
    scene, work = moving(1.0), Work()
    image = expose(scene)
    for _ in range(3):
        work.add(scene, image, (384, 192))
    found = work.means(resting=2)
    assert found["pixels"] == 0.5
    assert found["nodes"] == NODES
    assert found["splats"] == pytest.approx(image.splats / scene.gaussians.count, abs=1e-4)
    assert found["pairs"] == image.pairs
    assert found["resting"] == 2
    assert work.means(resting=0) == {"resting": 0.0}
