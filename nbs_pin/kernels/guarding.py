"""The guard of a control loop as a state machine over plain numbers (docs/runtime.md).

`admit` looks at a sample and says what to compute, `release` turns a torque into one that may be sent; between two
calls nothing is remembered but the state, which both replace. Configuration and state are numbers, then vectors (n,)
laid end to end, in the order of the names below.
"""

import math
from collections import namedtuple

from numba import boolean, float64, int64

from nbs_pin.kernels.jit import compile_for, exact_kernel, inlined
from nbs_pin.kernels.records import Vec

OK, DEGRADED, STOPPED = range(3)
"""Modes."""
COMPUTE, HOLD, BRAKE, RELEASE = range(4)
"""What a sample asks for: the law, the last torque, the torque of the safe stop, or none."""
(NONE, MISSED, NOT_FINITE, JUMP, FROZEN, TIME, PERIOD, REFERENCE, SIGN, DIVERGED, EXTERNAL, OUTPUT, CHATTER, MODEL, LAW,
 ARM, REQUESTED) = range(17)  # fmt: skip
"""Codes of faults."""
(LENGTH, COMPENSATED, PATIENCE, LOST_AFTER, RECOVERY, SLOWEST, FASTEST, SLOW, FAST, DECAY, REVERSALS, SIGN_SPEED,
 LEAD, NUMBERS) = range(14)  # fmt: skip
"""Numbers of the configuration, and how many; LEAD is how far references are ahead of the samples [s]."""
EFFORT, STEP, REACH, SPEED, ERROR, PUSH, DAMPING, RESOLUTION, WRAPS, LOWER, UPPER, VECTORS = range(12)
"""Vectors of the configuration, and how many."""
(MODE, CODE, ACTION, BEGUN, AT, BAD, UNFIT, CYCLES, LOST, QUIET, MEAN, SWINGS, FAR, PUSHED, TROUBLE, HELD, LATE,
 OVERRUN, CUT, SCALARS) = range(20)  # fmt: skip
"""Numbers of the state, and how many: the last four count what has happened since the beginning."""
(Q, V, Q_REF, V_REF, TAU, GRAVITY, STALE, MOVED, ALONG, SQUARE, SIDE, ROOM, PEAK, READ, AWAY,
 ROWS) = range(16)  # fmt: skip
"""Vectors of the state, and how many. While braking, Q and V are what is believed, and READ was read last."""
SEEN_Q, SEEN_V, AIM_Q, AIM_V, AIM_A, OUTSIDE, AHEAD_Q, AHEAD_V, KEPT = range(9)
"""Vectors of a record, and how many: what was given, and where the arm is when the reference is."""

Part = namedtuple("Part", "x rows")
"""Numbers and vectors, of the configuration or the state."""

_TURN = 2.0 * math.pi
_WINDOW, _SIGN_WINDOW, _CHATTER_TIME, _SMOOTH = 0.02, 0.05, 0.1, 0.2
LIMP = 5.0
"""Readings in a row in which a joint runs away from the brake, from which on it gets no torque."""
_GAP = 3.0  # periods over which a difference of positions still tells a velocity
_VEC = float64[::1]


def compile_guarding() -> None:
    """Compile the entry points for float64, so that no first call waits for the compiler."""
    compile_for(admit, int64(_VEC, _VEC, float64, boolean, boolean, *[_VEC] * 5))
    compile_for(take, int64(_VEC, _VEC, float64, boolean, boolean, *[_VEC] * 7))
    compile_for(release, int64(*[_VEC] * 4, int64))


@inlined
def _finite(x: Vec, n: int) -> bool:
    """Whether these are n numbers of usual size."""
    beyond = 0 if len(x) == n else 1
    for y in x:
        beyond += 0 if abs(y) <= 1e100 else 1  # NaN is not ≤
    return beyond == 0


@inlined
def _apart(x: float, y: float, wraps: float) -> float:
    """x − y, less whole turns where `wraps` is 1."""
    apart = x - y
    if wraps > 0.0:
        apart -= _TURN * math.ceil((apart - math.pi) / _TURN)
    return apart


@inlined
def _stop(s: Part, c: Part, code: int) -> None:
    """Latch the first fault, after its sample is kept; remember where every joint was and how fast."""
    if s.x[MODE] == STOPPED:
        return
    s.x[MODE], s.x[CODE] = STOPPED, code
    for i in range(s.rows.shape[1]):
        s.rows[PEAK, i], s.rows[READ, i] = abs(s.rows[V, i]) / c.rows[SPEED, i], s.rows[Q, i]
        if code == EXTERNAL:  # what pushes may go on, and make joints faster in spite of the brake
            s.rows[PEAK, i] = max(s.rows[PEAK, i], 1.0)
        if code == SIGN:  # a damping of this velocity would drive the joint
            s.rows[V, i] = 0.0


@inlined
def _clock(s: Part, c: Part, t: float) -> int:
    """The fault in the time of a sample; its mean period and the periods without a sample are counted."""
    h, passed, cycles = c.x[LENGTH], t - s.x[AT], s.x[CYCLES]
    if not passed > 0.0 or passed > c.x[PATIENCE] * h * cycles:
        return TIME
    s.x[MEAN] += _WINDOW * (min(passed / (h * cycles), 3.0) - s.x[MEAN])
    if cycles == 1.0 and passed > 1.5 * h:
        s.x[LATE] += math.floor(passed / h - 0.5)
        s.x[TROUBLE] = 1.0
    if s.x[MEAN] > c.x[SLOWEST] or s.x[MEAN] < c.x[FASTEST]:
        return PERIOD
    if s.x[MEAN] > c.x[SLOW] or s.x[MEAN] < c.x[FAST]:
        s.x[TROUBLE] = 1.0
    return NONE


@inlined
def _jumped(x: Vec, at: int, s: Part, c: Part, passed: float) -> bool:
    """Whether a position is where no motion leads from the one in row `at`, with the velocity in the next row."""
    longest = min(passed, 2.0 * c.x[LENGTH])
    for i in range(len(x)):
        apart = _apart(x[i], s.rows[at, i], c.rows[WRAPS, i]) - s.rows[at + 1, i] * passed
        if not abs(apart) <= c.rows[REACH, i] * longest:
            return True
    return False


@inlined
def _follows(q_ref: Vec, s: Part, c: Part, passed: float) -> bool:
    """Whether a finite reference is within the limits of the joints and goes on from the one before."""
    for i in range(len(q_ref)):
        if not c.rows[LOWER, i] <= q_ref[i] <= c.rows[UPPER, i]:
            return False
    return s.x[BEGUN] == 0.0 or not _jumped(q_ref, Q_REF, s, c, passed)


@inlined
def _sensed(q: Vec, v: Vec, v_ref: Vec, aimed: bool, passed: float, s: Part, c: Part) -> int:
    """JUMP: a velocity that cannot be. FROZEN: a reading that stays while the reference moves. SIGN: both differ.

    `v_ref` is not read unless `aimed`, which says that it is n finite numbers.
    """
    found, floor, per = NONE, c.x[SIGN_SPEED] * c.x[SIGN_SPEED], 1.0 / passed
    for i in range(len(q)):
        if not abs(v[i]) <= c.rows[REACH, i]:
            return JUMP
        change = _apart(q[i], s.rows[Q, i], c.rows[WRAPS, i])
        if change == 0.0:
            s.rows[STALE, i] += 1.0
            if aimed:
                s.rows[MOVED, i] += abs(v_ref[i]) * passed
        else:
            s.rows[STALE, i], s.rows[MOVED, i] = 0.0, 0.0
        if s.rows[STALE, i] >= c.x[PATIENCE] - 1.0 and s.rows[MOVED, i] > 2.0 * c.rows[RESOLUTION, i]:
            found = FROZEN
        s.rows[ALONG, i] += _SIGN_WINDOW * (v[i] * change * per - s.rows[ALONG, i])
        s.rows[SQUARE, i] += _SIGN_WINDOW * (v[i] * v[i] - s.rows[SQUARE, i])
        if s.rows[SQUARE, i] > floor and s.rows[ALONG, i] < -0.5 * s.rows[SQUARE, i]:
            found = SIGN
    return found


@inlined
def _strayed(q: Vec, q_ref: Vec, v_ref: Vec, external: Vec, s: Part, c: Part) -> int:
    """DIVERGED or EXTERNAL where an error, or a torque from outside, is too large three times in a row."""
    far, pushed = False, False
    for i in range(len(q)):
        error = _apart(q[i], q_ref[i] - c.x[LEAD] * v_ref[i], c.rows[WRAPS, i])  # at the time of the sample
        far = far or not abs(error) <= c.rows[ERROR, i] + s.rows[ROOM, i]
        pushed = pushed or not abs(external[i]) <= c.rows[PUSH, i]
        s.rows[ROOM, i] *= c.x[DECAY]
    s.x[FAR] = s.x[FAR] + 1.0 if far else 0.0
    s.x[PUSHED] = s.x[PUSHED] + 1.0 if pushed else 0.0
    if s.x[FAR] >= 3.0:
        return DIVERGED
    return EXTERNAL if s.x[PUSHED] >= 3.0 else NONE


@inlined
def _keep(t: float, q: Vec, v: Vec, s: Part) -> None:
    """Remember a sample."""
    for i in range(len(q)):
        s.rows[Q, i], s.rows[V, i] = q[i], v[i]
    s.x[AT], s.x[CYCLES], s.x[LOST] = t, 0.0, 0.0


@inlined
def _examined(t: float, q: Vec, v: Vec, q_ref: Vec, v_ref: Vec, external: Vec, s: Part, c: Part) -> int:
    """What is wrong with a finite sample, which the state knows afterwards; some faults stop at once."""
    fault, passed, n = NONE, c.x[LENGTH], s.rows.shape[1]
    aimed = _finite(q_ref, n) and _finite(v_ref, n)
    if s.x[BEGUN] > 0.0:
        passed = t - s.x[AT]
        fault = _clock(s, c, t)
        if fault == NONE:
            fault = JUMP if _jumped(q, Q, s, c, passed) else _sensed(q, v, v_ref, aimed, passed, s, c)
        if fault == JUMP:
            return JUMP
    follows = fault == NONE and aimed and _follows(q_ref, s, c, passed)
    _keep(t, q, v, s)
    if fault == NONE:
        if not follows:
            return REFERENCE
        fault = _strayed(q, q_ref, v_ref, external, s, c)
    if fault != NONE:
        _stop(s, c, fault)
        return fault
    for i in range(n):
        s.rows[Q_REF, i], s.rows[V_REF, i] = q_ref[i], v_ref[i]
    s.x[BEGUN] = 1.0
    return NONE


@inlined
def _braked(t: float, q: Vec, s: Part, c: Part) -> None:
    """A sample while stopped: velocities from positions alone; a joint that runs away from the brake goes limp.

    A clock that says nothing (it stands, goes back, leaps or is no number) is replaced by the count of periods. A step
    where no motion leads changes neither position nor velocity: one reading may be wrong, `LIMP` in a row are a joint
    that runs away, or an encoder that tells nothing.
    """
    h, passed = c.x[LENGTH], t - s.x[AT]
    if not c.x[FASTEST] * h <= passed <= c.x[PATIENCE] * h:
        passed = s.x[CYCLES] * h
    for i in range(len(q)):
        step = _apart(q[i], s.rows[READ, i], c.rows[WRAPS, i])
        s.rows[READ, i] = q[i]
        if s.x[LOST] > _GAP:  # a difference over a gap says nothing
            s.rows[Q, i], s.rows[V, i] = q[i], 0.0
            continue
        away = not abs(step - s.rows[V, i] * passed) <= c.rows[REACH, i] * passed
        if not away:
            s.rows[Q, i] = q[i]
            s.rows[V, i] += _SMOOTH * (step / passed - s.rows[V, i])
            away = not abs(s.rows[V, i]) / c.rows[SPEED, i] <= 1.5 * s.rows[PEAK, i] + 0.5
        if s.rows[AWAY, i] < LIMP:
            s.rows[AWAY, i] = s.rows[AWAY, i] + 1.0 if away else 0.0
    s.x[AT], s.x[CYCLES], s.x[LOST] = t, 0.0, 0.0


@exact_kernel
def admit(
    config: Vec, state: Vec, t: float, fresh: bool, overrun: bool, q: Vec, v: Vec, q_ref: Vec, v_ref: Vec, external: Vec
) -> int:
    """What is to be computed at this instant: COMPUTE, HOLD, BRAKE or RELEASE.

    Args:
        config: numbers, then vectors (n,), as named above.
        state: replaced.
        t: time of the sample [s].
        fresh: whether a sample has arrived since the last call; t, q and v are not read otherwise.
        overrun: whether the last call came back late.
        q: position [rad].
        v: velocity [rad/s].
        q_ref: desired position [rad].
        v_ref: desired velocity [rad/s].
        external: torque from outside [N·m]; zero where none is known.
    """
    n = (len(config) - NUMBERS) // VECTORS
    c = Part(config, config[NUMBERS:].reshape(VECTORS, n))
    s = Part(state, state[SCALARS:].reshape(ROWS, n))
    state[CYCLES] += 1.0
    state[LOST] += 1.0
    state[TROUBLE] = 0.0
    if overrun:
        state[OVERRUN] += 1.0
        state[TROUBLE] = 1.0
    placed = fresh and _finite(q, n)
    if state[MODE] == STOPPED:
        if placed:  # the brake needs neither the time nor velocities
            _braked(t, q, s, c)
    else:
        fault = NOT_FINITE if fresh else MISSED
        if placed and abs(t) <= 1e100 and _finite(v, n) and len(external) == n:
            fault = _examined(t, q, v, q_ref, v_ref, external, s, c)
        state[ACTION] = COMPUTE
        state[BAD] = state[BAD] + 1.0 if fault != NONE else 0.0
        if fault != NONE:
            state[ACTION], state[TROUBLE] = HOLD, 1.0
            if state[BAD] >= config[PATIENCE]:
                _stop(s, c, fault)
            state[HELD] += 1.0 if state[MODE] != STOPPED else 0.0
    if state[MODE] == STOPPED:
        state[ACTION] = BRAKE if state[LOST] <= config[LOST_AFTER] else RELEASE
    return int(state[ACTION])


@inlined
def _write(x: Vec, record: Vec, which: int, n: int) -> None:
    """A vector of a record; not numbers where x is none of n."""
    for i in range(n):
        record[which * n + i] = x[i] if len(x) == n else math.nan


@exact_kernel
def take(
    config: Vec,
    state: Vec,
    t: float,
    fresh: bool,
    overrun: bool,
    q: Vec,
    v: Vec,
    q_ref: Vec,
    v_ref: Vec,
    a_ref: Vec,
    external: Vec,
    record: Vec,
) -> int:
    """`admit`, with a copy of all that is given, and of q and v moved on by LEAD with a_ref, → record (KEPT n,)."""
    n = (len(config) - NUMBERS) // VECTORS
    lead = config[LEAD]
    _write(q, record, SEEN_Q, n)
    _write(v, record, SEEN_V, n)
    _write(q_ref, record, AIM_Q, n)
    _write(v_ref, record, AIM_V, n)
    _write(a_ref, record, AIM_A, n)
    _write(external, record, OUTSIDE, n)
    for i in range(n):
        speed, change = record[SEEN_V * n + i], lead * record[AIM_A * n + i]
        record[AHEAD_Q * n + i] = record[SEEN_Q * n + i] + lead * (speed + 0.5 * change)
        record[AHEAD_V * n + i] = speed + change
    return admit(config, state, t, fresh, overrun, q, v, q_ref, v_ref, external)


@inlined
def _swings(command: Vec, s: Part, c: Part) -> None:
    """Count joints whose torque goes from one limit to the other; the count fades in a tenth of a second."""
    found = 0.0
    s.x[SWINGS] *= 1.0 - min(c.x[LENGTH] / _CHATTER_TIME, 1.0)
    for i in range(len(command)):
        if abs(command[i]) > c.rows[EFFORT, i]:
            side = 1.0 if command[i] > 0.0 else -1.0
            found = 1.0
            if s.rows[SIDE, i] * side < 0.0:
                s.x[SWINGS] += 1.0
            s.rows[SIDE, i] = side
    s.x[CUT] += found


@inlined
def _wanted(i: int, command: Vec, s: Part, c: Part) -> float:
    """The torque of joint i, gravity included, before limits."""
    action, gravity = s.x[ACTION], s.rows[GRAVITY, i]
    if action == COMPUTE:
        return command[i]
    if action == RELEASE or s.rows[AWAY, i] >= LIMP:
        return c.x[COMPENSATED] * gravity
    return gravity - (c.rows[DAMPING, i] * s.rows[V, i] if s.x[LOST] == 0.0 else 0.0)


@exact_kernel
def release(config: Vec, state: Vec, command: Vec, gravity: Vec, fault: int) -> int:
    """The torque that may be sent → the vector TAU of the state; returns the mode after it.

    Args:
        config: as in `admit`.
        state: replaced; its vector TAU is the torque to send.
        command: torque of the law [N·m], gravity included; read only where `admit` said COMPUTE.
        gravity: G(q) [N·m], of the last good sample; one that is not finite leaves the last one.
        fault: code of what else went wrong, or NONE.
    """
    n = (len(config) - NUMBERS) // VECTORS
    c = Part(config, config[NUMBERS:].reshape(VECTORS, n))
    s = Part(state, state[SCALARS:].reshape(ROWS, n))
    if _finite(gravity, n):
        for i in range(n):
            s.rows[GRAVITY, i] = gravity[i]
    if state[ACTION] == COMPUTE:
        if _finite(command, n):
            state[UNFIT] = 0.0
            _swings(command, s, c)
            if state[SWINGS] > config[REVERSALS]:
                _stop(s, c, CHATTER)
        else:
            state[UNFIT] += 1.0
            state[HELD] += 1.0
            state[ACTION], state[TROUBLE] = HOLD, 1.0
            if state[UNFIT] >= config[PATIENCE]:
                _stop(s, c, OUTPUT)
    if fault != NONE:
        _stop(s, c, fault)
    if state[MODE] == STOPPED and state[ACTION] < BRAKE:
        state[ACTION] = BRAKE
    if state[ACTION] != HOLD:
        for i in range(n):
            most, step, last = c.rows[EFFORT, i], c.rows[STEP, i], s.rows[TAU, i]
            wire = min(max(_wanted(i, command, s, c), -most), most) - config[COMPENSATED] * s.rows[GRAVITY, i]
            wire = last + min(max(min(max(wire, -most), most) - last, -step), step)
            s.rows[TAU, i] = min(max(wire, -most), most)
    state[QUIET] = state[QUIET] + 1.0 if state[TROUBLE] == 0.0 else 0.0
    if state[MODE] != STOPPED:
        state[MODE] = DEGRADED if state[QUIET] < config[RECOVERY] else OK
    return int(state[MODE])
