"""The worst error of an arm with one joint, whose inertia is constant: exact for a quadratic Φ and a constant D.

With ∇Φ(z1) = kz1 + n, |n| ≤ h|z1|, and D(z2)z2 = dz2 + ε, |ε| ≤ e|z2|, the loop is a linear system under τ_d, n, ε.
The largest response of a linear system to |u| ≤ 1 is the L1 norm of its impulse response, here in closed form, and the
small-gain theorem adds the three (docs/certificates.md §4).
"""

import math
from typing import NamedTuple

import numpy as np

from nbs_pin.certificates.intervals import Interval
from nbs_pin.controllers.activations import SmoothedReLU, Squareplus
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.potential import Potential

_OUTWARD = 1.0 + 1e-9
_CELLS = 400
_ROUNDS = 12


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


class Worst(NamedTuple):
    """From z1 = z2 = 0 at all times, in the limit from anywhere; inf where the small-gain theorem does not apply."""

    z1: float
    """At least |z1| [rad]."""
    z2: float
    """At least |z2| [rad/s]."""


def worst_of(loop: Loop, disturbance: float, curvature: Interval, extra_damping: Interval) -> Worst:
    """The worst under |τ_d| ≤ `disturbance` [N·m].

    curvature: of ψ'' [N·m/rad]. extra_damping: of D − D₀ [N·m·s/rad], both wherever the loop goes.
    """
    m, lam = loop.inertia, loop.rate
    k, d = loop.stiffness + float(curvature.middle), loop.damping + float(extra_damping.middle)
    b = d / m + loop.omega
    value, rate = _norms(lam * k + b, lam * k * b + k / m)
    torque_to_z1, torque_to_z2 = value / m, (rate + lam * k * value) / m
    n_to_z1, n_to_z2 = lam * rate + (lam * b + 1.0 / m) * value, rate / m
    # |z1| ≤ g₁(τ + e|z2|) + h n₁|z1| and |z2| ≤ g₂(τ + e|z2|) + h n₂|z1|
    h, e = float(curvature.half_width), float(extra_damping.half_width)
    free = np.eye(2) - np.array([[h * n_to_z1, e * torque_to_z1], [h * n_to_z2, e * torque_to_z2]])
    if not (free[0, 0] > 1e-9 and free[1, 1] > 1e-9 and np.linalg.det(free) > 1e-9):
        return Worst(np.inf, np.inf)
    z1, z2 = np.linalg.solve(free, np.array([torque_to_z1, torque_to_z2]) * disturbance)
    return Worst(float(z1) * _OUTWARD, float(z2) * _OUTWARD)


def worst_error(loop: Loop, disturbance: float, potential: Potential, damping: Damping, within: Worst) -> float:
    """At least sup |z1| [rad] from z1 = z2 = 0 and limsup |z1| from anywhere, under |τ_d| ≤ `disturbance` [N·m].

    within: bounds of |z1| and |z2| known already. ψ'' and T² are bounded there, which bounds z1 and z2 anew, and so on.
    """
    for _ in range(_ROUNDS):
        found = worst_of(loop, disturbance, curvature(potential, within.z1), extra_damping(damping, within.z2))
        closer = Worst(min(found.z1, within.z1), min(found.z2, within.z2))
        if closer.z1 > 0.999 * within.z1 and closer.z2 > 0.999 * within.z2:
            return closer.z1
        within = closer
    return within.z1


def curvature(potential: Potential, radius: float) -> Interval:
    """ψ''(z) for |z| ≤ radius [N·m/rad]: y, y' and y'' of each layer on small cells, by interval arithmetic.

    y = σ(a), y' = σ'(a) a', y'' = σ''(a) a'² + σ'(a) a'', with σ and σ' monotone. Any number ≥ 0 for an activation
    that is not the package's.
    """
    scale, activation = float(potential.scale[0]), potential.network.activation
    if not isinstance(activation, SmoothedReLU | Squareplus):
        return Interval(np.float64(0.0), np.float64(np.inf))
    x = Interval.cells(scale * radius, _CELLS)
    one = Interval.of(np.ones_like(x.low))
    layers = potential.network.layers(numpy=True)
    y = dy = ddy = Interval.of(np.zeros((0, *x.low.shape[1:])))
    for layer in layers:
        wx, wy = np.asarray(layer.wx), np.zeros((len(layer.wx), 0)) if layer.wy is None else np.asarray(layer.wy)
        bias = np.float64(0.0) if layer.bias is None else np.asarray(layer.bias)[:, None]
        a, da, dda = (x.through(wx) + y.through(wy)) + bias, one.through(wx) + dy.through(wy), ddy.through(wy)
        ends = [activation.derivatives(end) for end in (a.low, a.high)]
        y, slope = Interval(ends[0][0], ends[1][0]), Interval(ends[0][1], ends[1][1])
        dy, ddy = slope * da, _bend(activation, a) * da.squared() + slope * dda
    return ddy.hull().times(scale * scale).widened(_OUTWARD)


def extra_damping(damping: Damping, radius: float) -> Interval:
    """T(z2)² for |z2| ≤ radius [N·m·s/rad], by interval arithmetic on small cells; tanh is monotone."""
    scale = float(damping.scale[0])
    x = Interval.cells(scale * radius, _CELLS)
    layers = damping.diagonal.layers(numpy=True)
    for i, (weight, bias) in enumerate(layers):
        x = x.through(np.asarray(weight)) + np.asarray(bias)[:, None]
        x = Interval(np.tanh(x.low), np.tanh(x.high)) if i < len(layers) - 1 else x
    return x.squared().hull().times(scale * scale).widened(_OUTWARD)


def _bend(activation: SmoothedReLU | Squareplus, a: Interval) -> Interval:
    """σ'' over the intervals: one hump, of which the ends and the top tell everything."""
    if isinstance(activation, SmoothedReLU):
        inside, touching = (a.low > 0.0) & (a.high < activation.d), (a.high >= 0.0) & (a.low <= activation.d)
        return Interval(inside / activation.d, touching / activation.d)
    low, high = (activation.derivatives(end)[2] for end in (a.low, a.high))
    top = activation.derivatives(np.zeros_like(low))[2]
    return Interval(np.minimum(low, high), np.where((a.low <= 0.0) & (a.high >= 0.0), top, np.maximum(low, high)))


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
