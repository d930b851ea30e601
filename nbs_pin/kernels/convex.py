"""Φ of one error with its gradient and Hessian-vector product: one pass forward with a tangent, one pass back."""

import math

import numpy as np

from nbs_pin.kernels.jit import inlined, kernel
from nbs_pin.kernels.layout import PADDING, ActivationCode, Packed, workspace
from nbs_pin.kernels.matrices import times_dual
from nbs_pin.kernels.records import Dual, Vec
from nbs_pin.kernels.views import layer, potential_of, row, take2, take4


@inlined
def activation(code: int, parameter: float, a: float) -> tuple[float, float, float, float]:
    """σ(a) and its first three derivatives; where σ'' jumps, its value beyond the middle piece."""
    if code == ActivationCode.SMOOTHED_RELU:
        s = a / parameter
        s = 0.0 if s < 0.0 else (1.0 if s > 1.0 else s)
        return s * (a - 0.5 * parameter * s), s, 1.0 / parameter if 0.0 < a < parameter else 0.0, 0.0
    if code == ActivationCode.SQUAREPLUS:
        square = a * a + parameter
        root, inverse = math.sqrt(square), 1.0 / square
        bend = 0.5 * parameter * root * inverse * inverse
        return 0.5 * (a + root), 0.5 * (1.0 + a * root * inverse), bend, -3.0 * a * inverse * bend
    return math.nan, math.nan, math.nan, math.nan


@kernel
def convex_forward(part: Packed, u: Vec, du: Vec, slope: Vec, bend: Vec) -> float:
    """f(x) of a convex network, and in the tapes σ'(a) and σ''(a)ȧ of every layer, for x in u[:n] and ẋ in du[:n]."""
    phi = potential_of(part)
    n, code, parameter, at = phi.n, phi.code, phi.parameter[0], 0
    u[n:], du[n:] = 0.0, 0.0
    u[n] = 1.0
    for k in range(phi.depth):
        size, length, matrix = layer(part, k)
        s, b, y, dy = slope[at : at + size], bend[at : at + size], u[n + 1 :], du[n + 1 :]
        times_dual(matrix, u[:length], du[:length], s, b)
        for i in range(size):
            y[i], first, second, _ = activation(code, parameter, s[i])
            s[i], dy[i], b[i] = first, first * b[i], second * b[i]
        y[size:], dy[size:] = 0.0, 0.0
        at += size
    return u[n + 1]


@kernel
def convex_reverse(part: Packed, slope: Vec, bend: Vec, g: Vec, dg: Vec) -> None:
    """∇f(x) → g[:n] and ∇²f(x)ẋ → dg[:n] from the tapes, which are used up: they carry λ and λ̇ from layer to layer.

    δ = σ'λ, δ̇ = σ''ȧλ + σ'λ̇;  ∇f = Σ Wxᵀδ, ∇²f ẋ = Σ Wxᵀδ̇;  λ ← Wyᵀδ, λ̇ ← Wyᵀδ̇.
    """
    phi, at = potential_of(part), len(slope)
    n = phi.n
    g[:], dg[:] = 0.0, 0.0
    g[n + 1] = 1.0
    for k in range(phi.depth - 1, -1, -1):
        size, length, matrix = layer(part, k)
        at -= size
        s, b = slope[at : at + size], bend[at : at + size]
        for i in range(size):
            lam, dlam = g[n + 1 + i], dg[n + 1 + i]
            s[i], b[i] = s[i] * lam, b[i] * lam + s[i] * dlam
        g[n:], dg[n:] = 0.0, 0.0
        for i in range(size):
            w, delta, ddelta = row(matrix, i, length), s[i], b[i]
            for j in range(length):
                g[j] += delta * w[j]
                dg[j] += ddelta * w[j]


@kernel
def potential(error: Dual, part: Packed, work: Vec, out: Dual) -> float:
    """Φ(z) [J]; ∇Φ(z) [N·m] and ∇²Φ(z) ż → out, for z and ż in error."""
    phi, z, dz, units = potential_of(part), error.value, error.rate, 0
    for k in range(phi.depth):
        units += layer(part, k)[0]
    u, du, g, dg, work = take4(work, phi.widest + PADDING)
    slope, bend, work = take2(work, units)
    for i in range(phi.n):
        u[i], du[i] = phi.scale[i] * z[i], phi.scale[i] * dz[i]
    value = convex_forward(part, u, du, slope, bend) - phi.value[0]
    convex_reverse(part, slope, bend, g, dg)
    times_dual(phi.stiffness, z, dz, out.value, out.rate)
    for i in range(phi.n):
        value += z[i] * (0.5 * out.value[i] - phi.scale[i] * phi.tangent[i])
        out.value[i] += phi.scale[i] * (g[i] - phi.tangent[i])
        out.rate[i] += phi.scale[i] * dg[i]
    return value


def subtract_tangent(part: Packed) -> Packed:
    """The potential with its f replaced by f(x) − f(0) − ∇f(0)·x, evaluated with the kernels themselves.

    Args:
        part: a potential as numpy arrays, with zeros for f(0) and ∇f(0).
    """
    bare, whole = (Packed(part.layout, part.weights.copy()) for _ in range(2))
    phi = potential_of(whole)
    potential_of(bare).scale[:] = 1.0  # ∇f itself is wanted, and to the last bit, so that ∇ψ(0) is exactly 0
    zero, product = np.zeros((2, phi.n))
    phi.value[0] = potential(Dual(zero, zero), bare, np.empty(workspace(part)), Dual(phi.tangent, product))
    return whole
