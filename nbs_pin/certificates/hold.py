"""What can happen while a torque is held for a period, linear in g = (x, |ȳ|, w, n, 1) (docs/certificates.md §13).

Norms: |b| = √(bᵀD₀b) for velocities, |f|_* = √(fᵀD₀⁻¹f) for torques, |b|_M = √(bᵀMb).
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.rounding import largest_eigenvalue
from nbs_pin.certificates.coriolis_terms import Coriolis, Norms, Velocity
from nbs_pin.certificates.sampled_law import UP, Curvature, SampledLaw

X, Y, W, N, ONE = np.eye(5)


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
    acceleration: Any
    """|ż2|."""
    acceleration_m: Any
    """|ż2|_M."""


class Late(NamedTuple):
    """What the reference and encoders add to the predicted z1, and the reference to the predicted ż1, in |·|."""

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
    late: Late
    """What the reference and encoders add to the prediction."""
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
    bent: Bent
    """What accelerations and encoders add to q̂ − q."""
    share: float
    """D(z2) ⪯ (1 + share)D₀."""
    coriolis: Coriolis
    """Bounds of C(q, v) over the hold."""


def hold_of(loop: SampledLaw, level: float, potential: float) -> Hold | None:
    """The hold, with ∇²Φ bounded where z1ᵀSz1 ≤ potential; None if z1 may leave that set, or nothing follows."""
    k = loop.constants
    if not (math.isfinite(loop.arm.turn) and loop.h * k.nu < 1.0 and k.kappa > 0.0 and loop.left > 0.0):
        return None
    curve = Curvature.of(loop, potential)
    if not np.isfinite(curve).all():
        return None
    sups = Suprema(*np.zeros(9))
    for _ in range(100):
        hold = _numbers(loop, level, curve, sups)
        found = _first(hold) if hold is not None else None
        if hold is None or found is None:
            return None
        if all(x <= y for x, y in zip(found, sups, strict=True)):
            stiffness = largest_eigenvalue(loop.root @ k.stiffness @ loop.root)
            farthest = math.sqrt(stiffness) * ((loop.timing.span + loop.lead) * sups.rate + hold.late.position)
            return hold if math.sqrt(begin(hold).potential) + farthest <= math.sqrt(potential) else None
        sups = Suprema(*(x * (1.0 + 1e-6) for x in found))
    return None


def _numbers(loop: SampledLaw, level: float, curve: Curvature, sups: Suprema) -> Hold | None:
    """The numbers of a hold whose suprema are bounded by `sups`; None if M may change too much in one hold."""
    k, arm, motion, lead, times, noise = loop.constants, loop.arm, loop.motion, loop.lead, loop.timing, loop.noise
    isk, snu = 1.0 / math.sqrt(k.kappa), math.sqrt(k.nu)
    rest = loop.loss_of_speed * curve.rest
    rest_m = min(isk * rest, arm.loss_m * curve.rest_loss / math.sqrt(k.delta))
    turning = curve.centre + rest
    norms = Norms(isk, snu, math.sqrt(loop.loss_of_speed))
    velocity = Velocity(arm, motion, norms, sups.rate, sups.rate_m, sups.speed_m, sups.loss)
    turn = velocity.turn
    bend = 0.5 * lead**2 * motion.acceleration + noise.position
    exponent = 2.0 * (turn * (times.oldest + loop.h + lead) + arm.spread * bend)
    if exponent > 1.0:
        return None
    stretch = math.exp(0.5 * exponent)
    moved = sups.acceleration + turning * sups.rate + motion.acceleration
    moved_m = sups.acceleration_m + curve.centre * sups.rate_m + rest_m * sups.rate + isk * motion.acceleration
    speed, speed_m = motion.speed + sups.rate, isk * motion.speed + sups.rate_m
    late = Late(
        lead**3 / 6.0 * motion.jerk + times.blur * lead * motion.acceleration + noise.position,
        lead**2 / 2.0 * motion.jerk + times.blur * motion.acceleration,
    )
    loss = sups.loss + math.sqrt(loop.loss_of_speed) * curve.steepest * (
        (times.span + lead) * sups.rate + late.position
    )
    lag = turning * (lead + times.blur)
    seen = sups.speed + lag * sups.rate + turning * late.position + late.rate + noise.rate
    share = loop.law.damping_share(seen * UP)
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
        late=late,
        turn=turn,
        speed=speed,
        speed_m=speed_m,
        speed_1=velocity.sum,
        stretch=stretch,
        bent=Bent(times.bow * moved + bend, times.bow * moved_m + isk * bend, arm.sum * (times.bow * moved + bend)),
        share=share,
        coriolis=velocity.coriolis(loss),
    )


def predicted(b: Hold) -> tuple[float, float]:
    """|ẑ2 − z̄2| for the predicted ẑ2 without noise of the velocity and z̄2 as read: by |ż1|, and constant."""
    return b.turning * (b.loop.lead + b.loop.timing.blur), b.turning * b.late.position + b.late.rate


def noisy(b: Hold) -> float:
    """What noise of the velocity adds to |φ̇ − ωz2|_M, besides −(c + ω) times it."""
    return (b.rest_m + b.isk * changed(b, b.loop.timing.half)) * b.loop.noise.rate


def by_reading(b: Hold) -> float:
    """|C(q, ε)b|_* ≤ by_reading·|b|_M for the error ε of a reading."""
    arm, noise = b.loop.arm, b.loop.noise
    mixed = min(arm.turn_d, arm.spread_d * math.sqrt(b.loop.constants.nu))
    return 0.5 * ((b.isk * arm.spread + mixed) * noise.reading + arm.spread * noise.reading_m)


def inverse(b: Hold) -> float:
    """|M∫M⁻¹f|_* ≤ inverse·∫|f|_*, for M at one time of the hold or of those that the readings reach into."""
    reach = b.loop.h * (1 + b.loop.timing.holds)
    return 1.0 + b.stretch**3 * b.turn * reach * b.isk * math.sqrt(b.loop.constants.nu)


def lagging(b: Hold, time: float) -> tuple[float, float]:
    """What joints turn between q and q̂, in Σ γ_i|·_i| and in Σ |·_i|, for a bound of |t − t̂| or its mean."""
    arm = b.loop.arm
    bent = min(arm.turn * b.bent.energy, arm.spread * b.bent.speed)
    return time * b.turn + bent, time * b.speed_1 + b.bent.total


def changed(b: Hold, time: float) -> float:
    """|Λ(∇²Φ(ẑ1) − ∇²Φ(z1))| by which ż1 is multiplied, for a bound of |t − t̂|."""
    rest = 2.0 * (b.turning - b.curve.centre)
    return min(rest, b.loop.loss_of_speed * b.curve.change * (time * b.sups.rate + b.bent.speed + b.late.position))


def slipped(b: Hold, time: float, rate: Any, acceleration: Any, one: Any) -> Any:
    """|φ̂ − φ|, for a bound of |t − t̂| or its mean, with the suprema of ż1, ż2 and of what is constant."""
    bent = b.loop.timing.bow * (acceleration + b.turning * rate)
    moved = b.turning * (time * rate + bent + b.late.position * one)
    return moved + time * b.loop.motion.acceleration * one


def _forces(b: Hold) -> tuple[Float[np.ndarray, "3 9"], Float[np.ndarray, " 3"]]:
    """|Mż2|_*, |ż2| and |ż2|_M without the damping that is held: by the suprema, and constant."""
    k, curve, motion, times, noise = b.loop.constants, b.curve, b.loop.motion, b.loop.timing, b.loop.noise
    far, rate_c = times.span + times.blur, curve.centre + k.omega
    G, L, S, SM, R, RM, F, A, B = np.eye(9)
    snu, isk, swing, fall = math.sqrt(k.nu) * b.stretch, b.isk, b.stretch**2, math.sqrt(b.loop.loss_of_speed)
    torque, inertial = torque_sizes(b), np.array([isk, snu, b.stretch])
    angle, sum_1 = lagging(b, times.half)
    lag, late = predicted(b)
    by_speed, here, by_speed_m, slow, form, slow_form = b.coriolis
    # ∇Φ, damping and gravity at the predicted state, and C at another pose times φ
    row = G + curve.steepest * (times.half * R + times.bow * (A + b.turning * R)) + lag * R
    row = row + b.loop.viscous * S + b.loop.alpha * L
    row = row + 2.0 * sum_1 * by_speed * (fall * L + b.turning * b.loop.lead * R)
    constant = b.loop.t + curve.steepest * b.late.position + late + noise.rate + b.loop.arm.gravity * sum_1
    constant += 2.0 * sum_1 * by_speed * (motion.speed + b.turning * b.late.position)
    # friction that is fed forward at φ̂, against that of the arm at v
    row = row + b.loop.fed.viscous * slipped(b, times.half, R, A, 0.0)
    constant += b.loop.fed.jump + b.loop.fed.viscous * slipped(b, times.half, 0.0, 0.0, 1.0)
    rows, constants = np.outer(torque, row), torque * constant
    rows += np.array([here * S, snu * form * SM, b.stretch * form * SM])
    # C(q, v̂ − v)φ and C(q, v)(φ̂ − φ)
    turned, bent = curve.centre * RM + b.rest_m * R, b.rest_m * (A + b.turning * R)
    slows = swing * np.minimum(slow * torque, [np.inf, snu * slow_form, b.stretch * slow_form])
    fasts = swing * np.minimum(by_speed_m * torque, [np.inf, snu * form, b.stretch * form])
    rows += np.outer(slows, far * (B + turned))
    constants += slows * (isk * motion.acceleration * (far + b.loop.lead) + noise.rate_m)
    rows += np.outer(fasts, times.half * turned + times.bow * (curve.centre * (B + turned) + bent))
    constants += fasts * (isk * motion.acceleration * times.half + (curve.centre * isk + b.rest_m) * b.late.position)
    # −ωM z2 and M times the change of φ̇ − ωz2, besides (c + ω)M∫ż2: in |·|_M, and in |·|
    change, loose = changed(b, times.half), b.turning - curve.centre
    rest = far * (curve.centre * turned + bent) + isk * (change + k.omega * lag) * R
    extra = (curve.centre * isk + b.rest_m + isk * change) * b.late.rate + k.omega * isk * late
    extra += rate_c * noise.rate_m + noisy(b)
    rest_d = far * (curve.centre * b.turning * R + loose * (A + b.turning * R)) + (change + k.omega * lag) * R
    extra_d = (b.turning + change) * b.late.rate + k.omega * late + (rate_c + loose + change) * noise.rate
    # (M(q̂) − M(q)) times φ̇ − ωz2, a_d included
    rows += np.outer(inertial, swing * angle * (turned + k.omega * SM + rest + rate_c * far * B))
    constants += inertial * (swing * angle * (extra + isk * motion.acceleration))
    own = k.omega * SM + rest
    rows += np.array(
        [
            isk * own + inverse(b) * rate_c * far * F,
            k.omega * S + rest_d + rate_c * far * A,
            b.stretch * (own + rate_c * far * B),
        ]
    )
    jerk = times.half * motion.jerk
    constants += np.array([isk * (extra + isk * jerk), extra_d + jerk, b.stretch * (extra + isk * jerk)])
    return rows, constants


def torque_sizes(b: Hold) -> Float[np.ndarray, " 3"]:
    """|f|_*, |M⁻¹f| and |M⁻¹f|_M are at most these times |f|_*."""
    return np.array([1.0, b.loop.constants.nu, math.sqrt(b.loop.constants.nu) * b.stretch])


class Begin(NamedTuple):
    """What the level of V' and of its history bounds at the beginning of a hold."""

    total: float
    """Φ + ½(1 − ½hν)|z2|_M² [J]."""
    potential: float
    """Φ [J]."""


def begin(b: Hold) -> Begin:
    """The sizes at the beginning; those of the level itself if readings are exact and act at once."""
    k, times, noise, left = b.loop.constants, b.loop.timing, b.loop.noise, b.loop.left
    moved = b.loop.h * b.sups.acceleration
    read = noise.reading + (b.curve.centre + k.omega) * b.isk * noise.reading_m
    read += b.stretch**2 * b.coriolis.slow * noise.reading_m
    # With the speeds at earlier instants, which are bounded as well
    linear = times.jitter * moved + read
    speed = math.sqrt((linear * k.nu / left) ** 2 + 2.0 * k.nu / left * b.level) + linear * k.nu / left
    total = b.level + 0.5 * times.age * speed**2 + linear * speed
    # With that at this instant alone
    linear = times.backlog * moved + read
    potential = b.level + linear * max(times.holds - 0.5, 0.0) * moved + 0.5 * linear**2 * k.nu / left
    return Begin(total, min(total, potential))


def _first(b: Hold) -> Suprema | None:
    """The suprema as numbers, from the state at the start of the hold; None if they do not follow."""
    k, curve, h = b.loop.constants, b.curve, b.loop.h
    total, potential = begin(b)
    own = 1.0 - 0.5 * h * k.nu
    gradient, loss = (math.sqrt(x * curve.growth * potential) for x in (curve.steepest, curve.loss))
    speed, speed_m = math.sqrt(2.0 * k.nu / own * total), math.sqrt(2.0 / own * total)
    most, fall = math.sqrt(curve.loss * curve.growth * total), math.sqrt(b.loop.loss_of_speed)
    rate = min(math.hypot(speed, fall * most), speed + fall * loss)
    rate_m = min(math.hypot(speed_m, b.loop.arm.loss_m * most), speed_m + b.loop.arm.loss_m * loss)
    rows, held, (lag, late) = _rows(b, h), 1.0 + b.share, predicted(b)
    forces, constants = _forces(b)
    rows[6:] = forces
    rows[6:, 4] += torque_sizes(b) * b.share * lag
    if b.loop.timing.holds:  # what is read is at most half a hold from an instant
        rows[6:, 7] += torque_sizes(b) * held * 0.5 * h
    base = [gradient, loss, speed, b.stretch * speed_m, rate, b.stretch * rate_m]
    constants = constants + torque_sizes(b) * (speed * held + b.share * (late + b.loop.noise.rate))
    return _solved(rows, np.array([*base, *constants]))


def rows_in_g(b: Hold) -> Suprema | None:
    """The suprema as rows in g."""
    k, rows, (forces, constants) = b.loop.constants, _rows(b, 0.5 * b.loop.h), _forces(b)
    rows[4], rows[5] = 0.0, 0.0
    rows[4, 2], rows[4, 1] = 1.0, math.sqrt(b.loop.loss_of_speed)
    rows[5, 3], rows[5, 1] = 1.0, b.loop.arm.loss_m
    rows[6:] = forces
    rows[6:, 7] += torque_sizes(b) * 0.5 * b.loop.h
    held = np.outer(torque_sizes(b), b.loop.past * Y + math.sqrt(b.share) * N) + np.outer(constants, ONE)
    base = [X / math.sqrt(k.delta), X, Y, mean_m(b), 0.0 * X, 0.0 * X, *held]
    return _solved(b.loop.past * rows, np.array(base))


def _rows(b: Hold, time: float) -> Float[np.ndarray, "9 9"]:
    """What the signals change by during the hold, z2 within `time`."""
    rows, h, steepest = np.zeros((9, 9)), b.loop.h, b.curve.steepest
    rows[0, 4], rows[1, 4] = steepest * h, math.sqrt(b.loop.loss_of_speed) * steepest * h
    rows[2, 7], rows[3, 8] = time, time
    rows[4, 7], rows[4, 4] = h, h * b.turning
    rows[5, 8], rows[5, 5], rows[5, 4] = h, h * b.curve.centre * b.stretch, h * b.rest_m * b.stretch
    return rows


def mean_m(b: Hold) -> Float[np.ndarray, " 5"]:
    """|ȳ|_M in every pose of the hold."""
    omega = b.loop.constants.omega
    return b.stretch * (W / math.sqrt(omega) if omega > 0.0 else b.isk * Y)


def _solved(rows: Float[np.ndarray, "9 9"], base: Float[np.ndarray, "9 *g"]) -> Suprema | None:
    """The least x ≥ 0 with x ≥ rows x + base, None if there is none."""
    if not (np.isfinite(rows).all() and np.abs(np.linalg.eigvals(rows)).max() < 0.999):
        return None
    return Suprema(*(np.linalg.solve(np.eye(9) - rows, base) * UP))
