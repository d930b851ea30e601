"""Φ of one error with its gradient and Hessian-vector product: one pass forward with a tangent, one pass back."""

import math

import numpy as np

from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.layout import PADDING, PART_HEADER, SMOOTHED_RELU, Packed, workspace


@kernel
def activate(code: int, parameter: float, y: np.ndarray, dy: np.ndarray, slope: np.ndarray, bend: np.ndarray) -> None:
    """σ(a) → y, σ'(a)ȧ → ẏ, slope ← σ'(a), bend ← σ''(a)ȧ, given a in slope and ȧ in bend."""
    if code == SMOOTHED_RELU:
        for i in range(len(slope)):
            a = slope[i]
            s = a / parameter
            if s < 0.0:
                s = 0.0
            elif s > 1.0:
                s = 1.0
            slope[i], y[i], dy[i] = s, s * (a - 0.5 * parameter * s), s * bend[i]
            bend[i] = bend[i] / parameter if 0.0 < a < parameter else 0.0 * bend[i]
    else:
        for i in range(len(slope)):
            a = slope[i]
            root = math.sqrt(a * a + parameter)
            s = 0.5 * (1.0 + a / root)
            slope[i], y[i], dy[i] = s, 0.5 * (a + root), s * bend[i]
            bend[i] = 0.5 * parameter / (root * root * root) * bend[i]


@kernel
def convex_forward(
    layout: np.ndarray, weights: np.ndarray, u: np.ndarray, du: np.ndarray, slope: np.ndarray, bend: np.ndarray
) -> float:
    """f(x) of a convex network, and in the tapes σ'(a) and σ''(a)ȧ of every layer, for x in u[:n] and ẋ in du[:n]."""
    n, depth, code = layout[0], layout[1], layout[2]
    u[n:], du[n:] = 0.0, 0.0
    u[n] = 1.0
    at = 0
    for layer in range(depth):
        size, length, offset = layout[PART_HEADER + 3 * layer : PART_HEADER + 3 * layer + 3]
        matrix = weights[offset : offset + size * length].reshape(size, length)
        s, b = slope[at : at + size], bend[at : at + size]
        for i in range(size):
            row = matrix[i]
            a, da = 0.0, 0.0
            for j in range(length):
                a += row[j] * u[j]
                da += row[j] * du[j]
            s[i], b[i] = a, da
        y, dy = u[n + 1 :], du[n + 1 :]
        activate(code, weights[0], y, dy, s, b)
        y[size:], dy[size:] = 0.0, 0.0
        at += size
    return u[n + 1]


@kernel
def convex_reverse(
    layout: np.ndarray, weights: np.ndarray, slope: np.ndarray, bend: np.ndarray, g: np.ndarray, dg: np.ndarray
) -> None:
    """∇f(x) → g[:n] and ∇²f(x)ẋ → dg[:n] from the tapes, which are used up: they carry λ and λ̇ from layer to layer.

    δ = σ'λ, δ̇ = σ''ȧλ + σ'λ̇;  ∇f = Σ Wxᵀδ, ∇²f ẋ = Σ Wxᵀδ̇;  λ ← Wyᵀδ, λ̇ ← Wyᵀδ̇.
    """
    n, depth = layout[0], layout[1]
    g[:], dg[:] = 0.0, 0.0
    at = len(slope)
    for layer in range(depth - 1, -1, -1):
        size, length, offset = layout[PART_HEADER + 3 * layer : PART_HEADER + 3 * layer + 3]
        matrix = weights[offset : offset + size * length].reshape(size, length)
        at -= size
        s, b = slope[at : at + size], bend[at : at + size]
        last = layer == depth - 1
        for i in range(size):
            lam, dlam = (1.0, 0.0) if last else (g[n + 1 + i], dg[n + 1 + i])
            s[i], b[i] = s[i] * lam, b[i] * lam + s[i] * dlam
        g[n:], dg[n:] = 0.0, 0.0
        for i in range(size):
            row = matrix[i]
            delta, ddelta = s[i], b[i]
            for j in range(length):
                g[j] += delta * row[j]
                dg[j] += ddelta * row[j]


@kernel
def potential(
    z: np.ndarray,
    dz: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    gradient: np.ndarray,
    product: np.ndarray,
) -> float:
    """Φ(z) [J]; ∇Φ(z) [N·m] → gradient and ∇²Φ(z) ż → product. (n,) each."""
    n, depth, widest = layout[0], layout[1], layout[3]
    total = 0
    for layer in range(depth):
        total += layout[PART_HEADER + 3 * layer]
    room = widest + PADDING
    u, du, g, dg = work[:room], work[room : 2 * room], work[2 * room : 3 * room], work[3 * room : 4 * room]
    slope, bend = work[4 * room : 4 * room + total], work[4 * room + total : 4 * room + 2 * total]
    scale, tangent = weights[2 : 2 + n], weights[2 + n : 2 + 2 * n]
    stiffness = weights[2 + 2 * n : 2 + 2 * n + n * n].reshape(n, n)
    for i in range(n):
        u[i], du[i] = scale[i] * z[i], scale[i] * dz[i]
    value = convex_forward(layout, weights, u, du, slope, bend) - weights[1]
    convex_reverse(layout, weights, slope, bend, g, dg)
    for i in range(n):
        force, rate = 0.0, 0.0
        for j in range(n):
            force += stiffness[i, j] * z[j]
            rate += stiffness[i, j] * dz[j]
        value += z[i] * (0.5 * force - scale[i] * tangent[i])
        gradient[i] = scale[i] * (g[i] - tangent[i]) + force
        product[i] = scale[i] * dg[i] + rate
    return value


def subtract_tangent(part: Packed) -> Packed:
    """The potential with its f replaced by f(x) − f(0) − ∇f(0)·x, evaluated with the kernels themselves."""
    n = int(part.layout[0])
    weights, bare = part.weights.copy(), part.weights.copy()
    bare[2 : 2 + n] = 1.0  # R is 1 here: ∇f itself is wanted, and to the last bit, so that ∇ψ(0) is exactly 0
    zero, gradient, product = np.zeros((3, n))
    weights[1] = potential(zero, zero, part.layout, bare, np.empty(workspace(part)), gradient, product)
    weights[2 + n : 2 + 2 * n] = gradient
    return Packed(part.layout, weights)
