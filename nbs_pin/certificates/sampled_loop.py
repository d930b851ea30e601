"""The level that a loop with held torques keeps, in place of V∞ of the loop in continuous time (docs/certificates.md §12).

Let ȳ be the mean of z2 at the two ends of a hold, and V' = Φ + ½z2ᵀ(M − ½hD₀)z2 at the instants. Then, over the hold,

    ΔV'/h ≤ −⟨x²⟩ − |ȳ|² − w² − n² + t√(|ȳ|² + b²) + gᵀQg,      g = (x, |ȳ|, w, n, 1),

with |·|² = ·ᵀD₀·, x = √⟨∇ΦᵀΛ∇Φ⟩, w² = ωȳᵀ⟨M⟩ȳ and n² the power of D − D₀. What happens during the hold is bounded by
rows that are linear in g (`_suprema`); b and Q are made of them (`_excess`) and vanish with h.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from nbs_pin.base.rounding import largest_eigenvalue, least_eigenvalue
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.coriolis import CoriolisBounds, MotionBounds
from nbs_pin.controllers.lyapunov_law import LyapunovLaw

_ENLARGED = (1.1, 1.3, 1.6, 2.0, 3.0, 5.0)
"""Levels of Φ on which ∇²Φ is bounded, relative to the level at the instants."""
_MOST = 30.0
"""Largest level that is tried, relative to that in continuous time."""
_UP = 1.0 + 1e-9
X, Y, W, N, ONE = np.eye(5)


@dataclass(frozen=True, eq=False)
class SampledLaw:
    """What the proof needs of law, arm, reference and disturbance."""

    law: LyapunovLaw
    constants: Constants
    arm: CoriolisBounds
    motion: MotionBounds
    t: float
    """√Δ, with friction as a disturbance."""
    alpha: float
    """α of friction, docs/certificates.md §8."""
    viscous: float
    """Largest share of D₀ that is viscous friction of the joints, which is not held."""
    h: float
    """Period [s]."""
    lead: float
    """Look-ahead [s]."""

    @cached_property
    def root(self) -> Float[np.ndarray, "n n"]:
        """D₀^-½."""
        values, vectors = np.linalg.eigh(self.constants.floor)
        return np.asarray((vectors / np.sqrt(values)) @ vectors.T)

    @cached_property
    def loss_of_speed(self) -> float:
        """λ_max(Λ^½D₀Λ^½): |Λf|² ≤ loss_of_speed·fᵀΛf."""
        rate = np.sqrt(self.constants.rate)
        return largest_eigenvalue(rate[:, None] * self.constants.floor * rate)


class Curvature(NamedTuple):
    """∇²Φ = cΛ⁻¹ + Ψ on a set of z1."""

    centre: float
    """c [1/s]."""
    steepest: float
    """λ_max(D₀^-½∇²ΦD₀^-½)."""
    growth: float
    """a with z1ᵀ∇Φ ≤ aΦ."""
    loss: float
    """λ_max(Λ^½∇²ΦΛ^½)."""
    rest: float
    """‖D₀^-½ΨD₀^-½‖."""
    rest_loss: float
    """‖Λ^½ΨΛ^½‖."""
    change: float
    """|D₀^-½(∇²Φ(z) − ∇²Φ(z'))D₀^-½| ≤ change·|z − z'|."""

    @classmethod
    def of(cls, loop: SampledLaw, potential: float) -> "Curvature":
        """The bounds where z1ᵀSz1 ≤ potential."""
        k, root, rate = loop.constants, loop.root, np.sqrt(loop.constants.rate)
        radii = np.sqrt(potential / np.diag(k.stiffness))
        low, high = loop.law.stiffness_range(radii)
        if not np.isfinite(high).all():
            return cls(*np.full(7, np.inf))
        losses = least_eigenvalue(rate[:, None] * low * rate), largest_eigenvalue(rate[:, None] * high * rate)
        centre, shape = 0.5 * (losses[0] + losses[1]), np.linalg.inv(np.linalg.cholesky(k.stiffness))
        middle = centre * np.diag(1.0 / k.rate)
        above, below = largest_eigenvalue(root @ (high - middle) @ root), least_eigenvalue(root @ (low - middle) @ root)
        scaled = k.floor / np.sqrt(np.diag(k.floor)) / np.sqrt(np.diag(k.floor))[:, None]
        return cls(
            centre=centre,
            steepest=largest_eigenvalue(root @ high @ root),
            growth=largest_eigenvalue(shape @ high @ shape.T),
            loss=losses[1],
            rest=max(above, -below),
            rest_loss=0.5 * (losses[1] - losses[0]),
            change=loop.law.stiffness_rate(radii, np.diag(k.floor) * least_eigenvalue(scaled)),
        )


class Suprema(NamedTuple):
    """Suprema over the hold: numbers, or rows that are linear in g."""

    gradient: Any
    """|∇Φ|_*."""
    loss: Any
    """√(∇ΦᵀΛ∇Φ)."""
    speed: Any
    """|z2|."""
    speed_m: Any
    """|z2|_M."""
    rate: Any
    """|ż1|."""
    rate_m: Any
    """|ż1|_M."""
    force: Any
    """|Mż2|_*."""


def kept_level(loop: SampledLaw, least: float) -> tuple[float, float]:
    """The least level of V' found that holds do not leave, and the largest Φ during them [J]; inf if none is found.

    least: V∞ of the loop in continuous time, or V of the start if that is larger.
    """
    level = 1.02 * least
    found = _after(loop, level)
    while not found[0] <= level:
        level = 1.02 * found[0]
        if not level <= _MOST * least:
            return math.inf, math.inf
        found = _after(loop, level)
    for _ in range(8):
        smaller = max(1.0005 * found[0], least)
        again = _after(loop, smaller)
        if not again[0] <= smaller < level:
            break
        level, found = smaller, again
    return level, found[1]


def _after(loop: SampledLaw, level: float) -> tuple[float, float]:
    """The level that V' tends to while it is within `level`, and the largest Φ; inf if nothing follows."""
    for enlarged in _ENLARGED:
        hold = _hold(loop, level, enlarged * level)
        if hold is not None:
            rate, force, gradient = hold.sups.rate, hold.sups.force, hold.sups.gradient
            bend = hold.curve.steepest * rate**2 + gradient * (loop.constants.nu * force + hold.turning * rate)
            return _limit(hold), (level + loop.h**2 / 8.0 * bend) * _UP
    return math.inf, math.inf


@dataclass(frozen=True, eq=False)
class Hold:
    """A hold that begins in {V' ≤ level}, by numbers that bound it whatever it does."""

    loop: SampledLaw
    level: float
    curve: Curvature
    sups: Suprema

    isk: float
    """1/√κ: |x|_M ≤ isk·|x|."""
    turning: float
    """|Λ∇²Φb| ≤ turning·|b| [1/s]."""
    rest_m: float
    """|ΛΨb|_M ≤ rest_m·|b|."""
    rest_f: float
    """|ΛΨM⁻¹f|_M ≤ rest_f·|f|_*."""
    late: tuple[float, float]
    """What the reference's jerk adds to the predicted z1 and ż1, in |·|."""
    turn: float
    """Σ γ_i|v_i| [1/s]."""
    speed: float
    """|v|."""
    speed_m: float
    """|v|_M."""
    speed_1: float
    """Σ |v_i| [rad/s]."""
    stretch: float
    """√ of the largest ratio of xᵀMx between two poses of the hold and its prediction."""
    half: float
    """Longest time between an instant of the hold and that for which the law was evaluated [s]."""
    mean: float
    """Its mean over the hold [s]."""
    bent: tuple[float, float, float]
    """What accelerations add to q̂ − q: in |·|, in |·|_M and in Σ|·_i|."""
    share: float
    """D(z2) ⪯ (1 + share)D₀."""
    held: tuple[float, float, float, float]
    """Of C: |C(v)z|_* by |z| and by |z|_M; |C(φ)b|_* by |b|_M; aᵀC(v)b by |a|_M|b|_M."""


def _hold(loop: SampledLaw, level: float, potential: float) -> Hold | None:
    """The hold, with ∇²Φ bounded where z1ᵀSz1 ≤ potential; None if z1 may leave that set, or nothing follows."""
    k = loop.constants
    if not (math.isfinite(loop.arm.turn) and loop.h * k.nu < 1.0 and k.kappa > 0.0):
        return None
    curve = Curvature.of(loop, potential)
    if not np.isfinite(curve).all():
        return None
    sups = Suprema(*np.zeros(7))
    for _ in range(100):
        hold = _numbers(loop, level, curve, sups)
        found = _first(hold) if hold is not None else None
        if hold is None or found is None:
            return None
        if all(x <= y for x, y in zip(found, sups, strict=True)):
            stiffness = largest_eigenvalue(loop.root @ k.stiffness @ loop.root)
            farthest = math.sqrt(stiffness) * ((loop.h + loop.lead) * sups.rate + hold.late[0])
            return hold if math.sqrt(level) + farthest <= math.sqrt(potential) else None
        sups = Suprema(*(x * (1.0 + 1e-6) for x in found))
    return None


def _numbers(loop: SampledLaw, level: float, curve: Curvature, sups: Suprema) -> Hold | None:
    """The numbers of a hold whose suprema are bounded by `sups`; None if M may change too much in one hold."""
    k, arm, motion, h, lead = loop.constants, loop.arm, loop.motion, loop.h, loop.lead
    isk, snu = 1.0 / math.sqrt(k.kappa), math.sqrt(k.nu)
    rest = loop.loss_of_speed * curve.rest
    rest_m = min(isk * rest, arm.loss_m * curve.rest_loss / math.sqrt(k.delta))
    rest_f = min(isk * rest * k.nu, arm.loss_m * curve.rest_loss * arm.loss_inverse * snu)
    turning = curve.centre + rest
    turn = motion.turn + arm.turn * sups.rate_m
    exponent = 2.0 * turn * (h + lead)
    if exponent > 1.0:
        return None
    stretch = math.exp(0.5 * exponent)
    moved = k.nu * sups.force + turning * sups.rate + motion.acceleration
    moved_m = snu * stretch * sups.force + curve.centre * sups.rate_m + rest_m * sups.rate + isk * motion.acceleration
    bend = 0.5 * lead**2 * motion.acceleration
    speed, speed_m = motion.speed + sups.rate, isk * motion.speed + sups.rate_m
    loss = sups.loss + math.sqrt(loop.loss_of_speed) * curve.steepest * (h + lead) * sups.rate
    lag, late = turning * lead, turning * lead**3 / 6.0 * motion.jerk + lead**2 / 2.0 * motion.jerk
    share = loop.law.damping_share((sups.speed + lag * sups.rate + late) * _UP)
    if not math.isfinite(share):
        return None
    slow, slow_m = motion.speed + math.sqrt(loop.loss_of_speed) * loss, isk * motion.speed + arm.loss_m * loss
    turned = motion.turn_d + min(arm.turn_d * sups.rate_m, arm.spread_d * sups.rate)
    mixed = min(arm.turn_d, arm.spread_d * snu)
    held = (
        0.5 * (turned + 2.0 * arm.spread_d * speed),
        0.5 * (isk * (motion.turn + min(arm.turn * sups.rate_m, arm.spread * sups.rate)) + mixed * speed + arm.spread * speed_m),
        0.5 * (isk * (motion.turn + min(arm.turn * arm.loss_m, arm.spread * math.sqrt(loop.loss_of_speed)) * loss)
               + mixed * slow + arm.spread * slow_m),
        0.5 * (turn + 2.0 * arm.turn * speed_m),
    )  # fmt: skip
    return Hold(
        loop=loop,
        level=level,
        curve=curve,
        sups=sups,
        isk=isk,
        turning=turning,
        rest_m=rest_m,
        rest_f=rest_f,
        late=(lead**3 / 6.0 * motion.jerk, lead**2 / 2.0 * motion.jerk),
        turn=turn,
        speed=speed,
        speed_m=speed_m,
        speed_1=motion.speed_1 + min(arm.sum_m * sups.rate_m, arm.sum * sups.rate),
        stretch=stretch,
        half=max(lead, h - lead),
        mean=(0.5 * h * h - h * lead + lead * lead) / h if lead <= h else lead - 0.5 * h,
        bent=(
            0.5 * h * h * moved + bend,
            0.5 * h * h * moved_m + isk * bend,
            arm.sum * (0.5 * h * h * moved + bend),
        ),
        share=share,
        held=held,
    )


def _predicted(b: Hold) -> tuple[float, float]:
    """|ẑ2 − z2| at the start of the hold, for the predicted ẑ2: by |ż1|, and constant."""
    return b.turning * b.loop.lead, b.turning * b.late[0] + b.late[1]


def _lagging(b: Hold, time: float) -> tuple[float, float]:
    """What joints turn between q and q̂, in Σ γ_i|·_i| and in Σ |·_i|, for a bound of |t − t̂| or its mean."""
    arm = b.loop.arm
    return time * b.turn + arm.turn * b.bent[1], time * b.speed_1 + b.bent[2]


def _changed(b: Hold, time: float) -> float:
    """|Λ(∇²Φ(ẑ1) − ∇²Φ(z1))| by which ż1 is multiplied, for a bound of |t − t̂|."""
    rest = 2.0 * (b.turning - b.curve.centre)
    return min(rest, b.loop.loss_of_speed * b.curve.change * (time * b.sups.rate + b.bent[0] + b.late[0]))


def _force(b: Hold) -> tuple[Float[np.ndarray, " 7"], float]:
    """|Mż2|_* without the damping that is held: by the suprema, and constant."""
    k, curve, motion, h = b.loop.constants, b.curve, b.loop.motion, b.loop.h
    G, L, S, SM, R, RM, F = np.eye(7)
    snu, omega, isk, swing = math.sqrt(k.nu) * b.stretch, k.omega, b.isk, b.stretch**2
    angle, sum_1 = _lagging(b, b.half)
    lag, late = _predicted(b)
    # ∇Φ and the damping at the predicted state
    row = G + curve.steepest * (b.half * R + 0.5 * h * h * (k.nu * F + b.turning * R)) + lag * R
    constant = b.loop.t + curve.steepest * b.late[0] + late
    # −ωM z2, and M times the change of φ̇ − ωz2
    turned = curve.centre * RM + b.rest_m * R
    change = isk * _changed(b, b.half)
    rest = h * curve.centre * turned + h * (b.rest_f * F + b.rest_m * b.turning * R) + change * R + omega * isk * lag * R
    extra = (curve.centre * isk + b.rest_m) * b.late[1] + change * b.late[1] + omega * isk * late
    inverse = 1.0 + swing * b.turn * h * isk * snu
    row = row + omega * isk * SM + inverse * (curve.centre + omega) * h * F + isk * rest
    constant += isk * extra
    # (M(q̂) − M(q)) times φ̇ − ωz2, a_d included, gravity, and the reference between the instants
    all_m = turned + omega * SM + rest + (curve.centre + omega) * h * snu * F
    row = row + isk * swing * angle * all_m
    constant += isk * (swing * angle * (extra + isk * motion.acceleration) + isk * motion.jerk * b.half)
    constant += b.loop.arm.gravity * sum_1
    # −C z2, and the change of C(q, v)φ
    by_speed, by_speed_m, slow, _ = b.held
    row = row + (by_speed + b.loop.viscous) * S + b.loop.alpha * L + swing * slow * h * (snu * F + turned)
    constant += swing * isk * motion.acceleration * (slow * (h + b.loop.lead) + by_speed_m * b.half)
    row = row + swing * by_speed_m * (b.half * turned + 0.5 * h * h * (curve.centre * (snu * F + turned) + b.rest_f * F))
    row = row + 2.0 * sum_1 * by_speed * math.sqrt(b.loop.loss_of_speed) * L
    return row, constant + 2.0 * sum_1 * by_speed * (motion.speed + b.turning * b.late[0])


def _first(b: Hold) -> Suprema | None:
    """The suprema as numbers, from the state at the start of the hold; None if they do not follow."""
    k, curve, h = b.loop.constants, b.curve, b.loop.h
    left, snu = 1.0 - 0.5 * h * k.nu, math.sqrt(k.nu) * b.stretch
    gradient, loss = (math.sqrt(x * curve.growth * b.level) for x in (curve.steepest, curve.loss))
    speed, speed_m = math.sqrt(2.0 * k.nu / left * b.level), math.sqrt(2.0 / left * b.level)
    rate = math.hypot(speed, math.sqrt(b.loop.loss_of_speed) * loss)
    rate_m = math.hypot(speed_m, b.loop.arm.loss_m * loss)
    rows, (force, constant) = np.zeros((7, 7)), _force(b)
    rows[0, 4], rows[1, 4] = curve.steepest * h, math.sqrt(b.loop.loss_of_speed) * curve.steepest * h
    rows[2, 6], rows[3, 6] = h * k.nu, h * snu
    rows[4, 6], rows[4, 4] = h * k.nu, h * b.turning
    rows[5, 6], rows[5, 5], rows[5, 4] = h * snu, h * curve.centre * b.stretch, h * b.rest_m * b.stretch
    lag, late = _predicted(b)
    rows[6] = force + b.share * lag * np.eye(7)[4]
    base = [gradient, loss, speed, b.stretch * speed_m, rate, b.stretch * rate_m]
    return _solved(rows, np.array([*base, speed * (1.0 + b.share) + b.share * late + constant]))


def _rows(b: Hold) -> Suprema | None:
    """The suprema as rows in g."""
    k, curve, h = b.loop.constants, b.curve, b.loop.h
    snu = math.sqrt(k.nu) * b.stretch
    rows, (force, constant) = np.zeros((7, 7)), _force(b)
    rows[0, 4], rows[1, 4] = curve.steepest * h, math.sqrt(b.loop.loss_of_speed) * curve.steepest * h
    rows[2, 6], rows[3, 6] = 0.5 * h * k.nu, 0.5 * h * snu
    rows[4, 2], rows[4, 1] = 1.0, math.sqrt(b.loop.loss_of_speed)
    rows[5, 3], rows[5, 1] = 1.0, b.loop.arm.loss_m
    rows[6] = force
    rows[6, 6] += 0.5 * h * k.nu
    zero = 0.0 * X
    base = [X / math.sqrt(k.delta), X, Y, _mean_m(b), zero, zero, Y + math.sqrt(b.share) * N + constant * ONE]
    return _solved(rows, np.array(base))


def _mean_m(b: Hold) -> Float[np.ndarray, " 5"]:
    """|ȳ|_M in every pose of the hold."""
    omega = b.loop.constants.omega
    return b.stretch * (W / math.sqrt(omega) if omega > 0.0 else b.isk * Y)


def _solved(rows: Float[np.ndarray, "7 7"], base: Float[np.ndarray, "7 *g"]) -> Suprema | None:
    """The least x ≥ 0 with x ≥ rows x + base, None if there is none."""
    if not (np.isfinite(rows).all() and np.abs(np.linalg.eigvals(rows)).max() < 0.999):
        return None
    return Suprema(*(np.linalg.solve(np.eye(7) - rows, base) * _UP))


class _Form:
    """A quadratic form in g with coefficients ≥ 0."""

    def __init__(self) -> None:
        self.matrix = np.zeros((5, 5))

    def add(self, factor: float, a: Float[np.ndarray, " 5"], b: Float[np.ndarray, " 5"]) -> None:
        """Adds factor·(aᵀg)(bᵀg)."""
        product = factor * np.outer(a, b)
        self.matrix += 0.5 * (product + product.T)


def _excess(b: Hold, sup: Suprema) -> tuple[Float[np.ndarray, "5 5"], Float[np.ndarray, " 5"], Float[np.ndarray, "5 5"]]:
    """Q, b, and a bound of ½(V' at both ends) − the mean that decays, all in g."""
    k, curve, motion, h, arm = b.loop.constants, b.curve, b.loop.motion, b.loop.h, b.loop.arm
    snu, isk, swing, y_m = math.sqrt(k.nu) * b.stretch, b.isk, b.stretch**2, _mean_m(b)
    force, rate = sup.force, sup.rate
    by_speed, by_speed_m, slow, all_m = b.held
    turned = curve.centre * sup.rate_m + b.rest_m * rate
    phi_m = isk * motion.acceleration * ONE + turned
    v_dot = snu * force + phi_m
    # rate of the force without the disturbance, and the mean of z2 − ȳ that follows
    rate_rate = b.loop.loss_of_speed * curve.change * b.sups.rate
    bend_m = isk * (motion.jerk * ONE + rate_rate * rate) + curve.centre * (snu * force + turned)
    bend_m = bend_m + b.rest_f * force + b.rest_m * b.turning * rate
    changing = isk * bend_m + isk * swing * b.turn * phi_m + 2.0 * swing * by_speed_m * v_dot
    changing = changing + 2.0 * b.speed_1 * by_speed * (motion.speed * ONE + rate)
    changing = changing + arm.gravity * (motion.speed_1 * ONE + arm.sum * rate) + swing * b.turn * force
    changing = changing + b.loop.viscous * k.nu * force
    drift, drift_m = k.nu * h * h / 12.0 * changing, snu * h * h / 12.0 * changing
    ripple, ripple_m = 0.5 * h * k.nu * force, 0.5 * h * snu * force
    q = _Form()
    lag, late = _predicted(b)
    seen = lag * rate + late * ONE
    q.add(math.sqrt(b.share), N, ripple + seen)
    q.add(k.omega, y_m, drift_m)
    q.add(k.omega * swing * b.turn * h / 4.0, y_m, ripple_m)
    q.add(1.0, sup.gradient, drift)
    q.add(curve.steepest * h / 4.0, rate, ripple)
    q.add(swing * all_m, y_m, drift_m)
    q.add(h / 4.0 * 1.5 * arm.turn * swing * b.sups.speed_m, ripple_m, v_dot)
    q.add(h / 4.0 * 2.0 * b.speed_1 * by_speed, Y, ripple)
    q.add(0.125 * h * h * k.nu * b.turn * swing**2, force, force)
    q.add((1.0 - k.coupling) / math.sqrt(k.delta) + b.loop.alpha, Y, X)
    q.add(b.loop.viscous, Y, drift)
    _add_held(b, sup, q, turned, v_dot, seen)
    spread = h / math.sqrt(12.0) * (k.nu * (sup.gradient + by_speed * Y) + k.omega * Y)
    ends = _Form()
    ends.add(h * h / 12.0 * curve.steepest, rate, rate)
    ends.add(h * h / 12.0, sup.gradient, k.nu * force + b.turning * rate)
    ends.add(0.125 * h * h * k.nu * swing, force, force)
    ends.add(0.25 * b.turn * h * h * snu, y_m, force)
    ends.add(0.5 * b.turn * h * swing, y_m, y_m)
    return q.matrix, spread, ends.matrix


def _add_held(
    b: Hold,
    sup: Suprema,
    q: _Form,
    turned: Float[np.ndarray, " 5"],
    v_dot: Float[np.ndarray, " 5"],
    seen: Float[np.ndarray, " 5"],
) -> None:
    """Adds ȳᵀ⟨e⟩: the law at the predicted state against the law along the hold."""
    k, curve, motion, h, arm = b.loop.constants, b.curve, b.loop.motion, b.loop.h, b.loop.arm
    snu, isk, swing, y_m, omega = math.sqrt(k.nu) * b.stretch, b.isk, b.stretch**2, _mean_m(b), k.omega
    by_speed, by_speed_m, slow, _ = b.held
    force, rate = sup.force, sup.rate
    angle, sum_1 = _lagging(b, b.mean)
    acceleration = k.nu * force + b.turning * rate
    # ∇Φ: its part cΛ⁻¹z1 has no lag on average if the law looks half a period ahead
    linear = curve.centre / k.delta * k.coupling
    uneven = abs(0.5 * h - b.loop.lead) * linear + b.mean * curve.rest
    q.add(1.0, Y, uneven * rate + (linear + curve.rest) * (h * h / 6.0 * acceleration + b.late[0] * ONE) + seen)
    # M(φ̇ − ωz2)
    inverse = 1.0 + swing * b.turn * h * isk * snu
    q.add(0.5 * h * (curve.centre + omega) * inverse, Y, force)
    change = isk * _changed(b, b.half)
    rest = 0.5 * h * (curve.centre * turned + b.rest_f * force + b.rest_m * b.turning * rate) + change * rate
    q.add(1.0, y_m, rest + omega * isk * seen + ((curve.centre * isk + b.rest_m + change) * b.late[1]) * ONE)
    twice = 2.0 * rest + (curve.centre + omega) * h * snu * force + turned + omega * sup.speed_m + omega * isk * seen
    q.add(swing * angle, y_m, twice + (isk * motion.acceleration + (curve.centre * isk + b.rest_m) * b.late[1]) * ONE)
    q.add(isk * motion.jerk * b.half, y_m, ONE)
    # gravity and C(q, v)φ
    bend = 0.5 * h * h * (acceleration + motion.acceleration * ONE) + 0.5 * b.loop.lead**2 * motion.acceleration * ONE
    q.add(arm.gravity, Y, b.mean * (motion.speed_1 * ONE + arm.sum * rate) + arm.sum * bend)
    q.add(swing * slow, Y, 0.5 * h * v_dot + b.loop.lead * isk * motion.acceleration * ONE)
    turn_m = b.mean * (turned + isk * motion.acceleration * ONE)
    second = 0.5 * h * h * (curve.centre * (snu * force + turned) + b.rest_f * force + b.rest_m * b.turning * rate)
    q.add(swing * by_speed_m, Y, turn_m + second + (curve.centre * isk + b.rest_m) * b.late[0] * ONE)
    slowest = motion.speed * ONE + math.sqrt(b.loop.loss_of_speed) * sup.loss + b.turning * (b.half * rate + bend + b.late[0] * ONE)
    q.add(2.0 * sum_1 * by_speed, Y, slowest)


def _limit(b: Hold) -> float:
    """The least level found that V' tends to [J]; inf if there is none."""
    rows = _rows(b)
    if rows is None:
        return math.inf
    k, t = b.loop.constants, b.loop.t
    excess, spread, ends = _excess(b, rows)

    def level(choice: Float[np.ndarray, " 3"]) -> float:
        """From t√(y² + b²) ≤ s(y² + b²) + t²/4s, a rate c of V', and the share of y² in W."""
        s, c, share = choice.tolist()
        if not (0.0 < s <= 1.0 and 0.0 < c < 2.0 / b.loop.h and 0.0 <= share <= 1.0):
            return math.inf
        form = np.diag([1.0 - c / (2.0 * k.rho), 1.0 - s - c * share / (2.0 * k.kappa), 1.0, 1.0, 0.0])
        form[2, 2] -= c * (1.0 - share) / (2.0 * k.omega) if k.omega > 0.0 else 0.0
        form -= excess + c * ends + s * np.outer(spread, spread)
        if np.linalg.eigvalsh(form[:4, :4])[0] <= 1e-9:
            return math.inf
        free = form[:4, 4]
        return float((t * t / (4.0 * s) - form[4, 4] + free @ np.linalg.solve(form[:4, :4], free)) / c)

    fastest = 2.0 * min(k.rho, k.omega + k.kappa)
    shares = (0.0, 0.3) if k.omega > 0.0 else (1.0,)
    tried = [np.array(x) for x in product(np.linspace(0.2, 1.0, 9), fastest * np.linspace(0.1, 1.0, 13), shares)]
    best = min(tried, key=level)
    if not math.isfinite(level(best)):
        return math.inf
    found = minimize(lambda x: min(level(x), 1e300), best, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-8})
    return min(level(best), level(found.x)) * _UP
