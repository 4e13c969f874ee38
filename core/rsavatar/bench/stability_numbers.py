"""Stress cases of everything before the renderer: rotations, kinematics, splines, losses, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from rsavatar.bench.scene import PARENTS, REST_JOINTS
from rsavatar.bench.stability_case import Case, Measured
from rsavatar.bench.stability_scenes import scene
from rsavatar.body.kinematics import pose
from rsavatar.data.base import BodyFit
from rsavatar.errors import DataError, KernelError, RsAvatarError, SpecError
from rsavatar.geometry.rotations import exp_so3, geodesic_distance, log_so3, rotvec_distance
from rsavatar.losses import l1
from rsavatar.motion.base import InitialMotion
from rsavatar.motion.spline import FrameSpline
from rsavatar.render import native
from rsavatar.shutter.base import Slot
from rsavatar.shutter.rolling import Scanline

ANGLES = {
    "0": 0.0,
    "1e-12": 1e-12,
    "1e-4": 1e-4,
    "pi - 1e-6": math.pi - 1e-6,
    "pi": math.pi,
    "pi + 1e-6": math.pi + 1e-6,
    "2 pi - 1e-6": 2 * math.pi - 1e-6,
    "2 pi": 2 * math.pi,
    "1e3": 1e3,
}


def cases() -> list[Case]:
    """All of them."""
    found = []
    for name, angle in ANGLES.items():
        found += [
            Case(
                f"exp and log at {name}", "exp(log(exp(r))) = exp(r) within 1e-6, finite gradients", _round_trip(angle)
            ),
            Case(
                f"distances at {name}", "the angle within 1e-6 (float64), gradient at most 1 a radian", _distance(angle)
            ),
            Case(
                f"kinematics at {name}",
                "native float32 as torch float64 within 1e-5, gradients 1e-4",
                _kinematics(angle),
            ),
        ]
    found += [Case(f"spline, P = {P}, controls of 1e3", "finite states and gradients", _spline(P)) for P in range(2, 9)]
    found += [
        Case(f"image stored as {d}", "loss moves by at most 1/255, gradients finite", _quantised(d)) for d in _STORED
    ]
    return [*found, *_refusals()]


def _vectors(angle: float) -> Tensor:
    axes = torch.randn(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return angle * torch.nn.functional.normalize(axes, dim=1)


def _round_trip(angle: float) -> Callable[[], Measured]:
    def run() -> Measured:
        worst, finite = 0.0, True
        for dtype in (torch.float32, torch.float64):
            rotvec = _vectors(angle).to(dtype).requires_grad_()
            back = log_so3(exp_so3(rotvec))
            torch.autograd.backward(back.sum())
            finite &= bool(torch.isfinite(back).all() and rotvec.grad is not None and torch.isfinite(rotvec.grad).all())
            worst = max(worst, float((exp_so3(back) - exp_so3(rotvec)).abs().max().detach()))
        return f"error {worst:.1e}", finite and worst < 1e-6

    return run


def _distance(angle: float) -> Callable[[], Measured]:
    def run() -> Measured:
        second = _vectors(angle).requires_grad_()
        first = torch.zeros_like(second)
        wrapped = abs(math.remainder(angle, 2 * math.pi))
        by_matrix, by_vector = geodesic_distance(exp_so3(first), exp_so3(second)), rotvec_distance(first, second)
        torch.autograd.backward((by_matrix + by_vector).sum())
        error = max(float((d - wrapped).abs().max().detach()) for d in (by_matrix, by_vector))
        steepest = math.nan if second.grad is None else float(second.grad.norm(dim=1).max())
        return f"error {error:.1e}, gradient {steepest / 2:.3f} a radian", error < 1e-6 and steepest <= 2 * (1 + 1e-6)

    return run


def _kinematics(angle: float) -> Callable[[], Measured]:
    def run() -> Measured:
        parents, results = torch.tensor(PARENTS, dtype=torch.int32), []
        vectors = _vectors(angle)[:48].reshape(2, 24, 3).float()
        weight = torch.randn(2, 24, 3, 4, generator=torch.Generator().manual_seed(1))
        for dtype in (torch.float32, torch.float64):
            rotations = vectors.to(dtype, copy=True).requires_grad_()
            root = vectors[:, 0].to(dtype, copy=True).requires_grad_()
            rest = torch.from_numpy(REST_JOINTS).to(dtype)
            transforms = pose(rotations, 0.5 * rotations, root, torch.zeros(2, 3, dtype=dtype), rest, parents)
            torch.autograd.backward((transforms * weight).sum())
            results.append(
                (
                    transforms.detach().double(),
                    torch.cat([g.grad.double().flatten() for g in (rotations, root) if g.grad is not None]),
                )
            )
        (got, gradient), (truth, exact) = results
        error, relative = float((got - truth).abs().max()), float((gradient - exact).norm() / exact.norm())
        return f"error {error:.1e}, gradient {relative:.1e}", error < 1e-5 and relative < 1e-4

    return run


def _spline(P: int) -> Callable[[], Measured]:
    def run() -> Measured:
        still = InitialMotion(np.zeros((3, 72)), np.zeros((3, 3)), np.zeros((3, 3)), np.arange(3.0), 1.0, 1.0)
        spline = FrameSpline(still, bands=4, P=P)
        spline.control.data = 1e3 * torch.randn(spline.control.shape, generator=torch.Generator().manual_seed(P))
        state = spline.state(1, torch.tensor([-2.0, -0.5, 0.0, 0.5, 2.0], dtype=torch.float64))
        transforms = exp_so3(state.rotations)
        torch.autograd.backward(transforms.sum() + state.Th.sum() + spline.penalty("aligned") + spline.penalty("paper"))
        gradient = spline.control.grad
        finite = gradient is not None and bool(torch.isfinite(gradient).all() and torch.isfinite(transforms).all())
        orthonormal = float((transforms @ transforms.mT - torch.eye(3)).abs().max().detach())
        return f"rotations orthonormal within {orthonormal:.1e}", finite and orthonormal < 1e-5

    return run


_STORED = {"float16": torch.float16, "bfloat16": torch.bfloat16}


def _quantised(name: str) -> Callable[[], Measured]:
    def run() -> Measured:
        s = scene(Scanline())
        image = native.render(replace(s, pose=(s.pose * 1.01).requires_grad_()))
        exact = native.render(s).rgb.clamp(0, 1)
        mask = torch.full_like(exact[0], 255).byte()
        stored = exact.to(_STORED[name]).float()
        plain, low = (l1(image, (255 * t + 0.5).byte(), mask, 0.0, 0.1) for t in (exact, stored))
        torch.autograd.backward(low)
        moved = abs(float(plain.detach() - low.detach()))
        return f"loss moves by {moved:.1e}", moved < 1 / 255 and math.isfinite(float(low.detach()))

    return run


def _refused(error: type[RsAvatarError], attempt: Callable[[], object]) -> Callable[[], Measured]:
    def run() -> Measured:
        try:
            attempt()
        except error as refusal:
            return f"{error.__name__}: {str(refusal)[:70]}", True
        return "accepted", False

    return run


def _refusals() -> list[Case]:
    s = scene(Scanline())
    nan = math.nan
    poses = np.zeros((2, 72))
    bad = poses.copy()
    bad[1, 5] = nan
    rows = tuple(replace(r, rate=nan) for r in s.rows)
    twice = (*s.rows, replace(s.rows[0], lo=5))
    double = replace(s, pose=s.pose.double())
    return [
        Case(
            "NaN in a body fit",
            "DataError",
            _refused(DataError, lambda: BodyFit(bad, poses[:, :3], poses[:, :3], np.zeros(10))),
        ),
        Case("NaN in a camera", "DataError", _refused(DataError, lambda: replace(s.camera, fx=nan))),
        Case("Inf in a slot", "SpecError", _refused(SpecError, lambda: Slot(0, 1, math.inf))),
        Case(
            "NaN in the renderer's clock",
            "KernelError",
            _refused(KernelError, lambda: native.render(replace(s, rows=rows))),
        ),
        Case(
            "slots out of order",
            "KernelError",
            _refused(KernelError, lambda: native.render(replace(s, rows=twice, pose=s.pose.expand(2, -1, -1, -1, -1)))),
        ),
        Case("float64 where float32 is due", "KernelError", _refused(KernelError, lambda: native.render(double))),
    ]
