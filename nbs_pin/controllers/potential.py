"""The error potential Φ: strongly convex for every parameter value, with its minimum at zero."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arguments import SEED, SHARE, WIDTHS, a, checked, choice, flag, maybe, number, numbers
from nbs_pin.base.arrays import (
    Array,
    JointArray,
    Scalars,
    Vectors,
    array_namespace,
    as_vectors,
    finite_result,
    is_torch_array,
    matvec,
)
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.intervals import OUTWARD, Interval
from nbs_pin.base.known_code import defines, known_code
from nbs_pin.base.storable import Tensors, storable
from nbs_pin.base.tensors import positive_definite, positive_scale
from nbs_pin.controllers.activations import Activation, SmoothedReLU, Squareplus
from nbs_pin.controllers.convex import FICNN, convex_terms, rectified
from nbs_pin.controllers.gain import Gain
from nbs_pin.kernels.convex import subtract_tangent
from nbs_pin.kernels.layout import Packed, pack_potential

POTENTIALS = ("paper", "smooth")
_CELLS = 400  # subintervals of [−radius, radius]


def _stored(t: Tensors) -> Mapping[str, Any]:
    gain = {"stiffness": t["stiffness.nominal"], "least_share": float(t["stiffness.least_share"])}
    return gain | {"scale": t["scale"], "widths": t.widths("network.wx")}


class _Units(NamedTuple):
    """Ranges of the units y = σ(a) of a layer, and their weights Wy."""

    wy: np.ndarray
    a: Interval
    da: Interval
    """∇a."""
    slope: Interval
    """σ'."""
    curvature: Interval
    """σ''."""


@known_code
@storable({"form": "form"}, parts={"activation": "network.activation"}, arrays=_stored)
class Potential(nn.Module):
    """Φ(z) = zᵀSz + ψ(z) [J] with ψ convex, so that ∇²Φ ⪰ 2S everywhere (docs/theory.md §3).

    Args:
        stiffness: Initial S (n, n), symmetric positive definite [J/rad²].
        form: "smooth" is the Bregman form ψ(z) = f(Rz) − f(0) − ∇f(0)ᵀRz of a smooth FICNN f with biases, C^∞. "paper"
            is ψ(z) = f(Rz), f without biases and with the smoothed ReLU; its second derivative, and so the torque,
            jumps where a pre-activation crosses 0 or d.
        widths: Hidden layer sizes of f.
        activation: σ of f; None takes `Squareplus` or, for "paper", `SmoothedReLU`.
        scale: Diagonal of R, (n,), to bring errors of weak and strong joints to one size; None is 1, as in the paper.
        least_share: Training keeps S at or above this share of its initial value (`Gain`).

    Raises:
        ArgumentError: For an unknown form or a number out of range.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> potential = nbs.Potential(stiffness=[[2.0, 0.0], [0.0, 1.0]])
        >>> value, gradient, _ = potential.terms(np.array([0.1, 0.0]), np.zeros(2))
        >>> bool(value >= 0.02), gradient.shape  # Φ(z) ≥ zᵀSz
        (True, (2,))
    """

    scale: torch.Tensor

    @checked(
        form=choice(*POTENTIALS),
        widths=WIDTHS,
        activation=maybe(a(Activation, "an Activation, such as Squareplus()")),
        least_share=SHARE,
        seed=SEED,
    )
    def __init__(
        self,
        stiffness: Float[Array, "n n"],
        *,
        form: str = "smooth",
        widths: tuple[int, ...] = (32, 32, 32),
        activation: Activation | None = None,
        scale: Float[Array, " n"] | None = None,
        least_share: float = 0.5,
        seed: int = 0,
    ) -> None:
        super().__init__()
        s = positive_definite("the stiffness S", stiffness)
        nv = len(s)
        self.form = form
        self.stiffness = Gain(s, least_share=least_share, name="the stiffness S")
        self.register_buffer("scale", positive_scale("the input scale R", scale, nv))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = FICNN(
                nv,
                widths,
                activation or (SmoothedReLU() if form == "paper" else Squareplus()),
                biases=form == "smooth",
                nonnegative=rectified if form == "paper" else abs,
            )

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self.scale)

    @property
    def modulus(self) -> float:
        """μ = 2 λ_min(S) for the present S: Φ is μ-strongly convex [J/rad²]."""
        return 2.0 * float(np.linalg.eigvalsh(self.stiffness.numpy())[0])

    def terms(self, z: Vectors, dz: Vectors) -> tuple[Scalars, Vectors, Vectors]:
        """Φ(z) [J], ∇Φ(z) [N·m] and ∇²Φ(z) dz with the array type of z."""
        z, dz = as_vectors(self.nv, z=z, dz=dz)
        xp = array_namespace(z)
        s, r = self.stiffness.like(z), self.scale if is_torch_array(z) else self.scale.numpy(force=True)
        value, gradient, product = self._psi(r * z, r * dz)
        force, force_rate = 2.0 * matvec(s, z), 2.0 * matvec(s, dz)
        energy = finite_result("Φ", value + 0.5 * xp.sum(z * force, axis=-1), z, dz)
        return energy, r * gradient + force, finite_result("∇²Φ dz", r * product + force_rate, z, dz)

    @property
    def is_packable(self) -> bool:
        """Whether the kernels implement all parts; False for a subclass."""
        activation = self.network.activation
        return defines(self, "packed") and defines(self.network, "layers") and defines(activation, "kernel")

    @checked(numpy=flag)
    def packed(self, *, numpy: bool = True) -> Packed:
        """Weights for the kernel of `terms`, as array or tensor; ArgumentError if the activation has no kernel."""
        activation = self.network.activation
        if activation.kernel is None:
            raise ArgumentError(f"{activation} has no compiled form; take SmoothedReLU or Squareplus.")
        layers, r = self.network.layers(numpy=numpy), self.scale.numpy(force=True) if numpy else self.scale
        tangent = None
        if self.form == "smooth" and not numpy:
            tangent = convex_terms(layers, activation, 0.0 * r, 0.0 * r)[:2]
        packed = pack_potential(layers, activation.kernel, r, self.stiffness.like(r), tangent)
        return subtract_tangent(packed) if self.form == "smooth" and numpy else packed

    @checked(radius=number(least=0.0))
    def curvature(self, radius: float) -> Interval:
        """Bounds of ψ'' for |z| ≤ radius [rad], for one joint [N·m/rad], by interval arithmetic.

        For each layer y = σ(a), y' = σ'(a) a', y'' = σ''(a) a'² + σ'(a) a'', with σ and σ' monotone.
        """
        if self.nv != 1:
            raise ArgumentError(f"Potential.curvature is for one joint, and this has {self.nv}; take curvature_range.")
        scale, activation = float(self.scale[0]), self.network.activation
        x = Interval.cells(scale * radius, _CELLS)
        one = Interval.of(np.ones_like(x.low))
        y = dy = ddy = Interval.of(np.zeros((0, *x.low.shape[1:])))
        for wy, wx, bias in self.network.layers(numpy=True):
            wy = np.zeros((len(wx), 0)) if wy is None else wy
            a = (x.through(wx) + y.through(wy)) + (np.float64(0.0) if bias is None else bias[:, None])
            da, dda = one.through(wx) + dy.through(wy), ddy.through(wy)
            ends = [activation.derivatives(end) for end in (a.low, a.high)]
            y, slope = Interval(ends[0][0], ends[1][0]), Interval(ends[0][1], ends[1][1])
            dy, ddy = slope * da, activation.curvature_range(a) * da.squared() + slope * dda
        return ddy.hull().times(scale * scale).widened(OUTWARD)

    @checked(radii=numbers(None, above=0.0))
    def curvature_range(self, radii: JointArray) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
        """A and B with A ⪯ ∇²ψ(z) ⪯ B while Σ (z_i/radii_i)² ≤ 1 [N·m/rad], by interval arithmetic.

        ∇²f = Σ_u λ_u σ''(a_u) g_ug_uᵀ over all units u, with g_u = ∇a_u and λ_u = ∂f/∂y_u ≥ 0 by the reverse pass. With
        g = c + d, |d| ≤ r, ggᵀ lies between (1 ∓ η)ccᵀ ± (1 ∓ 1/η)ddᵀ, and xᵀddᵀx ≤ (|x|ᵀr)². Pre-activations differ
        from those at 0 by at most the largest |g_u| of the ellipsoid, in its norm.
        """
        scale = np.abs(self.scale.numpy(force=True))
        _of_joints(self.nv, radii=radii)
        tape = self._tape(scale * radii)
        shape = (len(scale), len(scale))
        known, unknown, lam = [np.zeros(shape), np.zeros(shape)], np.zeros(shape), Interval.of(np.ones(1))
        for unit in reversed(tape):
            weight = lam * unit.curvature
            for k, w in enumerate((weight.low, weight.high)):
                known[k] += unit.da.middle.T @ (w[:, None] * unit.da.middle)
            unknown += unit.da.half_width.T @ (weight.high[:, None] * unit.da.half_width)
            lam = (lam * unit.slope).through(unit.wy.T)
        return self._widened(scale, known, unknown.sum(axis=1))  # |x|ᵀU|x| ≤ Σ (U1)_i x_i² for U ≥ 0

    @checked(radii=numbers(None, above=0.0), weights=numbers(None, above=0.0))
    def curvature_rate(self, radii: JointArray, weights: JointArray) -> float:
        """L with |xᵀ(∇²ψ(z) − ∇²ψ(z'))y| ≤ L‖x‖‖y‖‖z − z'‖ where `curvature_range` holds, ‖x‖² = Σ weights_i x_i².

        From norms of the first three derivatives of every unit y = σ(a), Dy = σ'Da, D²y = σ''(Da)² + σ'D²a and
        D³y = σ'''(Da)³ + 3σ''Da D²a + σ'D³a, where weights ≥ 0 pass norms on.
        """
        scale, activation = np.abs(self.scale.numpy(force=True)), self.network.activation
        _of_joints(self.nv, radii=radii, weights=weights)
        second, third = np.zeros((2, 0))
        for unit in self._tape(scale * radii):
            first = np.linalg.norm(np.maximum(-unit.da.low, unit.da.high) * scale / np.sqrt(weights), axis=1)
            second, third = unit.wy @ second, unit.wy @ third
            curvature, jerk = unit.curvature.high, activation.largest_third_derivative(unit.a)
            if not np.isfinite(jerk).all():
                return math.inf
            third = jerk * first**3 + 3.0 * curvature * first * second + unit.slope.high * third
            second = curvature * first**2 + unit.slope.high * second
        return float(third[0]) * OUTWARD

    def _tape(self, reach: JointArray) -> "list[_Units]":
        """The ranges of all units while Σ (x_i/reach_i)² ≤ 1, x = Rz, layer by layer."""
        y, dy, tape = np.zeros(0), Interval.of(np.zeros((0, len(reach)))), []
        activation = self.network.activation
        for wy, wx, bias in self.network.layers(numpy=True):
            wy = np.zeros((len(wx), 0)) if wy is None else wy
            middle = wy @ y + (0.0 if bias is None else bias)
            da = (dy.through(wy) + wx).widened(OUTWARD)
            off = np.linalg.norm(np.maximum(-da.low, da.high) * reach, axis=1)
            a = Interval(middle - off, middle + off).widened(OUTWARD)
            y = activation.derivatives(middle)[0]
            low, high = (activation.derivatives(end)[1] for end in (a.low, a.high))
            dy, slope = Interval(low[:, None], high[:, None]) * da, Interval(low, high)
            tape.append(_Units(wy, a, da, slope, activation.curvature_range(a)))
        return tape

    @staticmethod
    def _widened(
        scale: JointArray, known: list[np.ndarray], rest: JointArray
    ) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
        eta = float(np.clip(np.sqrt(rest.max() / max(np.linalg.norm(known[1], 2), 1e-300)), 1e-9, 1.0))
        low = (1.0 - eta) * known[0] - (1.0 / eta - 1.0) * np.diag(rest)
        high = (1.0 + eta) * known[1] + (1.0 + 1.0 / eta) * np.diag(rest)
        allowance = (OUTWARD - 1.0) * float(np.linalg.norm(high)) * np.eye(len(scale))
        return scale[:, None] * (low - allowance) * scale, scale[:, None] * (high + allowance) * scale

    def _psi(self, x: Vectors, dx: Vectors) -> tuple[Scalars, Vectors, Vectors]:
        if self.form == "paper":
            return self.network.terms(x, dx)
        xp = array_namespace(x)
        zero = 0.0 * x
        values, gradients, products = self.network.terms(xp.stack([x, zero]), xp.stack([dx, zero]))
        gradient_0 = gradients[1]
        psi = values[0] - values[1] - xp.sum(gradient_0 * x, axis=-1)
        return psi, gradients[0] - gradient_0, products[0]


def _of_joints(nv: int, **vectors: JointArray) -> None:
    """Raise ArgumentError unless each vector has a number per joint."""
    for name, x in vectors.items():
        if x.shape != (nv,):
            raise ArgumentError(f"{name} has {x.size} numbers, expected {nv}; give one per joint.")
