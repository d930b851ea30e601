"""An arm with its URDF's geometry and inertias that were measured."""

from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import Array, Matrices, Scalars, Vectors
from nbs_pin.base.checks import floats
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.friction import JointFriction, friction_of_size
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.pseudo_inertia import pseudo_inertia
from nbs_pin.dynamics.structure import ModelClaims, rigid_tree_claims
from nbs_pin.kernels.layout import Packed
from nbs_pin.robots.robot import Robot

_ROUNDING = 1e-9
"""How far below zero an eigenvalue of J, scaled to a unit diagonal, is still taken for a zero that was rounded."""


@known_code
@storable(("parameters", "rotor_inertia", "report"), parts=("robot", "friction"))
class IdentifiedDynamics(DynamicsProvider):
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
        self._robot, self.report = robot, report
        self.parameters = _consistent(floats("parameters", parameters).copy(), robot)
        self.friction = friction_of_size(friction, robot.nv)
        self.rotor_inertia = _rotors(rotor_inertia, robot)
        model = robot.model.copy()
        for i, body in enumerate(self.parameters):
            model.inertias[i + 1] = pin.Inertia.FromDynamicParameters(body)
        model.armature = self.rotor_inertia
        self._model = model
        self._rigid = PinocchioDynamics(replace(robot, model=model))

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self._robot.nv

    @property
    def robot(self) -> Robot:
        """The arm as its file describes it."""
        return self._robot

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M(q) [kg·m²]."""
        return self._rigid.mass_matrix(q)

    def coriolis_matrix(self, q: Vectors, v: Vectors) -> Matrices:
        """C(q, v) [N·m·s], the Christoffel one."""
        return self._rigid.coriolis_matrix(q, v)

    def gravity(self, q: Vectors) -> Vectors:
        """G(q) [N·m]."""
        return self._rigid.gravity(q)

    def potential_energy(self, q: Vectors) -> Scalars:
        """V(q) [J], up to a constant."""
        return self._rigid.potential_energy(q)

    def reference_torque(self, q: Vectors, v: Vectors, v_r: Vectors, a_r: Vectors) -> Vectors:
        """M a_r + C(q, v) v_r + G [N·m] by two RNEA."""
        return self._rigid.reference_torque(q, v, v_r, a_r)

    def forward_dynamics(self, q: Vectors, v: Vectors, tau: Vectors) -> Vectors:
        """v̇ [rad/s²] by the articulated body algorithm."""
        return self._rigid.forward_dynamics(q, v, tau)

    def packed_tree(self) -> Packed | None:
        """The arm's joints and identified bodies; None for a subclass, which may have changed an equation."""
        return pack_model(self._model) if type(self) is IdentifiedDynamics else None

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
