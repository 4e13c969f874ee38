"""Scene P13: a body of capsules, covered with Gaussians, that moves while a rolling shutter scans it.

The size of the paper's problem without anybody's data: 13 000 Gaussians bound to 24 joints, 1024 x 1024 pixels. One
number sets how fast the body moves. Everything follows from a seed.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rsavatar.body.kinematics import pose
from rsavatar.geometry.cameras import Camera
from rsavatar.imaging import NODES, plan, polynomials
from rsavatar.motion.base import CHANNELS, JOINTS, InitialMotion
from rsavatar.motion.spline import FrameSpline
from rsavatar.render.base import Gaussians, Options, Scene
from rsavatar.render.reference import C0
from rsavatar.shutter.base import Slot

Array = npt.NDArray[np.float64]

PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)
# fmt: off
REST_JOINTS = np.array([  # metres, y up, x to the body's left: proportions of an adult in a T pose
    [.00, -.24, .00], [.07, -.33, .00], [-.07, -.33, .00], [.00, -.12, -.02], [.11, -.71, .00], [-.11, -.71, .00],
    [.00, .02, .00], [.09, -1.11, -.03], [-.09, -1.11, -.03], [.00, .07, .02], [.11, -1.17, .09], [-.11, -1.17, .09],
    [.00, .28, -.01], [.08, .19, .00], [-.08, .19, .00], [.00, .37, .04], [.17, .23, -.01], [-.17, .23, -.01],
    [.43, .21, -.03], [-.43, .21, -.03], [.68, .22, -.03], [-.68, .22, -.03], [.76, .21, -.04], [-.76, .21, -.04]])
LIMBS = (  # (from joint, to joint, radius in metres)
    (0, 3, .150), (3, 6, .145), (6, 9, .140), (9, 12, .120), (12, 15, .060), (1, 4, .090), (2, 5, .090), (4, 7, .060),
    (5, 8, .060), (7, 10, .045), (8, 11, .045), (13, 16, .075), (14, 17, .075), (16, 18, .052), (17, 19, .052),
    (18, 20, .042), (19, 21, .042), (20, 22, .040), (21, 23, .040))
STANCE = {  # radians, beside the body's rest pose: arms down and bent, one leg forward
    1: (-.2, 0, .1), 2: (.25, 0, -.1), 4: (.3, 0, 0), 5: (.1, 0, 0), 16: (0, 0, -.9), 17: (0, 0, .9), 18: (0, -.5, 0),
    19: (0, .6, 0)}
STRIDE = {  # radians (metres for channel 24) over the readout at unit amplitude: a fast step with swinging arms
    0: (.02, .05, .01), 1: (-.14, 0, 0), 2: (.14, 0, 0), 4: (.12, 0, 0), 5: (-.1, 0, 0), 16: (.05, .1, .3),
    17: (.1, -.15, .25), 18: (0, -.3, .1), 19: (0, .25, -.1), 24: (.02, .015, .01)}
# fmt: on
HEAD = (np.array([0.0, 0.43, 0.04]), np.array([0.0, 0.47, 0.04]), 0.125)
GIRTH = 1.35  # clothed: makes 157 000 foreground pixels at 1024 rows
DISTANCE = 2.7  # metres from the camera to the body
SIGMA_PX = (1.2, 4.0)  # standard deviations along the surface of 13 000 Gaussians, pixels at 1024 rows
READOUT = 1.0  # source frames; the frame's period, too


@dataclass(frozen=True)
class Size:
    """What a scene is made from."""

    gaussians: int = 13_000
    pixels: int = 1024  # height and width
    motion_px: float = 50.0  # path between first and last row's instants of the fastest Gaussian, at this height
    seed: int = 0


@dataclass(frozen=True)
class MovingBody:
    """Gaussians on a body in motion before a camera. Rows are read in ``READOUT`` source frames, row 0 first.

    **Convention**: row v is exposed at ((v + 1/2) / H - 1/2) ``READOUT`` from the frame's mid time, the limit of the
    paper's bands as T goes to H.
    """

    gaussians: Gaussians  # float32
    motion: FrameSpline  # float32, one frame
    camera: Camera

    def transforms(self, offsets: Tensor) -> Tensor:
        """Joint transforms [D, 24, 3, 4] at ``offsets`` [D] source frames, float32; differentiable in the control."""
        return _transforms(self.motion, offsets)

    def exact_transforms(self, offsets: Tensor) -> Tensor:
        """The same in float64, of the same float32 control points."""
        with torch.no_grad():
            return _transforms(copy.deepcopy(self.motion).double(), offsets)

    def row_offsets(self) -> Tensor:
        """Instants [H] of the rows, source frames from the mid time, float64."""
        rows = torch.arange(self.camera.height, dtype=torch.float64)
        return READOUT * ((rows + 0.5) / self.camera.height - 0.5)

    def scene(self, slots: tuple[Slot, ...], options: Options, nodes: int = NODES) -> Scene:
        """What the renderer takes for these slots; its pose is differentiable in the motion's control points."""
        schedule = plan(slots, 0, self.camera.height, nodes)
        coefficients = polynomials(self.transforms(schedule.offsets), schedule.coefficients)
        return Scene(self.gaussians, coefficients, schedule.rows, self.camera, options)


def build(size: Size) -> MovingBody:
    """The scene of a size: body, colours, stance and stride from its seed, amplitude from its ``motion_px``."""
    rng = np.random.default_rng(size.seed)
    camera = _camera(size.pixels)
    gaussians = _gaussians(size, rng)
    stride = rng.normal(size=(2, CHANNELS, 3)) * np.array([0.03, 0.02])[:, None, None]  # velocity, acceleration
    for channel, velocity in STRIDE.items():
        stride[0, channel] = velocity
    jitter = 0.01 * rng.normal(size=(4, CHANNELS, 3))

    def moving(amplitude: float) -> MovingBody:
        return MovingBody(gaussians, _motion(amplitude, stride, jitter), camera)

    amplitude = size.motion_px / 50  # the stride's is about that
    made = moving(amplitude)
    while abs(off := longest_path(made) / size.motion_px - 1) > 1e-5:  # nearly proportional: a few rounds
        amplitude /= 1 + off
        made = moving(amplitude)
    return made


def longest_path(body: MovingBody) -> float:
    """Pixels between the places of the fastest Gaussian at the first and the last row's instants."""
    g = body.gaussians
    affine = torch.einsum("jm,tjrc->tmrc", g.skin_weights.double(), body.exact_transforms(body.row_offsets()[[0, -1]]))
    world = torch.einsum("tmrc,cm->tmr", affine[..., :3], g.means.double()) + affine[..., 3]
    pixels, _ = body.camera.project(world.numpy())
    return float(np.linalg.norm(pixels[1] - pixels[0], axis=-1).max())


def _transforms(motion: FrameSpline, offsets: Tensor) -> Tensor:
    state = motion.state(0, offsets)
    rest = torch.from_numpy(REST_JOINTS).to(state.Rh)
    return pose(state.rotations, None, state.Rh, state.Th, rest, torch.tensor(PARENTS, dtype=torch.int32))


def _camera(pixels: int) -> Camera:
    focal, centre = 1.1 * pixels, pixels / 2
    facing = np.diag([1.0, -1.0, -1.0])
    return Camera(facing, np.array([0.0, -0.4, DISTANCE]), focal, focal, centre, centre, pixels, pixels)


def _motion(amplitude: float, stride: Array, jitter: Array) -> FrameSpline:
    """A cubic B-spline whose control points s = -3/2 .. 3/2 follow base + amplitude (velocity s + ...)."""
    base = np.zeros((CHANNELS, 3))
    for joint, turn in STANCE.items():
        base[joint] = turn
    velocity, acceleration = stride
    s = np.arange(-1.5, 2.0)[:, None, None]
    control = base + amplitude * (velocity * s + acceleration * s * s / 2 + jitter)
    still = InitialMotion(np.zeros((1, 3 * JOINTS)), np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1), READOUT, READOUT)
    motion = FrameSpline(still, bands=1)
    motion.control.data = torch.from_numpy(control[None]).float()
    return motion


def _gaussians(size: Size, rng: np.random.Generator) -> Gaussians:
    """Flat Gaussians on the body's outer surface: two axes along it, the third, thin, along the normal."""
    points, normals = _surface(size.gaussians, rng)
    count = len(points)
    covering = np.sqrt(13_000 / size.gaussians)  # more of them are smaller: the body stays covered as it was
    metres = np.array([1.0, 1.0, 0.3]) * covering * DISTANCE / (1.1 * 1024)  # per pixel; the third axis is flattened
    across = np.cross(normals, rng.normal(size=(count, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(normals, across), normals], -1)
    opacity = rng.uniform(0.3, 0.95, count)
    stripes = 0.5 + 0.4 * np.sin(points * [23.0, 17.0, 29.0] + [0.0, 1.0, 2.0])
    colour = np.clip(stripes + 0.1 * rng.normal(size=(count, 3)), 0, 1)
    made = Gaussians(
        means=torch.from_numpy(points.T.copy()),
        rotations=torch.from_numpy(Rotation.from_matrix(axes).as_quat(scalar_first=True).T.copy()),
        log_scales=torch.from_numpy(np.log(rng.uniform(*SIGMA_PX, (count, 3)) * metres).T.copy()),
        opacity_logits=torch.from_numpy(np.log(opacity / (1 - opacity))),
        sh=torch.from_numpy((colour.T[None] - 0.5) / C0),
        skin_weights=torch.from_numpy(_skin_weights(points).T.copy()),
        screen=torch.zeros(2, count),
    )
    return replace(made, **{f.name: getattr(made, f.name).float() for f in fields(made)})


def _capsules() -> list[tuple[Array, Array, float]]:
    limbs = [(REST_JOINTS[a], REST_JOINTS[b], radius) for a, b, radius in LIMBS]
    return [(a, b, GIRTH * radius) for a, b, radius in [*limbs, HEAD]]


def _surface(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """``count`` points [count, 3] and normals on the union of the capsules, uniform by area."""
    capsules = _capsules()
    area = np.array([radius * (np.linalg.norm(b - a) + 2 * radius) for a, b, radius in capsules])
    drawn = rng.multinomial(3 * count, area / area.sum())  # about half lie inside another capsule
    parts = [_on_capsule(*capsule, n, rng) for capsule, n in zip(capsules, drawn, strict=True)]
    points, normals = (np.concatenate(part) for part in zip(*parts, strict=True))
    inside = [_to_segment(points, a, b) < 0.985 * radius for a, b, radius in capsules]
    outer = rng.permutation(np.flatnonzero(~np.any(inside, axis=0)))[:count]
    outer = np.sort(outer)  # limb by limb, as bodies' vertices are
    return points[outer], normals[outer]


def _on_capsule(a: Array, b: Array, radius: float, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points and normals on a capsule; area is uniform in height, caps included (Archimedes)."""
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    side = np.cross(axis, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    height, turn = np.sort(rng.uniform(-radius, length + radius, count)), rng.uniform(0, 2 * np.pi, count)
    on_axis = np.clip(height, 0, length)
    beyond = (height - on_axis) / radius
    around = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    normals = np.sqrt(1 - beyond**2)[:, None] * around + beyond[:, None] * axis
    return a + on_axis[:, None] * axis + radius * normals, normals


def _skin_weights(points: Array) -> Array:
    """Weights [M, 24] that fade over 2.5 cm of distance from the bones; the four largest are kept."""
    bones = [(PARENTS[j], REST_JOINTS[PARENTS[j]], REST_JOINTS[j]) for j in range(1, JOINTS)]
    bones += [(j, REST_JOINTS[j], REST_JOINTS[j] + 1e-6) for j in (15, 22, 23)]
    distance = np.full((len(points), JOINTS), np.inf)
    for joint, a, b in bones:
        distance[:, joint] = np.minimum(distance[:, joint], _to_segment(points, a, b))
    weights = np.exp((distance.min(1, keepdims=True) - distance) / 0.025)
    np.put_along_axis(weights, np.argsort(weights, 1)[:, :-4], 0.0, 1)
    return np.asarray(weights / weights.sum(1, keepdims=True))


def _to_segment(points: Array, a: Array, b: Array) -> Array:
    """Distances [M] of points [M, 3] from the segment a b."""
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.asarray(np.linalg.norm(points - a - along[:, None] * (b - a), axis=1))
