"""The renderer on the native kernels: ``render(scene)``, differentiable, bit-identical for any number of threads.

Layouts are those of ``core/native/layout.h``; tensors cross without a copy. The threads are ``kernels.threads()``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rsavatar.errors import KernelError, expected
from rsavatar.geometry.cameras import Camera
from rsavatar.kernels import Target, library, threads
from rsavatar.render.base import Comparison, Gaussians, Options, Rendering, Scene, TimedRows

_FIELDS = ("means", "rotations", "log_scales", "opacity_logits", "sh", "skin_weights", "screen")
_COUNTED = ("projected", "splats", "pairs", "broken")
_Pointer = ctypes.c_void_p


class _Gaussians(ctypes.Structure):
    _fields_ = (("count", ctypes.c_int32), ("bases", ctypes.c_int32), *((name, _Pointer) for name in _FIELDS))


class _Gradients(ctypes.Structure):
    _fields_ = tuple((name, _Pointer) for name in (*_FIELDS, "pose"))


class _Rows(ctypes.Structure):
    _fields_ = (
        ("lo", ctypes.c_int32),
        ("hi", ctypes.c_int32),
        ("rate", ctypes.c_float),
        ("start", ctypes.c_float),
        ("weight", ctypes.c_float),
    )


class _Camera(ctypes.Structure):
    _fields_ = (
        ("rotation", ctypes.c_float * 9),
        ("translation", ctypes.c_float * 3),
        *((name, ctypes.c_float) for name in ("fx", "fy", "cx", "cy")),
        ("height", ctypes.c_int32),
        ("width", ctypes.c_int32),
    )


class _Options(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_float) for name in ("near", "dilation", "alpha_min", "alpha_max", "transmittance_min")),
        ("strip_rows", ctypes.c_int32),
        ("threads", ctypes.c_int32),
        ("flags", ctypes.c_int32),
    )


class _Counters(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_int64) for name in _COUNTED)

    @property
    def values(self) -> list[int]:
        """In the order of the fields."""
        return [getattr(self, name) for name in _COUNTED]


_Tensors = tuple[Tensor, ...]  # the seven of ``Gaussians``, and the pose


@dataclass(frozen=True)
class _Static:
    """What an image takes besides tensors."""

    rows: tuple[TimedRows, ...]
    camera: Camera
    options: Options


@dataclass(frozen=True)
class _Seen:
    """What an image is compared with: contiguous bytes, and how."""

    rgb: Tensor
    mask: Tensor
    background: float
    mask_weight: float


_FLAGS = {"shear": 1, "implicit": 2, "resort": 4, "cull": 8}
_REASONS = {1: "out of memory", 2: "an argument is outside the limits of core/native/layout.h"}


class _Frame:
    """A kernel-side frame; goes back to the pool when the last reference to it does."""

    pool: list[int] = []  # noqa: RUF012 - one pool a process, on purpose

    def __init__(self) -> None:
        try:  # one call, so that no other thread comes between looking and taking
            self.handle = self.pool.pop()
        except IndexError:
            self.handle = library().rs_frame_create()
        if not self.handle:
            raise KernelError(expected("frame", "memory for a frame's plan", _REASONS[1]))

    def __del__(self) -> None:
        if getattr(self, "handle", None):
            self.pool.append(self.handle)


def _c_camera(camera: Camera) -> _Camera:
    rotation = (ctypes.c_float * 9)(*camera.rotation.ravel())
    translation = (ctypes.c_float * 3)(*camera.translation)
    return _Camera(rotation, translation, camera.fx, camera.fy, camera.cx, camera.cy, camera.height, camera.width)


def _c_options(o: Options) -> _Options:
    limits = (o.near, o.dilation, o.alpha_min, o.alpha_max, o.transmittance_min)
    return _Options(*limits, o.strip_rows, threads(), sum(_FLAGS[name] for name in o.without))


def _c_gaussians(tensors: _Tensors) -> _Gaussians:
    return _Gaussians(tensors[0].shape[1], tensors[4].shape[0], *(t.data_ptr() for t in tensors[:7]))


def _check(code: int) -> None:
    if code:
        raise KernelError(expected("native render", "success", _REASONS.get(code, f"code {code}")))


class _Render(torch.autograd.Function):
    """rgb, transmittance = f(the seven tensors of ``Gaussians``, pose); see ``rs_render`` in layout.h."""

    @staticmethod
    def forward(ctx: Any, static: _Static, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        camera, counters = static.camera, _Counters()
        tensors = tuple(t.detach().contiguous() for t in tensors)
        rgb, transmittance = torch.empty(3, camera.height, camera.width), torch.empty(camera.height, camera.width)
        image = (rgb.data_ptr(), transmittance.data_ptr())
        _draw(ctx, library().rs_render, static, tensors, *image, ctypes.byref(counters))
        ctx.save_for_backward(*tensors, rgb, transmittance)
        counted = torch.tensor(counters.values)
        ctx.mark_non_differentiable(counted)
        return rgb, transmittance, counted

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        *tensors, rgb, transmittance = ctx.saved_tensors
        images = (rgb, transmittance, upstream[0].contiguous(), upstream[1].contiguous())
        return None, *_gradients(ctx, library().rs_render_backward, tuple(tensors), *(t.data_ptr() for t in images))


class _RenderL1(torch.autograd.Function):
    """The loss of that image as a function of the same; see ``rs_render_l1``."""

    @staticmethod
    def forward(ctx: Any, static: _Static, seen: _Seen, *tensors: Tensor) -> tuple[Tensor, Tensor]:
        counters, loss, squared = _Counters(), ctypes.c_double(), ctypes.c_double()
        tensors = tuple(t.detach().contiguous() for t in tensors)
        target = Target(seen.rgb.data_ptr(), seen.mask.data_ptr(), seen.background, seen.mask_weight)
        found = (ctypes.byref(counters), ctypes.byref(loss), ctypes.byref(squared))
        _draw(ctx, library().rs_render_l1, static, tensors, ctypes.byref(target), *found)
        ctx.seen = seen  # many slots are compared again on the way back
        ctx.save_for_backward(*tensors)
        others = torch.tensor([squared.value, *counters.values], dtype=torch.float64)
        ctx.mark_non_differentiable(others)
        return torch.tensor(loss.value, dtype=torch.float64), others

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        return None, None, *_gradients(ctx, library().rs_render_l1_backward, ctx.saved_tensors, float(upstream[0]))


def _draw(ctx: Any, call: Callable[..., int], static: _Static, tensors: _Tensors, *rest: Any) -> None:
    """``call`` on a scene in a frame of its own, which is kept where a gradient is wanted."""
    frame, pose = _Frame(), tensors[7]
    rows = (_Rows * len(static.rows))(*(_Rows(r.lo, r.hi, r.rate, r.start, r.weight) for r in static.rows))
    what = (frame.handle, ctypes.byref(_c_gaussians(tensors)), pose.data_ptr(), *pose.shape[:2], ctypes.byref(rows))
    how = (ctypes.byref(_c_camera(static.camera)), ctypes.byref(_c_options(static.options)))
    _check(call(*what, *how, *rest))
    ctx.frame = frame if any(ctx.needs_input_grad) else None


def _gradients(ctx: Any, call: Callable[..., int], tensors: _Tensors, *rest: Any) -> list[Tensor | None]:
    """What ``call`` writes for those of ``tensors`` that need a gradient."""
    if ctx.frame is None:
        raise KernelError(expected("native render", "one backward for one forward", "a second backward"))
    needs = ctx.needs_input_grad[-len(tensors) :]
    wanted = [torch.empty_like(t) if need else None for t, need in zip(tensors, needs, strict=True)]
    gradients = _Gradients(*(None if t is None else t.data_ptr() for t in wanted))
    what = (ctx.frame.handle, ctypes.byref(_c_gaussians(tensors)), tensors[7].data_ptr())
    code = call(*what, *rest, ctypes.byref(gradients))
    ctx.frame = None  # back to the pool
    _check(code)
    return wanted


def render(scene: Scene) -> Rendering:
    """Render a scene; float32.

    Differentiable in every tensor of ``scene.gaussians`` and in ``scene.pose``, once.

    Raises:
        KernelError: if a tensor is not float32 on the CPU or of a wrong shape, if slots' rows partly overlap or leave
            the image, or if no kernel library fits this machine.
    """
    rgb, transmittance, counted = _apply(_Static(scene.rows, scene.camera, scene.options), *_inputs(scene))
    return Rendering(rgb, transmittance, *counted.tolist())


def render_l1(scene: Scene, target: Tensor, mask: Tensor, background: float, mask_weight: float) -> Comparison:
    """``losses.l1`` of ``render(scene)``, differentiable as that: each strip is compared and walked back while at hand.

    Raises:
        KernelError: as ``render``; or if target or mask are not bytes [3, H, W] and [H, W].
    """
    size = scene.camera.height, scene.camera.width
    for name, tensor, shape in (("target", target, (3, *size)), ("mask", mask, size)):
        if tensor.dtype != torch.uint8 or tuple(tensor.shape) != shape:
            raise KernelError(expected(name, f"torch.uint8 {shape}", f"{tensor.dtype} {tuple(tensor.shape)}"))
    seen = _Seen(target.contiguous(), mask.contiguous(), background, mask_weight)
    loss, others = _apply_l1(_Static(scene.rows, scene.camera, scene.options), seen, *_inputs(scene))
    squared, *counted = others.tolist()
    return Comparison(loss, squared, *map(int, counted))


_apply: Callable[..., tuple[Tensor, Tensor, Tensor]] = _Render.apply  # torch leaves apply untyped
_apply_l1: Callable[..., tuple[Tensor, Tensor]] = _RenderL1.apply


def _inputs(scene: Scene) -> _Tensors:
    _validate(scene.gaussians, scene.pose, scene.rows)
    return (*(getattr(scene.gaussians, name) for name in _FIELDS), scene.pose)


def _validate(g: Gaussians, pose: Tensor, rows: tuple[TimedRows, ...]) -> None:
    m, bases, slots = g.count, g.sh.shape[0], len(rows)
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3, m),
        "rotations": (4, m),
        "log_scales": (3, m),
        "opacity_logits": (m,),
        "sh": (bases, 3, m),
        "skin_weights": (24, m),
        "screen": (2, m),
    }
    pairs = [(name, getattr(g, name), shape) for name, shape in shapes.items()]
    pairs.append(("pose", pose, (slots, pose.shape[1], 24, 3, 4)))
    for name, tensor, shape in pairs:
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu" or tuple(tensor.shape) != shape:
            got = f"{tensor.dtype} {tuple(tensor.shape)} on {tensor.device}"
            raise KernelError(expected(name, f"torch.float32 {shape} on cpu", got))
