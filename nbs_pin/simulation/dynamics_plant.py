"""A dynamics provider integrated in time is a plant."""

import numpy as np

from nbs_pin.base.arrays import Array, Vectors, is_torch_array
from nbs_pin.base.checks import all_finite
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.dynamics.friction import JointFriction, friction_of_size
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.integrators import INTEGRATORS, IntegratorName
from nbs_pin.simulation.plant import Plant


class DynamicsPlant(Plant):
    """M(q) v̇ + C(q, v) v + G(q) + friction(v) = τ for any provider, the torque held over each step.

    dynamics: the truth; with `PinocchioDynamics` the Pinocchio plant, with a learned model the learned plant.
    integrator: "rk4", "semi_implicit_euler" or "euler" (`integrators.py`).
    friction: joint friction of the plant, or None for none.
    Raises ArgumentError for an unknown integrator or friction of another number of joints.
    """

    def __init__(
        self, dynamics: DynamicsProvider, integrator: IntegratorName = "rk4", friction: JointFriction | None = None
    ) -> None:
        if integrator not in INTEGRATORS:
            raise ArgumentError(f"integrator '{integrator}' is unknown; give one of {', '.join(INTEGRATORS)}.")
        self.dynamics = dynamics
        self.integrator = integrator
        self.friction = friction_of_size(friction, dynamics.nv)
        self._step = INTEGRATORS[integrator]

    @classmethod
    def for_robot(
        cls, robot: Robot, integrator: IntegratorName | None = None, joint_friction: str = "drop"
    ) -> "DynamicsPlant":
        """Pinocchio's dynamics of the arm, by RK4 unless told otherwise, with the joint friction that its URDF states.

        Raises:
            ArgumentError: For an unknown integrator or a joint_friction other than "drop" and "keep".
        """
        if joint_friction not in ("drop", "keep"):
            raise ArgumentError(f"joint_friction '{joint_friction}' is unknown; give 'drop' or 'keep'.")
        friction = JointFriction.of(robot) if joint_friction == "keep" else None
        return cls(PinocchioDynamics(robot), integrator or "rk4", friction)

    def __repr__(self) -> str:
        return f"DynamicsPlant({type(self.dynamics).__name__}, {self.integrator})"

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.dynamics.nv

    @property
    def robot(self) -> Robot | None:
        """The arm of the provider, or None."""
        return self.dynamics.robot

    def step(self, q: Vectors, v: Vectors, tau: Vectors, duration: float) -> tuple[Vectors, Vectors]:
        """State (q, v) after one integration step of `duration` [s] with τ [N·m] held (zero-order hold).

        Numpy in, numpy out; torch in, differentiable torch out.

        Raises SimulationDiverged when the result is not finite.
        """
        dynamics, friction = self.dynamics, self.friction

        def acceleration(q: Array, v: Array) -> Array:
            net = tau if friction is None else tau - friction.torque(v)
            return dynamics.forward_dynamics(q, v, net)

        with np.errstate(over="ignore", invalid="ignore"):  # overflow is reported below, with its cause
            q, v = self._step(acceleration, q, v, duration)
        if not (_finite(q) and _finite(v)):
            raise SimulationDiverged(
                f"{self!r} left the finite numbers in a step of {duration:g} s; "
                "take a shorter plant step, or look for an unstable controller."
            )
        return q, v


def _finite(x: Array) -> bool:
    return bool(x.isfinite().all()) if is_torch_array(x) else all_finite(x)
