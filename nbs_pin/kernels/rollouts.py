"""A whole closed-loop motion of one start as a kernel, and its adjoint: one pass forward, one pass back.

    x̂ = (q + ℓ(v + ½ℓa), v + ℓa)        the state ℓ seconds ahead, with the reference's acceleration a
    c = law(x̂, aim),  τ = clip(c) + τ_d     the torque asked for, and the one that acts for a whole period
    x⁺ = plant(x, τ)                     `substeps` steps of one integrator

The adjoint takes the cotangents of every state and of every torque asked for, and recomputes what it needs from the
states alone. Where a clip saturates, its derivative is 0: the torque there does not depend on what was asked for.
"""

import math
from typing import NamedTuple

import numpy as np

from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.law_adjoints import adjoint_workspace, law_adjoint, pid_adjoint
from nbs_pin.kernels.laws import law_row, pid
from nbs_pin.kernels.layout import PID, Packed
from nbs_pin.kernels.tree_laws import tree_law
from nbs_pin.kernels.trees import tree_acceleration, tree_acceleration_adjoint, tree_torque_adjoint, tree_workspace

EULER, SEMI_IMPLICIT_EULER, RK4 = 0, 1, 2
"""Integrators, by the equations of `plants/integrators.py`."""
INTEGRATOR_CODES = {"euler": EULER, "semi_implicit_euler": SEMI_IMPLICIT_EULER, "rk4": RK4}
"""The same, by the names a plant knows."""
_VECTORS, _FACTORS = 48, 4


class Scene(NamedTuple):
    """What a motion depends on beside its start and the law's weights; what all starts share."""

    clock: np.ndarray
    """Period, plant step [s], transition speed of the plant's friction [rad/s]."""
    counts: np.ndarray
    """Integrator, plant steps per period; int64."""
    limit: np.ndarray
    """Largest torque [N·m], (n,), inf for none."""
    friction: np.ndarray
    """Viscous [N·m·s/rad] and Coulomb [N·m] friction of the plant, (2, n)."""
    belief: tuple[np.ndarray, np.ndarray]
    """The law's tree."""
    truth: tuple[np.ndarray, np.ndarray]
    """The plant's tree."""


def rollout_workspace(law: Packed, scene: Scene) -> int:
    """How many numbers of scratch space `rollout` and `rollout_adjoint` need."""
    n = len(scene.limit)
    trees = max(tree_workspace(Packed(*scene.belief)), tree_workspace(Packed(*scene.truth)))
    laws = 0 if int(law.layout[0]) == PID else max(int(law.layout[7]), adjoint_workspace(law))
    return (_VECTORS + 2 * int(scene.counts[1])) * n + _FACTORS * n * n + max(trees, laws)


@kernel
def rollout(
    aims: np.ndarray,
    leads: np.ndarray,
    tau_d: np.ndarray,
    scene: Scene,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    command: np.ndarray,
    memory: np.ndarray,
) -> None:
    """States after each period → q[1:], v[1:] (T + 1, n), torques asked for → command (T, n), from q[0], v[0].

    aims: (T, 4, n), the reference's acceleration now, then q_d, v_d, a_d where the law looks. leads: (T,) [s].
    tau_d: (T, n) disturbance [N·m]. memory: (T + 1, 2, n), what a PID remembers.
    """
    n = len(scene.limit)
    tau = work[:n]
    memory[0] = 0.0
    for k in range(len(leads)):
        _ask(q[k], v[k], aims[k], leads[k], scene, layout, weights, work[n:], memory[k], memory[k + 1], command[k])
        for i in range(n):
            tau[i] = min(max(command[k, i], -scene.limit[i]), scene.limit[i]) + tau_d[k, i]
        q[k + 1], v[k + 1] = q[k], v[k]
        for _ in range(scene.counts[1]):
            _step(q[k + 1], v[k + 1], tau, scene, work[n:])


@kernel
def rollout_adjoint(
    aims: np.ndarray,
    leads: np.ndarray,
    tau_d: np.ndarray,
    scene: Scene,
    layout: np.ndarray,
    weights: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    command: np.ndarray,
    memory: np.ndarray,
    work: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    command_bar: np.ndarray,
    tau_d_bar: np.ndarray,
    weights_bar: np.ndarray,
) -> None:
    """Cotangents in q_bar, v_bar (T + 1, n) and command_bar (T, n) → those of the start in q_bar[0], v_bar[0].

    The rows after the first are used up. tau_d_bar (T, n) is written, weights_bar added to.
    """
    n, substeps = len(scene.limit), scene.counts[1]
    tau, memory_bar, tau_bar = work[:n], work[n : 3 * n], work[3 * n : 4 * n]
    path = work[4 * n : 4 * n + 2 * n * substeps].reshape(substeps, 2, n)
    room = work[4 * n + 2 * n * substeps :]
    memory_bar[:] = 0.0
    for k in range(len(leads) - 1, -1, -1):
        for i in range(n):
            tau[i] = min(max(command[k, i], -scene.limit[i]), scene.limit[i]) + tau_d[k, i]
        path[0, 0], path[0, 1] = q[k], v[k]
        for s in range(1, substeps):
            path[s] = path[s - 1]
            _step(path[s, 0], path[s, 1], tau, scene, room)
        tau_bar[:] = 0.0
        for s in range(substeps - 1, -1, -1):
            _step_adjoint(path[s, 0], path[s, 1], tau, scene, room, q_bar[k + 1], v_bar[k + 1], tau_bar)
        for i in range(n):
            q_bar[k, i] += q_bar[k + 1, i]
            v_bar[k, i] += v_bar[k + 1, i]
            tau_d_bar[k, i] = tau_bar[i]
            if abs(command[k, i]) <= scene.limit[i]:
                command_bar[k, i] += tau_bar[i]
        _ask_adjoint(
            q[k], v[k], aims[k], leads[k], scene, layout, weights, memory[k], room,
            command_bar[k], memory_bar, q_bar[k], v_bar[k], weights_bar,
        )  # fmt: skip


@kernel
def _ahead(q: np.ndarray, v: np.ndarray, a: np.ndarray, lead: float, q_seen: np.ndarray, v_seen: np.ndarray) -> None:
    for i in range(len(q)):
        dv = lead * a[i]
        q_seen[i], v_seen[i] = q[i] + lead * (v[i] + 0.5 * dv), v[i] + dv


@kernel
def _ask(
    q: np.ndarray,
    v: np.ndarray,
    aim: np.ndarray,
    lead: float,
    scene: Scene,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    memory: np.ndarray,
    after: np.ndarray,
    command: np.ndarray,
) -> None:
    """The torque the law asks for, and what it remembers afterwards."""
    n = len(q)
    q_seen, v_seen, room = work[:n], work[n : 2 * n], work[5 * n :]
    _ahead(q, v, aim[0], lead, q_seen, v_seen)
    if layout[0] == PID:
        out, gains = work[2 * n : 5 * n].reshape(3, n), weights.reshape(6, n)
        pid(memory[0], memory[1], q_seen, v_seen, aim[1], aim[2], scene.clock[0], gains, out)
        command[:], after[0], after[1] = out[0], out[1], out[2]
        return
    tree, bodies = scene.belief
    tree_law(q_seen, v_seen, aim[1], aim[2], aim[3], layout, weights, tree, bodies, room, command)


@kernel
def _ask_adjoint(
    q: np.ndarray,
    v: np.ndarray,
    aim: np.ndarray,
    lead: float,
    scene: Scene,
    layout: np.ndarray,
    weights: np.ndarray,
    memory: np.ndarray,
    work: np.ndarray,
    command_bar: np.ndarray,
    memory_bar: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    weights_bar: np.ndarray,
) -> None:
    """Adds to q_bar, v_bar and weights_bar; memory_bar goes from what follows the step to what precedes it."""
    n = len(q)
    q_seen, v_seen, qs_bar, vs_bar = work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n : 4 * n]
    v_r, a_r, feedback = work[4 * n : 5 * n], work[5 * n : 6 * n], work[6 * n : 7 * n]
    v_r_bar, a_r_bar, room = work[7 * n : 8 * n], work[8 * n : 9 * n], work[14 * n :]
    _ahead(q, v, aim[0], lead, q_seen, v_seen)
    qs_bar[:], vs_bar[:] = 0.0, 0.0
    if layout[0] == PID:
        out_bar = work[9 * n : 12 * n].reshape(3, n)
        before = work[12 * n : 14 * n]
        out_bar[0], out_bar[1], out_bar[2] = command_bar, memory_bar[:n], memory_bar[n:]
        before[:] = 0.0
        gains, gains_bar = weights.reshape(6, n), weights_bar.reshape(6, n)
        pid_adjoint(
            memory[0], memory[1], q_seen, v_seen, aim[1], aim[2], scene.clock[0], gains, out_bar,
            before[:n], before[n:], qs_bar, vs_bar, gains_bar,
        )  # fmt: skip
        memory_bar[:] = before
    else:
        law_row(q_seen, v_seen, aim[1], aim[2], aim[3], layout, weights, room, v_r, a_r, feedback)
        v_r_bar[:], a_r_bar[:] = 0.0, 0.0
        tree_torque_adjoint(
            q_seen, v_seen, v_r, a_r, command_bar, scene.belief[0], scene.belief[1], room,
            qs_bar, vs_bar, v_r_bar, a_r_bar,
        )  # fmt: skip
        law_adjoint(
            q_seen, v_seen, aim[1], aim[2], aim[3], layout, weights, room, v_r_bar, a_r_bar, command_bar,
            qs_bar, vs_bar, weights_bar,
        )  # fmt: skip
    for i in range(n):
        q_bar[i] += qs_bar[i]
        v_bar[i] += vs_bar[i] + lead * qs_bar[i]


@kernel
def _accelerate(
    q: np.ndarray,
    v: np.ndarray,
    tau: np.ndarray,
    scene: Scene,
    room: np.ndarray,
    net: np.ndarray,
    factor: np.ndarray,
    a: np.ndarray,
) -> None:
    """v̇ of the plant with its friction."""
    for i in range(len(q)):
        drag = scene.friction[1, i]
        if drag > 0.0:
            drag *= math.tanh(v[i] / scene.clock[2])
        net[i] = tau[i] - scene.friction[0, i] * v[i] - drag
    tree_acceleration(q, v, net, scene.truth[0], scene.truth[1], room, factor, a)


@kernel
def _accelerate_adjoint(
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    a_bar: np.ndarray,
    scene: Scene,
    room: np.ndarray,
    net_bar: np.ndarray,
    factor: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    tau_bar: np.ndarray,
) -> None:
    net_bar[:] = 0.0
    tree_acceleration_adjoint(q, v, a, a_bar, scene.truth[0], scene.truth[1], room, factor, q_bar, v_bar, net_bar)
    for i in range(len(q)):
        slope = scene.friction[0, i]
        if scene.friction[1, i] > 0.0:
            s = math.tanh(v[i] / scene.clock[2])
            slope += scene.friction[1, i] * (1.0 - s * s) / scene.clock[2]
        v_bar[i] -= slope * net_bar[i]
        tau_bar[i] += net_bar[i]


@kernel
def _stages(q: np.ndarray, v: np.ndarray, tau: np.ndarray, scene: Scene, work: np.ndarray) -> None:
    """The states and accelerations of an integrator's stages → work: rows q, v, a of each, (4, 3, n), and factors."""
    n, h = len(q), scene.clock[1]
    stage = work[n : 13 * n].reshape(4, 3, n)
    factors = work[13 * n : 13 * n + 4 * n * n].reshape(4, n, n)
    room = work[13 * n + 4 * n * n :]
    stage[0, 0], stage[0, 1] = q, v
    _accelerate(stage[0, 0], stage[0, 1], tau, scene, room, work[:n], factors[0], stage[0, 2])
    if scene.counts[0] != RK4:
        return
    for s in range(1, 4):
        c = h if s == 3 else 0.5 * h
        for i in range(n):
            stage[s, 0, i] = q[i] + c * stage[s - 1, 1, i]
            stage[s, 1, i] = v[i] + c * stage[s - 1, 2, i]
        _accelerate(stage[s, 0], stage[s, 1], tau, scene, room, work[:n], factors[s], stage[s, 2])


@kernel
def _step(q: np.ndarray, v: np.ndarray, tau: np.ndarray, scene: Scene, work: np.ndarray) -> None:
    """One plant step in place."""
    n, h, integrator = len(q), scene.clock[1], scene.counts[0]
    _stages(q, v, tau, scene, work)
    stage = work[n : 13 * n].reshape(4, 3, n)
    for i in range(n):
        if integrator == RK4:
            q[i] += h / 6.0 * (stage[0, 1, i] + 2.0 * (stage[1, 1, i] + stage[2, 1, i]) + stage[3, 1, i])
            v[i] += h / 6.0 * (stage[0, 2, i] + 2.0 * (stage[1, 2, i] + stage[2, 2, i]) + stage[3, 2, i])
        elif integrator == SEMI_IMPLICIT_EULER:
            v[i] += h * stage[0, 2, i]
            q[i] += h * v[i]
        else:
            q[i] += h * v[i]
            v[i] += h * stage[0, 2, i]


@kernel
def _step_adjoint(
    q: np.ndarray,
    v: np.ndarray,
    tau: np.ndarray,
    scene: Scene,
    work: np.ndarray,
    q_bar: np.ndarray,
    v_bar: np.ndarray,
    tau_bar: np.ndarray,
) -> None:
    """Cotangents of the state after a plant step → those of the state before it, in place; tau_bar is added to.

    With x_s the state of stage s and k_s = (v_s, a_s): x_s = x + c_s h k_{s−1} and x⁺ = x + h Σ b_s k_s, so that the
    cotangent of k_s is b_s h x̄⁺ + c_{s+1} h x̄_{s+1}, and that of x is x̄⁺ + Σ x̄_s.
    """
    n, h, integrator = len(q), scene.clock[1], scene.counts[0]
    _stages(q, v, tau, scene, work)
    stage = work[n : 13 * n].reshape(4, 3, n)
    factors = work[13 * n : 13 * n + 4 * n * n].reshape(4, n, n)
    bars = work[13 * n + 4 * n * n : 19 * n + 4 * n * n].reshape(6, n)
    a_bar, q_s, v_s, q_sum, v_sum, net_bar = bars[0], bars[1], bars[2], bars[3], bars[4], bars[5]
    room = work[19 * n + 4 * n * n :]
    if integrator != RK4:
        for i in range(n):
            if integrator == SEMI_IMPLICIT_EULER:
                v_bar[i] += h * q_bar[i]
                a_bar[i] = h * v_bar[i]
            else:
                a_bar[i] = h * v_bar[i]
                v_bar[i] += h * q_bar[i]
        _accelerate_adjoint(q, v, stage[0, 2], a_bar, scene, room, net_bar, factors[0], q_bar, v_bar, tau_bar)
        return
    q_s[:], v_s[:], q_sum[:], v_sum[:] = 0.0, 0.0, 0.0, 0.0
    for s in range(3, -1, -1):
        b = h / 6.0 if s in (0, 3) else h / 3.0
        c = 0.0 if s == 3 else (h if s == 2 else 0.5 * h)
        for i in range(n):
            a_bar[i] = b * v_bar[i] + c * v_s[i]
            v_s[i] = b * q_bar[i] + c * q_s[i]
            q_s[i] = 0.0
        _accelerate_adjoint(
            stage[s, 0], stage[s, 1], stage[s, 2], a_bar, scene, room, net_bar, factors[s], q_s, v_s, tau_bar
        )
        for i in range(n):
            q_sum[i] += q_s[i]
            v_sum[i] += v_s[i]
    for i in range(n):
        q_bar[i] += q_sum[i]
        v_bar[i] += v_sum[i]
