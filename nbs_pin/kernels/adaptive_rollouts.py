"""A whole closed-loop motion of an adaptive law from one start as a kernel: `rollouts.py` with estimates that move."""

import math

from nbs_pin.kernels import layout as at
from nbs_pin.kernels.adaptation import adaptive_step, adaptive_workspace
from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import State, Vec
from nbs_pin.kernels.rollouts import Course, Rollout, Scene, acting, advance, looking_ahead, rollout_workspace
from nbs_pin.kernels.views import take, take2


def adaptive_rollout_workspace(law: Packed, tree: Packed, scene: Scene) -> int:
    """Size of the scratch space that `adaptive_rollout` needs.

    Args:
        law: the law.
        tree: the model that is believed at first.
        scene: what the motions share.
    """
    n = len(scene.limit)
    return 3 * n + max(adaptive_workspace(law, tree), rollout_workspace(law, scene))


@kernel
def adaptive_rollout(
    course: Course, scene: Scene, waits: Vec, law: Packed, tree: Packed, unknown: Packed, duals: Vec, work: Vec,
    run: Rollout,
) -> bool:  # fmt: skip
    """A motion from its start.

    Args:
        course: what it follows.
        scene: what all motions share; its `belief` is not used.
        waits: torque beyond which the estimates wait [N·m], (n,).
        law: the law that adapts.
        tree: the model that is believed at first.
        unknown: what adapts (`adaptation.py`).
        duals: those at the start, and written, those at the end.
        work: scratch space (`adaptive_rollout_workspace`).
        run: written, but for the state in its first row, the start; its memory are the last two outputs.

    Returns:
        Whether all states and torques are finite.
    """
    n = law.layout[at.JOINTS]
    tau, work = take(work, n)
    q, v, rest = take2(work, n)
    run.memory[0] = 0.0
    finite = True
    for k in range(len(course.leads)):
        seen = State(q, v)
        target = looking_ahead(k, course, run, seen)
        for i in range(n):  # an assignment to a row would first ask whether the two overlap
            run.memory[k + 1, 1, i] = run.memory[k, 0, i]
        adaptive_step(
            run.memory[k, 1], seen, target, scene.period, waits, law, tree, unknown, rest,
            run.command[k], duals, run.memory[k + 1, 0],
        )  # fmt: skip
        acting(run.command[k], course.tau_d[k], scene, tau)
        for i in range(n):
            run.q[k + 1, i], run.v[k + 1, i] = run.q[k, i], run.v[k, i]
        for _ in range(scene.substeps):
            advance(State(run.q[k + 1], run.v[k + 1]), tau, scene, work)
        for i in range(n):
            finite = finite and math.isfinite(run.command[k, i]) and math.isfinite(run.q[k + 1, i])
            finite = finite and math.isfinite(run.v[k + 1, i])
    return finite
