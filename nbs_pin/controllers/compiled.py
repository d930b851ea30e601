"""Control laws as machine code: the same torque in microseconds."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from nbs_pin.base.arrays import Array, Vectors, as_vectors, finite_result, is_torch_array
from nbs_pin.base.checks import all_finite
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import joints_told
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.kernels.jit import NOT_TAKEN
from nbs_pin.kernels.laws import compile_laws, compile_tree_law, law_signals, law_workspace, pack_tree_law, tree_law
from nbs_pin.kernels.layout import LAW, LawCode, Packed
from nbs_pin.kernels.threads import Scratch, over_cores

_LAWS = {
    LawCode.BACKSTEPPING: "NeuralBackstepping",
    LawCode.SLOTINE_LI: "SlotineLi",
    LawCode.COMPUTED_TORQUE: "ComputedTorque",
    LawCode.PD_REFERENCE: "PD",
    LawCode.PD_GRAVITY: "PD",
}


class CompiledController(MemorylessController):
    """τ = M(q) a_r + C(q, v) v_r + G(q) + feedback as machine code, for numpy arrays.

    If the model is a rigid tree (`DynamicsProvider.packed_tree`), one kernel computes the torque; otherwise the law's
    kernel is combined with the model's own `reference_torque`. The object is a snapshot: later changes of the original
    controller do not affect it. Batches run on all cores, NaN gives NaN. Threads may share it: each call takes scratch
    space that no other is using.

    Args:
        law: Constants and weights as numpy arrays (`Controller.packed_law`).
        dynamics: Model of the arm that the law uses.
    """

    def __init__(self, law: Packed, dynamics: DynamicsProvider) -> None:
        self.law, self.dynamics, self._tree = law, dynamics, dynamics.packed_tree()
        if self._tree is None:
            compile_laws()
            self._packed: tuple[np.ndarray, ...] = tuple(law)
            self._scratch = Scratch(law_workspace(law))
        else:
            compile_tree_law()
            self._packed = tuple(pack_tree_law(law, self._tree))
            self._scratch = Scratch(law_workspace(law, self._tree))
        one, two = np.zeros(dynamics.nv), np.zeros((2, dynamics.nv))
        for x in (one, two):  # so that nothing is left to compile inside a control loop
            self.torque(x, x, x, x, x)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as its constructor arguments."""
        return type(self), (self.law, self.dynamics)

    def compile(self) -> "CompiledController":
        """The same law again."""
        return type(self)(self.law, self.dynamics)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.dynamics.nv

    @property
    def law_name(self) -> str:
        """Class of the law."""
        return _LAWS[LawCode(int(self.law.layout[LAW]))]

    def packed_law(self, *, numpy: bool = True) -> Packed:
        """The constants and weights that it was made of, as arrays."""
        return self.law

    def _facts(self) -> Iterable[str]:
        law = LawCode(int(self.law.layout[LAW])).name.lower().replace("_", " ")
        arm = () if self.dynamics.robot is None else (self.dynamics.robot.name,)
        return law, *arm, joints_told(self.nv), f"model {type(self.dynamics).__name__}"

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """τ [N·m]; arguments (..., nv), fastest as contiguous float64 vectors (nv,).

        Raises:
            ArgumentError: If shapes do not match, or for tensors, which only the uncompiled controller takes.
        """
        if isinstance(q, np.ndarray) and q.ndim == 1:
            tau = np.empty(self.nv)
            try:
                fits = self._one(q, v, q_ref, v_ref, a_ref, tau)
            except NOT_TAKEN:  # not all contiguous float64 vectors: converted and checked below
                fits = False
            if fits:
                return tau
        return self._torques(*as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref))

    def _one(
        self, q: np.ndarray, v: np.ndarray, q_ref: np.ndarray, v_ref: np.ndarray, a_ref: np.ndarray, tau: np.ndarray
    ) -> bool:
        """Write the torque of one state to tau; False unless all have length nv and the torque is finite."""
        work = self._scratch.take()
        if self._tree is not None:
            fits: bool = tree_law(q, v, q_ref, v_ref, a_ref, *self._packed, work, tau)
            self._scratch.give(work)
            return fits
        signals = np.empty((3, self.nv))
        fits = law_signals(q, v, q_ref, v_ref, a_ref, *self._packed, work, signals)
        self._scratch.give(work)
        if not fits:
            return False
        v_r, a_r, feedback = signals
        tau[:] = self.dynamics.reference_torque(q, v, v_r, a_r) + feedback
        return all_finite(tau)

    def _torques(self, *states: Array) -> Vectors:
        if is_torch_array(states[0]):
            raise ArgumentError(
                "a compiled controller was given torch tensors, expected numpy arrays; call the controller that"
                " `compile()` was called on, which is differentiable."
            )
        shape, n = states[0].shape, self.nv
        rows = [np.array(x, dtype=float, order="C").reshape(-1, n) for x in states]
        tau = np.empty(rows[0].shape)
        if self._tree is not None:

            def evaluate(part: slice) -> None:
                work = self._scratch.take()
                tree_law(*(x[part].ravel() for x in rows), *self._packed, work, tau[part].ravel())
                self._scratch.give(work)

            over_cores(evaluate, len(tau))
            return finite_result("the torque", tau, *rows).reshape(shape)
        signals, work = np.empty((3, tau.size)), self._scratch.take()
        law_signals(*(x.ravel() for x in rows), *self._packed, work, signals)
        self._scratch.give(work)
        v_r, a_r, feedback = signals.reshape(3, *tau.shape)
        tau = self.dynamics.reference_torque(rows[0], rows[1], v_r, a_r) + feedback
        return finite_result("the torque", tau, *rows).reshape(shape)
