"""Stress cases of the renderer: Gaussians, cameras, shutters and bodies at their worst."""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from rsavatar.bench.scene import READOUT, Size, build
from rsavatar.bench.stability_case import FIELDS, Case, Measured, against_twin, outcome, stays_physical
from rsavatar.render import native
from rsavatar.render.base import Gaussians, Options, Scene
from rsavatar.shutter.base import AbstractShutter, Slot, upwards
from rsavatar.shutter.rolling import Bands, Blur, Instant, Scanline

Change = Callable[[Scene], Scene]
AS_TWIN = "as the float64 twin: image within 1/255 and 1e-4 RMS, gradients within 1e-3"
PHYSICAL = "finite image and gradients, colours >= 0, 0 <= T <= 1"
SHUTTERS: dict[str, AbstractShutter] = {"global": Instant(), "scanline": Scanline()}


def scene(shutter: AbstractShutter, size: Size | None = None, readout: float = READOUT) -> Scene:
    """A moving body under a shutter."""
    body = build(size or Size(gaussians=120, pixels=96, motion_px=6.0))
    made = body.scene(shutter.slots(body.camera.height, readout, 0.0), Options())
    return replace(made, pose=made.pose.detach())


def gaussians(scene: Scene, **changes: Tensor) -> Scene:
    """The scene with other Gaussians."""
    return replace(scene, gaussians=replace(scene.gaussians, **changes))


def filled(name: str, value: float) -> Change:
    """Every number of one input set to ``value``."""
    return lambda s: gaussians(s, **{name: torch.full_like(getattr(s.gaussians, name), value)})


def _needles(aspect: float) -> Change:
    def change(s: Scene) -> Scene:
        scales = torch.full_like(s.gaussians.log_scales, math.log(0.5 / aspect))
        scales[0] = math.log(0.5)
        return gaussians(s, log_scales=scales, rotations=torch.randn(s.gaussians.rotations.shape, generator=_random()))

    return change


def _random() -> torch.Generator:
    return torch.Generator().manual_seed(1)


def _moved(x: float, z: float, some: int = 1) -> Change:
    """The body shifted, metres; every ``some``-th joint only."""

    def change(s: Scene) -> Scene:
        pose = s.pose.clone()
        pose[:, 0, ::some, 0, 3] += x
        pose[:, 0, ::some, 2, 3] += z
        return replace(s, pose=pose)

    return change


def _at_camera(s: Scene) -> Scene:
    """Every mean within a few millimetres of the camera's centre or of its near plane."""
    still = torch.zeros_like(s.pose)
    still[:, 0, :, :, :3] = torch.eye(3)
    centre = torch.from_numpy(s.camera.centre).float()[:, None]
    means = centre + 0.05 * torch.randn(s.gaussians.means.shape, generator=_random())
    means[:, 0] = centre[:, 0]
    return replace(gaussians(s, means=means), pose=still)


def _falling(speed: float) -> Change:
    """The body falls at ``speed`` times the scan's: at 1 a row of it is exposed over and over."""

    def change(s: Scene) -> Scene:
        pose = s.pose.clone()
        metres = speed * s.camera.height / s.camera.fy * float(s.camera.translation[2])
        pose[:, 1:] = 0
        pose[:, 1, :, 1, 3] = -metres / 2  # tau runs from -1 to 1; the world's y points up
        return replace(s, pose=pose)

    return change


GAUSSIANS: dict[str, tuple[Change, bool]] = {  # and whether the twin has the same convention
    "scale 0 (log scale -100)": (filled("log_scales", -100.0), True),
    "denormal scale (log scale -95)": (filled("log_scales", -95.0), True),
    "scale 100 m": (filled("log_scales", math.log(100.0)), True),
    "log scale 1e4": (filled("log_scales", 1e4), False),
    "log scale -1e4": (filled("log_scales", -1e4), True),
    "splats many times the image": (lambda s: gaussians(s, log_scales=s.gaussians.log_scales + math.log(500)), True),
    "zero quaternions": (filled("rotations", 0.0), True),
    "quaternions of length 1e3": (lambda s: gaussians(s, rotations=1e3 * s.gaussians.rotations), True),
    "quaternions of length 1e-3": (lambda s: gaussians(s, rotations=1e-3 * s.gaussians.rotations), True),
    "opacity 0 (logit -1e4)": (filled("opacity_logits", -1e4), True),
    "opacity 1 (logit 1e4)": (filled("opacity_logits", 1e4), True),
    "colours of 1e4": (lambda s: gaussians(s, sh=1e4 * s.gaussians.sh.abs()), False),
    "all behind the camera": (_moved(0, 10.0), True),
    "half behind the camera": (_moved(0, 6.0, 2), True),
    "within 5 cm of the camera": (_at_camera, False),
    "body out of the picture": (_moved(10.0, 0), True),
    "body half out of the picture": (_moved(1.0, 0), True),
    "screen offset 1e6 px": (filled("screen", 1e6), True),
    "all weights 0": (filled("skin_weights", 0.0), True),
}


def compared(change: Change, shutter: str, twin: bool) -> Callable[[], Measured]:
    """The experiment on one scene."""
    return lambda: (against_twin if twin else stays_physical)(change(scene(SHUTTERS[shutter])))


def cases() -> list[Case]:
    """All of them."""
    found = [
        Case(f"{name}, {shutter}", AS_TWIN if twin else PHYSICAL, compared(change, shutter, twin))
        for name, (change, twin) in GAUSSIANS.items()
        for shutter in SHUTTERS
    ]
    return [*_needle_cases(), *found, *_shutter_cases(), *_motion_cases(), *_broken_cases(), *_crowd_cases()]


def _needle_cases() -> list[Case]:
    """At 512 px, where a needle of half a metre is 100 px long: the conic's entries cancel most there."""
    size = Size(gaussians=10, pixels=512, motion_px=30.0)

    def of(aspect: float, shutter: AbstractShutter) -> Callable[[], Measured]:
        return lambda: against_twin(_needles(aspect)(scene(shutter, size)))

    return [Case(f"needles 1e{p}:1, {n}", AS_TWIN, of(10.0**p, s)) for p in (2, 3, 4) for n, s in SHUTTERS.items()]


class _Upwards(AbstractShutter):
    """Another shutter on a sensor that is read from its last row."""

    def __init__(self, inner: AbstractShutter) -> None:
        self._inner = inner

    def slots(self, height: int, readout: float, trigger: float) -> tuple[Slot, ...]:
        """The inner shutter's, reversed."""
        return upwards(self._inner.slots(height, readout, trigger), height)


def _shutter_cases() -> list[Case]:
    kinds: dict[str, tuple[AbstractShutter, float]] = {
        "T = 1": (Bands(1), READOUT),
        "T = H": (Bands(96), READOUT),
        "T = 3 H": (Bands(288), READOUT),
        "blur of 3": (Blur(3), READOUT),
        "readout 0, scanline": (Scanline(), 0.0),
        "readout 0, bands": (Bands(4), 0.0),
        "readout 1e-9, scanline": (Scanline(), 1e-9),
        "bottom-up with exposure": (_Upwards(Scanline(0.2, 3)), READOUT),
    }
    shapes = {"one pixel": (1, 1), "one row": (1, 96), "one column": (96, 1), "17 x 31": (17, 31)}

    def cut(height: int, width: int) -> Scene:
        whole = scene(Scanline())
        corner = whole.camera.cropped(
            48 - width // 2, 40 - height // 2, 48 - width // 2 + width, 40 - height // 2 + height
        )
        rows = (replace(whole.rows[0], lo=0, hi=height),)
        return replace(whole, camera=corner, rows=rows)

    def timed(shutter: AbstractShutter, readout: float) -> Callable[[], Measured]:
        return lambda: against_twin(scene(shutter, readout=readout))

    def shaped(height: int, width: int) -> Callable[[], Measured]:
        return lambda: against_twin(cut(height, width))

    shutters = [Case(name, AS_TWIN, timed(*how)) for name, how in kinds.items()]
    return [*shutters, *(Case(f"image of {name}", AS_TWIN, shaped(*shape)) for name, shape in shapes.items())]


def _motion_cases() -> list[Case]:
    speeds = {
        "at scan speed": 1.0,
        "within 1e-6 of scan speed": 1 - 1e-6,
        "at 3 times scan speed": 3.0,
        "at 100 times": 100.0,
    }
    moving = [(name, _falling(speed)) for name, speed in speeds.items()]
    return [Case(f"body falling {name}", PHYSICAL, compared(change, "scanline", False)) for name, change in moving]


def _broken_cases() -> list[Case]:
    promise = "not drawn, no gradient, counted in Rendering.broken; the rest as if it were not there"
    found = []
    for name in (*FIELDS, "pose"):
        for word, value in {"NaN": math.nan, "Inf": math.inf}.items():
            found.append(Case(f"{word} in {name}", promise, _broken(name, value)))
    return found


def _broken(name: str, value: float) -> Callable[[], Measured]:
    def run() -> Measured:
        s = scene(Scanline())
        if name == "pose":
            pose = s.pose.clone()
            pose[0, 0, 3, 1, 2] = value
            got = outcome(native.render, replace(s, pose=pose))
            return (
                f"{got.image.broken} of {s.gaussians.count} broken, finite {got.finite}",
                got.finite and got.image.broken > 0,
            )
        tensor = getattr(s.gaussians, name).clone()
        tensor[..., 7] = value
        got = outcome(native.render, gaussians(s, **{name: tensor}))
        others = torch.arange(s.gaussians.count) != 7
        without = Gaussians(**{n: getattr(s.gaussians, n)[..., others].contiguous() for n in FIELDS})
        same = torch.equal(got.image.rgb, native.render(replace(s, gaussians=without)).rgb)
        return (
            f"{got.image.broken} broken, finite {got.finite}, rest equal {same}",
            got.finite and got.image.broken == 1 and same,
        )

    return run


def _crowd_cases() -> list[Case]:
    promise = "forward and backward finish within 60 s and 1.5 GiB, finite"
    return [Case(f"1e6 Gaussians in one pixel, {name}", promise, _crowd(s)) for name, s in SHUTTERS.items()]


def _crowd(shutter: AbstractShutter) -> Callable[[], Measured]:
    def run() -> Measured:
        s, count, random = scene(shutter), 1_000_000, _random()
        one = {
            n: getattr(s.gaussians, n)[..., :1].expand(*getattr(s.gaussians, n).shape[:-1], count).clone()
            for n in FIELDS
        }
        one["means"] = 1e-3 * torch.randn(3, count, generator=random)
        one["means"][2] *= 300  # deep: the motion shuffles the order
        one["log_scales"].fill_(-8.0)
        one["skin_weights"] = torch.nn.functional.one_hot(torch.arange(count) % 24, 24).T.float().contiguous()
        before, begun = _peak_mib(), time.perf_counter()
        got = outcome(native.render, replace(s, gaussians=Gaussians(**one)))
        seconds, memory = time.perf_counter() - begun, _peak_mib() - before
        return (
            f"{seconds:.1f} s, {memory:.0f} MiB more, {got.image.pairs} pairs",
            got.finite and seconds < 60 and memory < 1536,
        )

    return run


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
