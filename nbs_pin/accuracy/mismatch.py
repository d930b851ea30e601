"""The mismatch δ of a model along a closed loop, and a bound of it with a stated confidence.

δ = (M − M̂) v̇ + (C − Ĉ) v + (G − Ĝ) [N·m] is the true torque minus the modelled torque at the true acceleration:
M̂v̇ + Ĉv + Ĝ + δ = τ + τ_d (paper, the equation before its Theorem 4). The corrected theorem requires
‖δ‖ ≤ a‖q‖ + b‖v‖ + c. As v̇ depends on the law, the constants hold for one law, not for the model (docs/theory.md §6).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import linprog
from scipy.special import betainccinv

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Run
from nbs_pin.base.shown import joints_told
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider

DOUBT = 1e-6
"""β: the probability that the drawn starts were so unusual that the stated violation is too small."""
_LEAST_WEIGHT = 0.1
_UNKNOWNS = 3


class Mismatch(NamedTuple):
    """δ along a run, and ‖δ‖ ≤ a‖q‖ + b‖v‖ + c in every row of every trajectory.

    With confidence 1 − `doubt`, a further trajectory of the same law, arm, reference and distribution of starts
    violates the bound at some control instant with probability at most `violation`.
    """

    a: float
    """[N·m/rad]."""
    b: float
    """[N·m·s/rad]."""
    c: float
    """[N·m]."""
    violation: float
    """ε, by the scenario theorem over trajectories, not samples; 1, which states nothing, for a single trajectory."""
    doubt: float
    """β, one minus the confidence."""
    trajectories: int
    """Number of independent starts, counted by distinct states in the first row."""
    rms: JointArray
    """Root mean square of δ per joint [N·m]."""
    t: Float[np.ndarray, " rows"]
    """Time [s]."""
    q_norm: Float[np.ndarray, "rows starts"]
    """‖q‖ [rad] in all rows but the last, whose torque was not applied."""
    v_norm: Float[np.ndarray, "rows starts"]
    """‖v‖ [rad/s]."""
    size: Float[np.ndarray, "rows starts"]
    """‖δ‖ [N·m]."""
    duration: float
    """Length of the trajectories [s]."""
    start_errors: JointArray
    """Largest |q(0) ⊖ q_d(0)| among the starts, per joint [rad]."""
    start_speeds: JointArray
    """Largest |v(0) − v_d(0)| among the starts, per joint [rad/s]."""
    q_ref: Float[np.ndarray, "rows n"]
    """q_d of the first trajectory [rad]."""
    disturbance: JointArray
    """Largest |τ_d| in the trajectories, per joint [N·m]."""

    def bound(self, q_norm: Float[np.ndarray, "*x"], v_norm: Float[np.ndarray, "*x"]) -> Float[np.ndarray, "*x"]:
        """a‖q‖ + b‖v‖ + c [N·m]."""
        return self.a * q_norm + self.b * v_norm + self.c


def mismatch(
    model: DynamicsProvider,
    truth: DynamicsProvider,
    run: Run,
    *,
    friction: JointFriction | None = None,
    doubt: float = DOUBT,
) -> Mismatch:
    """δ along a run with the truth as plant, and the (a, b, c) whose bound is smallest on average along the reference.

    Args:
        run: Axes between time and joint are independently drawn starts; equal first states count once.
        friction: Friction of the plant.

    Raises:
        ArgumentError: If the run has another number of joints, δ is not finite, or doubt is outside (0, 1).
    """
    if not 0.0 < doubt < 1.0:
        raise ArgumentError(f"doubt is {doubt}, expected a probability in (0, 1); 1e-6 is usual.")
    a = accelerations(truth, run, friction)
    q, v = run.q[:-1], run.v[:-1]
    rows = zip(q, v, a, strict=True)  # one instant at a time, to limit the memory that networks need
    delta = np.array([inverse_dynamics(truth, *row) - inverse_dynamics(model, *row) for row in rows])
    if not np.isfinite(delta).all():
        raise ArgumentError("the mismatch is not finite along the run; give a run that did not diverge.")
    norms = [np.linalg.norm(x, axis=-1).reshape(len(q), -1) for x in (q, v, delta)]
    # The scenario theorem needs an objective that is fixed before the starts are drawn, so it uses the reference only.
    weights = [max(float(np.linalg.norm(x, axis=-1).mean()), _LEAST_WEIGHT) for x in (run.q_ref, run.v_ref)]
    constants = _least_bound(norms[0].ravel(), norms[1].ravel(), norms[2].ravel(), weights)
    first = np.concatenate([x[0].reshape(-1, run.nv) for x in (q, v)], axis=1)
    count = len(np.unique(first, axis=0))
    rms = np.sqrt(np.mean(delta.reshape(-1, run.nv) ** 2, axis=0))
    return Mismatch(
        *constants,
        violation=violation_chance(count, doubt),
        doubt=doubt,
        trajectories=count,
        rms=rms,
        t=run.t[:-1],
        q_norm=norms[0],
        v_norm=norms[1],
        size=norms[2],
        duration=float(run.t[-1] - run.t[0]),
        start_errors=np.abs(model.difference(run.q[0], run.q_ref[0])).reshape(-1, run.nv).max(axis=0),
        start_speeds=np.abs(run.v[0] - run.v_ref[0]).reshape(-1, run.nv).max(axis=0),
        q_ref=run.q_ref[:-1].reshape(len(q), -1, run.nv)[:, 0],
        disturbance=np.abs(run.disturbance).reshape(-1, run.nv).max(axis=0),
    )


def accelerations(
    truth: DynamicsProvider, run: Run, friction: JointFriction | None = None
) -> Float[np.ndarray, "rows *batch n"]:
    """True v̇ [rad/s²] in all rows of a run but the last, whose torque was not applied."""
    if run.nv != truth.nv:
        raise ArgumentError(f"the run has {joints_told(run.nv)} and the truth {truth.nv}; give a run of that arm.")
    net = run.tau[:-1] + run.disturbance[:-1]
    if friction is not None:
        net = net - friction.torque(run.v[:-1], run.tau[:-1])
    return truth.forward_dynamics(run.q[:-1], run.v[:-1], net)


def violation_chance(trajectories: int, doubt: float = DOUBT, unknowns: int = _UNKNOWNS) -> float:
    """The smallest ε with Σ_{i<d} (N choose i) εⁱ(1 − ε)^{N−i} ≤ β, for d unknowns of a convex program.

    With β = 1e-6 and three unknowns, 374 trajectories give 5 % and 1905 give 1 %; too few trajectories give 1.
    Source: Campi and Garatti, "The exact feasibility of randomized solutions of uncertain convex programs" (2008).
    """
    if trajectories <= unknowns:
        return 1.0
    return float(betainccinv(unknowns, trajectories - unknowns + 1, doubt))


def _least_bound(
    q_norm: np.ndarray, v_norm: np.ndarray, size: np.ndarray, weights: list[float]
) -> tuple[float, float, float]:
    """(a, b, c) ≥ 0 that minimise w_q a + w_v b + c with a‖q‖ + b‖v‖ + c ≥ ‖δ‖ at every point, by cutting planes."""
    scale = float(size.max())
    if scale == 0.0:
        return 0.0, 0.0, 0.0
    points = np.column_stack([q_norm, v_norm, np.ones_like(q_norm)])
    wanted, chosen = size / scale, np.array([int(size.argmax())])
    while True:
        constants = linprog([*weights, 1.0], A_ub=-points[chosen], b_ub=-wanted[chosen]).x
        lack = wanted - points @ constants
        worst = np.argsort(-lack)[:30]
        if lack[worst[0]] <= 1e-7:
            break
        chosen = np.union1d(chosen, worst)
    a, b, c = (scale * np.maximum(constants, 0.0)).tolist()
    bound = a * q_norm + b * v_norm + c  # as `Mismatch.bound` computes it
    return a, b, c + max(0.0, float((size - bound).max())) + 4.0 * np.finfo(float).eps * float(bound.max())
