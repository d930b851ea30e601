"""Trainable gains that stay at or above a share of their initial value."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arguments import SHARE
from nbs_pin.base.arrays import Array, array_namespace, is_torch_array
from nbs_pin.base.known_code import known_code
from nbs_pin.base.tensors import positive_definite, positive_scale


@known_code
class Gain(nn.Module):
    """G(s) = φG₀ + (1 − φ) E G₀ E with E = diag(eˢ): a positive vector (n,) or a positive definite matrix (n, n).

    For a vector the product is elementwise, G = φG₀ + (1 − φ) e²ˢG₀. G(0) equals G₀ exactly, and G(s) ⪰ φG₀ for every
    s, the trainable parameter `change` (n,), initially zero. Bounds of the closed loop in terms of φS₀, φΛ₀ and φD₀
    (docs/theory.md §5) therefore hold throughout training; bounds in terms of the present gains are tighter.

    Args:
        nominal: G₀.
        least_share: φ in [0, 1); 0 only keeps the gain positive.
        name: Name of the gain in error messages.

    Raises:
        ArgumentError: If G₀ is not positive (definite), or φ is out of range.
    """

    nominal: torch.Tensor
    least_share: torch.Tensor

    def __init__(
        self, nominal: Float[Array, " n"] | Float[Array, "n n"], *, least_share: float = 0.0, name: str = "the gain"
    ) -> None:
        super().__init__()
        SHARE(f"least_share of {name}", least_share)
        matrix = len(np.shape(nominal)) == 2
        checked = (
            positive_definite(name, nominal) if matrix else positive_scale(name, nominal, math.prod(np.shape(nominal)))
        )
        self.register_buffer("nominal", checked)
        self.register_buffer("least_share", torch.tensor(least_share, dtype=torch.float64))
        self.change = nn.Parameter(torch.zeros(len(checked), dtype=torch.float64))

    def value(self, *, numpy: bool) -> Float[Array, " n"] | Float[Array, "n n"]:
        """G as a numpy array, or as a tensor differentiable in s."""
        parts = self.nominal, self.change, self.least_share
        nominal, s, share = (x.numpy(force=True) for x in parts) if numpy else parts
        e = array_namespace(s).exp(s)
        squares = e * e if nominal.ndim == 1 else e[:, None] * e
        return nominal * (share + (1.0 - share) * squares)  # the bracket is exactly 1 at s = 0

    def like(self, x: Array) -> Float[Array, " n"] | Float[Array, "n n"]:
        """G with the array type of x."""
        return self.value(numpy=not is_torch_array(x))

    def numpy(self) -> Float[Array, " n"] | Float[Array, "n n"]:
        """G as a new numpy array."""
        return self.value(numpy=True)
