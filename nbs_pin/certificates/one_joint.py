"""Bound of the error of an arm with one joint, whose inertia is constant: exact for quadratic Φ and constant D.

With ∇Φ(z1) = kz1 + n, |n| ≤ h|z1|, and D(z2)z2 = dz2 + ε, |ε| ≤ e|z2|, the loop is a linear system under τ_d, n, ε.
The largest response of a linear system to |u| ≤ 1 is the L1 norm of its impulse response, here in closed form, and the
small-gain theorem combines the three (docs/certificates.md §4).
"""

import math
from typing import NamedTuple

import numpy as np

from nbs_pin.base.intervals import OUTWARD, Interval
from nbs_pin.controllers.lyapunov_law import LyapunovLaw

_ROUNDS = 12


class Loop(NamedTuple):
    """ż1 = z2 − λ(kz1 + n), Mż2 = −ζ(kz1 + n) − (Mω + d)z2 − ε + τ_d."""

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
    coupling: float = 1.0
    """ζ."""


class Worst(NamedTuple):
    """Bounds at all times from z1 = z2 = 0, and in the limit from any start; inf if the small-gain theorem fails."""

    z1: float
    """Bound of |z1| [rad]."""
    z2: float
    """Bound of |z2| [rad/s]."""


def worst_of(loop: Loop, disturbance: float, curvature: Interval, extra_damping: Interval) -> Worst:
    """The bounds under |τ_d| ≤ `disturbance` [N·m].

    curvature: range of ψ'' [N·m/rad]. extra_damping: range of D − D₀ [N·m·s/rad], both on the states that are reached.
    """
    if not (np.isfinite(curvature.high) and np.isfinite(extra_damping.high)):
        return Worst(np.inf, np.inf)
    m, lam, zeta = loop.inertia, loop.rate, loop.coupling
    k, d = loop.stiffness + float(curvature.middle), loop.damping + float(extra_damping.middle)
    b = d / m + loop.omega
    value, rate = _norms(lam * k + b, lam * k * b + zeta * k / m)
    torque_to_z1, torque_to_z2 = value / m, (rate + lam * k * value) / m
    n_to_z1, n_to_z2 = lam * rate + (lam * b + zeta / m) * value, zeta * rate / m
    # |z1| ≤ g₁(τ + e|z2|) + h n₁|z1| and |z2| ≤ g₂(τ + e|z2|) + h n₂|z1|
    h, e = float(curvature.half_width), float(extra_damping.half_width)
    free = np.eye(2) - np.array([[h * n_to_z1, e * torque_to_z1], [h * n_to_z2, e * torque_to_z2]])
    if not (free[0, 0] > 1e-9 and free[1, 1] > 1e-9 and np.linalg.det(free) > 1e-9):
        return Worst(np.inf, np.inf)
    z1, z2 = np.linalg.solve(free, np.array([torque_to_z1, torque_to_z2]) * disturbance)
    return Worst(float(z1) * OUTWARD, float(z2) * OUTWARD)


def worst_error(loop: Loop, disturbance: float, law: LyapunovLaw, within: Worst) -> float:
    """Bound of sup |z1| from z1 = z2 = 0 and of limsup |z1| from any start [rad], under |τ_d| ≤ `disturbance` [N·m].

    within: known bounds of |z1| and |z2|. The ranges of ψ'' and T² within them give smaller bounds, and so on.
    """
    for _ in range(_ROUNDS):
        found = worst_of(loop, disturbance, law.extra_stiffness(within.z1), law.extra_damping(within.z2))
        closer = Worst(min(found.z1, within.z1), min(found.z2, within.z2))
        if closer.z1 > 0.999 * within.z1 and closer.z2 > 0.999 * within.z2:
            return closer.z1
        within = closer
    return within.z1


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
