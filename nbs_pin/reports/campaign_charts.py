"""Box plots of a campaign."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from nbs_pin.base.units import counted
from nbs_pin.campaigns.table import CampaignTable, Row
from nbs_pin.campaigns.trials import Figures
from nbs_pin.reports.plotting import ACTUAL, INK, LIMIT, NOTE, TORQUE, Heading, picture

_LONGEST = 44  # characters of a group's name


def plot_campaign(table: CampaignTable, path: str | Path, heading: Heading | None = None) -> Path:
    """Plot the errors and torques of every group of trials as boxes, write the picture and return its path.

    Left: the RMS error of the worst joint, logarithmic. Right: the largest torque of a joint as a share of its effort
    limit, where the arms have limits. A box goes from the first quartile to the third with the median in it, its
    whiskers as far as 1.5 times its length, and a dot is a trial beyond.
    """
    groups = table.groups()
    with picture(path, 11.0, 1.4 + 0.34 * max(3, len(groups)), heading=heading) as figure:
        errors, torques = figure.subplots(1, 2, sharey=True)
        units = dict.fromkeys(row.figures.unit for row in table.rows if row.figures is not None)
        _boxes(errors, [[f.rms_error_rad for f in _done(rows)] for rows in groups.values()], ACTUAL)
        errors.set_xscale("log")
        errors.set_title(f"RMS error of the worst joint [{', '.join(units)}]", loc="left")
        shares: list[list[Any]] = [[f.peak_effort_share for f in _done(rows)] for rows in groups.values()]
        limited = not any(share is None for group in shares for share in group)
        forces = "N·m" if "m" not in units else "N·m, N"
        peaks = shares if limited else [[f.peak_torque_Nm for f in _done(rows)] for rows in groups.values()]
        _boxes(torques, peaks, TORQUE)
        if limited:
            torques.axvline(1.0, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
        told = "largest torque of a joint ÷ its effort limit" if limited else f"largest torque of a joint [{forces}]"
        torques.set_title(told, loc="left")
        errors.set_yticks(np.arange(len(groups)), [_label(words, rows) for words, rows in groups.items()])
        errors.invert_yaxis()
    return Path(path)


def _done(rows: Sequence[Row]) -> list[Figures]:
    return [row.figures for row in rows if row.figures is not None]


def _label(words: str, rows: Sequence[Row]) -> str:
    """The name of a group, and how many of it failed."""
    failed = len(rows) - len(_done(rows))
    short = words if len(words) <= _LONGEST else f"{words[:_LONGEST]}…"
    return f"{short}\n{failed} of {counted(len(rows), 'trial')} failed" if failed else short


def _boxes(axes: Axes, groups: Sequence[Sequence[float]], colour: str) -> None:
    """A horizontal box for every group that has numbers."""
    filled = [(place, list(values)) for place, values in enumerate(groups) if values]
    axes.boxplot(
        [values for _, values in filled],
        positions=[place for place, _ in filled],
        orientation="horizontal",
        widths=0.55,
        manage_ticks=False,
        patch_artist=True,
        boxprops={"facecolor": colour, "alpha": 0.25, "edgecolor": colour, "linewidth": 0.9},
        medianprops={"color": INK, "linewidth": 1.4},
        whiskerprops={"color": colour, "linewidth": 0.9},
        capprops={"color": colour, "linewidth": 0.9},
        flierprops={"marker": "o", "markersize": 2.5, "markerfacecolor": colour, "markeredgecolor": NOTE, "alpha": 0.7},
    )
    axes.set_ylim(-0.6, len(groups) - 0.4)
