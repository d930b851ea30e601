"""The logistic function of symmetric matrices, for numpy and torch: the estimate that belongs to a dual."""

from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from nbs_pin.base.arrays import Array, is_torch_array
from nbs_pin.kernels.symmetric4 import FARTHEST


def logistic_and_cut(dual: Array) -> tuple[Array, Array]:
    """X = (1 + e^−Q)⁻¹ (..., n, n), and Q with its eigenvalues cut to ±`FARTHEST`, where X is within 1e-9 of 0 and 1.

    The cut is the Bregman projection onto 1e-9 ⪯ X ⪯ 1 − 1e-9, which brings X nearer to every matrix in there.
    """
    if not is_torch_array(dual):
        values, vectors = np.linalg.eigh(dual)
        cut = np.clip(values, -FARTHEST, FARTHEST)
        kept = dual if np.array_equal(cut, values) else _made(cut, vectors)
        return _made(1.0 / (1.0 + np.exp(-cut)), vectors), kept
    x = _Spectral.apply(dual, torch.sigmoid)  # type: ignore[no-untyped-call]
    return x, _Spectral.apply(dual, lambda y: y)  # type: ignore[no-untyped-call]


def _made(values: Array, vectors: Array) -> Array:
    """The matrix with these eigenvalues."""
    return (vectors * values[..., None, :]) @ vectors.swapaxes(-1, -2)


class _Spectral(torch.autograd.Function):
    """f of the eigenvalues cut to ±FARTHEST; its derivative is U((UᵀX̄U) ∘ Γ)Uᵀ, Γ_ij = (f(λ_i) − f(λ_j))/(λ_i − λ_j).

    Unlike torch's own derivative of eigenvectors it is defined where eigenvalues are equal (Daleckii and Krein 1965).
    """

    @staticmethod
    def forward(ctx: Any, dual: torch.Tensor, function: Any) -> torch.Tensor:
        values, vectors = torch.linalg.eigh(dual)
        with torch.enable_grad():
            inside = values.detach().requires_grad_()
            found = function(inside.clamp(-FARTHEST, FARTHEST))
            (slope,) = torch.autograd.grad(found.sum(), inside)
        ctx.save_for_backward(values, vectors, found.detach(), slope)
        return _made(found.detach(), vectors)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: torch.Tensor) -> tuple[torch.Tensor, None]:
        values, vectors, found, slope = ctx.saved_tensors
        apart = values[..., :, None] - values[..., None, :]
        near = apart.abs() < 1e-6
        mean = 0.5 * (slope[..., :, None] + slope[..., None, :])
        rise = found[..., :, None] - found[..., None, :]
        gamma = torch.where(near, mean, rise / torch.where(near, torch.ones_like(apart), apart))
        inner = vectors.transpose(-1, -2) @ (0.5 * (bar + bar.transpose(-1, -2))) @ vectors
        return vectors @ (inner * gamma) @ vectors.transpose(-1, -2), None
