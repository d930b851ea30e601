"""The error potential Φ: strongly convex for every parameter value, with its minimum at zero."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arrays import Array, JointArray, Scalars, Vectors, array_namespace, is_torch_array, matvec
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
    """

    scale: torch.Tensor

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
        if form not in POTENTIALS:
            raise ArgumentError(f"potential '{form}' is unknown; choose one of {', '.join(POTENTIALS)}.")
        s, nv = positive_definite("the stiffness S", stiffness), len(stiffness)
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
        xp = array_namespace(z)
        s, r = self.stiffness.like(z), self.scale if is_torch_array(z) else self.scale.numpy(force=True)
        value, gradient, product = self._psi(r * z, r * dz)
        force, force_rate = 2.0 * matvec(s, z), 2.0 * matvec(s, dz)
        return value + 0.5 * xp.sum(z * force, axis=-1), r * gradient + force, r * product + force_rate

    @property
    def is_packable(self) -> bool:
        """Whether the kernels implement all parts; False for a subclass."""
        activation = self.network.activation
        return defines(self, "packed") and defines(self.network, "layers") and defines(activation, "kernel")

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

    def curvature(self, radius: float) -> Interval:
        """Bounds of ψ'' for |z| ≤ radius [rad], for one joint [N·m/rad], by interval arithmetic.

        For each layer y = σ(a), y' = σ'(a) a', y'' = σ''(a) a'² + σ'(a) a'', with σ and σ' monotone.
        """
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

    def curvature_range(self, radii: JointArray) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
        """A and B with A ⪯ ∇²ψ(z) ⪯ B while Σ (z_i/radii_i)² ≤ 1 [N·m/rad], by interval arithmetic.

        ∇²f = Σ_u λ_u σ''(a_u) g_ug_uᵀ over all units u, with g_u = ∇a_u and λ_u = ∂f/∂y_u ≥ 0 by the reverse pass. With
        g = c + d, |d| ≤ r, ggᵀ lies between (1 ∓ η)ccᵀ ± (1 ∓ 1/η)ddᵀ, and xᵀddᵀx ≤ (|x|ᵀr)². Pre-activations differ
        from those at 0 by at most the largest |g_u| of the ellipsoid, in its norm.
        """
        scale, activation = np.abs(self.scale.numpy(force=True)), self.network.activation
        layers, reach = self.network.layers(numpy=True), scale * radii
        y, dy, tape = np.zeros(0), Interval.of(np.zeros((0, len(scale)))), []
        for wy, wx, bias in layers:
            wy = np.zeros((len(wx), 0)) if wy is None else wy
            middle = wy @ y + (0.0 if bias is None else bias)
            da = (dy.through(wy) + wx).widened(OUTWARD)
            off = np.linalg.norm(np.maximum(-da.low, da.high) * reach, axis=1)
            a = Interval(middle - off, middle + off).widened(OUTWARD)
            y = activation.derivatives(middle)[0]
            slope = Interval(*(activation.derivatives(end)[1] for end in (a.low, a.high)))
            dy = Interval(np.asarray(slope.low)[:, None], np.asarray(slope.high)[:, None]) * da
            tape.append((slope, activation.curvature_range(a), da))
        shape = (len(scale), len(scale))
        known, unknown, lam = [np.zeros(shape), np.zeros(shape)], np.zeros(shape), Interval.of(np.ones(1))
        for (wy, _, _), (slope, curvature, da) in zip(reversed(layers), reversed(tape), strict=True):
            weight = lam * curvature
            for k, w in enumerate((weight.low, weight.high)):
                known[k] += da.middle.T @ (np.asarray(w)[:, None] * da.middle)
            unknown += da.half_width.T @ (np.asarray(weight.high)[:, None] * da.half_width)
            lam = Interval.of(np.zeros(0)) if wy is None else (lam * slope).through(wy.T)
        return self._widened(scale, known, unknown.sum(axis=1))  # |x|ᵀU|x| ≤ Σ (U1)_i x_i² for U ≥ 0

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
