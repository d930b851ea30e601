"""A picture of several laws on one motion."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from nbs_pin.base.records import Run
from nbs_pin.base.units import several
from nbs_pin.reports.plotting import DASHES, LIMIT, LINES, Heading, draw_changes, picture, thin
from nbs_pin.simulation.metrics import squared_error


def plot_laws(runs: Mapping[str, Run], path: str | Path, heading: Heading | None = None) -> Path:
    """Plot error and torque of several laws on one motion, write the picture (`plotting.picture`) and return its path.

    Left: ‖z1‖ over time, logarithmic. Right: the largest |τ_i| over the joints, as a share of its effort limit, where
    the arm has limits.
    """
    first = next(iter(runs.values()))
    with picture(path, 11.0, 4.2, heading=heading) as figure:
        errors, torques = figure.subplots(1, 2)
        limited = bool(np.isfinite(first.effort_limit).any())
        for k, (name, run) in enumerate(runs.items()):
            style = {"color": LINES[k % len(LINES)], "linestyle": DASHES[k // len(LINES) % len(DASHES)]}
            error = np.sqrt(squared_error(run))
            errors.semilogy(*thin(run.t, np.where(error > 0.0, error, np.nan)), label=name, linewidth=1.0, **style)
            share = np.abs(run.tau) / (run.effort_limit if limited else 1.0)
            torques.plot(*thin(run.t, share.max(axis=-1)), label=name, linewidth=1.0, **style)
        if limited:
            torques.axhline(1.0, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
        force = several(of.torque for of in first.units)
        told = "largest torque of a joint ÷ its effort limit" if limited else f"largest torque of a joint [{force}]"
        torques.set_title(told, loc="left")
        errors.set_title(f"‖error‖ [{several(of.position for of in first.units)}]", loc="left")
        for axes in (errors, torques):
            axes.set(xlabel="time [s]", xlim=(first.t[0], first.t[-1]))
        draw_changes((errors, torques), first)
        errors.legend(frameon=False)
    return Path(path)
