"""What can happen while a torque is held for a period, linear in g = (x, |ȳ|, w, n, 1) (docs/certificates.md §13).

Norms: |b| = √(bᵀD₀b) for velocities, |f|_* = √(fᵀD₀⁻¹f) for torques, |b|_M = √(bᵀMb).
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.rounding import diagonal_below, largest_eigenvalue, least_eigenvalue
from nbs_pin.certificates.constants import Constants
from nbs_pin.certificates.coriolis import CoriolisBounds, MotionBounds
from nbs_pin.certificates.coriolis_terms import Coriolis, Norms, Velocity
from nbs_pin.controllers.lyapunov_law import LyapunovLaw

UP = 1.0 + 1e-9
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
    friction: JointArray
    """Viscous friction of the joints within D₀, which is not held [N·m·s/rad]."""
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
    def viscous(self) -> float:
        """Largest share of viscous friction in D₀."""
        return largest_eigenvalue(self.root @ np.diag(self.friction) @ self.root)

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
        return cls.with_diagonal(loop, potential)[0]

    @classmethod
    def with_diagonal(cls, loop: SampledLaw, potential: float) -> "tuple[Curvature, JointArray]":
        """The bounds where z1ᵀSz1 ≤ potential, and that of the diagonal of ∇²Φ [N·m/rad]."""
        k, root, rate = loop.constants, loop.root, np.sqrt(loop.constants.rate)
        radii = np.sqrt(potential / diagonal_below(k.stiffness))
        low, high = loop.law.stiffness_range(radii)
        if not np.isfinite(high).all():
            return cls(*np.full(7, np.inf)), np.diag(high)
        losses = least_eigenvalue(rate[:, None] * low * rate), largest_eigenvalue(rate[:, None] * high * rate)
        centre, shape = 0.5 * (losses[0] + losses[1]), np.linalg.inv(np.linalg.cholesky(k.stiffness))
        middle = centre * np.diag(1.0 / k.rate)
        above, below = largest_eigenvalue(root @ (high - middle) @ root), least_eigenvalue(root @ (low - middle) @ root)
        found = cls(
            centre=centre,
            steepest=largest_eigenvalue(root @ high @ root),
            growth=largest_eigenvalue(shape @ high @ shape.T),
            loss=losses[1],
            rest=max(above, -below),
            rest_loss=0.5 * (losses[1] - losses[0]),
            change=loop.law.stiffness_rate(radii, diagonal_below(k.floor)),
        )
        return found, np.asarray(np.diag(high))


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


class Late(NamedTuple):
    """What the reference's jerk adds to the predicted z1 and ż1, in |·|."""

    position: float
    rate: float


class Bent(NamedTuple):
    """A displacement in three sizes."""

    speed: float
    """In |·|."""
    energy: float
    """In |·|_M."""
    total: float
    """Σ|·_i|."""


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
    late: Late
    """What the reference's jerk adds to the prediction."""
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
    bent: Bent
    """What accelerations add to q̂ − q."""
    share: float
    """D(z2) ⪯ (1 + share)D₀."""
    coriolis: Coriolis
    """Bounds of C(q, v) over the hold."""


def hold_of(loop: SampledLaw, level: float, potential: float) -> Hold | None:
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
            farthest = math.sqrt(stiffness) * ((loop.h + loop.lead) * sups.rate + hold.late.position)
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
    norms = Norms(isk, snu, math.sqrt(loop.loss_of_speed))
    velocity = Velocity(arm, motion, norms, sups.rate, sups.rate_m, sups.speed_m, sups.loss)
    turn = velocity.turn
    bend = 0.5 * lead**2 * motion.acceleration
    exponent = 2.0 * (turn * (h + lead) + arm.spread * bend)
    if exponent > 1.0:
        return None
    stretch = math.exp(0.5 * exponent)
    moved = k.nu * sups.force + turning * sups.rate + motion.acceleration
    moved_m = snu * stretch * sups.force + curve.centre * sups.rate_m + rest_m * sups.rate + isk * motion.acceleration
    speed, speed_m = motion.speed + sups.rate, isk * motion.speed + sups.rate_m
    loss = sups.loss + math.sqrt(loop.loss_of_speed) * curve.steepest * (
        (h + lead) * sups.rate + lead**3 / 6.0 * motion.jerk
    )
    lag, late = turning * lead, turning * lead**3 / 6.0 * motion.jerk + lead**2 / 2.0 * motion.jerk
    share = loop.law.damping_share((sups.speed + lag * sups.rate + late) * UP)
    if not math.isfinite(share):
        return None
    return Hold(
        loop=loop,
        level=level,
        curve=curve,
        sups=sups,
        isk=isk,
        turning=turning,
        rest_m=rest_m,
        rest_f=rest_f,
        late=Late(lead**3 / 6.0 * motion.jerk, lead**2 / 2.0 * motion.jerk),
        turn=turn,
        speed=speed,
        speed_m=speed_m,
        speed_1=velocity.sum,
        stretch=stretch,
        half=max(lead, h - lead),
        mean=(0.5 * h * h - h * lead + lead * lead) / h if lead <= h else lead - 0.5 * h,
        bent=Bent(
            0.5 * h * h * moved + bend, 0.5 * h * h * moved_m + isk * bend, arm.sum * (0.5 * h * h * moved + bend)
        ),
        share=share,
        coriolis=velocity.coriolis(loss),
    )


def predicted(b: Hold) -> tuple[float, float]:
    """|ẑ2 − z2| at the start of the hold, for the predicted ẑ2: by |ż1|, and constant."""
    return b.turning * b.loop.lead, b.turning * b.late.position + b.late.rate


def lagging(b: Hold, time: float) -> tuple[float, float]:
    """What joints turn between q and q̂, in Σ γ_i|·_i| and in Σ |·_i|, for a bound of |t − t̂| or its mean."""
    arm = b.loop.arm
    bent = min(arm.turn * b.bent.energy, arm.spread * b.bent.speed)
    return time * b.turn + bent, time * b.speed_1 + b.bent.total


def changed(b: Hold, time: float) -> float:
    """|Λ(∇²Φ(ẑ1) − ∇²Φ(z1))| by which ż1 is multiplied, for a bound of |t − t̂|."""
    rest = 2.0 * (b.turning - b.curve.centre)
    return min(rest, b.loop.loss_of_speed * b.curve.change * (time * b.sups.rate + b.bent.speed + b.late.position))


def _force(b: Hold) -> tuple[Float[np.ndarray, " 7"], float]:
    """|Mż2|_* without the damping that is held: by the suprema, and constant."""
    k, curve, motion, h = b.loop.constants, b.curve, b.loop.motion, b.loop.h
    G, L, S, SM, R, RM, F = np.eye(7)
    snu, omega, isk, swing = math.sqrt(k.nu) * b.stretch, k.omega, b.isk, b.stretch**2
    angle, sum_1 = lagging(b, b.half)
    lag, late = predicted(b)
    # ∇Φ and the damping at the predicted state
    row = G + curve.steepest * (b.half * R + 0.5 * h * h * (k.nu * F + b.turning * R)) + lag * R
    constant = b.loop.t + curve.steepest * b.late.position + late
    # −ωM z2, and M times the change of φ̇ − ωz2
    turned = curve.centre * RM + b.rest_m * R
    change = isk * changed(b, b.half)
    rest = (
        h * curve.centre * turned + h * (b.rest_f * F + b.rest_m * b.turning * R) + change * R + omega * isk * lag * R
    )
    extra = (curve.centre * isk + b.rest_m) * b.late.rate + change * b.late.rate + omega * isk * late
    inverse = 1.0 + swing * b.turn * h * isk * snu
    row = row + omega * isk * SM + inverse * (curve.centre + omega) * h * F + isk * rest
    constant += isk * extra
    # (M(q̂) − M(q)) times φ̇ − ωz2, a_d included, gravity, and the reference between the instants
    all_m = turned + omega * SM + rest + (curve.centre + omega) * h * snu * F
    row = row + isk * swing * angle * all_m
    constant += isk * (swing * angle * (extra + isk * motion.acceleration) + isk * motion.jerk * b.half)
    constant += b.loop.arm.gravity * sum_1
    # −C z2, and the change of C(q, v)φ
    by_speed, here, by_speed_m, slow, _ = b.coriolis
    row = row + (here + b.loop.viscous) * S + b.loop.alpha * L + swing * slow * h * (snu * F + turned)
    constant += swing * isk * motion.acceleration * (slow * (h + b.loop.lead) + by_speed_m * b.half)
    row = row + swing * by_speed_m * (
        b.half * turned + 0.5 * h * h * (curve.centre * (snu * F + turned) + b.rest_f * F + b.rest_m * b.turning * R)
    )
    row = row + 2.0 * sum_1 * by_speed * math.sqrt(b.loop.loss_of_speed) * L
    row = row + 2.0 * sum_1 * by_speed * b.turning * b.loop.lead * R
    constant += swing * by_speed_m * (curve.centre * isk + b.rest_m) * b.late.position
    return row, constant + 2.0 * sum_1 * by_speed * (motion.speed + b.turning * b.late.position)


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
    lag, late = predicted(b)
    rows[6] = force + b.share * lag * np.eye(7)[4]
    base = [gradient, loss, speed, b.stretch * speed_m, rate, b.stretch * rate_m]
    return _solved(rows, np.array([*base, speed * (1.0 + b.share) + b.share * late + constant]))


def rows_in_g(b: Hold) -> Suprema | None:
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
    base = [X / math.sqrt(k.delta), X, Y, mean_m(b), zero, zero, Y + math.sqrt(b.share) * N + constant * ONE]
    return _solved(rows, np.array(base))


def mean_m(b: Hold) -> Float[np.ndarray, " 5"]:
    """|ȳ|_M in every pose of the hold."""
    omega = b.loop.constants.omega
    return b.stretch * (W / math.sqrt(omega) if omega > 0.0 else b.isk * Y)


def _solved(rows: Float[np.ndarray, "7 7"], base: Float[np.ndarray, "7 *g"]) -> Suprema | None:
    """The least x ≥ 0 with x ≥ rows x + base, None if there is none."""
    if not (np.isfinite(rows).all() and np.abs(np.linalg.eigvals(rows)).max() < 0.999):
        return None
    return Suprema(*(np.linalg.solve(np.eye(7) - rows, base) * UP))
