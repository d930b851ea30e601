"""The damping matrix D(z2): positive definite for every parameter value."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from array_api_compat import device
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arrays import Array, Matrices, Vectors, array_namespace, is_torch_array, matvec
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.intervals import OUTWARD, Interval
from nbs_pin.base.known_code import defines, known_code
from nbs_pin.base.storable import Tensors, storable
from nbs_pin.base.tensors import positive_definite, positive_scale
from nbs_pin.controllers.gain import Gain
from nbs_pin.kernels.layout import Packed, pack_damping

DAMPINGS = ("bounded", "paper")
_CELLS = 400  # subintervals of [−radius, radius]


def _stored(t: Tensors) -> Mapping[str, Any]:
    sizes = {"nv": len(t["scale"]), "scale": t["scale"], "widths": t.widths("diagonal.w")}
    if "floor.nominal" not in t:
        return sizes
    return sizes | {"floor": t["floor.nominal"], "least_share": float(t["floor.least_share"])}


@known_code
@storable(("form", "m"), arrays=_stored)
class Damping(nn.Module):
    """D(z) = D₀ + R T(Rz)ᵀT(Rz) R [N·m·s/rad], with T lower triangular from two tanh networks (docs/theory.md §4).

    Args:
        nv: Number of joints.
        form: "bounded" has D ⪰ D₀ for every parameter value; "paper" has no D₀ and diagonal relu(·) + m in T, hence
            D ≻ 0 but not D ⪰ m²I: T = [[1, 0], [1, 1]] has m = 1 and λ_min(TᵀT) = 0.382.
        floor: D₀ (n, n), symmetric positive definite, for "bounded" only.
        m: Smallest diagonal entry of T, for "paper" only.
        widths: Hidden layer sizes of both networks.
        scale: Diagonal of R, (n,); None is 1.
        gain: Initial weights are drawn from U(−gain, gain).
        least_share: Training keeps D₀ at or above this share of its initial value (`Gain`).

    Raises:
        ArgumentError: For an unknown form, a number out of range, or a floor that is missing or superfluous.
    """

    floor: Gain | None
    scale: torch.Tensor

    def __init__(
        self,
        nv: int,
        *,
        form: str = "bounded",
        floor: Float[Array, "n n"] | None = None,
        m: float = 0.001,
        widths: tuple[int, ...] = (32, 32),
        scale: Float[Array, " n"] | None = None,
        gain: float = 0.2,
        least_share: float = 0.5,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if form not in DAMPINGS:
            raise ArgumentError(f"damping '{form}' is unknown; choose one of {', '.join(DAMPINGS)}.")
        if (form == "bounded") != (floor is not None):
            raise ArgumentError(f"damping '{form}' was given floor {floor}; 'bounded' needs one, 'paper' has none.")
        if not m > 0.0:
            raise ArgumentError(f"m is {m}; give a positive number, the smallest diagonal entry of T.")
        self.form, self.m = form, m
        d0 = None if floor is None else positive_definite("the floor D₀", floor)
        self.floor = None if d0 is None else Gain(d0, least_share=least_share, name="the floor D₀")
        self.register_buffer("scale", positive_scale("the scale R", scale, nv))
        self._diagonal_index = np.arange(nv)
        self._lower_index = np.tril_indices(nv, -1)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.diagonal = _FCNN(nv, widths, nv, gain)
            self.lower = _FCNN(nv, widths, nv * (nv - 1) // 2, gain)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self.scale)

    def factor(self, x: Vectors) -> Matrices:
        """T at the scaled velocity error x = Rz, lower triangular."""
        xp = array_namespace(x)
        diagonal = self.diagonal.output(x)
        if self.form == "paper":
            diagonal = xp.clip(diagonal, 0.0, math.inf) + self.m
        t = xp.zeros((*x.shape, self.nv), dtype=x.dtype, device=device(x))
        t[..., self._diagonal_index, self._diagonal_index] = diagonal
        t[..., *self._lower_index] = self.lower.output(x)
        return t

    def matrix(self, z: Vectors) -> Matrices:
        """D(z)."""
        xp = array_namespace(z)
        d0, r = self._constants(numpy=not is_torch_array(z))
        t = self.factor(r * z) * r
        return d0 + xp.matrix_transpose(t) @ t

    def force(self, z: Vectors) -> Vectors:
        """D(z) z [N·m]."""
        d0, r = self._constants(numpy=not is_torch_array(z))
        t = self.factor(r * z)
        return matvec(d0, z) + r * matvec(array_namespace(z).matrix_transpose(t), matvec(t, r * z))

    @property
    def is_packable(self) -> bool:
        """Whether the kernels implement all parts; False for a subclass."""
        return defines(self, "packed") and all(defines(network, "layers") for network in (self.diagonal, self.lower))

    def packed(self, *, numpy: bool = True) -> Packed:
        """Weights for the kernel of `force` (`kernels/damping.py`), as an array or a differentiable tensor."""
        networks = self.diagonal.layers(numpy=numpy), self.lower.layers(numpy=numpy)
        d0, r = self._constants(numpy=numpy)
        return pack_damping(networks, self.form, self.m, r, d0)

    def excess(self, radius: float) -> Interval:
        """Bounds of T(z)² for |z| ≤ radius [rad/s], for one joint [N·m·s/rad], by interval arithmetic."""
        scale = float(self.scale[0])
        x = Interval.cells(scale * radius, _CELLS)
        layers = self.diagonal.layers(numpy=True)
        for i, (weight, bias) in enumerate(layers):
            x = x.through(weight) + bias[:, None]
            x = Interval(np.tanh(x.low), np.tanh(x.high)) if i < len(layers) - 1 else x
        return x.squared().hull().times(scale * scale).widened(OUTWARD)

    def slope(self) -> float:
        """ℓ with xᵀ(D(z) − D₀)x ≤ ℓ² (zᵀD₀z)(xᵀD₀x): inf where T(0) ≠ 0 or there is no D₀.

        ‖T(x)‖_F ≤ ‖x‖ √(Σ over the two networks of the squared product of the norms of their weights), as |tanh'| ≤ 1.
        """
        if self.floor is None:
            return math.inf
        d0, r = self._constants(numpy=True)
        square = 0.0
        for network in (self.diagonal, self.lower):
            layers = network.layers(numpy=True)
            if any(bias.any() for _, bias in layers):
                return math.inf
            square += math.prod(float(np.linalg.norm(weight, 2)) for weight, _ in layers) ** 2
        inverse = np.linalg.inv(np.linalg.cholesky(d0))
        return math.sqrt(square) * float(np.linalg.norm(inverse * r, 2)) ** 2 * OUTWARD

    def _constants(self, *, numpy: bool) -> tuple[Float[Array, "n n"], Float[Array, " n"]]:
        r = self.scale.numpy(force=True) if numpy else self.scale
        zero = array_namespace(r).zeros((self.nv, self.nv), dtype=r.dtype, device=device(r))
        return zero if self.floor is None else self.floor.like(r), r


@known_code
class _FCNN(nn.Module):
    """Tanh hidden layers, linear output; initial weights U(−gain, gain), zero biases, as in docs/theory.md §8."""

    def __init__(self, inputs: int, widths: tuple[int, ...], outputs: int, gain: float) -> None:
        super().__init__()
        sizes = (inputs, *widths, outputs)
        self.depth = len(sizes) - 1
        for i, (size, out) in enumerate(pairwise(sizes)):
            weight = torch.empty(out, size, dtype=torch.float64).uniform_(-gain, gain)
            self.register_parameter(f"w{i}", nn.Parameter(weight))
            self.register_parameter(f"b{i}", nn.Parameter(torch.zeros(out, dtype=torch.float64)))

    def layers(self, *, numpy: bool) -> list[tuple[Array, Array]]:
        named = {k: p.numpy(force=True) if numpy else p for k, p in self._parameters.items() if p is not None}
        return [(named[f"w{i}"], named[f"b{i}"]) for i in range(self.depth)]

    def output(self, x: Vectors) -> Float[Array, "*batch m"]:
        xp = array_namespace(x)
        for i, (weight, bias) in enumerate(self.layers(numpy=not is_torch_array(x))):
            x = x @ weight.T + bias
            x = xp.tanh(x) if i < self.depth - 1 else x
        return x
