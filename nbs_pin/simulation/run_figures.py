"""What a run came to, joint by joint and along the path of its tool: the figures of summaries, pictures and pages."""

from typing import Any

import numpy as np

from nbs_pin.base.plain import plain
from nbs_pin.base.records import Run
from nbs_pin.base.units import by_quantity
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation import metrics
from nbs_pin.simulation.tool_errors import tool_errors, tool_of


def figures(run: Run, robot: Robot | None = None) -> dict[str, Any]:
    """`metrics.summary` of the run and the RMS error over its last 30 %, as JSON can store them.

    They are None where a row is not finite. With a robot, also how far each joint left its position range, as the
    plants have no joint stops, and how far the tool was from its path, if it followed one. `units` says in what the
    numbers of each joint are: those of one that slides are in m and N, whatever the key says.
    """
    values = metrics.summary(run)
    values["units"] = by_quantity(run.slides)
    values["rms_error_last_30_percent_rad"] = plain(metrics.rms_error(run, 0.7 * float(run.t[-1])))
    if robot is not None:
        beyond = np.maximum(robot.lower - run.q, run.q - robot.upper).reshape(-1, run.nv)
        values["outside_position_range_rad"] = plain(np.maximum(beyond.max(axis=0), 0.0))
        tool = tool_of(run)
        if tool is not None:
            values["tool"] = tool | plain(tool_errors(run, robot).figures())
    return values
