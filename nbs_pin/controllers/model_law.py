"""What every law with a model of the arm is: a belief, friction to feed forward, parameters and a compiled form."""

from typing import Any

from torch import nn

from nbs_pin.base.arrays import Array
from nbs_pin.base.known_code import is_known
from nbs_pin.controllers.compiled import CompiledController
from nbs_pin.controllers.controller import Controller, MemorylessController
from nbs_pin.dynamics.friction import JointFriction, friction_of_size
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.kernels.layout import Packed, pack_law


class ModelLaw(MemorylessController, nn.Module):
    """τ = M(q) a_r + C(q, v) v_r + G(q) + feedback + friction; its gains and networks are torch parameters.

    dynamics: what the law believes of the arm. friction: fed forward at the velocity the law names, or None.
    Raises ArgumentError when the friction is for another number of joints.
    """

    def __init__(self, dynamics: DynamicsProvider, friction: JointFriction | None) -> None:
        super().__init__()
        self.dynamics, self.friction = dynamics, friction_of_size(friction, dynamics.nv)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.dynamics.nv

    @property
    def packable(self) -> bool:
        """Whether law, error and friction are the ones the kernels know, and not those of a subclass."""
        wraps = type(self.dynamics).difference is DynamicsProvider.difference
        return wraps and is_known(self) and (self.friction is None or is_known(self.friction)) and self._has_kernel

    def packed_law(self, *, numpy: bool = True) -> Packed:
        """Constants and weights for the kernels (`Controller.packed_law`)."""
        return self._packed(numpy) if self.packable else super().packed_law(numpy=numpy)

    def compile(self) -> Controller:  # type: ignore[override]  # torch.nn.Module has another compile
        """The law as machine code (`Controller.compile`)."""
        return CompiledController(self.packed_law(), self.dynamics) if self.packable else self

    @property
    def _has_kernel(self) -> bool:
        """Whether the law and its parts have a kernel; a law that says nothing runs as it is written."""
        return False

    def _packed(self, numpy: bool) -> Packed:
        """`packed_law` of a law that has a kernel."""
        raise NotImplementedError

    def _pack(self, law: int, gains: tuple[Array, Array], **parts: Any) -> Packed:
        """The law of that code (`kernels/layout.py`) with its gains; parts: those of `layout.pack_law`."""
        continuous = None if self.dynamics.robot is None else self.dynamics.robot.continuous
        f = self.friction
        return pack_law(law, gains, continuous, None if f is None else (f.viscous, f.coulomb, f.transition), **parts)
