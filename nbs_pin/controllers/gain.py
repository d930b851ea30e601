"""Gains that training may change, but never below a share of where they began."""

import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arrays import Array, array_namespace, is_torch_array
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.base.tensors import positive_definite, positive_scale


@known_code
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
        self, nominal: Float[Array, " n"] | Float[Array, "n n"], *, least_share: float = 0.0, name: str = "the gain"
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
