"""Numpy functions of one state with known vector-Jacobian products, as differentiable torch functions of batches."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from nbs_pin.base.arrays import over_rows


def differentiable(
    value: Callable[..., np.ndarray], vjp: Callable[..., Sequence[np.ndarray]], *arguments: torch.Tensor
) -> torch.Tensor:
    """`value` of the rows of tensors with equal leading axes, differentiable once, by `vjp`."""
    return _OverRows.apply(value, vjp, *arguments)  # type: ignore[no-untyped-call]


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().to("cpu", torch.float64).numpy()


class _OverRows(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, value: Callable[..., np.ndarray], vjp: Callable[..., Sequence[np.ndarray]], *arguments: torch.Tensor
    ) -> torch.Tensor:
        ctx.vjp = vjp
        ctx.save_for_backward(*arguments)
        return arguments[0].new_tensor(over_rows(value, *(_numpy(x) for x in arguments)))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        arguments = ctx.saved_tensors
        n, batch = arguments[0].shape[-1], arguments[0].shape[:-1]
        outputs = _numpy(cotangent).reshape(-1, *cotangent.shape[len(batch) :])
        rows = [_numpy(x).reshape(-1, n) for x in arguments]
        gradients = np.array([ctx.vjp(*row) for row in zip(outputs, *rows, strict=True)]).reshape(-1, len(arguments), n)
        return (None, None, *(x.new_tensor(gradients[:, k]).reshape(x.shape) for k, x in enumerate(arguments)))
