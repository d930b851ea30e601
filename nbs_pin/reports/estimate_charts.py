"""What a law that adapts believed during a run."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from nbs_pin.base.arguments import checked, count, writable
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import RUN, Run
from nbs_pin.reports.captions import arm_in_words, law_in_words, settings_in_words
from nbs_pin.reports.plotting import (
    ACTUAL,
    ERROR,
    INK,
    NOTE,
    TORQUE,
    VIOLET,
    Heading,
    draw_changes,
    one_start,
    picture,
    thin,
)
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.simulation.run_figures import estimates_of, figures, load_of, loads_of

_KINDS = ("Coulomb friction", "viscous friction", "rotor inertia", "constant torque", "constant acceleration")
_COLOURS = (ACTUAL, ERROR, TORQUE, VIOLET, INK, NOTE)


@checked(run=RUN, path=writable, start=count(0))
def plot_estimates(run: Run, path: str | Path, *, start: int = 0) -> Path:
    """Plot what a law that adapts believed and write the picture; returns its path.

    The first panels have mass and centre of the load, with the loads that the plant carried as dotted lines, the others
    friction, rotor inertia and constant torques of the joints, and masses of links. Ends in .png, .svg or .pdf.

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
    found = estimates_of(one)
    if not found:
        raise ArgumentError("the run has no estimates; plot one of a law that adapts, such as AdaptiveLaw.")
    load = load_of(found)
    links = {name: x for name, x in found.items() if name.endswith(" m [kg]") and not name.startswith("load at ")}
    groups = {"mass of links [kg]": {name.removesuffix(" m [kg]"): x for name, x in links.items()}}
    for kind in _KINDS:
        for name in (name for name in found if f" {kind} [" in name):
            joint, _, unit = name.partition(f" {kind} ")
            groups.setdefault(f"{kind} {unit}", {})[joint] = found[name]
    shown = {title: curves for title, curves in groups.items() if curves}
    rows = 2 * (load is not None) + len(shown)
    verdict = verdict_of(figures(one))
    heading = Heading(f"{arm_in_words(run)}: what {law_in_words(run)} has learned", settings_in_words(run), verdict)
    with picture(path, 9.0, 1.4 + 1.9 * rows, heading=heading) as figure:
        panels = list(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0])
        if load is not None:
            _draw_load(panels[0], panels[1], one, load)
        for axes, (title, curves) in zip(panels[2 * (load is not None) :], shown.items(), strict=True):
            _draw(axes, one, title, curves)
        draw_changes(panels, one)
        panels[-1].set(xlabel="time [s]", xlim=(float(run.t[0]), float(run.t[-1])))
    return Path(path)


def _draw_load(above: Axes, below: Axes, run: Run, load: tuple[str, np.ndarray, np.ndarray]) -> None:
    """The mass of the load beside what the plant carried, and its centre while there is one."""
    link, mass, centre = load
    _draw(above, run, f"load at {link}: mass [kg]", {"learned": mass})
    carried = np.zeros(len(run.t))
    for one in loads_of(run):
        until = np.inf if one["until_s"] is None else one["until_s"]
        carried[(run.t >= one["from_s"]) & (run.t < until)] += one["mass_kg"]
    if carried.any():
        above.plot(run.t, carried, color=INK, linewidth=0.9, linestyle=(0, (1, 2)), label="carried")
        above.legend(frameon=False, loc="best", ncols=2)
    heavy = np.abs(mass) > 0.25 * np.abs(mass).max()
    curves = {axis: np.where(heavy, 1e3 * centre[:, k], np.nan) for k, axis in enumerate("xyz")}
    _draw(below, run, f"its centre in the frame of {link} [mm]", curves)


def _draw(axes: Axes, run: Run, title: str, curves: dict[str, np.ndarray]) -> None:
    for k, (name, values) in enumerate(curves.items()):
        axes.plot(*thin(run.t, values), color=_COLOURS[k % len(_COLOURS)], linewidth=1.2, label=name,
                  linestyle="-" if k < len(_COLOURS) else (0, (4, 2)))  # fmt: skip
    axes.set_title(title, loc="left", fontsize=9.0, color=INK)
    axes.yaxis.set_major_locator(MaxNLocator(5))
    if len(curves) > 1:
        axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7)
