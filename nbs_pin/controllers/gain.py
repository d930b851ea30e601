"""Gains that training may change, but never below a share of where they began."""

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arrays import Array, array_namespace, is_torch_array
from nbs_pin.base.exceptions import ArgumentError


class Gain(nn.Module):
    """G(s) = φG₀ + (1 − φ) E G₀ E with E = diag(eˢ): a positive vector (n,) or a positive definite matrix (n, n).

    For a vector the product is elementwise, G = φG₀ + (1 − φ) e²ˢG₀. G(0) is G₀ to the last bit, and G(s) ⪰ φG₀ for
    every s. So bounds of the closed loop that are written with φS₀, φΛ₀ and φD₀ (docs/theory.md §5) hold for every
    value of the parameters, before, during and after training; those written with the present gains are tighter.

    nominal: G₀. least_share: φ in [0, 1); 0 keeps the gain positive and nothing more. name: what errors call it.
    Parameter `change`: s, (n,), zero at first. Raises ArgumentError unless G₀ is positive (definite) and φ in [0, 1).
    """

    nominal: torch.Tensor
    least_share: torch.Tensor

    def __init__(
        self,
        nominal: Float[Array, " n"] | Float[Array, "n n"],
        *,
        least_share: float = 0.0,
        name: str = "the gain",
    ) -> None:
        super().__init__()
        if not 0.0 <= least_share < 1.0:
            raise ArgumentError(f"least_share of {name} is {least_share}; give a number in [0, 1).")
        matrix = len(nominal.shape) == 2
        checked = positive_definite(name, nominal) if matrix else positive_scale(name, nominal, len(nominal))
        self.register_buffer("nominal", checked)
        self.register_buffer("least_share", torch.tensor(least_share, dtype=torch.float64))
        self.change = nn.Parameter(torch.zeros(len(checked), dtype=torch.float64))

    def value(self, *, numpy: bool) -> Float[Array, " n"] | Float[Array, "n n"]:
        """G: a numpy array, or a tensor that is differentiable in s."""
        parts = self.nominal, self.change, self.least_share
        nominal, s, share = (x.numpy(force=True) for x in parts) if numpy else parts
        e = array_namespace(s).exp(s)
        squares = e * e if nominal.ndim == 1 else e[:, None] * e
        return nominal * (share + (1.0 - share) * squares)  # at s = 0 the bracket is 1 exactly, for every φ

    def like(self, x: Array) -> Float[Array, " n"] | Float[Array, "n n"]:
        """G in the kind of x."""
        return self.value(numpy=not is_torch_array(x))

    def numpy(self) -> Float[Array, " n"] | Float[Array, "n n"]:
        """G as a numpy array of its own."""
        return self.value(numpy=True)


def positive_definite(name: str, matrix: Float[Array, "n n"]) -> Float[torch.Tensor, "n n"]:
    """The matrix as a float64 tensor; raises ArgumentError unless it is symmetric positive definite."""
    tensor = _copied(matrix)
    square = tensor.ndim == 2 and tensor.shape[0] == tensor.shape[1]
    if not square or not bool(torch.isfinite(tensor).all()) or not torch.equal(tensor, tensor.T):
        raise ArgumentError(
            f"{name} of shape {tuple(tensor.shape)} is not a finite symmetric matrix; give an n × n one."
        )
    smallest = float(torch.linalg.eigvalsh(tensor)[0])
    if not smallest > 0.0:
        raise ArgumentError(f"{name} has the eigenvalue {smallest:.3g}; give a positive definite matrix.")
    return tensor


def positive_scale(name: str, scale: Float[Array, " n"] | None, nv: int) -> Float[torch.Tensor, " n"]:
    """The scale as a float64 tensor of shape (nv,), ones for None; raises ArgumentError unless all are positive."""
    tensor = torch.ones(nv, dtype=torch.float64) if scale is None else _copied(scale)
    if tensor.shape != (nv,) or not bool((tensor > 0.0).all() & torch.isfinite(tensor).all()):
        raise ArgumentError(f"{name} is {tensor.tolist()}; give {nv} positive numbers.")
    return tensor


def _copied(x: Array) -> torch.Tensor:
    """A float64 tensor of its own; numpy copies first, because torch warns of arrays that cannot be written."""
    return x.detach().clone().double() if is_torch_array(x) else torch.from_numpy(np.array(x, dtype=float))
