"""The damping matrix D(z2): between two constant matrices for every parameter value."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from array_api_compat import device
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arguments import MOST_JOINTS, SEED, SHARE, WIDTHS, checked, choice, count, flag, maybe, number
from nbs_pin.base.arrays import (
    Array,
    Matrices,
    Vectors,
    array_namespace,
    as_vectors,
    finite_result,
    is_torch_array,
    matvec,
)
from nbs_pin.base.checks import told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.intervals import OUTWARD, Interval, Numbers
from nbs_pin.base.known_code import defines, known_code
from nbs_pin.base.rounding import least_eigenvalue, up
from nbs_pin.base.storable import Tensors, storable
from nbs_pin.base.tensors import positive_definite, positive_scale
from nbs_pin.controllers.gain import Gain
from nbs_pin.kernels.layout import Packed, pack_damping

DAMPINGS = ("bounded", "paper")
_CELLS = 400  # subintervals of [−radius, radius]
_FAR = 1e100  # radii beyond it count as unbounded


def _stored(t: Tensors) -> Mapping[str, Any]:
    sizes = {"nv": len(t["scale"]), "scale": t["scale"], "widths": t.widths("diagonal.w")}
    if "floor.nominal" not in t:
        return sizes
    ceiling = float(t["ceiling"]) if "ceiling" in t else None
    return sizes | {"floor": t["floor.nominal"], "least_share": float(t["floor.least_share"]), "ceiling": ceiling}


@known_code
@storable(("form", "m"), arrays=_stored)
class Damping(nn.Module):
    """D(z) = D₀ + R T(Rz)ᵀT(Rz) R [N·m·s/rad], with T lower triangular from two tanh networks (docs/theory.md §4).

    With a ceiling b the networks give T', and T = T'/√(1 + ‖T'‖_F²/b): then D₀ ⪯ D(z) ≺ D₀ + bR² for all their weights.

    Args:
        nv: Number of joints.
        form: "bounded" has D ⪰ D₀ for every parameter value; "paper" has no D₀ and diagonal relu(·) + m in T, hence
            D ≻ 0 but not D ⪰ m²I: T = [[1, 0], [1, 1]] has m = 1 and λ_min(TᵀT) = 0.382.
        floor: D₀ (n, n), symmetric positive definite, for "bounded" only.
        m: Smallest diagonal entry of T, for "paper" only.
        widths: Hidden layer sizes of both networks.
        scale: Diagonal of R, (n,); None is 1.
        ceiling: b, for "bounded" only; None leaves T as the networks give it, bounded by nothing but their weights.
        gain: Initial weights are drawn from U(−gain, gain).
        least_share: Training keeps D₀ at or above this share of its initial value (`Gain`).

    Raises:
        ArgumentError: For an unknown form, a number out of range, or a floor or ceiling that is missing or superfluous.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> damping = nbs.Damping(2, floor=[[3.0, 0.0], [0.0, 1.0]])
        >>> excess = damping.matrix(np.array([0.5, -2.0])) - np.diag([3.0, 1.0])
        >>> bool(np.linalg.eigvalsh(excess)[0] > -1e-12)  # D ⪰ D₀
        True
    """

    floor: Gain | None
    scale: torch.Tensor
    ceiling: torch.Tensor | None

    @checked(
        nv=count(1, MOST_JOINTS, "joints"),
        form=choice(*DAMPINGS),
        m=number(above=0.0),
        widths=WIDTHS,
        ceiling=maybe(number(above=0.0)),
        gain=number(least=0.0),
        least_share=SHARE,
        seed=SEED,
    )
    def __init__(
        self,
        nv: int,
        *,
        form: str = "bounded",
        floor: Float[Array, "n n"] | None = None,
        m: float = 0.001,
        widths: tuple[int, ...] = (32, 32),
        scale: Float[Array, " n"] | None = None,
        ceiling: float | None = None,
        gain: float = 0.2,
        least_share: float = 0.5,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if (form == "bounded") != (floor is not None):
            raise ArgumentError(
                f"damping '{form}' was given floor {told(floor)}; 'bounded' needs one, 'paper' has none."
            )
        if ceiling is not None and form == "paper":
            raise ArgumentError(f"damping 'paper' was given ceiling {ceiling}; 'bounded' alone has one.")
        self.form, self.m = form, m
        d0 = None if floor is None else positive_definite("the floor D₀", floor)
        self.floor = None if d0 is None else Gain(d0, least_share=least_share, name="the floor D₀")
        self.register_buffer("scale", positive_scale("the scale R", scale, nv))
        self.register_buffer("ceiling", None if ceiling is None else torch.tensor(ceiling, dtype=torch.float64))
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
        (x,) = as_vectors(self.nv, x=x)
        return finite_result("T", self._factor(x), x)

    def _factor(self, x: Vectors) -> Matrices:
        xp = array_namespace(x)
        diagonal = self.diagonal.output(x)
        if self.form == "paper":
            diagonal = xp.clip(diagonal, 0.0, math.inf) + self.m
        t = xp.zeros((*x.shape, self.nv), dtype=x.dtype, device=device(x))
        t[..., self._diagonal_index, self._diagonal_index] = diagonal
        t[..., *self._lower_index] = self.lower.output(x)
        if self.ceiling is None:
            return t
        ceiling = self.ceiling if is_torch_array(x) else float(self.ceiling)
        return t / xp.sqrt(1.0 + xp.sum(t * t, axis=(-2, -1), keepdims=True) / ceiling)

    def matrix(self, z: Vectors) -> Matrices:
        """D(z)."""
        (z,) = as_vectors(self.nv, z=z)
        xp = array_namespace(z)
        d0, r = self._constants(numpy=not is_torch_array(z))
        t = self.factor(r * z) * r
        return finite_result("D(z)", d0 + xp.matrix_transpose(t) @ t, z)

    def force(self, z: Vectors) -> Vectors:
        """D(z) z [N·m]."""
        (z,) = as_vectors(self.nv, z=z)
        d0, r = self._constants(numpy=not is_torch_array(z))
        t = self.factor(r * z)
        force = matvec(d0, z) + r * matvec(array_namespace(z).matrix_transpose(t), matvec(t, r * z))
        return finite_result("D(z)z", force, z)

    @property
    def stretch(self) -> float:
        """r with R² ⪯ rD₀, rounded up: the largest eigenvalue of D₀^−½R²D₀^−½; inf if there is no D₀."""
        if self.floor is None:
            return math.inf
        d0, r = self._constants(numpy=True)
        least = least_eigenvalue(d0 / r / r[:, None])
        return up(1.0 / least) if least > 0.0 else math.inf

    @property
    def is_packable(self) -> bool:
        """Whether the kernels implement all parts; False for a subclass."""
        return defines(self, "packed") and all(defines(network, "layers") for network in (self.diagonal, self.lower))

    @checked(numpy=flag)
    def packed(self, *, numpy: bool = True) -> Packed:
        """Weights for the kernel of `force` (`kernels/damping.py`), as an array or a differentiable tensor."""
        networks = self.diagonal.layers(numpy=numpy), self.lower.layers(numpy=numpy)
        d0, r = self._constants(numpy=numpy)
        return pack_damping(networks, self.form, self.m, r, d0, None if self.ceiling is None else float(self.ceiling))

    @checked(radius=number(least=0.0))
    def excess(self, radius: float) -> Interval:
        """Bounds of T(z)² for |z| ≤ radius [rad/s], for one joint [N·m·s/rad], by interval arithmetic."""
        if self.nv != 1:
            raise ArgumentError(f"Damping.excess is for one joint, and this has {self.nv}; take share.")
        scale = float(self.scale[0])
        x = Interval.cells(scale * radius, _CELLS)
        layers = self.diagonal.layers(numpy=True)
        for i, (weight, bias) in enumerate(layers):
            x = x.through(weight) + bias[:, None]
            x = Interval(np.tanh(x.low), np.tanh(x.high)) if i < len(layers) - 1 else x
        square = x.squared().hull()
        limited = Interval(self._limited(square.low), self._limited(square.high))
        return limited.times(scale * scale).widened(OUTWARD)

    @checked(radius=number(least=0.0, most=math.inf))
    def share(self, radius: float) -> float:
        """n with D(z) ⪯ (1 + n) D₀ while zᵀD₀z ≤ radius² [W], for the present weights; inf if there is no D₀.

        With r of `stretch`: D − D₀ ⪯ ‖T‖_F² R² ⪯ r‖T‖_F² D₀, and ‖Rz‖ ≤ √r radius (docs/theory.md §4).
        """
        stretch = self.stretch
        if math.isinf(stretch):
            return math.inf
        reached = up(radius * math.sqrt(stretch))
        square = self.diagonal.largest_square(reached) + self.lower.largest_square(reached)
        return up(float(self._limited(np.float64(up(square)))) * stretch)

    def _limited(self, square: Numbers) -> Numbers:
        """‖T‖_F² from that of the networks' T', which it does not exceed, and increases with."""
        if self.ceiling is None:
            return square
        ceiling, finite = float(self.ceiling), np.isfinite(square)
        kept = np.where(finite, square, 0.0)
        return np.where(finite, kept / (1.0 + kept / ceiling), ceiling)[()]

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

    def largest_square(self, radius: float) -> float:
        """An upper bound of ‖output(x)‖² over ‖x‖ ≤ radius, for the present weights; inf if none is known.

        Layer by layer it bounds what x changes of the outputs at x = 0, each output's change and the norm of all:
        |Δ(Wh)_j| ≤ Σ_k |w_jk||Δh_k| and ≤ ‖w_j‖‖Δh‖, ‖Δ(Wh)‖ ≤ ‖W‖‖Δh‖, |Δtanh a| ≤ |Δa| and ≤ 1 + |tanh a|. Rounding
        errors of the outputs at 0 count as changes.
        """
        eps, layers, norm = float(np.finfo(float).eps), self.layers(numpy=True), radius if radius < _FAR else math.inf
        value, change = np.zeros(layers[0][0].shape[1]), np.full(layers[0][0].shape[1], norm)
        for i, (weight, bias) in enumerate(layers):
            rounding = (len(value) + 2) * eps * (np.abs(weight) @ np.abs(value) + np.abs(bias))
            if math.isinf(norm):
                change = np.full(len(bias), norm)
            else:
                change = np.minimum(np.abs(weight) @ change, np.linalg.norm(weight, axis=1) * norm) + rounding
                norm *= float(np.linalg.svd(weight, compute_uv=False).max(initial=0.0))
                norm = min(norm + float(np.linalg.norm(rounding)), float(np.linalg.norm(change)))
            value = weight @ value + bias
            if i < self.depth - 1:
                value = np.tanh(value)
                change = np.minimum(change, 1.0 + np.abs(value)) + 4.0 * eps
                norm = min(norm + 4.0 * eps * math.sqrt(len(value)), float(np.linalg.norm(change)))
        square = min(float(((np.abs(value) + change) ** 2).sum()), (float(np.linalg.norm(value)) + norm) ** 2)
        return square if square < math.inf else math.inf
