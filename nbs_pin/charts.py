"""Charts of studies: curves over many runs, in the style of `plotting`."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from nbs_pin.plotting import ACTUAL, ERROR, REFERENCE, TORQUE, picture


def plot_scaling(joints: Sequence[float], series: Mapping[str, Sequence[float]], path: str | Path) -> Path:
    """Draws cost [µs] against number of joints, a line per series, and writes the picture (PNG); returns its path."""
    with picture(path, 6.4, 4.0) as figure:
        axes = figure.add_subplot()
        for (name, values), colour in zip(series.items(), (ACTUAL, REFERENCE, TORQUE, ERROR), strict=False):
            axes.plot(joints, values, "o-", color=colour, markersize=3.5, label=name)
        axes.set(xlabel="joints", ylabel="one control step, median [µs]", xlim=(0, None), ylim=(0, None))
        axes.legend(frameon=False, loc="upper left")
    return Path(path)
