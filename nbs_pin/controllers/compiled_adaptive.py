"""Adaptive laws as machine code, and the memory of an adaptive law."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import PERIOD, a, checked
from nbs_pin.base.arrays import Array, Vectors, as_vectors, finite_result, is_torch_array
from nbs_pin.base.checks import told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import joints_told
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.estimates import estimate_of
from nbs_pin.controllers.exported import Parts
from nbs_pin.controllers.passive_outputs import Output
from nbs_pin.controllers.unknowns import Unknowns
from nbs_pin.export.adaptation import LATE
from nbs_pin.kernels.adaptation import adaptive_law, adaptive_workspace, compile_adaptive_law, pack_adaptive
from nbs_pin.kernels.jit import NOT_TAKEN
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.threads import Scratch
from nbs_pin.robots.robot import Robot


class AdaptiveMemory(NamedTuple):
    """What an adaptive law remembers between two samples."""

    duals: Array
    """Q of every unknown body, ten numbers each, then the dual of every unknown number, (..., m)."""
    output: Array
    """What drives adaptation (`passive_outputs.py`) at the last instant, z2 [rad/s] for most laws, (..., n)."""
    before: Array
    """The same one instant before: encoder noise in it is independent of that in today's acceleration."""


MEMORY = a(AdaptiveMemory, "what initial_memory or step returned")
"""The check of an argument that is a memory of an adaptive law."""


class CompiledAdaptiveLaw(Controller):
    """`AdaptiveLaw.step` as machine code, for numpy arrays: a snapshot of the law.

    Args:
        law: Constants and weights of the law that adapts (`Controller.packed_law`).
        tree: The rigid tree that it believes.
        unknowns: What adapts.
        rates: γ of every unknown.
        leak: σ [1/s].
        period: Longest control period [s].
        output: What drives adaptation.
        robot: The arm, beyond whose effort limits the estimates wait.
    """

    def __init__(
        self, law: Packed, tree: Packed, unknowns: Unknowns, rates: Float[np.ndarray, " unknowns"], leak: float,
        period: float, output: Output, robot: Robot,
    ) -> None:  # fmt: skip
        rates = np.array(rates)  # a snapshot
        self._given = law, tree, unknowns, rates, leak, period, output, robot
        compile_adaptive_law()
        self._packed = tuple(pack_adaptive(law, tree, unknowns.packed(rates, leak, output)))
        self._start, self._limit, self._period = unknowns.start, robot.effort_limit, period
        self._scratch = Scratch(adaptive_workspace(law, tree))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as its constructor arguments."""
        return type(self), self._given

    def compile(self) -> "CompiledAdaptiveLaw":
        """The same law again."""
        return type(self)(*self._given)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self._limit)

    @property
    def law_name(self) -> str:
        """AdaptiveLaw."""
        return "AdaptiveLaw"

    def _facts(self) -> Iterable[str]:
        return joints_told(self.nv), f"{len(self._start)} estimates"

    def packed_law(self, *, numpy: bool = True) -> Packed:
        """The constants and weights that it was made of, as arrays."""
        return Packed(*self._packed)

    def parts_in_c(self) -> Parts:
        """The law inside, the model that it begins with, and what adapts."""
        law, tree, unknowns, rates, leak, period, output, robot = self._given
        return Parts(law, tree, robot, unknowns.adapting(rates, leak, output, period))

    def initial_memory(self, q: Vectors) -> AdaptiveMemory:
        """The first estimates, with the leading axes of q."""
        (q,) = as_vectors(self.nv, q=q)
        _numpy(q)
        return AdaptiveMemory(self._start + 0.0 * q[..., :1], np.zeros_like(q), np.zeros_like(q))

    @checked(memory=MEMORY)
    def recorded(self, memory: AdaptiveMemory) -> Array:
        """The duals."""
        return memory.duals

    def estimates(self, recorded: np.ndarray) -> tuple[np.ndarray, list[str]]:
        """`Estimate.values` of these duals, and its names."""
        _, tree, unknowns, *_, robot = self._given
        (duals,) = as_vectors(len(self._start), recorded=recorded)
        found = estimate_of(robot, tree, unknowns, np.asarray(duals, dtype=float))
        return found.values, found.names

    def step(
        self, memory: AdaptiveMemory, q: Vectors, v: Vectors, reference: Reference, period: float
    ) -> tuple[Vectors, AdaptiveMemory]:
        """τ [N·m] for the next period [s], and the memory after it; ArgumentError for tensors or wrong shapes."""
        if type(period) is not float or not 0.0 < period <= self._period:
            period = checked_period(period, self._period)
        if isinstance(q, np.ndarray) and q.ndim == 1:
            tau, output, duals = np.empty(self.nv), np.empty(self.nv), np.empty(len(self._start))
            try:
                fits = self._into(memory, (q, v, reference.q, reference.v, reference.a), period, tau, duals, output)
            except (AttributeError, *NOT_TAKEN):  # not all contiguous float64 vectors: converted and checked below
                fits = False
            if fits:
                return tau, AdaptiveMemory(duals, output, memory.output)
        return self._steps(memory, q, v, reference, period)

    def _into(
        self, memory: AdaptiveMemory, state: tuple[Array, ...], period: float, tau: Array, duals: Array, output: Array
    ) -> bool:
        """Write torque, duals and output of the states laid end to end; False unless all fit and are finite."""
        work = self._scratch.take()
        fits: bool = adaptive_law(
            memory.duals, memory.before, *state, period, self._limit, *self._packed, work, tau, duals, output
        )
        self._scratch.give(work)
        return fits

    def _steps(
        self, memory: AdaptiveMemory, q: Array, v: Array, reference: Reference, period: float
    ) -> tuple[Vectors, AdaptiveMemory]:
        duals, given = read_memory(memory, len(self._start), self.nv, q, v, reference)
        _numpy(given[0])
        last, before, *state = (np.array(x, dtype=float) for x in given)
        tau, output, after = np.empty(last.shape), np.empty(last.shape), np.empty(duals.shape)
        rows = tuple(x.ravel() for x in state)
        flat = AdaptiveMemory(np.array(duals, dtype=float).ravel(), last.ravel(), before.ravel())
        self._into(flat, rows, period, tau.reshape(-1), after.reshape(-1), output.reshape(-1))
        return finite_result("the torque", tau, *given, duals), AdaptiveMemory(after, output, last)


def checked_period(period: Any, longest: float) -> float:
    """The period [s]; raises ArgumentError for one longer than γ was made for."""
    period = PERIOD("period", period)
    if period > LATE * longest:
        raise ArgumentError(
            f"period is {period:g} s, expected at most {longest:g} s, for which the law's γ are; make the law with"
            f" period={period:g}."
        )
    return float(period)


def read_memory(
    memory: AdaptiveMemory, count: int, nv: int, q: Array, v: Array, reference: Reference
) -> tuple[Array, tuple[Array, ...]]:
    """The duals (..., count); and output, the one before it, q, v, the reference's q, v, a as arrays of one shape."""
    if not isinstance(memory, AdaptiveMemory):
        raise ArgumentError(f"memory is {told(memory)}, expected what initial_memory or step returned; give that.")
    try:
        aim = {"q_ref": reference.q, "v_ref": reference.v, "a_ref": reference.a}
    except AttributeError as error:
        raise ArgumentError(f"reference is {told(reference)}, expected a Reference of q, v and a.") from error
    given = as_vectors(nv, output=memory.output, before=memory.before, q=q, v=v, **aim)
    (duals,) = as_vectors(count, duals=memory.duals)
    if is_torch_array(duals) != is_torch_array(given[0]) or duals.shape[:-1] != given[0].shape[:-1]:
        raise ArgumentError(
            f"the memory's duals are {told(duals)} beside states of shape {tuple(given[0].shape)}; give the memory that"
            " initial_memory(q) makes for as many states."
        )
    return duals, given


def _numpy(x: Array) -> None:
    if is_torch_array(x):
        raise ArgumentError("a compiled law was given torch tensors, expected numpy arrays; call `AdaptiveLaw.step`.")
