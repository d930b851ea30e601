"""A learned Lagrangian as a dynamics model, for numpy arrays and torch tensors."""

import copy
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arguments import a, checked, maybe
from nbs_pin.base.arrays import Array, Matrices, Scalars, Vectors, as_vectors, finite_result, is_torch_array
from nbs_pin.base.claims import refuse
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.base.shown import joints_told
from nbs_pin.base.storable import storable
from nbs_pin.base.units import counted
from nbs_pin.dynamics.friction import JointFriction, friction_of_size
from nbs_pin.dynamics.lagrangian_network import CompiledTorque, LagrangianNetwork
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.structure import ModelClaims
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.tree_layout import tree_workspace
from nbs_pin.kernels.trees import tree_accelerations
from nbs_pin.robots.robot import ARM, Robot


@known_code
@storable(("report",), parts=("network", "robot", "friction"))
class LagrangianDynamics(DynamicsProvider, nn.Module):
    """M̂, Ĉ, Ĝ and V̂ of a learned Lagrangian network (docs/theory.md §6).

    The network is copied and its parameters are frozen, so that training a controller does not change the model. Where
    T̂ is not quadratic, M̂, Ĉ and Ĝ are taken at v = 0, while `reference_torque` and `forward_dynamics` are the exact
    Euler–Lagrange equation with the inertia at (q, v).

    Args:
        friction: Friction learned with the Lagrangian, for laws that feed it forward; not part of M̂, Ĉ, Ĝ.
        report: Record of the fit (`FitReport`).

    Raises:
        ArgumentError: If robot or friction have another number of joints, or the network is not float64.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> from nbs_pin.dynamics.cholesky import CholeskyNetwork
        >>> model = nbs.LagrangianDynamics(CholeskyNetwork([False, False], epsilon=0.1))  # `fit` makes trained ones
        >>> bool(np.linalg.eigvalsh(model.mass_matrix([0.3, 0.2]))[0] >= 0.1)
        True
    """

    network: LagrangianNetwork

    @checked(network=a(LagrangianNetwork, "a network, such as fit(data).network"), robot=maybe(ARM))
    def __init__(
        self,
        network: LagrangianNetwork,
        robot: Robot | None = None,
        friction: JointFriction | None = None,
        report: Any = None,
    ) -> None:
        super().__init__()
        if robot is not None and robot.nv != network.nv:
            raise ArgumentError(
                f"the network is for {joints_told(network.nv)} and {robot.name} has {robot.nv}; give its arm."
            )
        for name, x in network.named_parameters():
            if x.dtype != torch.float64:
                raise ArgumentError(f"parameter '{name}' is {x.dtype}, expected float64; give network.double().")
        self.network = copy.deepcopy(network).requires_grad_(False)
        self.register_load_state_dict_post_hook(_forget_machine_code)  # type: ignore[no-untyped-call]
        self._robot, self.friction, self.report = robot, friction_of_size(friction, network.nv), report

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.network.nv

    def _facts(self) -> Iterable[str]:
        return (
            type(self.network).__name__,
            *super()._facts(),
            counted(sum(x.numel() for x in self.parameters()), "number"),
        )

    @property
    def robot(self) -> Robot | None:
        """The arm, if one was given."""
        return self._robot

    def mass_matrix(self, q: Vectors) -> Matrices:
        """M̂(q) [kg·m²]."""
        return self._evaluate(self.network.mass_matrix, q=q)

    def coriolis_matrix(self, q: Vectors, v: Vectors) -> Matrices:
        """Ĉ(q, v) [N·m·s], the Christoffel matrix of M̂."""
        return self._evaluate(self.network.coriolis_matrix, q=q, v=v)

    def gravity(self, q: Vectors) -> Vectors:
        """Ĝ(q) [N·m]."""
        return self._evaluate(self.network.gravity, q=q)

    def potential_energy(self, q: Vectors) -> Scalars:
        """V̂(q) [J], up to a constant."""
        return self._evaluate(self.network.potential, q=q)

    def reference_torque(self, q: Vectors, v: Vectors, v_r: Vectors, a_r: Vectors) -> Vectors:
        """M̂ a_r + Ĉ(q, v) v_r + Ĝ [N·m], for numpy arrays by machine code where the network has it."""
        vectors = as_vectors(self.nv, q=q, v=v, v_r=v_r, a_r=a_r)
        if is_torch_array(vectors[0]) or self._machine_code is None:
            return self._evaluate(self.network.torque, q=q, v=v, v_r=v_r, a_r=a_r)
        rows = (np.ascontiguousarray(x).reshape(-1, self.nv) for x in vectors)
        return finite_result("the torque", self._machine_code(*rows), *vectors).reshape(vectors[0].shape)

    def forward_dynamics(self, q: Vectors, v: Vectors, tau: Vectors) -> Vectors:
        """v̇ [rad/s²] under the torque τ [N·m], for numpy arrays by machine code where the network has it."""
        vectors = as_vectors(self.nv, q=q, v=v, tau=tau)
        if is_torch_array(vectors[0]) or self._machine_code is None or not self.network.quadratic:
            return self._evaluate(self.network.acceleration, q=q, v=v, tau=tau)
        rows, tree = [np.ascontiguousarray(x).reshape(-1, self.nv) for x in vectors], self._tree
        if tree is None:
            found = _accelerations(self._machine_code, *rows).reshape(vectors[0].shape)
            return finite_result("the acceleration", found, *vectors)
        a, factor = np.empty(rows[0].shape), np.empty((self.nv, self.nv))
        tree_accelerations(*rows, *tree, np.empty(tree_workspace(tree)), factor, a)
        return finite_result("the acceleration", a, *vectors).reshape(vectors[0].shape)

    def packed_tree(self) -> Packed | None:
        """The network as a rigid tree, or None; None for a subclass, which may change equations."""
        return self._tree if type(self) is LagrangianDynamics else None

    @checked(robot=ARM)
    def suits(self, robot: Robot) -> bool:
        """Whether the joints of the network match those of the robot."""
        return self.network.suits(robot.parents, robot.prismatic)

    def structure_claims(self) -> ModelClaims | None:
        """The claims of the network; raises CertificateRefused if its machine code does not match its weights."""
        if self._tree is not None:
            now = self.network.packed_tree()
            if now is None or not all(np.array_equal(x, y) for x, y in zip(self._tree, now, strict=True)):
                refuse("the model's machine code does not match its weights", "load the model again")
        return self.network.structure_claims()

    @cached_property
    def _tree(self) -> Packed | None:
        return self.network.packed_tree()

    @cached_property
    def _machine_code(self) -> CompiledTorque | None:
        return self.network.compiled()

    def _evaluate(self, function: Callable[..., torch.Tensor], **arguments: Array) -> Array:
        """The function over leading batch axes, with the array type of the arguments (numpy or torch)."""
        vectors = as_vectors(self.nv, **arguments)
        if is_torch_array(vectors[0]):
            return function(*vectors)
        device = next((x.device for x in self.network.parameters()), None)
        # The same array becomes the same tensor, since `torque` is cheaper when w is v.
        tensors = {id(x): torch.from_numpy(np.array(x)).to(device) for x in vectors}
        with torch.no_grad():
            try:
                result = function(*(tensors[id(x)] for x in vectors)).numpy(force=True)
            except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
                names = ", ".join(arguments)
                raise ArgumentError(
                    f"the model has no M ≻ 0 for these {names} ({error!s:.80}); give others."
                ) from error
        return finite_result("the result", result, *vectors)


def _accelerations(
    torque: CompiledTorque,
    q: Float[np.ndarray, "rows n"],
    v: Float[np.ndarray, "rows n"],
    tau: Float[np.ndarray, "rows n"],
) -> Float[np.ndarray, "rows n"]:
    """v̇ from the torque alone, which is M a + C v + G with M of its columns."""
    rows, n = q.shape
    still, unit = np.zeros((rows * n, n)), np.tile(np.eye(n), (rows, 1))
    rest = torque(q, still[:rows], still[:rows], still[:rows])
    lifted = torque(np.repeat(q, n, axis=0), still, still, unit).reshape(rows, n, n)
    bias = torque(q, v, v, still[:rows])
    try:
        return np.asarray(np.linalg.solve((lifted - rest[:, None]).swapaxes(1, 2), (tau - bias)[..., None])[..., 0])
    except np.linalg.LinAlgError as error:
        raise ArgumentError(f"the model has no M ≻ 0 for these q, v, tau ({error!s:.80}); give others.") from error


def _forget_machine_code(module: nn.Module, keys: Any) -> None:
    """Discard the machine code of the previous weights."""
    for name in ("_machine_code", "_tree"):
        vars(module).pop(name, None)
