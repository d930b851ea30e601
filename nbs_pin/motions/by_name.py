"""Desired motions by name or from a file."""

import difflib
import math
from pathlib import Path

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.motions.references import DesiredMotion, Sinusoid, paper_reference
from nbs_pin.robots.robot import Robot

NAMED = ("sinusoid", "paper")
DEFAULT_DURATION = 10.0
"""Duration of a motion by name, which has no end of its own [s]."""


def motion_of(
    text: str,
    robot: Robot,
    *,
    frequency: float,
    period: float,
    time_unit: str | None = None,
    degrees: bool | None = None,
) -> tuple[DesiredMotion, float]:
    """The motion that `text` names and its duration [s].

    `text` is "sinusoid" (`Sinusoid.for_robot` at `frequency` [rad/s]), "paper" (`paper_reference`), or a CSV or NPZ
    file, whose duration is cut to whole periods [s]; `load_reference` takes `time_unit` and `degrees`. Raises
    ArgumentError for any other text.
    """
    if text == "sinusoid":
        return Sinusoid.for_robot(robot, frequency), DEFAULT_DURATION
    if text == "paper":
        return paper_reference(robot.nv), DEFAULT_DURATION
    if Path(text).suffix.lower() not in (".csv", ".npz"):
        near = difflib.get_close_matches(text, NAMED, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ArgumentError(f"no reference '{text}'; {hint}give sinusoid, paper, or a .csv or .npz file.")
    from nbs_pin.motions.reference_files import load_reference

    motion = load_reference(text, robot, time_unit=time_unit, degrees=degrees)
    return motion, max(1, math.floor(motion.duration / period + 1e-9)) * period
