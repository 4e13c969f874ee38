"""The scene of the studio subject: who moves before which cameras, and what a row-by-row exposure sees of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rsavatar.body.anny import anny_body
from rsavatar.body.base import BodyModel
from rsavatar.data.base import Array, BodyFit, Bytes, Image
from rsavatar.data.studio_motion import Motion, bones, choose_motion, pose_meshes, skinning_table
from rsavatar.data.studio_paint import WARDROBES, drawn_wardrobe, painter
from rsavatar.data.studio_render import SAMPLES, Paint, Strip, draw
from rsavatar.geometry.cameras import Camera

TRAINING, HELD_OUT = (0, 2, 4, 6), (1, 3, 5, 7)
EXPOSED = 16  # instants that the exposure of a row is the mean of


@dataclass(frozen=True, eq=False)
class Stage:
    """Everything that decides a picture: who, how they move, what they wear, and from where they are seen."""

    body: BodyModel
    motion: Motion
    paint: Paint
    table: Array  # skinning table of the person
    cameras: tuple[Camera, ...]

    def picture(self, camera: Camera, times: Array) -> Image:
        """RGB and coverage of a picture whose row v is exposed at ``times[v]``, in source frames."""
        return self.pictures([camera], times)[0]

    def pictures(self, cameras: list[Camera], times: Array, samples: int = SAMPLES) -> list[Image]:
        """The same for several cameras with one clock; each distinct time is posed once."""
        starts = np.flatnonzero(np.concatenate([[True], np.diff(times) != 0]))
        ends = np.append(starts[1:], len(times))
        meshes = pose_meshes(self.table, bones(self.body, self.motion.at(times[starts]))[0])
        strips = [Strip(int(lo), int(hi), mesh) for lo, hi, mesh in zip(starts, ends, meshes, strict=True)]
        return [draw(strips, self.body.faces, camera, self.paint, samples) for camera in cameras]

    def exposed(self, cameras: list[Camera], times: Array, exposure: float) -> list[Image]:
        """The mean of pictures over an ``exposure`` in source frames that is centred on every row's time."""
        if not exposure:
            return self.pictures(cameras, times)
        shifts = exposure * ((np.arange(EXPOSED) + 0.5) / EXPOSED - 0.5)
        shots = [self.pictures(cameras, times + shift) for shift in shifts]
        views = range(len(cameras))
        return [(_mean([shot[k][0] for shot in shots]), _mean([shot[k][1] for shot in shots])) for k in views]


def _mean(images: list[Bytes]) -> Bytes:
    mean: Bytes = np.floor(np.mean(images, axis=0) + 0.5).astype(np.uint8)
    return mean


def set_stage(seed: int, size: int, style: str = "", drawn_clothes: bool = False) -> Stage:
    """The person, the motion and the cameras of a seed; converts the free body if it is not cached.

    ``style`` names another motion than the seed's own, ``drawn_clothes`` are the seed's alone.
    """
    body = anny_body()
    motion = choose_motion(body, seed, style)
    rest, joints = body.shaped(motion.shapes), body.rest_joints(motion.shapes)
    clothes = drawn_wardrobe(seed) if drawn_clothes else WARDROBES[seed % len(WARDROBES)]
    paint = painter(rest, body.faces, joints, clothes)
    return Stage(body, motion, paint, skinning_table(rest, body.weights), _ring(seed, size))


def _ring(seed: int, size: int) -> tuple[Camera, ...]:
    """Eight cameras about 2.95 m away, 45 degrees apart, each a little different, looking at the chest."""
    rng = np.random.default_rng([seed, 11])
    cameras = []
    for k in range(len(TRAINING + HELD_OUT)):
        azimuth = 2 * np.pi * k / 8 + rng.normal(0, 0.04)
        distance, height = 2.95 + rng.normal(0, 0.05), 1.45 + rng.normal(0, 0.10)
        centre = np.array([distance * np.sin(azimuth), -distance * np.cos(azimuth), height])
        forward = np.array([0.0, 0.0, 1.07]) + rng.normal(0, 0.02, 3) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        fx, fy = size * (1.07 + rng.normal(0, 0.01, 2))
        cx, cy = size * (0.5 + rng.normal(0, 0.008, 2))
        lens = {"fx": float(fx), "fy": float(fy), "cx": float(cx), "cy": float(cy)}
        cameras.append(Camera(rotation, -rotation @ centre, **lens, height=size, width=size))
    return tuple(cameras)


def row_times(mid: float, readout: float, height: int) -> Array:
    """Times [H] of the rows of a frame, source frames (paper, eq. rowtime, window centred on ``mid``)."""
    times: Array = mid + readout * (np.arange(height) / height - 0.5)
    return times


def seen_states(stage: Stage, mids: Array, readout: float) -> list[BodyFit]:
    """For each frame the states at the times at which its joints were exposed, rows averaged over training cameras."""
    joints = bones(stage.body, stage.motion.at(mids))[1]
    views = [stage.cameras[c] for c in TRAINING]
    rows = np.mean([np.clip(view.project(joints)[0][..., 1], 0, view.height) / view.height for view in views], 0)
    return [stage.motion.at(mid + readout * (row - 0.5)) for mid, row in zip(mids, rows, strict=True)]


def image_motion(stage: Stage, mids: Array, readout: float) -> Array:
    """Path length [N], in pixels, of each frame's fastest surface point during the readout in a training camera."""
    out = []
    for mid in mids:
        times = mid + readout * np.linspace(-0.5, 0.5, 9)
        meshes = pose_meshes(stage.table[::5], bones(stage.body, stage.motion.at(times))[0])
        paths = [stage.cameras[c].project(meshes)[0] for c in TRAINING]
        out.append(max(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum(0).max() for path in paths))
    return np.array(out)
