"""Numpy functions of one state, with known vector-Jacobian products, as differentiable torch functions of batches."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable


def differentiable(
    value: Callable[..., np.ndarray], vjp: Callable[..., Sequence[np.ndarray]], *arguments: torch.Tensor
) -> torch.Tensor:
    """The function `value` over the rows of tensors with equal leading axes, once differentiable through `vjp`."""
    return _OverRows.apply(value, vjp, *arguments)  # type: ignore[no-untyped-call]


def _rows(tensor: torch.Tensor, batch_ndim: int) -> np.ndarray:
    array = tensor.detach().to("cpu", torch.float64).numpy()
    return array.reshape(-1, *array.shape[batch_ndim:])


class _OverRows(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, value: Callable[..., np.ndarray], vjp: Callable[..., Sequence[np.ndarray]], *arguments: torch.Tensor
    ) -> torch.Tensor:
        ctx.vjp = vjp
        ctx.save_for_backward(*arguments)
        like, batch = arguments[0], arguments[0].shape[:-1]
        rows = [_rows(x, len(batch)) for x in arguments]
        values = np.stack([value(*row) for row in zip(*rows, strict=True)])
        return torch.as_tensor(values.reshape(*batch, *values.shape[1:]), dtype=like.dtype, device=like.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        arguments = ctx.saved_tensors
        like, batch = arguments[0], arguments[0].shape[:-1]
        rows = [_rows(x, len(batch)) for x in (cotangent, *arguments)]
        gradients = zip(*(ctx.vjp(*row) for row in zip(*rows, strict=True)), strict=True)
        tensors = (torch.as_tensor(np.stack(g), dtype=like.dtype, device=like.device) for g in gradients)
        return (None, None, *(t.reshape(x.shape) for t, x in zip(tensors, arguments, strict=True)))
