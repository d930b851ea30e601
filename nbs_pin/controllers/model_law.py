"""Base of all laws with a model of the arm: model, friction feed-forward, parameters and compiled form."""

from collections.abc import Iterable
from typing import Any

from torch import nn

from nbs_pin.base.arguments import checked, flag
from nbs_pin.base.arrays import Array
from nbs_pin.base.known_code import defines
from nbs_pin.base.shown import joints_told
from nbs_pin.controllers.compiled import CompiledController
from nbs_pin.controllers.controller import Controller, MemorylessController
from nbs_pin.dynamics.friction import JointFriction, friction_of_size, has_viscous_and_coulomb_only
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.kernels.layout import Packed, pack_law


class ModelLaw(MemorylessController, nn.Module):
    """τ = M(q) a_r + C(q, v) v_r + G(q) + feedback + friction; its gains and networks are torch parameters.

    Args:
        dynamics: Model of the arm that the law uses.
        friction: Joint friction fed forward at a velocity that the subclass states, or None.

    Raises:
        ArgumentError: If friction is for another number of joints.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.ComputedTorque.for_robot(nbs.load_robot("two_link"))
        >>> isinstance(law, nbs.ModelLaw), law.nv, law.packable
        (True, 2, True)
    """

    def __init__(self, dynamics: DynamicsProvider, friction: JointFriction | None) -> None:
        super().__init__()
        MODEL(f"{type(self).__name__}: dynamics", dynamics)
        self.dynamics, self.friction = dynamics, friction_of_size(friction, dynamics.nv)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.dynamics.nv

    def _facts(self) -> Iterable[str]:
        arm = () if self.dynamics.robot is None else (self.dynamics.robot.name,)
        friction = () if self.friction is None else ("with friction",)
        return *arm, joints_told(self.nv), f"model {type(self.dynamics).__name__}", *self._gains_told(), *friction

    def _gains_told(self) -> Iterable[str]:
        """The ranges of the gains, for `_facts`."""
        return ()

    @property
    def packable(self) -> bool:
        """Whether the kernels implement the law, its error and its friction; False for a subclass."""
        wraps = type(self.dynamics).difference is DynamicsProvider.difference
        friction = has_viscous_and_coulomb_only(self.friction)
        return wraps and friction and defines(self, "_packed") and self._has_kernel

    @checked(numpy=flag)
    def packed_law(self, *, numpy: bool = True) -> Packed:
        """Constants and weights for the kernels (`Controller.packed_law`)."""
        return self._packed(numpy) if self.packable else super().packed_law(numpy=numpy)

    def compile(self) -> Controller:  # type: ignore[override]  # torch.nn.Module has another compile
        """The law as machine code (`Controller.compile`)."""
        return CompiledController(self.packed_law(), self.dynamics) if self.packable else self

    @property
    def _has_kernel(self) -> bool:
        """Whether the parts of a law that defines `_packed` have kernels."""
        return True

    def _packed(self, numpy: bool) -> Packed:
        """`packed_law` of exactly the class that defines it, by which a law has a kernel."""
        raise NotImplementedError

    def _pack(self, law: int, gains: tuple[Array, Array], **parts: Any) -> Packed:
        """The law with this code (`kernels/layout.py`) and these gains; parts: those of `layout.pack_law`."""
        continuous = None if self.dynamics.robot is None else self.dynamics.robot.continuous
        f = self.friction
        return pack_law(law, gains, continuous, None if f is None else (f.viscous, f.coulomb, f.transition), **parts)
