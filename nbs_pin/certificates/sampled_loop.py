"""The level that a loop with held torques keeps (docs/certificates.md §13).

Let ȳ be the mean of z2 at the two ends of a hold, and V' = Φ + ½z2ᵀ(M − ½hD₀)z2 at the instants. Then, over the hold,

    ΔV'/h ≤ −⟨x²⟩ − |ȳ|² − w² − n² + t√(|ȳ|² + d²) + gᵀQg,      g = (x, |ȳ|, w, n, 1),

with |·|² = ·ᵀD₀·, x = √⟨∇ΦᵀΛ∇Φ⟩, w² = ωȳᵀ⟨M⟩ȳ and n² the power of D − D₀. What happens during the hold is bounded by
rows that are linear in g (`hold.py`); d and Q are made of them (`_excess`) and vanish with h.
"""

import math
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from nbs_pin.certificates.hold import (
    ONE,
    Hold,
    N,
    Suprema,
    X,
    Y,
    begin,
    by_reading,
    changed,
    hold_of,
    inverse,
    lagging,
    mean_m,
    noisy,
    predicted,
    rows_in_g,
    slipped,
)
from nbs_pin.certificates.sampled_law import UP, SampledLaw

_ENLARGED = (1.1, 1.3, 1.6, 2.0, 3.0, 5.0)
"""Levels of Φ on which ∇²Φ is bounded, relative to the level at the instants."""
_LEAST = 1e-15
"""Level to begin with if there is no disturbance: holding the torque alone disturbs [J]."""
_MOST, _SMALL = 2.0, 1e-6
"""Largest levels tried where the ones below show nothing: relative to that in continuous time, and absolute [J]."""
_ROUNDS = 100
"""Levels that are tried, each a little above that which the one before tends to."""


class Kept(NamedTuple):
    """A level of V' that no hold leaves, and what else then holds; inf where none is found."""

    level: float
    """[J]."""
    potential: float
    """Largest Φ, also during the holds [J]."""
    seen: float
    """Largest Φ + ½z2ᵀM z2 of the states that the law is evaluated at [J]."""
    reached: float
    """Largest V' at the instants [J]: the level itself, unless it is that of V' with its history."""


_NOTHING = Kept(*(math.inf,) * 4)


def kept_level(loop: SampledLaw, least: float) -> Kept:
    """The least level found that V' tends to and that holds do not leave.

    least: V∞ of the loop in continuous time, or V of the start if that is larger.
    """
    kept = _after(loop, max(1.02 * least, _LEAST))
    for _ in range(_ROUNDS):
        if kept[1] <= kept[0].level:
            break
        # A level may be too small for what the reference alone does during a hold.
        larger = 1.02 * kept[1] if math.isfinite(kept[1]) else 4.0 * kept[0].level
        if not math.isfinite(kept[1]) and larger > max(_MOST * least, _SMALL):
            return _NOTHING
        kept = _after(loop, larger)
    if not kept[1] <= kept[0].level:
        return _NOTHING
    for _ in range(8):
        again = _after(loop, max(1.0005 * kept[1], least))
        if not again[1] <= again[0].level < kept[0].level:
            break
        kept = again
    return kept[0]


def _after(loop: SampledLaw, level: float) -> tuple[Kept, float]:
    """What holds while V' is within `level`, and the level that V' then tends to; inf if nothing follows."""
    for enlarged in _ENLARGED:
        hold = hold_of(loop, level, enlarged * level)
        if hold is not None:
            rate, gradient = hold.sups.rate, hold.sups.gradient
            bend = hold.curve.steepest * rate**2 + gradient * (hold.sups.acceleration + hold.turning * rate)
            reached, potential = begin(hold)
            potential += loop.h**2 / 8.0 * bend
            return Kept(level, potential * UP, _seen(hold), reached * UP), _limit(hold)
    return Kept(level, math.inf, math.inf, math.inf), math.inf


def _seen(b: Hold) -> float:
    """Φ + W of the predicted state: √Φ and √W change by at most half their slopes times the way to it."""
    k, times, late = b.loop.constants, b.loop.timing, predicted(b)
    # The reading may lie between two instants.
    apart = min(times.delay, b.loop.h - times.delay)
    moved = (b.loop.lead + apart) * b.sups.rate + b.late.position
    z2 = late[0] * b.sups.rate + late[1] + (times.blur + apart) * b.sups.acceleration + b.loop.noise.rate
    start = math.sqrt(begin(b).total / (1.0 - 0.5 * b.loop.h * k.nu))
    change = 0.5 * math.sqrt(b.curve.steepest * b.curve.growth) * moved
    return ((start + b.isk * z2 / math.sqrt(2.0)) * b.stretch + change) ** 2 * UP


class _Form:
    """A quadratic form in g with coefficients ≥ 0."""

    def __init__(self) -> None:
        self.matrix = np.zeros((5, 5))

    def add(self, factor: float, a: Float[np.ndarray, " 5"], b: Float[np.ndarray, " 5"]) -> None:
        """Adds factor·(aᵀg)(bᵀg)."""
        product = factor * np.outer(a, b)
        self.matrix += 0.5 * (product + product.T)


def _excess(
    b: Hold, sup: Suprema
) -> tuple[Float[np.ndarray, "5 5"], Float[np.ndarray, " 5"], Float[np.ndarray, "5 5"]]:
    """Q, d, and a bound of ½(V' at both ends) − the mean that decays, all in g."""
    k, curve, motion, h, arm = b.loop.constants, b.curve, b.loop.motion, b.loop.h, b.loop.arm
    snu, isk, swing, y_m = math.sqrt(k.nu) * b.stretch, b.isk, b.stretch**2, mean_m(b)
    force, rate, acceleration, acceleration_m = sup.force, sup.rate, sup.acceleration, sup.acceleration_m
    by_speed, here, by_speed_m, _, all_m, _ = b.coriolis
    turned = curve.centre * sup.rate_m + b.rest_m * rate
    phi_m = isk * motion.acceleration * ONE + turned
    v_dot = acceleration_m + phi_m
    # rate of the force without the disturbance, and the mean of z2 − ȳ that follows
    rate_rate = b.loop.loss_of_speed * curve.change * b.sups.rate
    bend_m = isk * (motion.jerk * ONE + rate_rate * rate) + curve.centre * (acceleration_m + turned)
    bend_m = bend_m + b.rest_m * (acceleration + b.turning * rate)
    changing = isk * bend_m + isk * swing * b.turn * phi_m + 2.0 * swing * by_speed_m * v_dot
    changing = changing + 2.0 * b.speed_1 * by_speed * (motion.speed * ONE + rate)
    changing = changing + arm.gravity * (motion.speed_1 * ONE + arm.sum * rate) + swing * b.turn * force
    changing = changing + b.loop.viscous * acceleration + b.loop.unfed_viscous * b.turning * rate
    drift, drift_m = k.nu * h * h / 12.0 * changing, snu * h * h / 12.0 * changing
    ripple, ripple_m = 0.5 * h * acceleration, 0.5 * h * acceleration_m
    q = _Form()
    lag, late = predicted(b)
    seen = lag * rate + late * ONE
    q.add(math.sqrt(b.share), N, ripple + b.loop.timing.age * acceleration + seen + b.loop.noise.rate * ONE)
    q.add(k.omega, y_m, drift_m)
    q.add(k.omega * swing * b.turn * h / 4.0, y_m, ripple_m)
    q.add(1.0, sup.gradient, drift)
    q.add(curve.steepest * h / 4.0, rate, ripple)
    q.add(swing * all_m, y_m, drift_m)
    q.add(h / 4.0 * 1.5 * arm.turn * swing * b.sups.speed_m, ripple_m, v_dot)
    q.add(h / 4.0 * 2.0 * b.speed_1 * by_speed, Y, ripple)
    q.add(0.125 * h * h * b.turn * swing, acceleration_m, acceleration_m)
    q.add((1.0 - k.coupling) / math.sqrt(k.delta) + b.loop.alpha, Y, X)
    q.add(b.loop.viscous, Y, drift)
    _add_held(b, sup, q, turned, v_dot, seen)
    spread = h / math.sqrt(12.0) * (k.nu * (sup.gradient + (here + b.loop.viscous) * Y) + k.omega * Y)
    spread = spread + h * b.loop.timing.unevenness * k.nu * Y
    _add_fed(b, sup, spread, q)
    ends = _Form()
    ends.add(h * h / 12.0 * curve.steepest, rate, rate)
    ends.add(h * h / 12.0, sup.gradient, acceleration + b.turning * rate)
    ends.add(0.125 * h * h, acceleration_m, acceleration_m)
    ends.add(0.25 * b.turn * h * h, y_m, acceleration_m)
    ends.add(0.5 * b.turn * h * swing, y_m, y_m)
    _add_past(b, sup, drift, q, ends)
    past = b.loop.past
    return past**2 * q.matrix, past * spread, past**2 * ends.matrix


def _add_fed(b: Hold, sup: Suprema, spread: Float[np.ndarray, " 5"], q: _Form) -> None:
    """Adds ȳᵀ⟨f̂(φ̂) − f̂(φ)⟩, the power of f̂(φ) − f(v), and what both move z2 by beside ȳ."""
    fed, times = b.loop.fed, b.loop.timing
    mean, most = (slipped(b, time, sup.rate, sup.acceleration, ONE) for time in (times.mean, times.half))
    # ĉ tanh changes by its slope times the way, and by no more than 2ĉ.
    steep = fed.slope * slipped(b, times.mean, b.sups.rate, b.sups.acceleration, 1.0)
    flat = fed.viscous * slipped(b, times.mean, b.sups.rate, b.sups.acceleration, 1.0) + fed.jump
    q.add(1.0, Y, fed.slope * mean if steep < flat else fed.viscous * mean + fed.jump * ONE)
    q.add(0.5 * b.loop.h * fed.jump, sup.acceleration, ONE)
    q.add(1.0, spread, fed.viscous * most + fed.jump * ONE)
    q.add(fed.power, ONE, ONE)


def _add_past(b: Hold, sup: Suprema, drift: Float[np.ndarray, " 5"], q: _Form, ends: _Form) -> None:
    """Adds what a damper that reads late and with noise leaves besides exact changes of V'."""
    k, h, times, noise = b.loop.constants, b.loop.h, b.loop.timing, b.loop.noise
    linear, y_m = b.curve.centre + k.omega, mean_m(b)
    q.add(h * times.backlog, sup.acceleration, sup.acceleration)
    q.add(math.sqrt(12.0) * times.unevenness, Y, drift)
    slow = b.stretch**2 * b.coriolis.slow * noise.reading_m
    if b.coriolis.slow_form < b.coriolis.slow * math.sqrt(k.nu):
        q.add(b.stretch**2 * b.coriolis.slow_form * noise.reading_m, sup.acceleration_m, ONE)
    else:
        q.add(slow, sup.acceleration, ONE)
    q.add(noise.reading, sup.acceleration + linear * inverse(b) * sup.force, ONE)
    q.add(linear * b.stretch**2 * b.turn * noise.reading_m, y_m, ONE)
    ends.add(h * times.backlog, Y, sup.acceleration)
    ends.add(noise.reading + slow, Y, ONE)
    ends.add(linear * noise.reading_m, y_m, ONE)


def _add_held(
    b: Hold,
    sup: Suprema,
    q: _Form,
    turned: Float[np.ndarray, " 5"],
    v_dot: Float[np.ndarray, " 5"],
    seen: Float[np.ndarray, " 5"],
) -> None:
    """Adds ȳᵀ⟨e⟩: the law at the predicted state against the law along the hold."""
    k, curve, motion, arm = b.loop.constants, b.curve, b.loop.motion, b.loop.arm
    times, noise = b.loop.timing, b.loop.noise
    isk, swing, y_m, omega = b.isk, b.stretch**2, mean_m(b), k.omega
    by_speed, _, by_speed_m, slow, _, _ = b.coriolis
    rate, far = sup.rate, times.period + times.age
    (angle, sum_1), farthest = lagging(b, times.mean), lagging(b, times.half)[1]
    acceleration = sup.acceleration + b.turning * rate
    # ∇Φ: its part cΛ⁻¹z1 has no lag on average if the law is evaluated for the middle of the hold
    linear = curve.centre / k.delta * k.coupling
    uneven = abs(0.5 * times.period - times.ahead) * linear + times.mean * curve.rest
    bowed = times.mean_bow * acceleration + b.late.position * ONE
    q.add(1.0, Y, uneven * rate + (linear + curve.rest) * bowed + seen)
    # M(φ̇ − ωz2)
    q.add((far - 0.5 * times.period) * (curve.centre + omega) * inverse(b), Y, sup.force)
    change = isk * changed(b, times.half)
    rest = curve.centre * turned + b.rest_m * acceleration
    rest = (far - 0.5 * times.period) * rest + change * rate
    late = ((curve.centre * isk + b.rest_m + change) * b.late.rate + noisy(b)) * ONE
    q.add(1.0, y_m, rest + omega * isk * seen + late)
    twice = 2.0 * rest + (curve.centre + omega) * far * sup.acceleration_m + turned + omega * (sup.speed_m + isk * seen)
    late = late + (isk * motion.acceleration + (curve.centre + omega) * noise.rate_m) * ONE
    q.add(swing * angle, y_m, twice + late)
    q.add(isk * motion.jerk * times.half, y_m, ONE)
    # gravity and C(q, v)φ
    bend = times.bow * (acceleration + motion.acceleration * ONE)
    bend = bend + (0.5 * b.loop.lead**2 * motion.acceleration + noise.position) * ONE
    q.add(arm.gravity, Y, times.mean * (motion.speed_1 * ONE + arm.sum * rate) + arm.sum * bend)
    q.add(swing * slow, Y, (far - 0.5 * times.period) * v_dot + b.loop.lead * isk * motion.acceleration * ONE)
    turn_m = turned + isk * motion.acceleration * ONE
    second = times.bow * (curve.centre * (sup.acceleration_m + turned) + b.rest_m * acceleration)
    second = second + (curve.centre * isk + b.rest_m) * b.late.position * ONE
    q.add(swing * by_speed_m, Y, times.mean * turn_m + second)
    # What C(q̂, φ̂) differs by from hold to hold, times the error of a reading
    q.add(4.0 / times.period * farthest * swing * slow * noise.reading_m, Y, ONE)
    q.add(2.0 / times.period * swing * by_reading(b), Y, times.half * turn_m + second)
    slowest = (
        motion.speed * ONE
        + math.sqrt(b.loop.loss_of_speed) * sup.loss
        + b.turning * (times.half * rate + bend + b.late.position * ONE)
    )
    q.add(2.0 * sum_1 * by_speed, Y, slowest)


def _limit(b: Hold) -> float:
    """The least level found that V' tends to [J]; inf if there is none."""
    rows = rows_in_g(b)
    if rows is None:
        return math.inf
    k, t = b.loop.constants, b.loop.t
    excess, spread, ends = _excess(b, rows)
    most = 2.0 / b.loop.h if b.loop.timing.holds == 0 else min(2.0 / b.loop.h, 1.000001 * b.loop.fastest)

    def levels(choices: Float[np.ndarray, "many k"]) -> Float[np.ndarray, " many"]:
        """From t√(y² + d²) ≤ s(y² + d²) + t²/4s, a rate c of V', and the share of y² in W."""
        s, c = choices[:, 0], choices[:, 1]
        share = choices[:, 2] if k.omega > 0.0 else np.ones(len(s))
        form = np.zeros((len(s), 5, 5))
        form[:, 0, 0], form[:, 1, 1] = 1.0 - c / (2.0 * k.rho), 1.0 - s - c * share / (2.0 * k.kappa)
        form[:, 2, 2] = 1.0 - (c * (1.0 - share) / (2.0 * k.omega) if k.omega > 0.0 else 0.0)
        form[:, 3, 3] = 1.0
        form -= excess + c[:, None, None] * ends + s[:, None, None] * np.outer(spread, spread)
        found, allowed = np.full(len(s), math.inf), (s > 0.0) & (s <= 1.0) & (c > 0.0) & (c < most)
        some = np.flatnonzero(allowed & (share >= 0.0) & (share <= 1.0))
        some = some[np.linalg.eigvalsh(form[some, :4, :4])[:, 0] > 1e-9]
        free = form[some, :4, 4]
        gain = (free * np.linalg.solve(form[some, :4, :4], free[..., None])[..., 0]).sum(axis=-1)
        found[some] = (t * t / (4.0 * s[some]) - form[some, 4, 4] + gain) / c[some]
        return found

    rates = b.loop.fastest * np.linspace(0.04, 1.0, 25)
    # Without ω only y² bounds W, so its share is 1.
    grid = np.array([(*x, 0.0) for x in product(np.linspace(0.1, 1.0, 19), rates)])[:, : 3 if k.omega > 0.0 else 2]
    tried = levels(grid)
    best = int(np.argmin(tried))
    if not math.isfinite(tried[best]):
        return math.inf
    found = minimize(
        lambda x: min(float(levels(x[None])[0]), 1e300),
        grid[best],
        method="Nelder-Mead",
        options={"xatol": 1e-4, "fatol": 1e-8},
    )
    return min(float(tried[best]), float(levels(found.x[None])[0])) * UP
