"""Adam in one native pass over all parameters, which refuses a step whose gradients are not finite."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from rsavatar import kernels
from rsavatar.errors import KernelError, expected

BETAS = (0.9, 0.999)
NOT_FINITE = 3  # what rs_adam returns then


class _Parameter(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("value", "mean", "square", "gradient")),
        ("rate", ctypes.c_float),
        ("step", ctypes.c_int32),
    )


Moments = dict[str, Tensor]  # step, exp_avg, exp_avg_sq: torch.optim.Adam's names


class Adam:
    """Adam (Kingma and Ba, 2015) without weight decay, on float32 parameters of the CPU.

    Groups are those of ``torch.optim``, whose base class takes a second to import the compiler that it asks to leave it
    alone. A parameter without a gradient is left alone, and so is its count of steps.
    """

    def __init__(self, groups: list[dict[str, Any]], rate: float, epsilon: float = 1e-8) -> None:
        self.param_groups = [{"lr": rate, **group} for group in groups]
        self.state: dict[torch.nn.Parameter, Moments] = {}
        self._epsilon = epsilon

    @property
    def moments(self) -> dict[int, Moments]:
        """What is known of each parameter that has moved, by its place in the groups."""
        return {i: self.state[p] for i, p in enumerate(self._parameters()) if p in self.state}

    @moments.setter
    def moments(self, saved: dict[int, Moments]) -> None:
        parameters = self._parameters()
        self.state = {parameters[i]: moments for i, moments in saved.items()}

    def _parameters(self) -> list[torch.nn.Parameter]:
        return [parameter for group in self.param_groups for parameter in group["params"]]

    def advance(self, *watched: Tensor) -> bool:
        """Take a step, or none: False where a gradient, or a tensor of ``watched``, holds NaN or infinity.

        Raises:
            KernelError: if memory ran out.
        """
        moving = [(p, g["lr"], self._state_of(p)) for g in self.param_groups for p in g["params"] if p.grad is not None]
        took = self._native(moving, watched) if kernels.available() else self._slow(moving, watched)
        if took:
            for _, _, state in moving:
                state["step"] += 1
        return took

    def forget(self) -> None:
        """Drop the gradients; torch's ``zero_grad`` takes half a millisecond for that."""
        for parameter in self._parameters():
            parameter.grad = None

    def _state_of(self, parameter: torch.nn.Parameter) -> Moments:
        if parameter not in self.state:
            still = {name: torch.zeros_like(parameter.data) for name in ("exp_avg", "exp_avg_sq")}
            self.state[parameter] = {"step": torch.zeros(()), **still}
        return self.state[parameter]

    def _native(self, moving: list[tuple[Tensor, float, Moments]], watched: tuple[Tensor, ...]) -> bool:
        gradients = [p.grad.contiguous() for p, _, _ in moving if p.grad is not None]
        rows = [_Parameter(w.numel(), None, None, None, w.data_ptr(), 0.0, 0) for w in watched]
        for (parameter, rate, state), gradient in zip(moving, gradients, strict=True):
            pointers = (t.data_ptr() for t in (parameter, state["exp_avg"], state["exp_avg_sq"], gradient))
            rows.append(_Parameter(parameter.numel(), *pointers, rate, int(state["step"]) + 1))
        array = (_Parameter * len(rows))(*rows)
        code = kernels.library().rs_adam(ctypes.byref(array), len(rows), *BETAS, self._epsilon, kernels.threads())
        if code not in (0, NOT_FINITE):
            raise KernelError(expected("Adam's step", "memory for its plan", "out of memory"))
        return bool(code == 0)

    def _slow(self, moving: list[tuple[Tensor, float, Moments]], watched: tuple[Tensor, ...]) -> bool:
        gradients = [p.grad for p, _, _ in moving if p.grad is not None]
        if not all(bool(torch.isfinite(t).all()) for t in (*gradients, *watched)):
            return False
        beta1, beta2 = BETAS
        for (parameter, rate, state), gradient in zip(moving, gradients, strict=True):
            step, mean, square = float(state["step"]) + 1, state["exp_avg"], state["exp_avg_sq"]
            mean.lerp_(gradient, 1 - beta1)
            square.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
            root = square.div(1 - beta2**step).sqrt_().add_(self._epsilon)
            parameter.data.addcdiv_(mean, root, value=-rate / (1 - beta1**step))
        return True
