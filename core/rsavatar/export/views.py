"""Novel views of a replay under any shutter, by the same slots and kernels as training."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch

from rsavatar.data.base import Array, Bytes
from rsavatar.errors import SpecError, expected
from rsavatar.export.replay import Replay, Stage
from rsavatar.geometry.cameras import Camera
from rsavatar.imaging import expose, plan
from rsavatar.render.base import Rendering
from rsavatar.shutter.base import AbstractShutter
from rsavatar.shutter.rolling import Bands, Blur, Instant, Scanline

Background = Literal["black", "white", "transparent"]
Format = Literal["png", "webp"]
DISTANCE = 5.0  # of the framing camera from the stage's centre, in reaches: a portrait lens, not a wide one
MARGIN = 1.08  # of the framing camera's picture around the stage
MOST_BLUR, MOST_BANDS = 64, 8192


@dataclass(frozen=True)
class View:
    """One picture to be made. ``camera`` None is a camera that frames the whole sequence, in front of the body.

    ``azimuth`` and ``elevation`` (degrees) turn the camera around the stage; ``readout`` is in source frames, None is
    the subject's own; ``size`` is the longer side in pixels.
    """

    camera: str | None = None
    time: float = 0.0
    shutter: str = "global"
    readout: float | None = None
    azimuth: float = 0.0
    elevation: float = 0.0
    zoom: float = 1.0
    size: int = 512
    background: Background = "black"


def render_view(replay: Replay, view: View) -> Bytes:
    """The picture, RGB [H, W, 3], or RGBA [H, W, 4] on a transparent background.

    Raises:
        SpecError: if the camera, the time, the shutter or the readout is not one that the subject has.
    """
    camera, trigger = camera_of(replay, view)
    frame, offset = replay.place(view.time)
    slots = shutter_of(replay, view.shutter).slots(camera.height, readout_of(replay, view), offset + trigger)
    with torch.no_grad():
        schedule = plan(slots, 0, camera.height)
        scene = replay.actor.scene(frame, camera, schedule, replay.skin_weights, replay.spec.sh_degree)
        return pixels_of(expose(scene), view.background)


def pixels_of(rendering: Rendering, background: Background) -> Bytes:
    """Bytes of a rendering, rounded as evaluation rounds them."""
    rgb = rendering.over(1.0 if background == "white" else 0.0)
    if background == "transparent":
        alpha = (1 - rendering.transmittance)[None]
        rgb = torch.cat([rgb / alpha.clamp_min(1e-6), alpha])
    pixels: Bytes = (rgb.permute(1, 2, 0).clamp(0, 1) * 255 + 0.5).to(torch.uint8).contiguous().numpy()
    return pixels


def encode(pixels: Bytes, fmt: Format) -> bytes:
    """A picture's file."""
    order = [2, 1, 0, 3][: pixels.shape[2]]
    options = {"png": [cv2.IMWRITE_PNG_COMPRESSION, 4], "webp": [cv2.IMWRITE_WEBP_QUALITY, 92]}
    done, data = cv2.imencode(f".{fmt}", np.ascontiguousarray(pixels[..., order]), options[fmt])
    if not done:
        raise SpecError(expected("format", "png or webp", fmt))
    return bytes(data)


def readout_of(replay: Replay, view: View) -> float:
    """Source frames from the first row to the last.

    Raises:
        SpecError: if it is negative or longer than a frame's period, which no sensor reads.
    """
    timing = replay.subject.timing
    if view.readout is None:
        return timing.readout_frames
    longest = max(timing.period_frames, timing.readout_frames)
    if not 0 <= view.readout <= longest:
        raise SpecError(expected("readout", f"0 to {longest:g} source frames", view.readout))
    return view.readout


def shutter_of(replay: Replay, word: str) -> AbstractShutter:
    """global, rolling (every row at its own instant), bands:T, or blur:S (the mean of S instants; blur alone: K).

    Raises:
        SpecError: if it is none of these.
    """
    name, colon, text = word.partition(":")
    count = int(text) if text.isdecimal() else None
    if name == "blur" and (count is None) == (not colon):
        count = count or round(replay.subject.timing.period_frames)
        if 1 <= count <= MOST_BLUR:
            return Blur(count)
    if name == "bands" and count is not None and 1 <= count <= MOST_BANDS:
        return Bands(count)
    known: dict[str, AbstractShutter] = {"global": Instant(), "rolling": Scanline()}
    if word not in known:
        wanted = f"global, blur, blur:S (S to {MOST_BLUR}), rolling, or bands:T (T to {MOST_BANDS})"
        raise SpecError(expected("shutter", wanted, repr(word)))
    return known[word]


def camera_of(replay: Replay, view: View) -> tuple[Camera, float]:
    """The camera of a view and its trigger in source frames (that of the calibrated camera; else 0).

    Raises:
        SpecError: if the subject has no such camera.
    """
    cameras = replay.subject.cameras
    if view.camera is not None and view.camera not in cameras:
        raise SpecError(expected("camera", f"one of {', '.join(cameras)}", repr(view.camera)))
    if view.camera is None:
        base, trigger = framing_camera(replay.stage, view.size), 0.0
    else:
        base, trigger = cameras[view.camera], replay.subject.timing.trigger(view.camera)
    longer = max(base.height, base.width)
    sized = base if longer == view.size else base.scaled(view.size / longer)
    turned = orbit(sized, replay.stage, view.azimuth, view.elevation)
    return replace(turned, fx=turned.fx * view.zoom, fy=turned.fy * view.zoom), trigger


def framing_camera(stage: Stage, size: int) -> Camera:
    """A square camera in front of the body whose picture holds the whole sequence."""
    forward = -stage.front
    rotation = np.stack([np.cross(-stage.up, forward), -stage.up, forward])
    centre = stage.centre + DISTANCE * stage.reach * stage.front
    focal = size / 2 * DISTANCE / MARGIN
    return Camera(rotation, -rotation @ centre, focal, focal, size / 2, size / 2, size, size)


def orbit(camera: Camera, stage: Stage, azimuth: float, elevation: float) -> Camera:
    """The camera carried around the stage's centre: ``azimuth`` degrees to its right, then ``elevation`` upwards."""
    if azimuth == 0 and elevation == 0:
        return camera
    around = _turn(stage.up, azimuth)
    right = around @ camera.rotation[0]
    level = right - (right @ stage.up) * stage.up
    whole = _turn(-level / np.linalg.norm(level), elevation) @ around
    centre = stage.centre + whole @ (camera.centre - stage.centre)
    rotation = camera.rotation @ whole.T
    return replace(camera, rotation=rotation, translation=-rotation @ centre)


def _turn(axis: Array, degrees: float) -> Array:
    """Rotation matrix about a unit axis (Rodrigues)."""
    angle = math.radians(degrees)
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: Array = np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * (K @ K)
    return matrix
