"""A plant that another one replaces during a run: a load is picked up, a tool falls off, friction sets in."""

import math
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

from nbs_pin.base.arguments import DURATION, checked, many, number
from nbs_pin.base.arrays import Vectors
from nbs_pin.base.checks import told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import joints_told
from nbs_pin.robots.joint_differences import difference_of_joints
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.plant import PLANT, Plant

_ROUNDING = 1e-12
"""Relative error of the time of a plant step, k·h, far above that of its rounding and far below a step."""
_TIME = number(least=0.0, unit="s")


def _change(name: str, value: Any) -> tuple[float, Plant]:
    if isinstance(value, str | bytes) or not isinstance(value, Sequence) or len(value) != 2:
        raise ArgumentError(f"{name} is {told(value)}; give a pair of a time [s] and the plant from then on.")
    return DURATION(f"{name}[0]", value[0]), PLANT(f"{name}[1]", value[1])


class ChangingPlant(Plant):
    """The plant `first`, until others take over at their times, each where the one before has left the arm.

    The time loops (`simulate`, `stream`, `PlantArm`) step the plant of the moment, `at(t)`: a change takes effect at
    the first plant step that begins at its time or later. What nobody told the law is simulated by it: the law, the
    checks and the effort limits know `robot`, the arm of the first plant. `rollout`, `train` and `attack` differentiate
    a single `DynamicsPlant` and refuse one that changes.

    Args:
        first: The plant from t = 0 on.
        changes: Pairs of a time [s] and the plant from then on, times above 0 and increasing.

    Raises:
        ArgumentError: If the times do not increase, or a plant has other joints than the first or changes itself.

    Example:
        >>> import nbs_pin as nbs
        >>> bare = nbs.load_robot("two_link")
        >>> loaded = bare.with_payload("tip", 0.5)  # kg
        >>> plant = nbs.ChangingPlant(nbs.MujocoPlant(bare), [(0.5, nbs.MujocoPlant(loaded))])
        >>> law = nbs.NeuralBackstepping.for_robot(bare)
        >>> run = nbs.simulate(plant, law, nbs.Hold([0.3, 0.2]), duration=1.0, period=0.001)
        >>> moved = abs(run.q - [0.3, 0.2]).max(axis=1)  # rad
        >>> bool(moved[:501].max() < 1e-9), bool(moved[-1] > 1e-3)
        (True, True)
    """

    @checked(first=PLANT, changes=many(_change, least=1, most=10_000, of="changes"))
    def __init__(self, first: Plant, changes: Iterable[tuple[float, Plant]]) -> None:
        times, later = zip(*changes, strict=True)
        for before, after in pairwise(times):
            if not after > before:
                raise ArgumentError(
                    f"ChangingPlant: changes at {before:g} s and then at {after:g} s; give them in the order of time, "
                    "one at each."
                )
        _check_nested(first, "first")
        for t, plant in zip(times, later, strict=True):
            _check_nested(plant, f"the plant from {t:g} s on")
            _check_joints(first, t, plant)
        self.first = first
        self._times, self._plants = times, (first, *later)

    def _facts(self) -> Iterable[str]:
        times = ", ".join(f"{t:g}" for t in self._times[:5])
        return repr(self.first), f"changes at {times}{', …' if len(self._times) > 5 else ''} s"

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.first.nv

    @property
    def robot(self) -> Robot | None:
        """The arm of the first plant, which checks and effort limits believe in, or None."""
        return self.first.robot

    @property
    def changes(self) -> tuple[float, ...]:
        """Times at which another plant takes over [s], in order."""
        return self._times

    def at(self, t: float) -> Plant:
        """The plant from time t [s] on: the last of those whose time has come, up to the rounding of t.

        Raises:
            ArgumentError: If t is not a finite number of at least 0.
        """
        if not (type(t) is float and 0.0 <= t < math.inf):
            t = _TIME("ChangingPlant.at: t", t)
        return self._plants[bisect_right(self._times, t * (1.0 + _ROUNDING))].at(t)

    def step(self, q: Vectors, v: Vectors, tau: Vectors, duration: float) -> tuple[Vectors, Vectors]:
        """One step of the first plant, since a step does not say when it is: `at(t).step` is that of time t.

        Raises:
            SimulationDiverged: If the result is not finite, or the engine reports a warning.
        """
        return self.first.step(q, v, tau, duration)


def _check_nested(plant: Plant, what: str) -> None:
    if plant.changes:
        raise ArgumentError(
            f"ChangingPlant: {what} is {plant!r}, which changes itself; give the plants it is made of, with all times "
            "in one list."
        )


def _check_joints(first: Plant, t: float, plant: Plant) -> None:
    """Raise ArgumentError unless the arm of the plant from time t on has the joints of the first one's."""
    if plant.nv != first.nv:
        problem = f"it has {joints_told(plant.nv)} and the first plant {first.nv}"
    elif plant.robot is None or first.robot is None:
        return
    else:
        problem = difference_of_joints(plant.robot, first.robot, "the first plant")
    if problem:
        raise ArgumentError(
            f"ChangingPlant: the plant from {t:g} s on is of another arm: {problem}; build all for one arm."
        )
