"""Joint friction, for plants and for feedforward in controllers."""

from dataclasses import dataclass

import numpy as np

from nbs_pin.base.arguments import a, check_fields, checked, maybe, number
from nbs_pin.base.arrays import JointArray, Vectors, array_namespace, as_vectors, constant_like
from nbs_pin.base.checks import floats, is_usual, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.robots.robot import ARM, Robot


@known_code
@storable(("viscous", "coulomb", "transition"))
@dataclass(frozen=True, eq=False)
class JointFriction:
    """Friction torque viscous·v + coulomb·tanh(v / transition) [N·m], opposing the motion.

    The tanh makes Coulomb friction differentiable and suitable for explicit integrators: near v = 0 it is a damper with
    coefficient coulomb / transition, and a step h is stable for h·coulomb / (transition·M) < 2.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> nbs.JointFriction(viscous=[0.5, 0.2], coulomb=[1.0, 0.0]).torque(np.array([2.0, -1.0]))
        array([ 2. , -0.2])
    """

    viscous: JointArray
    """Viscous coefficient per joint [N·m·s/rad]."""
    coulomb: JointArray
    """Coulomb torque per joint [N·m]."""
    transition: float = 0.01
    """Speed at which 76 % of the Coulomb torque is reached [rad/s]."""

    def __post_init__(self) -> None:
        for name in ("viscous", "coulomb"):
            value = np.atleast_1d(floats(f"JointFriction: {name}", getattr(self, name)))
            if value.ndim != 1 or value.size == 0 or not (is_usual(value) and (value >= 0.0).all()):
                raise ArgumentError(f"{name} friction is {told(value)}; give finite numbers ≥ 0, one per joint.")
            object.__setattr__(self, name, value)
        if self.viscous.shape != self.coulomb.shape:
            raise ArgumentError(
                f"viscous has {self.viscous.size} joints and coulomb {self.coulomb.size}; give one number per joint."
            )
        check_fields(self, transition=number(above=0.0, unit="rad/s"))

    @classmethod
    @checked(robot=ARM)
    def of(cls, robot: Robot, transition: float = 0.01) -> "JointFriction":
        """Friction from the URDF of the robot (`<dynamics damping friction>`), zero where it has none."""
        return cls(robot.damping, robot.friction, transition)

    def torque(self, v: Vectors) -> Vectors:
        """Friction torque [N·m] at the velocity v [rad/s], with the array type of v (numpy or torch)."""
        (v,) = as_vectors(self.viscous.size, v=v)
        viscous, coulomb = constant_like(v, self.viscous), constant_like(v, self.coulomb)
        return viscous * v + coulomb * array_namespace(v).tanh(v / self.transition)


FRICTION = a(JointFriction, "a JointFriction, such as JointFriction.of(robot)")
"""The check of an argument that is joint friction."""


def friction_of_size(friction: JointFriction | None, nv: int) -> JointFriction | None:
    """Return the friction; raise ArgumentError unless it is None or a JointFriction of nv joints."""
    maybe(FRICTION)("friction", friction)
    if friction is not None and friction.viscous.size != nv:
        raise ArgumentError(
            f"the friction is for {friction.viscous.size} joints, the arm has {nv}; give one per joint."
        )
    return friction
