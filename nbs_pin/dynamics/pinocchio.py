"""Dynamics of a URDF arm by Pinocchio, for numpy arrays and for torch tensors, with analytical first derivatives."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import pinocchio as pin

from nbs_pin.base.arguments import checked
from nbs_pin.base.arrays import Array, Matrices, Scalars, Vectors, as_vectors, finite_result, is_torch_array, over_rows
from nbs_pin.base.claims import refuse
from nbs_pin.base.known_code import defines, known_code
from nbs_pin.base.storable import storable
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.structure import ModelClaims, rigid_tree_claims
from nbs_pin.kernels.layout import Packed
from nbs_pin.robots.robot import ARM, Robot

Row: TypeAlias = np.ndarray


@dataclass(frozen=True)
class Quantity:
    """A function of one state (one batch row) and its vector-Jacobian product."""

    value: Callable[..., Row]
    """value(q, …) -> output."""
    vjp: Callable[..., Sequence[Row]]
    """vjp(cotangent, q, …) -> one gradient per argument."""


@known_code
@storable(parts=("robot",))
class PinocchioDynamics(DynamicsProvider):
    """M, C and G of `robot` by CRBA, Pinocchio's Christoffel Coriolis matrix and RNEA.

    Joint friction of the URDF (`JointFriction`) and rotor inertia are not included. Results for torch tensors can be
    differentiated once, by Pinocchio's analytical derivatives; second derivatives raise an error.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> nbs.PinocchioDynamics(nbs.load_robot("two_link")).gravity(np.zeros(2)).round(3)
        array([29.4,  9.8])
    """

    @checked(robot=ARM)
    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._model = robot.model
        self._data = self._model.createData()
        self._weightless = self._model.copy()
        self._weightless.gravity = pin.Motion.Zero()
        self._unit = np.eye(robot.nv)
        self._zero = np.zeros(robot.nv)

    @property
    def model(self) -> pin.Model:
        """The Pinocchio model that it computes with."""
        return self._model

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self._robot.nv

    @property
    def robot(self) -> Robot:
        """The arm."""
        return self._robot

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M(q) [kg·m²] by the composite rigid body algorithm."""
        return self._evaluate(Quantity(self._mass_matrix, self._mass_matrix_vjp), q=q)

    def coriolis_matrix(self, q: Vectors, v: Vectors) -> Matrices:
        """C(q, v) [N·m·s], the Christoffel matrix of M."""
        return self._evaluate(Quantity(self._coriolis_matrix, self._coriolis_matrix_vjp), q=q, v=v)

    def gravity(self, q: Vectors) -> Vectors:
        """G(q) [N·m]."""
        return self._evaluate(Quantity(self._gravity, self._gravity_vjp), q=q)

    def potential_energy(self, q: Vectors) -> Scalars:
        """V(q) [J], zero where all masses lie at the height of the base."""
        return self._evaluate(Quantity(self._potential_energy, self._potential_energy_vjp), q=q)

    def reference_torque(self, q: Vectors, v: Vectors, v_r: Vectors, a_r: Vectors) -> Vectors:
        """M a_r + C(q, v) v_r + G [N·m] by two RNEA passes, without a matrix.

        C(q, v) v_r = h((v + v_r)/2) − h((v − v_r)/2) with h(x) = C(q, x) x (docs/theory.md §1).
        """
        return self._evaluate(Quantity(self._reference_torque, self._reference_torque_vjp), q=q, v=v, v_r=v_r, a_r=a_r)

    def forward_dynamics(self, q: Vectors, v: Vectors, tau: Vectors) -> Vectors:
        """v̇ [rad/s²] by the articulated body algorithm."""
        return self._evaluate(Quantity(self._forward_dynamics, self._forward_dynamics_vjp), q=q, v=v, tau=tau)

    def packed_tree(self) -> Packed | None:
        """The joints and bodies of the model; None for a subclass, which may change equations."""
        return pack_model(self._model) if defines(self, "packed_tree") else None

    def structure_claims(self) -> ModelClaims | None:
        """The claims of a rigid tree; raises CertificateRefused if the model no longer matches `robot`."""
        tree, own = self.packed_tree(), pack_model(self._robot.model)
        if tree is not None and not all(np.array_equal(x, y) for x, y in zip(tree, own, strict=True)):
            refuse(f"the model is no longer that of the arm {self._robot.name}", "construct it again from that arm")
        return rigid_tree_claims(tree)

    def _evaluate(self, quantity: Quantity, **arguments: Array) -> Array:
        """The quantity over leading batch axes, with the array type of the arguments (numpy or torch)."""
        vectors = as_vectors(self.nv, **arguments)
        if is_torch_array(vectors[0]):
            from nbs_pin.dynamics.autograd import differentiable

            return differentiable(quantity.value, quantity.vjp, *vectors)
        if vectors[0].ndim == 1:
            return finite_result("the result", quantity.value(*vectors), *vectors)
        return finite_result("the result", over_rows(quantity.value, *vectors), *vectors)

    # Values at one state.

    def _mass_matrix(self, q: Row) -> Row:
        return pin.crba(self._model, self._data, q)

    def _coriolis_matrix(self, q: Row, v: Row) -> Row:
        return pin.computeCoriolisMatrix(self._model, self._data, q, v)

    def _gravity(self, q: Row) -> Row:
        return pin.computeGeneralizedGravity(self._model, self._data, q)

    def _potential_energy(self, q: Row) -> Row:
        return np.asarray(pin.computePotentialEnergy(self._model, self._data, q))

    def _reference_torque(self, q: Row, v: Row, v_r: Row, a_r: Row) -> Row:
        mean = pin.rnea(self._model, self._data, q, 0.5 * (v + v_r), a_r)
        return mean - pin.rnea(self._weightless, self._data, q, 0.5 * (v - v_r), self._zero)

    def _forward_dynamics(self, q: Row, v: Row, tau: Row) -> Row:
        return pin.aba(self._model, self._data, q, v, tau)

    # Vector-Jacobian products at one state.

    def _mass_matrix_vjp(self, cotangent: Row, q: Row) -> tuple[Row]:
        # Column j of M is the RNEA torque of the unit acceleration e_j without gravity.
        columns = (self._rnea_derivatives(self._weightless, q, self._zero, e)[0] for e in self._unit)
        return (sum((dq.T @ cotangent[:, j] for j, dq in enumerate(columns)), self._zero),)

    def _coriolis_matrix_vjp(self, cotangent: Row, q: Row, v: Row) -> tuple[Row, Row]:
        # Column j of C(q, v) is h((v + e_j)/2) − h((v − e_j)/2).
        q_bar, v_bar = self._zero, self._zero
        for j, e in enumerate(self._unit):
            plus_q, plus_v, _ = self._rnea_derivatives(self._weightless, q, 0.5 * (v + e), self._zero)
            minus_q, minus_v, _ = self._rnea_derivatives(self._weightless, q, 0.5 * (v - e), self._zero)
            q_bar = q_bar + (plus_q - minus_q).T @ cotangent[:, j]
            v_bar = v_bar + 0.5 * (plus_v - minus_v).T @ cotangent[:, j]
        return q_bar, v_bar

    def _gravity_vjp(self, cotangent: Row, q: Row) -> tuple[Row]:
        return (pin.computeGeneralizedGravityDerivatives(self._model, self._data, q).T @ cotangent,)

    def _potential_energy_vjp(self, cotangent: float, q: Row) -> tuple[Row]:
        return (cotangent * self._gravity(q),)

    def _reference_torque_vjp(self, cotangent: Row, q: Row, v: Row, v_r: Row, a_r: Row) -> tuple[Row, Row, Row, Row]:
        mean_q, mean_v, mass = self._rnea_derivatives(self._model, q, 0.5 * (v + v_r), a_r)
        half_q, half_v, _ = self._rnea_derivatives(self._weightless, q, 0.5 * (v - v_r), self._zero)
        return (
            (mean_q - half_q).T @ cotangent,
            0.5 * (mean_v - half_v).T @ cotangent,
            0.5 * (mean_v + half_v).T @ cotangent,
            mass @ cotangent,
        )

    def _forward_dynamics_vjp(self, cotangent: Row, q: Row, v: Row, tau: Row) -> tuple[Row, Row, Row]:
        jacobians = pin.computeABADerivatives(self._model, self._data, q, v, tau)
        return tuple(jacobian.T @ cotangent for jacobian in jacobians)

    def _rnea_derivatives(self, model: pin.Model, q: Row, v: Row, a: Row) -> tuple[Row, Row, Row]:
        """∂τ/∂q, ∂τ/∂v and M at one state."""
        live = pin.computeRNEADerivatives(model, self._data, q, v, a)  # views into data that later calls overwrite
        dq, dv, mass = (np.array(x) for x in live)
        return dq, dv, mass
