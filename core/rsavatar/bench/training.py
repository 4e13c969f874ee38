"""A whole training step on scene P13, as ``train.fit`` takes it: poses, networks, render, loss, backward, Adam."""

from __future__ import annotations

import gc
from functools import cache

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from rsavatar.avatar.avatar import Avatar
from rsavatar.avatar.networks import PoseResidual, SkinOffset
from rsavatar.avatar.surface import Surface
from rsavatar.bench.scene import PARENTS, READOUT, REST_JOINTS, MovingBody, Size, build
from rsavatar.bench.ways import Way, compose_whole, scan
from rsavatar.body.base import SHAPES, BodyModel
from rsavatar.imaging import Actor, expose, plan
from rsavatar.losses import l1, render_l1
from rsavatar.methods.base import body_box
from rsavatar.motion.base import JOINTS, InitialMotion
from rsavatar.motion.spline import FrameSpline
from rsavatar.optimization import BLOCK, Settings, SkinBlock, State
from rsavatar.render.base import Options, Scene
from rsavatar.train import Observation

Array = npt.NDArray[np.float64]

VERTICES = 6890  # SMPL's


class Training:
    """An actor with all networks that the paper has, an image to fit, and the state of its optimisers.

    The image is the moving body's own, cut to the body as training does; the actor starts at it. A step does the same
    work wherever it starts.
    """

    def __init__(self, size: Size, way: Way, frames: int = 20) -> None:
        """``way`` is how the actor's images are rendered; whole images are the paper's way."""
        body = build(size)
        self._seen = _observe(body, way)
        self._actor = _actor(body, size, frames)
        self._loss = _loss_of_whole if way.whole else _loss
        self._settings = Settings(
            iterations=20_000,
            seed=0,
            extent=1.0,
            lambda_reg=1.0,
            continuity="aligned",
            mask_weight=0.1,
            sh_degree=1,
            checkpoint_every=1000,
            density=None,
            sh_from=0,
        )
        self._state = State(self._actor, self._settings)
        self._skin = SkinBlock(self._actor)
        gc.freeze()  # as ``train.fit`` does

    def step(self) -> None:
        """One step of ``train.fit``'s loop."""
        seen, actor, state, settings = self._seen, self._actor, self._state, self._settings
        state.set_rates(settings)
        degree = settings.degree(state.step)
        scene = actor.scene(seen.frame, seen.camera, seen.schedule, self._skin.weights, degree)
        loss = self._loss(scene, seen, settings)
        loss = loss + settings.lambda_reg * actor.motion.penalty(settings.continuity)
        torch.autograd.backward(loss)
        state.advance(actor, scene.gaussians.screen, loss.detach(), seen.full_size)

    def refresh(self) -> None:
        """What ``train.fit`` does between blocks of steps: the skinning network's step and its new weights."""
        if self._skin.weights.grad is None:  # what a block of steps would have left there
            self._skin.weights.grad = torch.zeros_like(self._skin.weights)
        self._skin.close(self._state.skin_optimizer)
        self._skin = SkinBlock(self._actor)

    @staticmethod
    def amortised(step_ms: float, refresh_ms: float) -> float:
        """Milliseconds of a step with its share of a refresh."""
        return step_ms + refresh_ms / BLOCK


def _loss(scene: Scene, seen: Observation, settings: Settings) -> Tensor:
    return render_l1(scene, seen.rgb, seen.mask, 0.0, settings.mask_weight).loss


def _loss_of_whole(scene: Scene, seen: Observation, settings: Settings) -> Tensor:
    return l1(compose_whole(scene), seen.rgb, seen.mask, 0.0, settings.mask_weight)


def _observe(body: MovingBody, way: Way) -> Observation:
    """The body's image as bytes, cut to its mask, with the way's slots planned for the cut."""
    height, width = body.camera.height, body.camera.width
    with torch.no_grad():
        image = expose(body.scene(scan(height).slots, Options()))
    rgb = (255 * image.rgb.clamp(0, 1)).round().byte()
    mask = (255 * (1 - image.transmittance)).round().byte()
    x0, y0, x1, y1 = body_box(mask.numpy()) or (0, 0, width, height)
    return Observation(
        frame=0,
        camera=body.camera.cropped(x0, y0, x1, y1),
        schedule=plan(way.slots, y0, y1),
        rgb=rgb[:, y0:y1, x0:x1].contiguous(),
        mask=mask[y0:y1, x0:x1].contiguous(),
        full_size=(height, width),
    )


def _actor(body: MovingBody, size: Size, frames: int) -> Actor:
    """The body's Gaussians on a mesh with SMPL's number of vertices, in its own motion, with blend shapes of zero."""
    avatar, g = Avatar(Surface(_mesh(size.seed), np.zeros(SHAPES))), body.gaussians
    avatar.means = torch.nn.Parameter(g.means.clone())
    avatar.rotations = torch.nn.Parameter(g.rotations.clone())
    avatar.log_scales = torch.nn.Parameter(g.log_scales.clone())
    avatar.opacity_logits = torch.nn.Parameter(g.opacity_logits.clone())
    avatar.sh_constant = torch.nn.Parameter(g.sh.clone())
    avatar.sh_linear = torch.nn.Parameter(torch.zeros(3, 3, g.count))
    avatar.bind()
    pose_offsets = torch.zeros(frames, 3, VERTICES)
    return Actor(avatar, _motion(body, frames), pose_offsets, PoseResidual(), SkinOffset())


@cache
def _mesh(seed: int) -> BodyModel:
    """Vertices on the body of capsules; no faces, shapes that change nothing."""
    vertices = build(Size(gaussians=VERTICES, seed=seed)).gaussians
    points = vertices.means.double().T.numpy()
    return BodyModel(
        v_template=points,
        faces=np.zeros((0, 3), np.int64),
        weights=vertices.skin_weights.double().T.numpy(),
        joint_regressor=REST_JOINTS @ np.linalg.pinv(points),
        parents=PARENTS,
        shape_directions=np.zeros((VERTICES, 3, SHAPES)),
        pose_directions=None,
        name="capsules",
    )


def _motion(body: MovingBody, frames: int) -> FrameSpline:
    """The body's trajectory in every one of ``frames`` frames."""
    mids: Array = np.arange(frames, dtype=np.float64) * READOUT
    poses, root = np.zeros((frames, 3 * JOINTS)), np.zeros((frames, 3))
    motion = FrameSpline(InitialMotion(poses, root, root, mids, READOUT, READOUT), bands=1)
    motion.control.data = body.motion.control.detach().expand(frames, -1, -1, -1).clone()
    return motion
