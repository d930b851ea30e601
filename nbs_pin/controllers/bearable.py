"""How heavy an adaptive law may believe an arm to be: what its sampled loop bears.

A law with M̂ in its model feeds M̂ g v back to an arm with the inertia M, g = −∂(a_r − ωz2)/∂v. A torque that is held
for a period h turns this into v⁺ = (1 − h g M⁻¹M̂)v, so that estimates far above M make the arm shake, saturate, and
stop learning before they can become smaller again. Largest loads and rotors keep h g λ_max(M⁻¹ΔM̂) ≤ ½ over sampled
poses.
"""

import warnings
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import units
from nbs_pin.controllers.gains import effective_inertia, largest_inertia, sample_configurations
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.controllers.unknowns import Carrier
from nbs_pin.dynamics.body_fields import body_fields
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.kernels.layout import Packed
from nbs_pin.robots.robot import Robot

_SHARE = 0.5  # of h g λ(M⁻¹ΔM̂) = 1, where v⁺ = 0
_OF_MASS, _OF_RADIUS = 0.75, 0.9  # of that, what mass, and mass with extent along the axis, may take by default
_POSES, _HALVINGS = 200, 30
_SPARE = 1.05  # beyond the limit without a warning
_REMEDY = "state the arm's rotor inertia by armature="
_ROTOR = 0.25  # largest rotor by default, of the largest inertia of the joints of its kind


class Bearable:
    """What the sampled loop of a law bears beside the inertia of its model, over sampled poses.

    Args:
        law: The law.
        tree: Its model.
        period: Control period h [s].
    """

    def __init__(self, law: LyapunovLaw, tree: Packed, period: float) -> None:
        robot = law.dynamics.robot
        assert robot is not None
        self.law, self.robot = law, robot
        self.limit = _SHARE / (period * _feedback_rate(law))
        """Largest λ_max(M⁻¹ΔM̂)."""
        q = sample_configurations(robot, _POSES)
        zero = 0.0 * q
        fields = body_fields(RigidTree.of(tree), np.zeros(3), q, zero, zero, zero)
        self._units = [fields.velocities(np.tile(unit, (_POSES, 1))) for unit in np.eye(law.nv)]
        self._root = np.linalg.cholesky(law.dynamics.mass_matrix(q))

    def heavier(self, joint: int, body: Float[np.ndarray, "4 4"]) -> float:
        """Largest λ_max(M⁻¹ΔM̂) with this pseudo-inertia at a joint's body."""
        units = np.stack([bodies[joint] for bodies in self._units])
        added = np.einsum("ipkl,lm,jpkm->pij", units, body, units)
        inner = np.linalg.solve(self._root, np.linalg.solve(self._root, added).swapaxes(-1, -2))
        return float(np.linalg.eigvalsh(inner)[:, -1].max())

    def mass(self, carrier: Carrier, most: float) -> float:
        """The largest mass of a load by default [kg], at most this."""
        heavier, bound = self.heavier(carrier.joint, carrier.largest(most, 0.0, 0.0)), _OF_MASS * self.limit
        return most if heavier <= bound else most * bound / heavier

    def radius(self, carrier: Carrier, mass: float, most: float) -> float:
        """How far a load may be along the axis of its joint by default [m], at most this."""
        return self._largest(lambda x: self.heavier(carrier.joint, carrier.largest(mass, x, 0.0)), most, _OF_RADIUS)

    def across(self, carrier: Carrier, mass: float, radius: float) -> float:
        """How far a load may be across that axis by default [m], at most this radius."""
        return self._largest(lambda x: self.heavier(carrier.joint, carrier.largest(mass, radius, x)), radius, 1.0)

    def _largest(self, heavier: Callable[[float], float], most: float, share: float) -> float:
        """The largest x ≤ most with heavier(x) ≤ share·limit; `most` if no x has it, of which `warn_of_load` tells."""
        bound = share * self.limit
        if heavier(most) <= bound or heavier(0.0) > bound:
            return most
        low, high = 0.0, most
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if heavier(middle) <= bound else (low, middle)
        return low

    def rotors(self) -> JointArray:
        """The largest rotor inertia of every joint by default [kg·m², kg]."""
        largest, slides = largest_inertia(self.robot, self.law.dynamics), self.robot.prismatic
        alike = np.array([largest[slides == kind].max() for kind in slides])
        return np.minimum(_ROTOR * alike, self.limit * effective_inertia(self.robot, self.law.dynamics))

    def warn_of_load(self, carrier: Carrier, mass: float, radius: float, across: float) -> None:
        """Warn if estimates of a load within these bounds may be more than the sampled law bears."""
        heavier = self.heavier(carrier.joint, carrier.largest(mass, radius, across))
        if heavier > _SPARE * self.limit:
            warnings.warn(
                f"AdaptiveLaw: a load of {mass:.3g} kg within {radius:.3g} m, {across:.3g} m across, may be taken for"
                f" {heavier:.0f} times the inertia of {self.robot.name}, and at this period the law bears"
                f" {self.limit:.0f} times; {_REMEDY}, or give a smaller load or a shorter period.",
                stacklevel=5,
            )

    def warn_of_rotors(self, largest: JointArray) -> None:
        """Warn if rotors up to these may be more than the sampled law bears."""
        heavier = largest / effective_inertia(self.robot, self.law.dynamics)
        worst = int(np.argmax(heavier))
        if heavier[worst] > _SPARE * self.limit:
            warnings.warn(
                f"AdaptiveLaw: a rotor of {largest[worst]:.3g} {units('inertia', self.robot.prismatic)[worst]} at"
                f" '{self.robot.joint_names[worst]}' is {heavier[worst]:.0f} times the inertia of {self.robot.name}"
                f" there, and at this period the law bears {self.limit:.0f} times; {_REMEDY}, or give a smaller"
                " largest_rotor or a shorter period.",
                stacklevel=5,
            )


def rotors_of(robot: Robot, largest: PerJoint) -> JointArray:
    """Largest rotors, one per joint; raises ArgumentError for another number of them."""
    given = np.asarray(largest, dtype=float)
    if given.shape not in ((), (robot.nv,)):
        raise ArgumentError(
            f"AdaptiveLaw: largest_rotor has {given.size} numbers, expected one or {robot.nv}, one per joint; give that"
            " many."
        )
    return np.full(robot.nv, given)


def _feedback_rate(law: LyapunovLaw) -> float:
    """g [1/s] on the reference."""
    zero = np.zeros((law.nv, law.nv))
    e = law.errors(zero, np.eye(law.nv), zero, zero, zero)
    return float(np.abs(np.linalg.eigvals(e.a_r - law.inertial_rate * e.z2)).max())
