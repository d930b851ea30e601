"""Loads that appear during a run: the plant that changes with them, and what is kept of them."""

from collections.abc import Callable, Sequence
from typing import Any

from nbs_pin.base.records import Run
from nbs_pin.cli.payloads import TimedLoad
from nbs_pin.cli.values import OptionError
from nbs_pin.robots.carrying import carrying
from nbs_pin.robots.robot import Robot
from nbs_pin.robots.urdf_options import Payload
from nbs_pin.simulation.changing_plant import ChangingPlant
from nbs_pin.simulation.plant import Plant


def loaded(robot: Robot, loads: Sequence[TimedLoad], build: Callable[[Robot], Plant]) -> Plant:
    """The plant that `build` makes of the arm, replaced whenever a load appears or goes.

    Raises:
        RobotError: If an arm has no such link.
    """
    first = build(robot)
    if not loads:
        return first
    later = []
    for t in _times(loads):
        there = [(load.link, Payload(load.mass, load.com)) for load in loads if load.acts_at(t)]
        later.append((t, build(carrying(robot, there)) if there else first))
    return ChangingPlant(first, later)


def check_times(loads: Sequence[TimedLoad], duration: float) -> None:
    """Raise OptionError if one of the loads would appear or go at the end of the motion or after it."""
    for load in loads:
        for t, what in ((load.begin, "appear"), (load.end, "go again")):
            if t is not None and t >= duration:
                raise OptionError(
                    f"--payload is '{load.words}', but the motion ends at {duration:g} s, before the load would "
                    f"{what}; give earlier times, or a longer --duration."
                )


def kept(loads: Sequence[TimedLoad]) -> dict[str, Any]:
    """The loads as settings and runs keep them: nothing where there are none."""
    return {"loads": [load.told() for load in loads]} if loads else {}


def note(run: Run, loads: Sequence[TimedLoad]) -> None:
    """Keep the loads in a run that no time loop of the simulation has recorded, with the times at which they change."""
    run.info.update(kept(loads))
    if loads:
        run.info["plant_changes"] = _times(loads)


def _times(loads: Sequence[TimedLoad]) -> list[float]:
    """When a load appears or goes [s]."""
    return sorted({t for load in loads for t in (load.begin, load.end) if t is not None})
