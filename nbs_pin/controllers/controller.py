"""The protocol of every controller: memory in, torque and memory out."""

from abc import ABC, abstractmethod
from typing import Any

from nbs_pin.base.arrays import Array, Vectors
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.kernels.layout import Packed


class Controller(ABC):
    """A tracking law called once per control period; what it must remember is a value the caller keeps."""

    @property
    @abstractmethod
    def nv(self) -> int:
        """Number of joints."""

    @abstractmethod
    def initial_memory(self, q: Vectors) -> Any:
        """What the law remembers before its first step, for a start at q; None for a law without memory."""

    @abstractmethod
    def step(self, memory: Any, q: Vectors, v: Vectors, reference: Reference, period: float) -> tuple[Vectors, Any]:
        """Torque τ [N·m] to hold for the next period [s], and the memory for the step after it."""

    @property
    def packable(self) -> bool:
        """Whether the law has a compiled form: `packed_law` gives its numbers and `compile` the same law on kernels."""
        return False

    def packed_law(self, *, numpy: bool = True) -> Packed:
        """Constants and weights of the law as the kernels take them (`kernels/layout.py`).

        numpy: True gives an array, False a tensor of the same numbers, differentiable in the law's parameters.
        Raises ArgumentError unless the law is `packable`.
        """
        raise ArgumentError(f"{type(self).__name__} has no compiled form; run it as it is, or build it of known parts.")

    def compile(self) -> "Controller":
        """The same law as machine code, for numpy: a snapshot that later changes of this controller do not reach.

        It agrees with this form to 1e-12 of the torque. A law without a compiled form is its own: one from outside the
        package, a subclass, whose torque may be another, or a network with an activation of the user's.
        """
        return self


class MemorylessController(Controller):
    """A law whose torque depends on the present state and reference alone."""

    @abstractmethod
    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """Torque τ [N·m] for the state (q, v) and the reference (q_ref, v_ref, a_ref), all of shape (..., nv)."""

    def initial_memory(self, q: Vectors) -> None:
        """None: nothing is remembered."""
        return None

    def step(self, memory: None, q: Vectors, v: Vectors, reference: Reference, period: float) -> tuple[Vectors, None]:
        """`torque` at the present state; memory and period are not used."""
        return self.torque(q, v, reference.q, reference.v, reference.a), None
