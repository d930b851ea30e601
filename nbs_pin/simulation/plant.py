"""The protocol of every plant: the truth that a controller acts on."""

from abc import ABC, abstractmethod

from nbs_pin.base.arrays import Vectors
from nbs_pin.robots.robot import Robot


class Plant(ABC):
    """A mechanical system that moves under joint torques; state in, state out, nothing kept between calls."""

    @property
    @abstractmethod
    def nv(self) -> int:
        """Number of joints."""

    @property
    @abstractmethod
    def robot(self) -> Robot | None:
        """The arm this plant simulates, or None for one without a URDF."""

    @abstractmethod
    def step(self, q: Vectors, v: Vectors, tau: Vectors, duration: float) -> tuple[Vectors, Vectors]:
        """State (q, v) after one integration step of `duration` [s] with the torque τ [N·m] held constant.

        Raises SimulationDiverged when the result is not finite or the engine reports a warning.
        """
