"""Control laws as machine code: the same torque in microseconds."""

from typing import Any

import numpy as np

from nbs_pin.base.arrays import Array, Vectors, as_vectors, is_torch_array
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.kernels.laws import compile_laws, compile_tree_law, law_signals, law_workspace, pack_tree_law, tree_law
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.threads import over_cores


class CompiledController(MemorylessController):
    """τ = M(q) a_r + C(q, v) v_r + G(q) + feedback as machine code, for numpy arrays.

    If the model is a rigid tree (`DynamicsProvider.packed_tree`), one kernel computes the torque; otherwise the law's
    kernel is combined with the model's own `reference_torque`. The object is a snapshot: later changes of the original
    controller do not affect it. Batches run on all cores, NaN gives NaN. It owns scratch space: use one per thread.

    Args:
        law: Constants and weights as numpy arrays (`Controller.packed_law`).
        dynamics: Model of the arm that the law uses.
    """

    def __init__(self, law: Packed, dynamics: DynamicsProvider) -> None:
        self.law, self.dynamics, self._tree = law, dynamics, dynamics.packed_tree()
        if self._tree is None:
            compile_laws()
            self._packed: tuple[np.ndarray, ...] = (*law, np.empty(law_workspace(law)))
            self._signals = np.empty((3, dynamics.nv))
        else:
            compile_tree_law()
            self._packed = (*pack_tree_law(law, self._tree), np.empty(law_workspace(law, self._tree)))
        one, two = np.zeros(dynamics.nv), np.zeros((2, dynamics.nv))
        for x in (one, two):  # so that nothing is left to compile inside a control loop
            self.torque(x, x, x, x, x)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as its constructor arguments."""
        return type(self), (self.law, self.dynamics)

    def compile(self) -> "CompiledController":
        """The same law with its own scratch space, for another `simulate` or thread."""
        return type(self)(self.law, self.dynamics)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.dynamics.nv

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """τ [N·m]; arguments (..., nv), fastest as contiguous float64 vectors (nv,).

        Raises:
            ArgumentError: If shapes do not match, or for tensors, which only the uncompiled controller takes.
        """
        if isinstance(q, np.ndarray) and q.ndim == 1:
            tau = np.empty(self.nv)
            try:
                fits = self._one(q, v, q_ref, v_ref, a_ref, tau)
            except TypeError:  # not all contiguous float64 vectors: converted and checked below
                fits = False
            if fits:
                return tau
        return self._torques(*as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref))

    def _one(
        self, q: np.ndarray, v: np.ndarray, q_ref: np.ndarray, v_ref: np.ndarray, a_ref: np.ndarray, tau: np.ndarray
    ) -> bool:
        """Write the torque of one state to tau; False, with nothing written, unless all have length nv."""
        if self._tree is not None:
            return tree_law(q, v, q_ref, v_ref, a_ref, *self._packed, tau)
        if not law_signals(q, v, q_ref, v_ref, a_ref, *self._packed, self._signals):
            return False
        v_r, a_r, feedback = self._signals
        tau[:] = self.dynamics.reference_torque(q, v, v_r, a_r) + feedback
        return True

    def _torques(self, *states: Array) -> Vectors:
        if is_torch_array(states[0]):
            raise ArgumentError(
                "a compiled controller was given torch tensors, expected numpy arrays; call the controller that"
                " `compile()` was called on, which is differentiable."
            )
        shape, n = states[0].shape, self.nv
        rows = [np.array(x, dtype=float, order="C").reshape(-1, n) for x in states]
        tau, (*packed, work) = np.empty(rows[0].shape), self._packed
        if self._tree is not None:

            def evaluate(part: slice) -> None:
                tree_law(*(x[part].ravel() for x in rows), *packed, np.empty_like(work), tau[part].ravel())

            over_cores(evaluate, len(tau))
            return tau.reshape(shape)
        signals = np.empty((3, tau.size))
        law_signals(*(x.ravel() for x in rows), *packed, work, signals)
        v_r, a_r, feedback = signals.reshape(3, *tau.shape)
        return (self.dynamics.reference_torque(rows[0], rows[1], v_r, a_r) + feedback).reshape(shape)
