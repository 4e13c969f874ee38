"""First colours come from the pictures."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rsavatar import kernels
from rsavatar.imaging import Actor, expose
from rsavatar.methods.base import build_actor, observations
from rsavatar.methods.rolling import RollingShutterAvatar
from rsavatar.painting import OPAQUE, paint
from rsavatar.render.reference import C0
from rsavatar.train import Observation
from tests.core import small_subject

pytestmark = pytest.mark.skipif(not kernels.available(), reason="no native kernels were built for this machine")


@pytest.fixture
def scene() -> tuple[Actor, list[Observation]]:
    case, method = small_subject.case(), RollingShutterAvatar()
    return build_actor(method, case), observations(method, case)


def colours(actor: Actor) -> torch.Tensor:
    """[M, 3]."""
    return 0.5 + C0 * actor.avatar.sh_constant.detach()[0].T


def photographed(actor: Actor, observations: list[Observation]) -> list[Observation]:
    """The same views of the actor itself, opaque as ``paint`` looks at it."""
    thin = actor.avatar.opacity_logits.data
    actor.avatar.opacity_logits.data = torch.full_like(thin, OPAQUE).logit_()
    taken = []
    with torch.no_grad():
        for seen in observations:
            image = expose(actor.scene(seen.frame, seen.camera, seen.schedule, actor.skin_weights(), 0))
            rgb, mask = (255 * image.rgb).round().byte(), (255 * (1 - image.transmittance)).round().byte()
            taken.append(replace(seen, rgb=rgb, mask=mask))
    actor.avatar.opacity_logits.data = thin
    return taken


def test_a_body_of_one_colour_is_painted_in_it(scene: tuple[Actor, list[Observation]]) -> None:
    actor, seen = scene
    colour = torch.tensor([0.8, 0.3, 0.1])
    actor.avatar.sh_constant.data += ((colour - 0.5) / C0)[:, None]
    pictures = photographed(actor, seen)
    actor.avatar.sh_constant.data.zero_()
    opacities = actor.avatar.opacity_logits.detach().clone()
    paint(actor, pictures)
    assert (colours(actor) - colour).abs().max() < 0.01
    assert torch.equal(actor.avatar.opacity_logits, opacities)
    assert actor.avatar.sh_constant.grad is None


def test_each_part_gets_its_own_colour(scene: tuple[Actor, list[Observation]]) -> None:
    actor, seen = scene
    upper = actor.avatar.means.detach()[1] > 0
    actor.avatar.sh_constant.data[0] = torch.where(upper, 0.4, -0.4) / C0
    pictures = photographed(actor, seen)
    paint(actor, pictures)
    found = colours(actor).mean(1)
    assert found[upper].mean() - found[~upper].mean() > 0.2


def test_what_no_picture_shows_takes_the_mean_colour(scene: tuple[Actor, list[Observation]]) -> None:
    actor, seen = scene
    actor.avatar.means.data[:, 0] = torch.tensor([50.0, 0.0, 0.0])
    paint(actor, seen)
    others = colours(actor)[1:]
    assert torch.isfinite(colours(actor)).all()
    assert others.min(0).values.le(colours(actor)[0]).all()
    assert others.max(0).values.ge(colours(actor)[0]).all()


def test_a_body_that_is_nowhere_in_the_masks_stays_grey(scene: tuple[Actor, list[Observation]]) -> None:
    actor, seen = scene
    empty = [replace(o, rgb=torch.zeros_like(o.rgb), mask=torch.zeros_like(o.mask)) for o in seen]
    paint(actor, empty)
    assert (colours(actor) == 0.5).all()
