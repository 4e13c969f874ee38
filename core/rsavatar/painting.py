"""First colours: what the pictures show where the body's fit puts each Gaussian."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch

from rsavatar.imaging import Actor, expose
from rsavatar.render.reference import C0

if TYPE_CHECKING:
    from rsavatar.train import Observation

PICTURES = 48  # are looked at, spread over cameras and frames: more show nothing new
OPAQUE = 0.9  # opacity while looking, so that a Gaussian does not take the colour of what hides it
SEEN = 1e-2  # of the mean weight: Gaussians seen less than that take the body's mean colour


def paint(actor: Actor, observations: Sequence[Observation]) -> None:
    """Give each Gaussian the mean colour of the pixels that it covers, each weighted as the renderer blends it.

    An image is linear in the Gaussians' colours: rgb(p) = sum_i w_i(p) c_i. So the gradient of sum_p rgb(p) g(p) with
    respect to c_i is sum_p w_i(p) g(p); its value for the picture over that for the mask is the mean. Occlusion, and
    the instant of every row, are the renderer's.
    """
    avatar = actor.avatar
    thin = avatar.opacity_logits.data
    avatar.opacity_logits.data = torch.full_like(thin, OPAQUE).logit_()
    weights = actor.skin_weights().detach()
    colour, covered = (torch.zeros_like(avatar.sh_constant) for _ in range(2))
    for seen in observations[:: -(-len(observations) // PICTURES)]:
        scene = actor.scene(seen.frame, seen.camera, actor.timed(seen.schedule), weights, 0)
        for total, picture in ((colour, seen.rgb), (covered, seen.mask.expand_as(seen.rgb))):
            shown = (expose(scene).rgb * (picture / 255)).sum()
            total.add_(torch.autograd.grad(shown, avatar.sh_constant, retain_graph=True)[0])
    avatar.opacity_logits.data = thin
    if covered.any():  # else the fit puts nobody where the masks are, and the Gaussians stay grey
        mean = colour.sum(-1, keepdim=True) / covered.sum(-1, keepdim=True)
        rgb = torch.where(covered > SEEN * covered.mean(), colour / covered, mean)
        avatar.sh_constant.data = (rgb - 0.5) / C0
