"""An arm with its URDF's geometry and inertias that were measured."""

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import Array
from nbs_pin.base.checks import floats
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.friction import JointFriction, friction_of_size
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.pseudo_inertia import pseudo_inertia
from nbs_pin.dynamics.structure import ModelClaims, rigid_tree_claims
from nbs_pin.robots.robot import Robot

_ROUNDING = 1e-9
"""How far below zero an eigenvalue of J, scaled to a unit diagonal, is still taken for a zero that was rounded."""


@known_code
@storable(("parameters", "rotor_inertia", "report"), parts=("robot", "friction"))
class IdentifiedDynamics(PinocchioDynamics):
    """M, C, G of an arm with the joints of `robot` and the inertial parameters given here instead of its own.

    robot: gives geometry, gravity, limits and drawings; its own inertias play no part. parameters: (n, 10), per body
    mass [kg], first moment [kg·m] and inertia about the joint's origin [kg·m²] in Pinocchio's order (m, mx, my, mz,
    Ixx, Ixy, Iyy, Ixz, Iyz, Izz). friction: what was identified beside them, for laws that feed it forward; it is no
    part of M, C, G. rotor_inertia: per joint [kg·m², kg], a part of M, zero by default. report: how they were found,
    for the reader. Raises ArgumentError for another number of joints, a body that no mass distribution has, and a rotor
    inertia below zero.
    """

    def __init__(
        self,
        robot: Robot,
        parameters: Float[Array, "n 10"],
        friction: JointFriction | None = None,
        rotor_inertia: Float[Array, " n"] | None = None,
        report: Any = None,
    ) -> None:
        self.parameters = _consistent(floats("parameters", parameters).copy(), robot)
        self.friction, self.report = friction_of_size(friction, robot.nv), report
        self.rotor_inertia = _rotors(rotor_inertia, robot)
        model = robot.model.copy()
        for i, body in enumerate(self.parameters):
            model.inertias[i + 1] = pin.Inertia.FromDynamicParameters(body)
        model.armature = self.rotor_inertia
        super().__init__(replace(robot, model=model))
        self._described = robot

    @property
    def robot(self) -> Robot:
        """The arm as its file describes it."""
        return self._described

    def structure_claims(self) -> ModelClaims | None:
        """Those of a rigid tree."""
        return rigid_tree_claims(self.packed_tree())


def _consistent(parameters: np.ndarray, robot: Robot) -> np.ndarray:
    """The parameters; raises ArgumentError unless there is a solid body for each of the arm's joints."""
    if parameters.shape != (robot.nv, 10):
        raise ArgumentError(
            f"parameters have shape {parameters.shape}, expected ({robot.nv}, 10): ten for each joint of {robot.name}."
        )
    for name, body in zip(robot.joint_names, parameters, strict=True):
        j = pseudo_inertia(body)
        scale = np.sqrt(np.diag(j)) if (np.isfinite(body).all() and (np.diag(j) > 0.0).all()) else None
        if scale is None or np.linalg.eigvalsh(j / scale / scale[:, None])[0] < -_ROUNDING:
            raise ArgumentError(
                f"the body behind joint '{name}' has parameters {body.tolist()}, which no distribution of mass has; "
                "give finite ones whose pseudo-inertia is positive definite."
            )
    return parameters


def _rotors(rotor_inertia: Array | None, robot: Robot) -> np.ndarray:
    """One finite number ≥ 0 per joint; raises ArgumentError otherwise."""
    rotors = np.zeros(robot.nv) if rotor_inertia is None else floats("rotor_inertia", rotor_inertia).copy()
    if rotors.shape != (robot.nv,) or not (np.isfinite(rotors).all() and (rotors >= 0.0).all()):
        raise ArgumentError(
            f"rotor_inertia is {rotors.tolist()}, expected {robot.nv} finite numbers ≥ 0 [kg·m²]; correct it."
        )
    return rotors
