"""Fully input-convex neural networks with gradient and Hessian-vector product in closed form."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import nn

from nbs_pin.base.arrays import Array, Scalars, Vectors, is_torch_array
from nbs_pin.base.known_code import known_code
from nbs_pin.controllers.activations import Activation


class ConvexLayer(NamedTuple):
    """One layer y ← σ(Wy y + Wx x + b) with Wy ≥ 0 elementwise; no Wy in the first layer, b optional."""

    wy: Array | None
    wx: Array
    bias: Array | None


@known_code
class FICNN(nn.Module):
    """f(x): ℝⁿ → ℝ, convex for every parameter value (paper eq. (6), Amos et al. 2017).

    Every layer, the scalar output included, is y_{i+1} = σ(nonnegative(Wy_i) y_i + Wx_i x + b_i) with y_0 = 0.
    `nonnegative` maps free parameters to weights ≥ 0; with a convex, non-decreasing σ, f is then convex.
    """

    def __init__(
        self,
        inputs: int,
        widths: tuple[int, ...],
        activation: Activation,
        *,
        biases: bool,
        nonnegative: Callable[[Array], Array],
    ) -> None:
        super().__init__()
        self.activation = activation
        self._nonnegative = nonnegative
        sizes = (*widths, 1)
        self.depth = len(sizes)
        for i, size in enumerate(sizes):
            self.register_parameter(f"wy{i}", _free(size, sizes[i - 1]) if i else None)
            self.register_parameter(f"wx{i}", _free(size, inputs))
            self.register_parameter(f"b{i}", _free(size) if biases else None)

    def layers(self, *, numpy: bool) -> tuple[ConvexLayer, ...]:
        """Effective weights of the layers, as numpy arrays or as tensors differentiable in the parameters."""
        named = {k: p.numpy(force=True) if numpy and p is not None else p for k, p in self._parameters.items()}
        return tuple(
            ConvexLayer(self._nonnegative(named[f"wy{i}"]) if i else None, named[f"wx{i}"], named[f"b{i}"])
            for i in range(self.depth)
        )

    def terms(self, x: Vectors, dx: Vectors) -> tuple[Scalars, Vectors, Vectors]:
        """f(x), ∇f(x) and ∇²f(x) dx with the array type of x; no Hessian is formed."""
        return convex_terms(self.layers(numpy=not is_torch_array(x)), self.activation, x, dx)


def convex_terms(
    layers: tuple[ConvexLayer, ...], activation: Activation, x: Vectors, dx: Vectors
) -> tuple[Scalars, Vectors, Vectors]:
    """f(x), ∇f(x), ∇²f(x) dx of a FICNN: one forward pass with its tangent ẏ, one reverse pass with its tangent λ̇.

    With a the pre-activations and λ = ∂f/∂y:  y = σ(a), ẏ = σ'(a) ȧ;  δ = σ'(a) λ, δ̇ = σ''(a) ȧ λ + σ'(a) λ̇;
    ∇f = Σ Wxᵀδ, ∇²f dx = Σ Wxᵀδ̇, and λ ← Wyᵀδ, λ̇ ← Wyᵀδ̇.
    """
    y, dy = x[..., :0], dx[..., :0]
    tape = []
    for wy, wx, bias in layers:
        a, da = x @ wx.T, dx @ wx.T
        if wy is not None:
            a, da = a + y @ wy.T, da + dy @ wy.T
        y, s1, s2 = activation.derivatives(a if bias is None else a + bias)
        dy = s1 * da
        tape.append((s1, s2 * da))
    lam, dlam = 0.0 * y + 1.0, 0.0 * y
    gradient, product = 0.0 * x, 0.0 * x
    for (wy, wx, _), (s1, s2_da) in zip(reversed(layers), reversed(tape), strict=True):
        delta, ddelta = s1 * lam, s2_da * lam + s1 * dlam
        gradient, product = gradient + delta @ wx, product + ddelta @ wx
        if wy is not None:
            lam, dlam = delta @ wy, ddelta @ wy
    return y[..., 0], gradient, product


def rectified(weight: Array) -> Array:
    """max(weight, 0), the paper's map to weights ≥ 0."""
    return 0.5 * (weight + abs(weight))


def _free(*shape: int) -> nn.Parameter:
    return nn.Parameter(torch.empty(shape, dtype=torch.float64).uniform_(-0.1, 0.2))
