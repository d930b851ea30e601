"""Data of an arm, what they cover, and the files they go into: the study behind `nbs-pin collect`."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.files import write_whole
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.excitation import torque_limits
from nbs_pin.reports.plotting import ACTUAL, LIMIT, TORQUE, picture
from nbs_pin.robots.robot import Robot

FILES = ("data.npz", "coverage.png", "summary.json")
"""What `write_results` writes, the summary last."""
_DOTS = 4000
_AT_LIMIT = 1.0 - 1e-9


def figures(data: Dataset, robot: Robot) -> dict[str, Any]:
    """What the samples cover, per joint, as JSON can store it; units in the keys, for sliding joints m and N."""
    limit = torque_limits(robot)
    return {
        "samples": len(data),
        "trajectories": data.trajectories,
        "joints": list(robot.joint_names),
        "q_least_rad": data.q.min(axis=0).tolist(),
        "q_most_rad": data.q.max(axis=0).tolist(),
        "rms_velocity_rad_per_s": _rms(data.v),
        "peak_velocity_rad_per_s": np.abs(data.v).max(axis=0).tolist(),
        "rms_acceleration_rad_per_s2": _rms(data.a),
        "rms_torque_Nm": _rms(data.tau),
        "peak_torque_Nm": np.abs(data.tau).max(axis=0).tolist(),
        "torque_limit_Nm": limit.tolist(),
        "at_torque_limit_fraction": (np.abs(data.tau) >= _AT_LIMIT * limit).mean(axis=0).tolist(),
    }


def write_results(data: Dataset, folder: str | Path, robot: Robot, facts: dict[str, Any]) -> dict[str, Any]:
    """Writes `FILES` into the folder, the data first; returns the figures.

    facts: what summary.json holds beside the figures. Raises OSError when they cannot be written.
    """
    folder, numbers = Path(folder), figures(data, robot)
    data.save(folder / "data.npz")
    plot_coverage(data, folder / "coverage.png", robot)
    text = json.dumps(facts | {"figures": numbers}, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    write_whole(folder / "summary.json", text.encode())
    return numbers


def plot_coverage(data: Dataset, path: str | Path, robot: Robot) -> Path:
    """Draws which states the samples cover and writes the picture (PNG); returns its path.

    A column per joint: velocity against position with the joint's range, and torque against acceleration with the
    torque limits where they are within sight; at most 4000 samples, evenly picked.
    """
    shown = np.unique(np.linspace(0, len(data) - 1, _DOTS).astype(int))
    q, v, a, tau = (x[shown] for x in (data.q, data.v, data.a, data.tau))
    with picture(path, 1.0 + 2.4 * data.nv, 4.8) as figure:
        grid = figure.subplots(2, data.nv, squeeze=False)
        for joint, (states, torques) in enumerate(grid.T):
            info, limit = robot.joints[joint], robot.effort_limit[joint]
            states.plot(q[:, joint], v[:, joint], ".", color=ACTUAL, markersize=1.5, alpha=0.5)
            torques.plot(a[:, joint], tau[:, joint], ".", color=TORQUE, markersize=1.5, alpha=0.5)
            for bound in (info.lower, info.upper):
                if np.isfinite(bound):
                    states.axvline(bound, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
            for bound in (-limit, limit):
                if np.abs(tau[:, joint]).max() > 0.5 * limit:
                    torques.axhline(bound, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
            length, force = ("m", "N") if info.prismatic else ("rad", "N·m")
            states.set_title(info.name, loc="left")
            states.set(xlabel=f"q [{length}]", ylabel=f"v [{length}/s]")
            torques.set(xlabel=f"acceleration [{length}/s²]", ylabel=f"τ [{force}]")
    return Path(path)


def _rms(x: np.ndarray) -> list[float]:
    return np.sqrt((x**2).mean(axis=0)).tolist()
