"""The worst error of an arm with one joint, whose inertia is constant: exact for a quadratic Φ and a constant D.

With ∇Φ(z1) = kz1 + n, |n| ≤ ½H|z1|, and D(z2)z2 = dz2 + e, |e| ≤ ½E|z2|, the loop is a linear system under τ_d, n, e.
The largest response of a linear system to |u| ≤ 1 is the L1 norm of its impulse response, here in closed form, and the
small-gain theorem adds the three (docs/certificates.md §4).
"""

import math
from typing import NamedTuple

import numpy as np

from nbs_pin.networks.activations import SmoothedReLU, Squareplus
from nbs_pin.networks.convex import ConvexLayer
from nbs_pin.networks.damping import Damping
from nbs_pin.networks.potential import Potential

_OUTWARD = 1.0 + 1e-9


class Loop(NamedTuple):
    """ż1 = z2 − λ(kz1 + n), Mż2 = −(kz1 + n) − (Mω + d)z2 − e + τ_d."""

    inertia: float
    """M [kg·m²]."""
    rate: float
    """λ [rad/s per N·m]."""
    omega: float
    """ω [1/s]."""
    stiffness: float
    """2S [N·m/rad]."""
    damping: float
    """D₀ [N·m·s/rad]."""


def worst_error(loop: Loop, disturbance: float, curvature: float = 0.0, extra_damping: float = 0.0) -> float:
    """At least sup |z1| [rad] from z1 = z2 = 0 and limsup |z1| from anywhere, under |τ_d| ≤ `disturbance` [N·m].

    curvature: H ≥ ψ'' [N·m/rad]. extra_damping: E ≥ T² [N·m·s/rad]. inf where the small-gain theorem does not apply.
    """
    m, lam = loop.inertia, loop.rate
    k, d = loop.stiffness + 0.5 * curvature, loop.damping + 0.5 * extra_damping
    b = d / m + loop.omega
    value, rate = _norms(lam * k + b, lam * k * b + k / m)
    torque_to_z1, torque_to_z2 = value / m, (rate + lam * k * value) / m
    n_to_z1, n_to_z2 = lam * rate + (lam * b + 1.0 / m) * value, rate / m
    if not math.isfinite(curvature):
        return math.inf
    # |z1| ≤ g₁(τ + ½E|z2|) + ½H n₁|z1| and |z2| ≤ g₂(τ + ½E|z2|) + ½H n₂|z1|
    h, e = 0.5 * curvature, 0.5 * extra_damping
    gains = np.array([[h * n_to_z1, e * torque_to_z1], [h * n_to_z2, e * torque_to_z2]])
    free = np.eye(2) - gains
    if not (np.trace(free) > 0.0 and free[0, 0] > 1e-9 and np.linalg.det(free) > 1e-9):
        return math.inf
    return float(np.linalg.solve(free, np.array([torque_to_z1, torque_to_z2]) * disturbance)[0]) * _OUTWARD


def largest_curvature(potential: Potential) -> float:
    """H ≥ ψ''(z) for every z [N·m/rad], by bounds of slope and curvature from layer to layer.

    With 0 ≤ σ' ≤ 1 and σ'' ≤ c: |∂y_i/∂z| ≤ g = |Wx| + Wy g₋ and ∂²y_i/∂z² ≤ c g² + Wy h₋. inf for other activations.
    """
    network = potential.network
    match network.activation:
        case SmoothedReLU(d):
            steepest = 1.0 / d
        case Squareplus(b):
            steepest = 0.5 / math.sqrt(b)
        case _:
            return math.inf
    slope, curvature = np.zeros(0), np.zeros(0)
    for layer in network.layers(numpy=True):
        slope = _through(layer, slope) + np.abs(np.asarray(layer.wx)[:, 0])
        curvature = steepest * slope**2 + _through(layer, curvature)
    return float(curvature[0]) * float(potential.scale[0]) ** 2 * _OUTWARD


def largest_extra_damping(damping: Damping) -> float:
    """E ≥ D(z2) − D₀ for every z2 [N·m·s/rad]: |T| ≤ Σ|w| + |b|, since |tanh| ≤ 1."""
    weight, bias = damping.diagonal.layers(numpy=True)[-1]
    return float((np.abs(weight).sum() + np.abs(bias).sum()) ** 2) * float(damping.scale[0]) ** 2 * _OUTWARD


def _through(layer: ConvexLayer, x: np.ndarray) -> np.ndarray:
    return np.zeros(len(layer.wx)) if layer.wy is None else np.asarray(layer.wy) @ x


def _norms(p1: float, p0: float) -> tuple[float, float]:
    """L1 norms of the impulse responses of 1/(s² + p₁s + p₀) and of s/(s² + p₁s + p₀), for p₁, p₀ > 0.

    The second is the total variation of the first response h: twice the sum of its peaks.
    """
    half, square = 0.5 * p1, p0 - 0.25 * p1 * p1
    if square > 1e-12 * p0:  # h = e^{−half·t} sin(wt)/w, each peak e^{−π half/w} of the one before
        w = math.sqrt(square)
        t = math.atan2(w, half) / w
        peak = math.exp(-half * t) * math.sin(w * t) / w
        return 1.0 / (p0 * math.tanh(0.5 * math.pi * half / w)), 2.0 * peak / -math.expm1(-math.pi * half / w)
    # h = (e^{−at} − e^{−bt})/(b − a) ≥ 0, one peak; equal poles within rounding are one pole, peak 1/(ea)
    spread = math.sqrt(max(-square, 0.0))
    slow, fast = half - spread, half + spread
    slow = p0 / fast
    if fast - slow < 1e-6 * fast:
        return 1.0 / p0, 2.0 / (math.e * slow)
    t = math.log(fast / slow) / (fast - slow)
    return 1.0 / p0, 2.0 * (math.exp(-slow * t) - math.exp(-fast * t)) / (fast - slow)
