"""Relative errors of a model on states of a box.

A relative error is ‖x̂ − x‖_F/‖x‖_F with x stacked over the samples: the root mean square of the errors of the samples,
each relative to the RMS size of x.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray, Vectors, matvec
from nbs_pin.base.checks import PerJoint, floats, is_usual, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import joints_told
from nbs_pin.dynamics.equations import inverse_dynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.robots.robot import Robot

ACCELERATION = 5.0
"""Largest acceleration of the samples, which is uniformly distributed [rad/s²]."""

Value: TypeAlias = Float[np.ndarray, "*points"] | float
"""One number, or one per sample or cell."""


class Errors(NamedTuple):
    """Relative errors of a model: one number each, or an array with one per sample or cell."""

    mass_matrix: Value
    """Error of M."""
    coriolis: Value
    """Error of C(q, v) v."""
    gravity: Value
    """Error of G."""
    inverse: Value
    """Error of the torque M v̇ + C v + G for a given acceleration."""
    forward: Value
    """Error of the acceleration for a given torque."""


@dataclass(frozen=True, eq=False)
class Box:
    """States for a comparison: lower ≤ q ≤ upper and |v_i| ≤ speed_i."""

    lower: JointArray
    upper: JointArray
    """Range of q [rad, m for a prismatic joint]."""
    speed: JointArray
    """Largest |v_i| [rad/s, m/s]."""

    @classmethod
    def of(cls, lower: PerJoint, upper: PerJoint, speed: PerJoint, nv: int) -> "Box":
        """The box for nv joints, from one number or one per joint; raises ArgumentError if it is empty or infinite."""
        given = {"the lower end": lower, "the upper end": upper, "the speed": speed}
        arrays = {name: floats(f"{name} of the box", value) for name, value in given.items()}
        for name, x in arrays.items():
            if x.shape not in ((), (nv,)) or not is_usual(x):
                raise ArgumentError(f"{name} of the box is {told(x)}; give one finite number, or {nv} of them.")
        low, high, fast = (np.full(nv, x) for x in arrays.values())
        if not ((low < high).all() and (fast > 0.0).all()):
            raise ArgumentError(
                f"the box from {low.tolist()} to {high.tolist()} with speeds {fast.tolist()} is empty; give lower < "
                "upper and speeds > 0 for every joint."
            )
        return cls(low, high, fast)

    @classmethod
    def of_robot(cls, robot: Robot | None, nv: int, speed: PerJoint) -> "Box":
        """The box of the robot's position limits, or [−π, π] for all joints without a robot.

        A revolute joint without limits, or with more than one turn between them, gets one turn about their middle.
        """
        if robot is None:
            return cls.of(-np.pi, np.pi, speed, nv)
        return cls.of(*robot.one_turn_range, speed, nv)

    def states(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Uniform (q, v, v̇), (count, n) each, v̇ up to `ACCELERATION`."""
        q, v, a = rng.uniform(-1.0, 1.0, (3, count, len(self.lower)))
        return self.at(q), self.speed * v, ACCELERATION * a

    def at(self, u: Vectors) -> Vectors:
        """The configuration [rad] at u, in coordinates where the box is [−1, 1]ⁿ."""
        return 0.5 * (self.lower + self.upper) + 0.5 * (self.upper - self.lower) * u


class Judged(NamedTuple):
    """Errors and torques of a model on given states."""

    each: Errors
    """Errors of the states, (samples,) each."""
    true: Float[np.ndarray, "samples n"]
    """True torque for the given acceleration [N·m]."""
    modelled: Float[np.ndarray, "samples n"]
    """Torque of the model for the given acceleration [N·m]."""

    @property
    def errors(self) -> Errors:
        """Errors over all states, one number each."""
        return Errors(*(float(np.sqrt(np.mean(np.square(e)))) for e in self.each))


def judge(
    model: DynamicsProvider,
    truth: DynamicsProvider,
    q: Float[np.ndarray, "samples n"],
    v: Float[np.ndarray, "samples n"],
    a: Float[np.ndarray, "samples n"],
) -> Judged:
    """Errors on states with acceleration a [rad/s²], those of forward dynamics under the true torque for a.

    Raises:
        ArgumentError: If the numbers of joints differ, or the model is not finite at some state.
    """
    check_joints(model, truth)
    true, modelled = (
        [d.mass_matrix(q), matvec(d.coriolis_matrix(q, v), v), d.gravity(q), inverse_dynamics(d, q, v, a)]
        for d in (truth, model)
    )
    true, modelled = [*true, a], [*modelled, model.forward_dynamics(q, v, true[3])]
    for name, x in zip(Errors._fields, modelled, strict=True):
        if not np.isfinite(x).all():
            raise ArgumentError(
                f"the model's {name.replace('_', ' ')} is not finite in {int((~np.isfinite(x)).sum())} of {x.size} "
                "numbers; fit the model again, or use a smaller box."
            )
    return Judged(Errors(*map(_shares, modelled, true)), true[3], modelled[3])


def check_joints(model: DynamicsProvider, truth: DynamicsProvider) -> None:
    """Raise ArgumentError unless both models have the same number of joints."""
    if model.nv != truth.nv:
        raise ArgumentError(
            f"the model has {joints_told(model.nv)} and the truth {truth.nv}; compare models of one arm."
        )


def share(error: Any, size: Any) -> Any:
    """Error ÷ size; 0 where both are 0, inf where only the size is."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.equal(error, 0.0), 0.0, np.divide(error, size))


def _shares(modelled: np.ndarray, true: np.ndarray) -> np.ndarray:
    """‖x̂ − x‖ of each sample relative to the RMS of ‖x‖."""
    size, error = (np.linalg.norm(x.reshape(len(x), -1), axis=1) for x in (true, modelled - true))
    return share(error, np.sqrt(np.mean(size**2)))
