"""Laws as machine code: the same numbers, microseconds a step."""

from typing import Any

import numpy as np
from jaxtyping import Float

from nbs_pin.arrays import Array, as_vectors, is_torch_array
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.exceptions import ArgumentError
from nbs_pin.runtime.laws import compile_laws, law_row, law_rows
from nbs_pin.runtime.layout import COMPUTED_TORQUE, PD_GRAVITY, Packed
from nbs_pin.runtime.threads import over_cores


class CompiledController(MemorylessController):
    """τ = M(q) a_r + C(q, v) v_r + G(q) + feedback: the law from a kernel, the model by its provider's shortest route.

    What `compile()` of a memoryless law gives: a snapshot, which later changes of that controller do not reach.
    Numpy only; batches run over all cores. NaN in gives NaN out. Each owns scratch space: use one per thread.

    law: constants and weights as numpy arrays (`Controller.packed_law`). dynamics: what the law believes of the arm.
    """

    def __init__(self, law: Packed, dynamics: DynamicsProvider) -> None:
        compile_laws()
        self.law, self.dynamics = law, dynamics
        self._model = _model_route(int(law.layout[0]), dynamics)
        self._v_r, self._a_r, self._feedback = np.empty((3, dynamics.nv))
        self._packed = (law.layout, law.weights, np.empty(int(law.layout[7])))
        one, two = np.zeros(dynamics.nv), np.zeros((2, dynamics.nv))
        for x in (one, two):  # so that no first call, of whatever the model compiles, happens inside a control loop
            self.torque(x, x, x, x, x)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as the arguments it is rebuilt from."""
        return type(self), (self.law, self.dynamics)

    def compile(self) -> "CompiledController":
        """The same law with scratch space of its own, so that each `simulate` and each thread may have one."""
        return type(self)(self.law, self.dynamics)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.dynamics.nv

    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Float[np.ndarray, "*batch n"]:
        """τ [N·m]; arguments (..., nv), fastest as contiguous float64 vectors (nv,).

        Raises ArgumentError when shapes do not fit, or for tensors: those belong to the controller this one came from.
        """
        if isinstance(q, np.ndarray) and q.ndim == 1:
            try:
                fits = law_row(q, v, q_ref, v_ref, a_ref, *self._packed, self._v_r, self._a_r, self._feedback)
            except TypeError:  # not all contiguous float64 vectors: converted and checked below
                fits = False
            if fits:
                return self._model(q, v, self._v_r, self._a_r) + self._feedback
        return self._torques(*as_vectors(self.nv, q=q, v=v, q_ref=q_ref, v_ref=v_ref, a_ref=a_ref))

    def _torques(self, *states: Array) -> Float[np.ndarray, "*batch n"]:
        if is_torch_array(states[0]):
            raise ArgumentError(
                "a compiled controller was given torch tensors, expected numpy arrays; call the controller that"
                " `compile()` was called on, which is differentiable."
            )
        shape, n = states[0].shape, self.nv
        rows = [np.array(x, dtype=float, order="C").reshape(-1, n) for x in states]
        v_r, a_r, feedback = np.empty((3, *rows[0].shape))
        layout, weights, work = self._packed

        def evaluate(part: slice) -> None:
            given, signals = (x[part] for x in rows), (x[part] for x in (v_r, a_r, feedback))
            law_rows(*given, layout, weights, np.empty_like(work), *signals)

        over_cores(evaluate, len(v_r))
        return (self._model(rows[0], rows[1], v_r, a_r) + feedback).reshape(shape)


def _gravity(route: Any, q: np.ndarray) -> np.ndarray:
    zero = np.zeros(q.shape)
    return route(q, zero, zero, zero)


def _model_route(law: int, dynamics: DynamicsProvider) -> Any:
    """(q, v, v_r, a_r) -> M a_r + C v_r + G by the shortest way that this law allows."""
    route = dynamics.compiled_reference_torque()
    if law == PD_GRAVITY:
        return lambda q, v, v_r, a_r: _gravity(route, q)
    if law == COMPUTED_TORQUE:  # v_r is v, and the provider may see it
        return lambda q, v, v_r, a_r: route(q, v, v, a_r)
    return route
