"""A plant from a dynamics model, integrated in time."""

from collections.abc import Iterable
from functools import partial

import numpy as np

from nbs_pin.base.arguments import DURATION, checked, choice, maybe
from nbs_pin.base.arrays import Array, Vectors, as_vectors, is_torch_array
from nbs_pin.base.checks import all_finite
from nbs_pin.base.doors import in_words, option
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged, TooLarge
from nbs_pin.dynamics.friction import JointFriction, friction_of_size
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.simulation.integrators import INTEGRATORS, IntegratorName
from nbs_pin.simulation.plant import Plant


class DynamicsPlant(Plant):
    """M(q) v̇ + C(q, v) v + G(q) + friction(v) = τ for any dynamics model, with the torque held over each step.

    Args:
        dynamics: The dynamics of the arm: `PinocchioDynamics` or any other model, a learned one included.
        integrator: "rk4", "semi_implicit_euler" or "euler" (`integrators.py`).
        friction: Joint friction, or None.

    Raises:
        ArgumentError: If integrator is unknown, or friction is for another number of joints.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(nbs.load_robot("two_link")))
        >>> plant.step(np.zeros(2), np.zeros(2), np.ones(2), 0.001)[1].round(4)
        array([-0.0108,  0.0128])
    """

    @checked(dynamics=MODEL, integrator=choice(*INTEGRATORS))
    def __init__(
        self, dynamics: DynamicsProvider, integrator: IntegratorName = "rk4", friction: JointFriction | None = None
    ) -> None:
        self.dynamics = dynamics
        self.integrator = integrator
        self.friction = friction_of_size(friction, dynamics.nv)
        self._step = INTEGRATORS[integrator]

    @classmethod
    @checked(
        robot=ARM,
        integrator=maybe(choice(*INTEGRATORS)),
        joint_friction=choice("drop", "keep"),
        joint_stops=choice("drop", "keep"),
    )
    def for_robot(
        cls,
        robot: Robot,
        integrator: IntegratorName | None = None,
        joint_friction: str = "drop",
        joint_stops: str = "drop",
    ) -> "DynamicsPlant":
        """Pinocchio's dynamics of the arm, RK4 by default; joint_friction "keep" adds the friction of the URDF.

        Raises:
            ArgumentError: If integrator is unknown, joint_friction is not "drop" or "keep", or joint_stops is "keep",
                which MuJoCo alone has.
        """
        if joint_stops == "keep":
            raise ArgumentError(f"the plant pinocchio has no joint stops; {option('plant', 'mujoco')} has.")
        friction = JointFriction.of(robot) if joint_friction == "keep" else None
        return cls(PinocchioDynamics(robot), integrator or "rk4", friction)

    def _facts(self) -> Iterable[str]:
        return type(self.dynamics).__name__, self.integrator

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.dynamics.nv

    @property
    def robot(self) -> Robot | None:
        """The arm of the provider, or None."""
        return self.dynamics.robot

    def step(self, q: Vectors, v: Vectors, tau: Vectors, duration: float) -> tuple[Vectors, Vectors]:
        """State (q, v) after one step of `duration` [s] with τ [N·m] held; differentiable for tensors.

        Raises:
            SimulationDiverged: If the result is not finite.
        """
        dynamics, friction = self.dynamics, self.friction
        q, v, tau = as_vectors(self.nv, q=q, v=v, tau=tau)
        duration = _DURATION(duration)

        def acceleration(q: Array, v: Array) -> Array:
            net = tau if friction is None else tau - friction.torque(v, tau)
            return dynamics.forward_dynamics(q, v, net)

        far = (
            f"{in_words(self, 'the plant')} diverged to a state that is not finite in a step of {duration:g} s; "
            "take a shorter plant step, or check the controller."
        )
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # overflow is reported below
                q, v = self._step(acceleration, q, v, duration)
        except TooLarge as error:
            raise SimulationDiverged(far) from error
        if not (_finite(q) and _finite(v)):
            raise SimulationDiverged(far)
        return q, v


_DURATION = partial(DURATION, "duration")


def _finite(x: Array) -> bool:
    return bool(x.isfinite().all()) if is_torch_array(x) else all_finite(x)
