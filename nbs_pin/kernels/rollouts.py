"""A whole closed-loop motion of one start as a kernel, and its adjoint: one pass forward, one pass back.

    x̂ = (q + ℓ(v + ½ℓa), v + ℓa)        the state ℓ seconds ahead, with the reference's acceleration a
    c = law(x̂, aim),  τ = clip(c) + τ_d     the torque asked for, and the one that acts for a whole period
    x⁺ = plant(x, τ)                     `substeps` steps of one integrator

The adjoint takes the cotangents of every state and of every torque asked for, and recomputes what it needs from the
states alone. Where a clip saturates, its derivative is 0: the torque there does not depend on what was asked for.
"""

import math
from collections import namedtuple
from typing import NamedTuple

import numpy as np

from nbs_pin.kernels.jit import inlined, kernel
from nbs_pin.kernels.law_adjoints import adjoint_workspace, law_adjoint, pid_adjoint
from nbs_pin.kernels.laws import law_workspace, pid_step, signals_of, torque_of
from nbs_pin.kernels.layout import LAW, IntegratorCode, LawCode, Packed
from nbs_pin.kernels.records import Mat, Memory, Motion, Signals, State, Target, Vec
from nbs_pin.kernels.tree_layout import tree_workspace
from nbs_pin.kernels.trees import tree_acceleration, tree_acceleration_adjoint, tree_torque_adjoint
from nbs_pin.kernels.views import pid_of, row, take, take2, take3, take4

STAGES = 4
"""Of the integrator that has most."""


class Scene(NamedTuple):
    """Constants of a motion, shared by all starts."""

    period: float
    step: float
    """Control period and plant step [s]."""
    substeps: int
    """Plant steps per period."""
    integrator: int
    """Its `IntegratorCode`."""
    limit: Vec
    """Largest torque [N·m], (n,), inf for none."""
    viscous: Vec
    coulomb: Vec
    """Friction of the plant, (n,) [N·m·s/rad, N·m]."""
    transition: float
    """Speed at which its Coulomb friction changes sign [rad/s]."""
    belief: Packed
    truth: Packed
    """The tree of the law and that of the plant."""


class Course(NamedTuple):
    """What one motion of T periods follows."""

    aims: np.ndarray
    """(T, 4, n), the reference's acceleration now, then q_d, v_d, a_d where the law looks."""
    leads: Vec
    """(T,), how far ahead of the instant that is [s]."""
    tau_d: Mat
    """(T, n), disturbance [N·m]."""


class Rollout(NamedTuple):
    """One motion of T periods, or the cotangents of it."""

    q: Mat
    v: Mat
    """(T + 1, n), states at the control instants [rad, rad/s]."""
    command: Mat
    """(T, n), torques asked for [N·m]."""
    memory: np.ndarray
    """(T + 1, 2, n), what a PID remembers."""


Stages = namedtuple("Stages", "q v a net factors")
"""States and accelerations of an integrator's stages, (4n,) each; torque less friction, (n,), of the last one; Cholesky
factors of M, (4, n, n)."""


def rollout_workspace(law: Packed, scene: Scene) -> int:
    """Size of the scratch space that `rollout` and `rollout_adjoint` need.

    Args:
        law: the law, with weights as a numpy array.
        scene: what the motions share.
    """
    n = len(scene.limit)
    trees = max(tree_workspace(scene.belief), tree_workspace(scene.truth))
    laws = 0 if law.layout[LAW] == LawCode.PID else max(law_workspace(law), adjoint_workspace(law))
    asking, stepping = 9 * n + max(trees, laws), (3 * STAGES + 6) * n + STAGES * n * n + trees
    return (1 + 2 * scene.substeps) * n + max(asking, stepping)


@kernel
def rollout(course: Course, scene: Scene, law: Packed, work: Vec, run: Rollout) -> None:
    """A motion from its start.

    Args:
        course: what it follows.
        scene: what all motions share.
        law: the law.
        work: scratch space (`rollout_workspace`).
        run: written, but for the state in its first row, the start.
    """
    tau, work = take(work, len(scene.limit))
    run.memory[0] = 0.0
    for k in range(len(course.leads)):
        _ask(k, course, scene, law, work, run)
        acting(run.command[k], course.tau_d[k], scene, tau)
        for i in range(len(tau)):  # an assignment to a row would first ask whether the two overlap
            run.q[k + 1, i], run.v[k + 1, i] = run.q[k, i], run.v[k, i]
        for _ in range(scene.substeps):
            advance(State(run.q[k + 1], run.v[k + 1]), tau, scene, work)


@kernel
def rollout_adjoint(
    course: Course, scene: Scene, law: Packed, work: Vec, run: Rollout, bars: Rollout, tau_d_bar: Mat, law_bar: Packed
) -> None:
    """Gradient with respect to start, disturbance and weights of the law.

    Args:
        course: what the motion followed.
        scene: what all motions share.
        law: the law.
        work: scratch space (`rollout_workspace`).
        run: as `rollout` left it.
        bars: cotangents of states and torques, and zeros for those of the memory; what is gained per start is left in
            the first row of q and v, the rest is used up.
        tau_d_bar: written, (T, n).
        law_bar: the law with cotangents for weights; added to.
    """
    n = len(scene.limit)
    tau, work = take(work, n)
    path, work = take(work, 2 * scene.substeps * n)
    states = path.reshape(scene.substeps, 2, n)
    for k in range(len(course.leads) - 1, -1, -1):
        after_bar, tau_bar = State(bars.q[k + 1], bars.v[k + 1]), tau_d_bar[k]
        tau_bar[:] = 0.0
        acting(run.command[k], course.tau_d[k], scene, tau)
        states[0, 0], states[0, 1] = run.q[k], run.v[k]
        for s in range(1, scene.substeps):
            states[s] = states[s - 1]
            advance(State(states[s, 0], states[s, 1]), tau, scene, work)
        for s in range(scene.substeps - 1, -1, -1):
            _step_adjoint(State(states[s, 0], states[s, 1]), tau, scene, work, after_bar, tau_bar)
        for i in range(n):
            bars.q[k, i] += after_bar.q[i]
            bars.v[k, i] += after_bar.v[i]
            if abs(run.command[k, i]) <= scene.limit[i]:
                bars.command[k, i] += tau_bar[i]
        _ask_adjoint(k, course, scene, law, work, run, bars, law_bar)


@inlined
def acting(command: Vec, tau_d: Vec, scene: Scene, tau: Vec) -> None:
    """The torque that acts → tau."""
    for i in range(len(tau)):
        tau[i] = min(max(command[i], -scene.limit[i]), scene.limit[i]) + tau_d[i]


@inlined
def looking_ahead(k: int, course: Course, run: Rollout, seen: State) -> Target:
    """The state that the law sees at instant k → seen; where it is to go."""
    aim, lead = course.aims[k], course.leads[k]
    for i in range(len(seen.q)):
        dv = lead * aim[0, i]
        seen.q[i], seen.v[i] = run.q[k, i] + lead * (run.v[k, i] + 0.5 * dv), run.v[k, i] + dv
    return Target(aim[1], aim[2], aim[3])


@inlined
def _remembered(k: int, run: Rollout) -> Memory:
    """What a PID remembers at instant k."""
    return Memory(run.memory[k, 0], run.memory[k, 1])


@kernel
def _ask(k: int, course: Course, scene: Scene, law: Packed, work: Vec, run: Rollout) -> None:
    """The torque that the law asks for at instant k, and what it remembers afterwards."""
    q, v, work = take2(work, len(scene.limit))
    seen, tau = State(q, v), run.command[k]
    target = looking_ahead(k, course, run, seen)
    if law.layout[LAW] == LawCode.PID:
        memory, after, aim = _remembered(k, run), _remembered(k + 1, run), State(target.q, target.v)
        pid_step(memory, seen, aim, scene.period, pid_of(law.weights), tau, after)
    else:
        torque_of(seen, target, law, scene.belief, work, tau)


@kernel
def _ask_adjoint(
    k: int, course: Course, scene: Scene, law: Packed, work: Vec, run: Rollout, bars: Rollout, law_bar: Packed
) -> None:
    """Adds to the cotangents of the state at instant k, of what a PID remembers there, and of the law's weights."""
    n, lead, tau_bar = len(scene.limit), course.leads[k], bars.command[k]
    q, v, q_bar, v_bar, work = take4(work, n)
    seen, seen_bar = State(q, v), State(q_bar, v_bar)
    target = looking_ahead(k, course, run, seen)
    q_bar[:], v_bar[:] = 0.0, 0.0
    if law.layout[LAW] == LawCode.PID:
        memory, aim = _remembered(k, run), State(target.q, target.v)
        memory_bar, after_bar = _remembered(k, bars), _remembered(k + 1, bars)
        pid_adjoint(
            memory, seen, aim, scene.period, law.weights, tau_bar, after_bar, memory_bar, seen_bar, law_bar.weights
        )
    else:
        v_r, a_r, feedback, work = take3(work, n)
        v_r_bar, a_r_bar, work = take2(work, n)
        signals_of(seen, target, law, work, Signals(v_r, a_r, feedback))
        v_r_bar[:], a_r_bar[:] = 0.0, 0.0
        motion_bar = Motion(q_bar, v_bar, v_r_bar, a_r_bar)
        tree_torque_adjoint(Motion(q, v, v_r, a_r), tau_bar, scene.belief, work, motion_bar)
        law_adjoint(seen, target, law, work, Signals(v_r_bar, a_r_bar, tau_bar), seen_bar, law_bar)
    for i in range(n):
        bars.q[k, i] += q_bar[i]
        bars.v[k, i] += v_bar[i] + lead * q_bar[i]


@kernel
def _accelerate(s: int, stages: Stages, tau: Vec, scene: Scene, work: Vec) -> None:
    """v̇ of the plant with its friction, at the state of stage s."""
    n, net = len(tau), stages.net
    state = State(row(stages.q, s, n), row(stages.v, s, n))
    for i in range(n):
        drag = scene.coulomb[i]
        if drag > 0.0:
            drag *= math.tanh(state.v[i] / scene.transition)
        net[i] = tau[i] - scene.viscous[i] * state.v[i] - drag
    tree_acceleration(state, net, scene.truth, work, stages.factors[s], row(stages.a, s, n))


@kernel
def _accelerate_adjoint(
    s: int, stages: Stages, a_bar: Vec, scene: Scene, work: Vec, state_bar: State, tau_bar: Vec
) -> None:
    n, net_bar = len(a_bar), stages.net
    state, a = State(row(stages.q, s, n), row(stages.v, s, n)), row(stages.a, s, n)
    net_bar[:] = 0.0
    tree_acceleration_adjoint(state, a, a_bar, scene.truth, work, stages.factors[s], state_bar, net_bar)
    for i in range(n):
        slope = scene.viscous[i]
        if scene.coulomb[i] > 0.0:
            share = math.tanh(state.v[i] / scene.transition)
            slope += scene.coulomb[i] * (1.0 - share * share) / scene.transition
        state_bar.v[i] -= slope * net_bar[i]
        tau_bar[i] += net_bar[i]


@inlined
def _tableau(integrator: int, s: int) -> tuple[int, float, float, bool]:
    """How many stages an integrator has, b_s, c_s, and whether v⁺ moves q; b_s of an unknown one is NaN.

    With x_s the state of stage s and k_s = (v_s, a_s): x_s = x + c_s h k_{s−1} and x⁺ = x + h Σ b_s k_s. Where v⁺ moves
    q, h²a is added to q⁺.
    """
    if integrator == IntegratorCode.RK4:
        return STAGES, 1.0 / 6.0 if s in (0, 3) else 1.0 / 3.0, 0.0 if s == 0 else (1.0 if s == 3 else 0.5), False
    if integrator == IntegratorCode.SEMI_IMPLICIT_EULER:
        return 1, 1.0, 0.0, True
    if integrator == IntegratorCode.EULER:
        return 1, 1.0, 0.0, False
    return 1, math.nan, 0.0, False


@inlined
def _run_stages(state: State, tau: Vec, scene: Scene, work: Vec) -> tuple[Stages, Vec]:
    """The states and accelerations of the integrator's stages in scratch space, and the rest of that."""
    n, h = len(tau), scene.step
    q, v, a, work = take3(work, STAGES * n)
    net, work = take(work, n)
    factors, work = take(work, STAGES * n * n)
    stages = Stages(q, v, a, net, factors.reshape(STAGES, n, n))
    for i in range(n):
        q[i], v[i] = state.q[i], state.v[i]
    _accelerate(0, stages, tau, scene, work)
    for s in range(1, _tableau(scene.integrator, 0)[0]):
        c, before, now = _tableau(scene.integrator, s)[2], (s - 1) * n, s * n
        for i in range(n):
            q[now + i], v[now + i] = state.q[i] + c * h * v[before + i], state.v[i] + c * h * a[before + i]
        _accelerate(s, stages, tau, scene, work)
    return stages, work


@kernel
def advance(state: State, tau: Vec, scene: Scene, work: Vec) -> None:
    """One plant step in place."""
    n, h = len(tau), scene.step
    stages, work = _run_stages(state, tau, scene, work)
    count, _, _, ahead = _tableau(scene.integrator, 0)
    for s in range(count):
        b, v, a = _tableau(scene.integrator, s)[1], row(stages.v, s, n), row(stages.a, s, n)
        for i in range(n):
            state.q[i] += h * b * v[i]
            state.v[i] += h * b * a[i]
            if ahead:
                state.q[i] += h * h * a[i]


@kernel
def _step_adjoint(state: State, tau: Vec, scene: Scene, work: Vec, state_bar: State, tau_bar: Vec) -> None:
    """Cotangents of the state after a plant step → those of the state before it, in place; tau_bar is added to.

    The cotangent of k_s is b_s h x̄⁺ + c_{s+1} h x̄_{s+1} (`_tableau`), and that of x is x̄⁺ + Σ x̄_s.
    """
    n, h = len(tau), scene.step
    stages, work = _run_stages(state, tau, scene, work)
    count, _, _, ahead = _tableau(scene.integrator, 0)
    a_bar, q_sum, v_sum, work = take3(work, n)
    q_s, v_s, work = take2(work, n)
    q_s[:], v_s[:], q_sum[:], v_sum[:] = 0.0, 0.0, 0.0, 0.0
    for s in range(count - 1, -1, -1):
        b, c = h * _tableau(scene.integrator, s)[1], 0.0 if s + 1 == count else h * _tableau(scene.integrator, s + 1)[2]
        for i in range(n):
            a_bar[i] = b * state_bar.v[i] + c * v_s[i]
            if ahead:
                a_bar[i] += h * h * state_bar.q[i]
            v_s[i] = b * state_bar.q[i] + c * q_s[i]
            q_s[i] = 0.0
        _accelerate_adjoint(s, stages, a_bar, scene, work, State(q_s, v_s), tau_bar)
        for i in range(n):
            q_sum[i] += q_s[i]
            v_sum[i] += v_s[i]
    for i in range(n):
        state_bar.q[i] += q_sum[i]
        state_bar.v[i] += v_sum[i]
