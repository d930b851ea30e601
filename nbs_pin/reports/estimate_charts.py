"""A picture of what a law that adapts believed during a run."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from nbs_pin.base.arguments import checked, count, writable
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import RUN, Run
from nbs_pin.reports.captions import arm_in_words, law_in_words
from nbs_pin.reports.estimate_panels import CARRIED, Panel, panels_of
from nbs_pin.reports.plotting import (
    DASHES,
    INK,
    LINES,
    NOTE,
    draw_changes,
    heading_of,
    one_start,
    picture,
    short_name,
    thin,
    time_span,
)

_ROWS = 10
"""Names below each other in the legend of a panel."""


@checked(run=RUN, path=writable, start=count(0))
def plot_estimates(run: Run, path: str | Path, *, start: int = 0) -> Path:
    """Plot what a law that adapts believed and write the picture; returns its path.

    The first panels have mass and centre of the load, with what the plant carried as a dotted curve, the others masses
    of links, and friction, rotor inertia and constant torques of the joints. Ends in .png, .svg or .pdf.

    Raises:
        ArgumentError: If the run has no estimates, as that of a law which does not adapt, or the start does not exist.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, reference = nbs.AdaptiveLaw.for_robot(robot), nbs.Sinusoid.for_robot(robot)
        >>> run = nbs.simulate(nbs.MujocoPlant(robot), law, reference, 0.1, 0.001)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(nbs.plot_estimates(run, f"{folder}/estimates.png").name)
        estimates.png
    """
    one = one_start(run, start)
    shown = panels_of(one)
    if not shown:
        raise ArgumentError("the run has no estimates; plot one of a law that adapts, such as AdaptiveLaw.")
    heading = heading_of(one, title=f"{arm_in_words(run)}: what the {law_in_words(run)} has learned")
    with picture(path, 9.0, 1.4 + 1.9 * len(shown), heading=heading) as figure:
        grid = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
        for axes, panel in zip(grid, shown, strict=True):
            _draw(axes, run.t, panel)
        draw_changes(grid, one)
        grid[-1].set(xlabel="time [s]", xlim=time_span(one))
    return Path(path)


def _draw(axes: Axes, t: Float[np.ndarray, " rows"], panel: Panel) -> None:
    for k, (name, values) in enumerate(panel.curves.items()):
        style = {"color": LINES[k % len(LINES)], "linestyle": DASHES[k // len(LINES) % len(DASHES)], "linewidth": 1.2}
        if name == CARRIED and not panel.of_joints:
            style = {"color": INK, "linestyle": (0, (1, 1.5)), "linewidth": 1.3}
        axes.plot(*thin(t, values), label=short_name(name), **style)
    axes.set_title(f"{panel.title} [{panel.unit}]".replace("$", r"\$"), loc="left", fontsize=9.0, color=INK)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    if len(panel.curves) > 1:  # right of the panel, where the legend covers no curve
        columns = -(-len(panel.curves) // _ROWS)
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7, ncols=columns,
                    handlelength=1.6, columnspacing=1.0)  # fmt: skip
    known = np.concatenate(list(panel.curves.values()))
    known = known[np.isfinite(known)]
    if not len(known):
        axes.annotate("no load", (0.5, 0.5), xycoords="axes fraction", ha="center", va="center", color=NOTE)
        axes.set_yticks([])
    elif panel.unit == "mm":  # without what a centre jumps to at the first and last instants of a load
        low, high = np.percentile(known, [0.5, 99.5])
        room = max(0.1 * (high - low), 0.5)
        axes.set_ylim(low - room, high + room)
