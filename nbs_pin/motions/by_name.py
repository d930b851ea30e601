"""Desired motions by name or from a file."""

import difflib
import math
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import joints_told
from nbs_pin.motions.references import DesiredMotion, Sinusoid, paper_reference
from nbs_pin.robots.robot import Robot

NAMED = ("sinusoid", "paper")
DRAWN = {"circle": "circle:RADIUS or circle:RADIUS@xz", "line": "line:DX,DY,DZ"}
"""Paths of a tool by name and how they are written; lengths in m."""
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
    duration: float | None = None,
    **tool: Any,
) -> tuple[DesiredMotion, float]:
    """The motion that `text` names and its duration [s].

    `text` is "sinusoid" (`Sinusoid.for_robot` at `frequency` [rad/s]), "paper" (`paper_reference`), a path of the tool
    ("circle:0.1", "circle:0.1@xz" or "line:0.2,0,0", from where `tool_posture` puts it [m]), or a CSV or NPZ file: of
    joints, whose duration is cut to whole periods [s], or of the tool, with columns x, y and z. `load_reference` takes
    `time_unit` and `degrees`; `tool_motion` takes `duration` [s], None for its default, and the settings in `tool`.
    Raises ArgumentError for any other text, and for settings of a tool path where there is none.
    """
    led = {**tool, "duration": duration}
    kind, stated, numbers = text.partition(":")
    if kind in DRAWN and (stated or text == kind):
        return _drawn(kind, numbers, robot, period, led)
    file = Path(text)
    is_file = file.suffix.lower() in (".csv", ".npz")
    if is_file and file.is_file() and not {"x", "y", "z"} <= set(robot.joint_names):
        from nbs_pin.motions.tool_files import is_tool_file, load_tool_path

        if is_tool_file(file):
            return _led(load_tool_path(file, time_unit=time_unit), robot, period, led)
    near = [] if is_file else difflib.get_close_matches(kind, (*NAMED, *DRAWN), n=1)
    if tool and (kind in NAMED or is_file or not near):
        name, value = next(iter(tool.items()))
        raise ArgumentError(
            f"{option(name, value)} is for a path of the tool, and the reference is '{text}'; give "
            f"{option('reference', 'circle:0.1')}, a line or a file with x, y and z."
        )
    if text == "sinusoid":
        return Sinusoid.for_robot(robot, frequency), DEFAULT_DURATION
    if text == "paper":
        return paper_reference(robot.nv), DEFAULT_DURATION
    if not is_file:
        hint = f"did you mean {near[0]}? " if near else ""
        raise ArgumentError(
            f"no reference '{text}'; {hint}give sinusoid, paper, circle:RADIUS, line:DX,DY,DZ, or a .csv or .npz file."
        )
    from nbs_pin.motions.reference_files import load_reference

    motion = load_reference(text, robot, time_unit=time_unit, degrees=degrees)
    return motion, max(1, math.floor(motion.duration / period + 1e-9)) * period


def _drawn(kind: str, numbers: str, robot: Robot, period: float, given: dict[str, Any]) -> tuple[DesiredMotion, float]:
    """The motion along a circle or a line from where the posture puts the frame."""
    from nbs_pin.motions.tool_paths import ToolPath
    from nbs_pin.motions.tool_postures import is_held, last_frame, tool_posture

    lengths, stated, plane = numbers.partition("@")
    values = _numbers(lengths)
    if len(values) != {"circle": 1, "line": 3}[kind] or (stated and kind == "line"):
        example = {"circle": "circle:0.1", "line": "line:0,0.2,0"}[kind]
        written = f"{kind}:{numbers}" if numbers else kind
        raise ArgumentError(f"the reference is '{written}'; give {DRAWN[kind]} with lengths in m, such as {example}.")
    frame = given.setdefault("frame", last_frame(robot))
    held = "hold" if is_held(robot, frame, given.get("orientation")) else "free"
    posture = given.setdefault("posture", tool_posture(robot, frame, orientation=held))
    if np.shape(posture) != (robot.nv,):
        raise ArgumentError(f"the posture has {len(posture)} numbers for {joints_told(robot.nv)}; give one per joint.")
    begin = robot.pose(posture, frame)[:3, 3]
    if kind == "line":
        return _led(ToolPath.line(begin, values), robot, period, given)
    return _led(ToolPath.circle(begin, values[0], plane or _plane(robot, frame)), robot, period, given)


def _plane(robot: Robot, frame: str) -> Any:
    """The normal of the plane in which the frame moves, of an arm in a plane; else the horizontal plane."""
    from nbs_pin.motions.inverse_kinematics import InverseKinematics

    directions = InverseKinematics(robot, frame, np.zeros(robot.nv), False).directions[:, :3]
    return np.cross(*directions) if len(directions) == 2 else "xy"


def _led(path: Any, robot: Robot, period: float, given: dict[str, Any]) -> tuple[DesiredMotion, float]:
    """The motion along the path and its duration in whole periods: to its end, or, of a file with times, within it."""
    from nbs_pin.motions.tool_motions import tool_motion

    motion = tool_motion(robot, path, **given)
    periods = motion.duration / period
    whole = math.floor(periods + 1e-9) if not motion.rests else math.ceil(periods - 1e-9)
    return motion, max(1, whole) * period


def _numbers(text: str) -> list[float]:
    """Numbers separated by commas; none if one is not a number."""
    try:
        return [float(word if word.isascii() and "_" not in word else "") for word in text.split(",")]
    except ValueError:
        return []
