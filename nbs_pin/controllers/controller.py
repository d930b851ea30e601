"""The protocol of every controller: memory in, torque and memory out."""

from abc import ABC, abstractmethod
from typing import Any

from jaxtyping import Float

from nbs_pin.arrays import Array
from nbs_pin.state import Reference


class Controller(ABC):
    """A tracking law called once per control period; what it must remember is a value the caller keeps."""

    @property
    @abstractmethod
    def nv(self) -> int:
        """Number of joints."""

    @abstractmethod
    def initial_memory(self, q: Float[Array, "*batch n"]) -> Any:
        """What the law remembers before its first step, for a start at q; None for a law without memory."""

    @abstractmethod
    def step(
        self, memory: Any, q: Float[Array, "*batch n"], v: Float[Array, "*batch n"], reference: Reference, period: float
    ) -> tuple[Float[Array, "*batch n"], Any]:
        """Torque τ [N·m] to hold for the next period [s], and the memory for the step after it."""

    def compile(self) -> "Controller":
        """The same law as machine code, for numpy: a snapshot that later changes of this controller do not reach.

        It agrees with this form to 1e-12 of the torque. A law without a compiled form is its own.
        """
        return self


class MemorylessController(Controller):
    """A law whose torque depends on the present state and reference alone."""

    @abstractmethod
    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Float[Array, "*batch n"]:
        """Torque τ [N·m] for the state (q, v) and the reference (q_ref, v_ref, a_ref), all of shape (..., nv)."""

    def initial_memory(self, q: Float[Array, "*batch n"]) -> None:
        """None: nothing is remembered."""
        return None

    def step(
        self,
        memory: None,
        q: Float[Array, "*batch n"],
        v: Float[Array, "*batch n"],
        reference: Reference,
        period: float,
    ) -> tuple[Float[Array, "*batch n"], None]:
        """`torque` at the present state; memory and period are not used."""
        return self.torque(q, v, reference.q, reference.v, reference.a), None
