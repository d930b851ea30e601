"""The interface of all plants: the simulated arm on which a controller acts."""

from abc import ABC, abstractmethod
from collections.abc import Iterable

from nbs_pin.base.arguments import a
from nbs_pin.base.arrays import Vectors
from nbs_pin.base.shown import Shown, joints_told
from nbs_pin.robots.robot import Robot


class Plant(Shown, ABC):
    """A mechanical system driven by joint torques; it keeps no state between calls.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> plant = nbs.MujocoPlant(nbs.load_robot("two_link"))
        >>> isinstance(plant, nbs.Plant), plant.nv
        (True, 2)
    """

    @property
    @abstractmethod
    def nv(self) -> int:
        """Number of joints."""

    @property
    @abstractmethod
    def robot(self) -> Robot | None:
        """The simulated arm, or None for a plant without a URDF."""

    @property
    def changes(self) -> tuple[float, ...]:
        """Times at which another plant takes over [s], in order; a plant that stays what it is has none."""
        return ()

    def at(self, t: float) -> "Plant":
        """The plant that acts from time t [s] on, itself unless it changes (`ChangingPlant`).

        The time loops ask it at every plant step, and step what it returns.
        """
        return self

    def _facts(self) -> Iterable[str]:
        return (joints_told(self.nv) if self.robot is None else self.robot.name,)

    @abstractmethod
    def step(self, q: Vectors, v: Vectors, tau: Vectors, duration: float) -> tuple[Vectors, Vectors]:
        """State (q, v) after one integration step of `duration` [s] with the torque τ [N·m] held constant.

        Raises:
            SimulationDiverged: If the result is not finite, or the engine reports a warning.
        """


PLANT = a(Plant, "a plant, such as MujocoPlant(robot)")
"""The check of an argument that is a plant."""
