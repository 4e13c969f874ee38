"""A subject in memory that trains in milliseconds a step: the capsule body, filmed by the renderer itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from rsavatar.bench.scene import PARENTS, READOUT, REST_JOINTS, Array, MovingBody, Size, build
from rsavatar.body.base import BodyModel
from rsavatar.data.base import BodyFit, Bytes, Image, Subject, Timing
from rsavatar.geometry.cameras import Camera
from rsavatar.methods.base import Case
from rsavatar.render import native
from rsavatar.render.base import Options
from rsavatar.shutter.rolling import Scanline
from rsavatar.spec import resolve

PIXELS = 64
ANGLES = {"00": 0.0, "01": 1.1, "02": 0.5}  # radians about the vertical


def case(frames: int = 2, training: tuple[str, ...] = ("00", "01"), **request: object) -> Case:
    """A job on it. Its fit is off by some 0.02 radians."""
    moving = build(Size(gaussians=300, pixels=PIXELS, motion_px=4.0))
    words = {"method": "rs-avatar", "subject": "small", "preset": "smoke", "T": "scanline", **request}
    return Case(resolve(words), _subject(moving, frames, training), _body(moving))


def _body(moving: MovingBody) -> BodyModel:
    points = moving.gaussians.means.T.double().numpy()
    weights = moving.gaussians.skin_weights.T.double().numpy()
    regressor = REST_JOINTS @ np.linalg.pinv(points)
    shapes = 0.01 * np.random.default_rng(0).normal(size=(len(points), 3, 10))
    weights /= weights.sum(1, keepdims=True)
    return BodyModel(points, np.zeros((0, 3), np.int64), weights, regressor, PARENTS, shapes, None, "capsules")


def _subject(moving: MovingBody, frames: int, training: tuple[str, ...]) -> Subject:
    with torch.no_grad():
        middle = moving.motion.state(0, torch.zeros(1, dtype=torch.float64))
    noise = 0.02 * np.random.default_rng(1).normal(size=(frames, 72)) * (np.arange(72) >= 3)
    fit = BodyFit(
        middle.rotations.reshape(1, 72).double().numpy() + noise,
        np.repeat(middle.Rh.double().numpy(), frames, 0),
        np.repeat(middle.Th.double().numpy(), frames, 0),
        np.zeros(10),
    )
    cameras = {name: _camera(moving.camera, angle) for name, angle in ANGLES.items()}
    pictures = {name: _film(moving, camera) for name, camera in cameras.items()}

    def read(name: str, frame: int) -> Image:
        return pictures[name]

    timing = Timing(np.arange(frames, dtype=np.float64), READOUT, READOUT)
    return Subject("small", Path(), cameras, training, ("02",), fit, timing, read, read, "stability")


def _camera(front: Camera, angle: float) -> Camera:
    c, s = np.cos(angle), np.sin(angle)
    turn: Array = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
    return replace(front, rotation=front.rotation @ turn)


def _film(moving: MovingBody, camera: Camera) -> Image:
    scene = moving.scene(Scanline().slots(camera.height, READOUT, 0.0), Options())
    with torch.no_grad():
        image = native.render(replace(scene, camera=camera))
    rgb: Bytes = (255 * image.rgb.clamp(0, 1)).byte().permute(1, 2, 0).contiguous().numpy()
    mask: Bytes = (255 * (1 - image.transmittance)).byte().numpy()
    return rgb * (mask[..., None] > 0), mask
