"""What the charts of a page show of a run: every signal over time, at most `MAX_ROWS` of its rows."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from nbs_pin.base.records import Run
from nbs_pin.reports.estimate_panels import panels_of
from nbs_pin.reports.external import external_torque
from nbs_pin.reports.pages import encoded
from nbs_pin.reports.plotting import stretches
from nbs_pin.reports.scene import positions, tips_of
from nbs_pin.robots.robot import Robot, configuration_difference
from nbs_pin.simulation.run_figures import changes_of

MAX_ROWS = 10_001
"""Of longer runs, the page has the first row of every stretch, and those of its largest error and largest torque."""


def signals_of(run: Run, robot: Robot, most: int = MAX_ROWS) -> dict[str, Any]:
    """The signals of a run with one start: numbers per row and joint [rad, N·m], of tips per row and tip [m]."""
    rows = _rows(run, most)
    error = configuration_difference(run.q, run.q_ref, run.continuous)
    picked = {name: np.array(getattr(run, name)[rows]) for name in ("q", "q_ref", "v", "v_ref", "tau", "disturbance")}
    asked = run.tau_command[rows]
    if rows[-1] == len(run.t) - 1 and len(rows) > 1:  # the last torque was computed, but never applied
        picked["tau"][-1], asked = picked["tau"][-2], np.concatenate([asked[:-1], asked[-2:-1]])
        picked["disturbance"][-1] = picked["disturbance"][-2]
    picked["external"] = external_torque(run, robot)[rows]
    cut = np.abs(run.tau_command[:-1]) > run.effort_limit
    ends, t = tips_of(run, robot), run.t
    gap = positions(robot, ends, picked["q"]) - positions(robot, ends, picked["q_ref"])
    return {
        "times": encoded(t[rows], np.float64),
        "all": len(rows) == len(t),
        **{name: encoded(values) for name, values in picked.items()},
        "error": encoded(error[rows]),
        "share": encoded(np.abs(asked) / run.effort_limit),
        "tips": [tip.name for tip in ends],
        "tip": encoded(np.linalg.norm(gap, axis=-1)),
        "saturated": [[(float(t[i]), float(t[j])) for i, j in stretches(of_joint)] for of_joint in cut.T],
        "changes": changes_of(run),
        "disturbed": bool(run.disturbance.any()),
        "estimates": [
            {"title": title, "unit": unit, "names": list(curves), "of_joints": of_joints,
             "values": encoded(np.stack(list(curves.values()), axis=-1)[rows])}
            for title, unit, curves, of_joints in panels_of(run)
        ],
    }  # fmt: skip


def _rows(run: Run, most: int) -> Int[np.ndarray, " rows"]:
    count = len(run.t)
    if count <= most:
        return np.arange(count)
    width = -(-3 * count // most)
    error = np.abs(configuration_difference(run.q, run.q_ref, run.continuous)).max(axis=-1)
    share = (np.abs(run.tau_command) / np.where(np.isfinite(run.effort_limit), run.effort_limit, 1.0)).max(axis=-1)
    begins = np.arange(0, count, width)
    return np.unique(np.concatenate([begins, begins + _most(error, width), begins + _most(share, width), [count - 1]]))


def _most(values: Float[np.ndarray, " rows"], width: int) -> Int[np.ndarray, " stretches"]:
    """Within each stretch of that width, which value is largest."""
    padded = np.pad(np.nan_to_num(values), (0, -len(values) % width), constant_values=-1.0)
    return padded.reshape(-1, width).argmax(axis=1)
