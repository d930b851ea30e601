"""Identified dynamics of an arm some of whose motors turn several joints, as in wrists with bevel gears."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import Array
from nbs_pin.base.checks import floats
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.friction import JointFriction, coupling_of
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.pinocchio import Row
from nbs_pin.robots.robot import Robot


@storable(("parameters", "motor_inertia", "coupling", "report"), parts=("robot", "friction"))
class CoupledDynamics(IdentifiedDynamics):
    """M, C, G of identified bodies, with rotors that several joints turn: M = M_bodies + Nᵀ diag(J) N.

    The motors turn by φ = N q, in angles of the joint side. N is constant, so that C and G are those of the bodies.

    Args:
        robot: As in `IdentifiedDynamics`.
        parameters: As in `IdentifiedDynamics`.
        coupling: N (n, n), invertible; for a last motor that turns q5 + q6 it is the identity with N[5, 4] = 1.
        friction: As in `IdentifiedDynamics`; a `DriveFriction` holds N for that of the motors.
        motor_inertia: J (n,) [kg·m²], rotor inertia of each motor as its own joint feels it; None is zero.
        report: As in `IdentifiedDynamics`.

    Raises:
        ArgumentError: As `IdentifiedDynamics`, or if N is not an invertible n×n matrix.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> own = np.stack([body.toDynamicParameters() for body in list(robot.model.inertias)[1:]])
        >>> model = nbs.CoupledDynamics(robot, own, [[1.0, 0.0], [1.0, 1.0]], motor_inertia=[0.0, 0.5])
        >>> model.mass_matrix([0.0, 0.0]) - nbs.PinocchioDynamics(robot).mass_matrix([0.0, 0.0])
        array([[0.5, 0.5],
               [0.5, 0.5]])
    """

    def __init__(
        self,
        robot: Robot,
        parameters: Float[Array, "n 10"],
        coupling: Float[Array, "n n"],
        friction: JointFriction | None = None,
        motor_inertia: Float[Array, " n"] | None = None,
        report: Any = None,
    ) -> None:
        super().__init__(robot, parameters, friction, None, report)
        self.coupling = coupling_of(coupling, robot.nv)
        self.motor_inertia = np.zeros(robot.nv) if motor_inertia is None else floats("motor_inertia", motor_inertia)
        if self.motor_inertia.shape != (robot.nv,) or not (self.motor_inertia >= 0.0).all():
            raise ArgumentError(f"motor_inertia is {motor_inertia}, expected {robot.nv} finite numbers ≥ 0 [kg·m²].")
        self._rotors = self.coupling.T @ (self.motor_inertia[:, None] * self.coupling)

    def write_urdf(self, path: str | Path) -> Path:
        """Refused: URDF has no coupled drives.

        Raises:
            ArgumentError: Always; names what can be written.
        """
        raise ArgumentError(
            "a URDF has no coupled drives; write the bodies alone, with "
            "IdentifiedDynamics(model.robot, model.parameters).write_urdf(path), or save the model as .nbs."
        )

    def _mass_matrix(self, q: Row) -> Row:
        return super()._mass_matrix(q) + self._rotors

    def _reference_torque(self, q: Row, v: Row, v_r: Row, a_r: Row) -> Row:
        return super()._reference_torque(q, v, v_r, a_r) + self._rotors @ a_r

    def _forward_dynamics(self, q: Row, v: Row, tau: Row) -> Row:
        left = tau - super()._reference_torque(q, v, v, np.zeros(self.nv))
        return np.asarray(np.linalg.solve(self._mass_matrix(q), left))

    def _reference_torque_vjp(self, cotangent: Row, q: Row, v: Row, v_r: Row, a_r: Row) -> tuple[Row, Row, Row, Row]:
        *others, of_a = super()._reference_torque_vjp(cotangent, q, v, v_r, a_r)
        return others[0], others[1], others[2], of_a + self._rotors @ cotangent

    def _forward_dynamics_vjp(self, cotangent: Row, q: Row, v: Row, tau: Row) -> tuple[Row, Row, Row]:
        a = self._forward_dynamics(q, v, tau)
        of_q, of_v, _ = self._rnea_derivatives(self._model, q, v, a)
        of_tau = np.linalg.solve(self._mass_matrix(q), cotangent)
        return -of_q.T @ of_tau, -of_v.T @ of_tau, of_tau
