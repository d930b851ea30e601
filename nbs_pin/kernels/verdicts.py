"""What a monitor concludes of torques, whatever the model: which are more than a certificate allows, and for how long.

`judge_window` is for means over windows of encoder readings (docs/certificates.md §12), `judge_period` for exact states
over one period: the latter is `certificates/assumptions.py` for one period, and tests hold the two together.
"""

import math

import numpy as np
from numba import float64, int64, void

from nbs_pin.kernels.jit import compile_for, exact_kernel, inlined, kernel
from nbs_pin.kernels.records import Mat, Vec
from nbs_pin.kernels.watching import (
    A_REF,
    COMMAND,
    LAG,
    LAGS,
    LAW,
    OTHER,
    Q_REF,
    SPARE,
    SPEED,
    SPREAD,
    TAU,
    TORQUE,
    V_REF,
    VARIED,
    Q,
    U,
    earlier,
)

RESOLUTION, BOX, GAP_VISCOUS, GAP_COULOMB, VISCOUS, COULOMB, LOWER, UPPER, WRAPS, LIMITS = range(10)
"""Rows of a certificate's limits, and their number: encoder steps [rad], admissible torques [N·m] (inf for a ball),
friction that is not fed forward, friction that is, position limits [rad], 1 for joints whose error wraps."""
RADIUS, OF_Q, OF_V, CONSTANT, TRANSITION, NUMBERS = range(6)
"""Numbers of a certificate: radius of the ball [N·m] (inf for a box), a, b, c of the model's error, transition of the
friction fed forward [rad/s], and how many."""
EFFORT, WRAP, REFERENCE, STOPS = 1, 2, 4, 8
"""Bits of `instant`."""
EXCEEDS, DELAY, LATE, RUBS, RATIO, MOVES, WINDOW = range(7)
"""Numbers of `judge_window`: 1 for an unexplained torque, the delay that explains it [periods], 1 for commands that are
not the law's, 1 if it opposes the motion, the largest ratio of torque to bound, Σ|v| [rad/s], and how many."""
OF_RATE, OF_ACCELERATION, ROUNDING = 1e-3, 0.02, 1e-9
OF_TORQUE = 1e-3
"""Shares that `certificates/sampled_motion.py` and `certificates/assumptions.py` allow."""

_VEC, _MAT, _CUBE = float64[::1], float64[:, ::1], float64[:, :, ::1]


def compile_verdicts() -> None:
    """Compile the entry points for float64, so that no first call waits for the compiler."""
    compile_for(instant, int64(_MAT, _MAT, _VEC, float64, _MAT))
    compile_for(judge_errors, int64(_VEC, _VEC, _VEC, float64, _VEC, _VEC))
    compile_for(judge_window, void(_MAT, _CUBE, _MAT, _VEC, float64, int64, _VEC, _MAT, _VEC, _VEC))


@inlined
def wrapped(x: float, wraps: float) -> float:
    """x less whole turns, in (−π, π] [rad], where `wraps` is 1."""
    return x - 2.0 * math.pi * np.ceil((x - math.pi) / (2.0 * math.pi)) if wraps > 0.0 else x


@exact_kernel
def instant(before: Mat, now: Mat, z1: Vec, period: float, limits: Mat) -> int:
    """The error at an instant → z1 [rad], and bits for what went wrong since the one before.

    Args:
        before: sample (7, n) of the instant before.
        now: of this one.
        z1: written, (n,).
        period: between the two [s].
        limits: (`LIMITS`, n).
    """
    found, h = 0, period
    for i in range(len(z1)):
        wraps = limits[WRAPS, i]
        z1[i] = wrapped(now[Q, i] - now[Q_REF, i], wraps)
        if wraps > 0.0 and abs(z1[i] - wrapped(before[Q, i] - before[Q_REF, i], wraps)) > math.pi:
            found |= WRAP
        if before[TAU, i] != before[COMMAND, i]:
            found |= EFFORT
        step = limits[RESOLUTION, i]
        if now[Q, i] <= limits[LOWER, i] + step or now[Q, i] >= limits[UPPER, i] - step:
            found |= STOPS
        q0, q1, v0, v1 = before[Q_REF, i], now[Q_REF, i], before[V_REF, i], now[V_REF, i]
        a0, a1 = before[A_REF, i], now[A_REF, i]
        jump, size = abs(a1 - a0), abs(a1) + abs(a0)
        moved = abs(wrapped(q1 - q0, wraps) - 0.5 * h * (v1 + v0) + h * h / 12.0 * (a1 - a0))
        turned = abs(v1 - v0 - 0.5 * h * (a1 + a0))
        may_move = h * h * jump + h * OF_RATE * (abs(v1) + abs(v0)) + ROUNDING * (1.0 + abs(q1))
        may_turn = h * jump + h * OF_ACCELERATION * size + ROUNDING * (1.0 + abs(v1))
        if moved > may_move or turned > may_turn:
            found |= REFERENCE
    return found


@inlined
def outside(torque: Vec, tolerance: Vec, limits: Mat, radius: float, rest: Vec) -> float:
    """Distance of a torque from the admissible set, enlarged by a tolerance per joint; the joints' shares → rest."""
    size, room = 0.0, 0.0
    for i in range(len(torque)):
        size += torque[i] * torque[i]
        room += tolerance[i] * tolerance[i]
    share = max(1.0 - (radius + math.sqrt(room)) / math.sqrt(size), 0.0) if size > 0.0 and radius < math.inf else 0.0
    far = 0.0
    for i in range(len(torque)):
        if limits[BOX, i] < math.inf:
            over = max(abs(torque[i]) - limits[BOX, i] - tolerance[i], 0.0)
            rest[i] = over if torque[i] > 0.0 else -over
        else:
            rest[i] = share * torque[i]
        far += rest[i] * rest[i]
    return math.sqrt(far)


@exact_kernel
def judge_errors(z1: Vec, reach: Vec, start: Vec, fallen: float, errors: Vec, bounds: Vec) -> int:
    """How many of ‖z1‖ and |z1_i| are above their bounds.

    Args:
        z1: (n,).
        reach: what the readings leave uncertain of each error [rad], (n + 1,).
        start: the bounds at the first instant [rad], (n + 1,).
        fallen: share of them that is left.
        errors: written, (n + 1,).
        bounds: written, (n + 1,).
    """
    square, found = 0.0, 0
    for i in range(len(z1)):
        square += z1[i] * z1[i]
        errors[i + 1] = abs(z1[i])
    errors[0] = math.sqrt(square)
    for k in range(len(errors)):
        bounds[k] = fallen * start[k]
        if errors[k] - reach[k] > bounds[k] * (1.0 + ROUNDING):
            found += 1
    return found


@kernel
def judge_window(
    mean: Mat,
    history: Mat,
    more: Mat,
    share: Vec,
    period: float,
    half: int,
    q: Vec,
    limits: Mat,
    numbers: Vec,
    out: Vec,
) -> None:
    """What a window of readings says of the assumptions.

    Args:
        mean: (8, n) of `watching.average`; U is written with the friction that is fed forward.
        history: what it averaged.
        more: (`MORE`, n) of it; SPREAD and VARIED are written with the part of U that is too large, and its tolerance.
        share: |M|r, of `watching.centre`.
        period: [s].
        half: m, half the length of the window [periods].
        q: reading at its centre [rad].
        limits: (`LIMITS`, n) of the certificate.
        numbers: (`NUMBERS`,) of the certificate.
        out: written, (`WINDOW`,).
    """
    n, width = len(q), half * period
    radius, transition = numbers[RADIUS], numbers[TRANSITION]
    size_q, size_v, gap, torque, asked, moves = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        v = mean[SPEED, i]
        size_q, size_v, moves = size_q + q[i] * q[i], size_v + v * v, moves + abs(v)
        slack = limits[RESOLUTION, i] / width + abs(more[VARIED, i])
        unknown = limits[GAP_VISCOUS, i] * (abs(v) + slack) + limits[GAP_COULOMB, i]
        gap += unknown * unknown
        torque, asked = torque + mean[TORQUE, i] ** 2, asked + mean[LAW, i] ** 2
    size_q, size_v, gap = math.sqrt(size_q), math.sqrt(size_v), math.sqrt(gap)
    granted = gap + numbers[OF_Q] * size_q + numbers[OF_V] * size_v + numbers[CONSTANT]
    fraction = OF_TORQUE + (period * size_v) ** 2
    tolerance, rest, other = more[VARIED], more[SPREAD], more[SPARE]
    ratio = 1.0
    for i in range(n):
        v, slack, loudest = mean[SPEED, i], limits[RESOLUTION, i] / width + abs(more[VARIED, i]), more[SPREAD, i]
        upper, lower = math.tanh((v + slack) / transition), math.tanh((v - slack) / transition)
        mean[U, i] += limits[VISCOUS, i] * v + limits[COULOMB, i] * math.tanh(v / transition)
        tolerance[i] = share[i] * (2.0 / (width * width) + limits[RESOLUTION, i] / (period * period))
        tolerance[i] += limits[COULOMB, i] * (upper - lower) + fraction * math.sqrt(torque)
        bound = limits[BOX, i] if radius == math.inf else radius
        reached = abs(mean[U, i]) + tolerance[i] + 2.0 * loudest + abs(mean[LAG, i])
        ratio = max(ratio, reached / bound if bound > 0.0 else math.inf)
    out[MOVES], out[RATIO], out[EXCEEDS], out[DELAY], out[RUBS], out[LATE] = moves, ratio, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        other[i] = OF_TORQUE * math.sqrt(asked)
    if outside(mean[LAG], other, limits, radius, rest) > 0.0:
        out[LATE] = 1.0
    exceeds = outside(mean[U], tolerance, limits, radius, rest) > granted
    if exceeds:
        out[EXCEEDS], out[RUBS] = 1.0, 1.0
        for i in range(n):
            if rest[i] * mean[SPEED, i] > 0.0:
                out[RUBS] = 0.0
        late = more[OTHER]
        for k in range(LAGS):
            earlier(history, half, k + 1, late)
            clear = False
            for i in range(n):
                change, room = mean[TORQUE, i] - late[i], min(limits[BOX, i], radius) + tolerance[i]
                clear = clear or (rest[i] != 0.0 and abs(change) > 0.5 * room)
                late[i] = mean[U, i] + change
            if clear and out[DELAY] == 0.0 and outside(late, tolerance, limits, radius, other) <= granted:
                out[DELAY] = k + 1.0
