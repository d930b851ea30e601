"""Rigid-body dynamics with the geometry of a URDF and identified inertial parameters."""

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arguments import checked, writable
from nbs_pin.base.arrays import Array
from nbs_pin.base.checks import floats
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import defines, known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.friction import DriveFriction, JointFriction, friction_of_size
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.dynamics.pseudo_inertia import pseudo_inertia
from nbs_pin.dynamics.structure import ModelClaims, rigid_tree_claims
from nbs_pin.kernels.layout import Packed
from nbs_pin.robots.joint_drive import Drive
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.robots.urdf_writer import write_urdf

_ROUNDING = 1e-9
"""Allowance for rounding in the smallest eigenvalue of J, scaled to a unit diagonal."""


@known_code
@storable(("parameters", "rotor_inertia", "report"), parts=("robot", "friction"))
class IdentifiedDynamics(PinocchioDynamics):
    """M, C, G of an arm with the joints of `robot` and the given inertial parameters in place of its own.

    Args:
        robot: Geometry, gravity, limits and drawings; its inertias are not used.
        parameters: (n, 10), per body mass [kg], first moment [kg·m] and inertia about the joint's origin [kg·m²], in
            the order of Pinocchio (m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz).
        friction: Friction for laws that feed it forward; not part of M, C, G.
        rotor_inertia: (n,) [kg·m², kg], added to the diagonal of M; None is zero.
        report: Record of the identification (`IdentificationReport`).

    Raises:
        ArgumentError: For a wrong number of joints, a body that is not physically consistent, or rotor inertia < 0.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> own = np.stack([body.toDynamicParameters() for body in list(robot.model.inertias)[1:]])
        >>> model, truth = nbs.IdentifiedDynamics(robot, own), nbs.PinocchioDynamics(robot)
        >>> np.allclose(model.mass_matrix([0.3, 0.2]), truth.mass_matrix([0.3, 0.2]))
        True
    """

    @checked(robot=ARM)
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
        """The arm with the inertias of its URDF."""
        return self._described

    def packed_tree(self) -> Packed | None:
        """The joints and the identified bodies; None for a subclass, which may change equations."""
        return pack_model(self._model) if defines(self, "packed_tree") else None

    @checked(path=writable)
    def write_urdf(self, path: str | Path) -> Path:
        """Write the arm's URDF with these bodies, rotor inertias and friction; returns its path.

        `load_robot(path)` gives an arm whose M, C and G are those of this model. All that is fixed to the link behind a
        joint, as a payload is, becomes part of that link's body. Friction that this model does not know stays as the
        arm's; offsets and terms other than viscous and Coulomb friction are left out, with a warning. The speed
        `transition` of Coulomb friction has no place in URDF, as gravity has none: give `load_robot` the arm's if it is
        not 9.81 m/s² downward. Meshes keep the addresses that they have in the arm's description.

        Raises:
            OSError: If it cannot be written.

        Example:
            >>> import tempfile
            >>> import nbs_pin as nbs
            >>> robot = nbs.load_robot("two_link")
            >>> model = nbs.AdaptiveLaw.for_robot(robot).estimate().dynamics()
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     print(nbs.load_robot(model.write_urdf(f"{folder}/two_link.urdf")))
            Robot('two_link', 2 joints, 2 kg, effort 100 N·m)
        """
        arm, friction = self.robot, self.friction
        if isinstance(friction, DriveFriction):
            text = "URDF has viscous and Coulomb friction alone; offsets and other terms of the friction are left out"
            warnings.warn(f"{text} of {path}.", stacklevel=2)
        viscous, coulomb = (arm.damping, arm.friction) if friction is None else (friction.viscous, friction.coulomb)
        numbers = zip(viscous.tolist(), coulomb.tolist(), self.rotor_inertia.tolist(), strict=True)
        drives = {name: Drive(*own) for name, own in zip(arm.joint_names, numbers, strict=True)}
        return write_urdf(arm, path, self._model, drives)

    def structure_claims(self) -> ModelClaims | None:
        """The claims of a rigid tree."""
        return rigid_tree_claims(self.packed_tree())


def _consistent(parameters: np.ndarray, robot: Robot) -> np.ndarray:
    """Return the parameters; raise ArgumentError unless every joint has a physically consistent body."""
    if parameters.shape != (robot.nv, 10):
        raise ArgumentError(f"parameters have shape {parameters.shape}, expected ({robot.nv}, 10); give ten per joint.")
    for name, body in zip(robot.joint_names, parameters, strict=True):
        j = pseudo_inertia(body)
        scale = np.sqrt(np.diag(j)) if (np.isfinite(body).all() and (np.diag(j) > 0.0).all()) else None
        if scale is None or np.linalg.eigvalsh(j / scale / scale[:, None])[0] < -_ROUNDING:
            raise ArgumentError(
                f"the body behind joint '{name}' has parameters {body.tolist()}, which no distribution of mass has; "
                "give finite parameters with a positive definite pseudo-inertia."
            )
    return parameters


def _rotors(rotor_inertia: Array | None, robot: Robot) -> np.ndarray:
    """Return one finite number ≥ 0 per joint; raise ArgumentError otherwise."""
    rotors = np.zeros(robot.nv) if rotor_inertia is None else floats("rotor_inertia", rotor_inertia).copy()
    if rotors.shape != (robot.nv,) or not (np.isfinite(rotors).all() and (rotors >= 0.0).all()):
        raise ArgumentError(f"rotor_inertia is {rotors.tolist()}, expected {robot.nv} finite numbers ≥ 0 [kg·m²].")
    return rotors
