"""Figures of runs, and the style of every figure, without any global plotting state."""

import io
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from nbs_pin.base.arguments import checked, count, maybe, writable
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.files import write_whole
from nbs_pin.base.picture_kinds import is_svg_wanted, svg_beside
from nbs_pin.base.records import RUN, Run
from nbs_pin.base.shown import joints_told
from nbs_pin.base.units import percent
from nbs_pin.dynamics.momentum_observer import OBSERVED, ObservedTorques
from nbs_pin.reports.captions import arm_in_words, law_in_words, settings_in_words
from nbs_pin.reports.verdicts import BAD, GOOD, WARNING, Verdict, verdict_of
from nbs_pin.robots.named import robot_of
from nbs_pin.robots.robot import ARM, Robot, configuration_difference
from nbs_pin.robots.urdf import JointData
from nbs_pin.simulation.metrics import saturated_fraction
from nbs_pin.simulation.run_figures import changes_of, figures
from nbs_pin.simulation.tool_errors import tool_errors, tool_of

ACTUAL, REFERENCE, ERROR = "#1f5fbf", "#ff8c1a", "#b3261e"
TORQUE, LIMIT, SATURATED, FAST = "#22734d", "#8a8f98", "#f6c945", "#7b3fa0"
MAX_POINTS = 4000
"""Longer curves are thinned, keeping the extremes of every stretch."""

_STYLE: Any = {
    "font.size": 8.5, "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": "#9aa3ad",
    "axes.linewidth": 0.7, "axes.grid": True, "axes.axisbelow": True, "axes.formatter.useoffset": False,
    "grid.color": "#e6eaee", "grid.linewidth": 0.6, "lines.linewidth": 1.2, "lines.solid_capstyle": "round",
    "xtick.color": "#4a5562", "ytick.color": "#4a5562", "svg.hashsalt": "nbs_pin",
    "svg.fonttype": "path",
}  # fmt: skip
INK, NOTE, VIOLET = "#1d2733", "#5d6b7a", "#7a4fa3"
LINES = (ACTUAL, REFERENCE, TORQUE, FAST, ERROR, "#8c564b", "#17a2b8", "#6c757d")
"""Colours of many curves in one panel."""
DASHES: Any = ("solid", (0, (5, 2)), (0, (1, 1.2)))
"""Dashes of the curves, where there are more than colours: the second for those after the first `LINES`."""
_COLOURS = {GOOD: TORQUE, WARNING: "#8a5a00", BAD: ERROR}
_UNDATED: Any = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
_WIDE: Any = {"color": "#ffc891", "linewidth": 4.5}  # of the reference, so that it shows beside the curve on it
_CHANGE: Any = {"color": INK, "linewidth": 0.9, "linestyle": (0, (1, 1.5))}
_OBSERVED: Any = {"color": ERROR, "linewidth": 0.9, "linestyle": (0, (4, 2))}
_LONGEST = 20  # characters of a name beside a row or in a legend
_NARROWEST = 0.012  # share of the time axis that a marked stretch takes, at least


class Heading(NamedTuple):
    """What stands above a figure."""

    title: str
    """The arm and the law, or what was done."""
    settings: Sequence[str] = ()
    """What else determines the figure, one phrase each."""
    verdict: Verdict | None = None


@contextmanager
def picture(
    path: str | Path, width: float, height: float, dpi: int = 120, heading: Heading | None = None
) -> Iterator[Figure]:
    """An empty figure of that size [inch] in the common style, written to the path when the block ends.

    A path that ends in .svg or .pdf gets that kind, any other a PNG, beside which there is an SVG if the shell asks for
    it (`base/picture_kinds.py`). It is written whole, or not at all if drawing
    fails. The heading takes its room from the figure. Raises OSError if it cannot be written.
    """
    kind = Path(path).suffix.lower().removeprefix(".")
    kind = kind if kind in ("svg", "pdf") else "png"
    with rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing")  # a name in another script; it stands in summary.json
        figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
        FigureCanvasAgg(figure)
        if heading is not None:
            _head(figure, heading)
        yield figure
        _lay_out(figure)
        files = {Path(path): kind}
        if kind == "png" and is_svg_wanted():
            files[svg_beside(path)] = "svg"
        drawn = {}
        for file, form in files.items():
            buffer = io.BytesIO()
            figure.savefig(buffer, format=form, metadata={} if form == "png" else _UNDATED[form])
            drawn[file] = buffer.getvalue()
    for file, data in drawn.items():
        write_whole(file, data)


def _lay_out(figure: Figure) -> None:
    """Arrange the axes once; with a layout engine, "none" included, savefig would draw the figure once in vain."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if not axis.get_label_text():
                axis.set_label_coords(0.5, 0.5)  # else places for nothing are looked for
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.execute(figure)
    figure.set_layout_engine(None)


def _head(figure: Figure, heading: Heading) -> None:
    """Write the heading at the top, and keep the layout below it."""
    width, height = figure.get_size_inches()
    lines = [(line, 11.5, "bold", INK) for line in textwrap.wrap(heading.title, int(9.5 * width))]
    lines += [(line, 8.0, "normal", NOTE) for line in textwrap.wrap(" · ".join(heading.settings), int(15.0 * width))]
    if heading.verdict is not None:
        colour = _COLOURS.get(heading.verdict.level, INK)
        lines += [(line, 8.5, "normal", colour) for line in textwrap.wrap(heading.verdict.text, int(14.0 * width))]
    down = 0.06
    for text, size, weight, colour in lines:
        figure.text(0.1 / width, 1.0 - down / height, text.replace("$", r"\$"), fontsize=size, fontweight=weight,
                    color=colour, va="top")  # fmt: skip
        down += 1.42 * size / 72.0
    engine = figure.get_layout_engine()
    assert isinstance(engine, ConstrainedLayoutEngine)
    engine.set(rect=(0.0, 0.0, 1.0, 1.0 - down / height))


@checked(run=RUN, path=writable, start=count(0), robot=maybe(ARM), external=maybe(OBSERVED))
def plot_tracking(
    run: Run, path: str | Path, *, start: int = 0, robot: Robot | None = None, external: ObservedTorques | None = None
) -> Path:
    """Plot how each joint follows its reference and write the picture; returns its path.

    It is a PNG, or of the kind that the path ends in: .svg or .pdf. Each row shows actual and desired position, |error|
    on a logarithmic scale that is the same for joints of one kind (wrapped on continuous joints), and the applied
    torque with the disturbance, if there was one, and the effort limits where they are near; saturated stretches are
    shaded, and a dotted line stands where another plant took over (`ChangingPlant`). The heading has the law, its
    settings and a verdict. `start` selects one start of a batched run. With a `robot`, the arm that ran, position
    limits are drawn where the joint comes near them, and stretches are shaded in which it is outside them or faster
    than its velocity limit. A run along a path of the tool has a last row: its errors and the path, for which None
    loads the arm that the run names. `external`, what `MomentumObserver.observe` made of the run, is drawn dashed
    beside torque and disturbance.

    Raises:
        ArgumentError: If the start does not exist, robot or `external` do not fit the run, or the arm of a path of the
            tool is missing or has changed.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
        >>> run = nbs.simulate(nbs.MujocoPlant(robot), law, reference, 0.1, 0.001)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(nbs.plot_tracking(run, f"{folder}/tracking.png").name)
        tracking.png
    """
    one = one_start(run, start)
    if robot is not None and robot.nv != run.nv:
        raise ArgumentError(f"the run has {joints_told(run.nv)} and {robot!r} {robot.nv}; give the robot of the run.")
    q, v, q_ref, tau = one.q, one.v, one.q_ref, one.tau
    outside = None if external is None else _observed(external, run, start)
    error = np.abs(configuration_difference(q, q_ref, run.continuous))
    cut = np.abs(one.tau_command) > run.effort_limit
    tau[-1], cut[-1] = np.nan, False  # commanded, but never applied
    fraction = float(saturated_fraction(one))
    decades = [_decades(error[:, [of is other for other in run.units]]) for of in run.units]
    tool = tool_of(run)
    robot = robot_of(run) if robot is None and tool is not None else robot
    rows = run.nv + (tool is not None)
    with picture(path, 13.0, 1.15 + 1.5 * rows + (1.5 if tool else 0.0), heading=heading_of(one, robot)) as figure:
        heights = [1.0] * run.nv + [2.0] * (tool is not None)
        grid = figure.subplots(rows, 3, squeeze=False, height_ratios=heights)
        for joint, (position_axes, error_axes, torque_axes) in enumerate(grid[: run.nv]):
            _draw_position(position_axes, run.t, q[:, joint], q_ref[:, joint])
            if robot is not None:
                _draw_stops(position_axes, run.t, q[:, joint], v[:, joint], robot.joints[joint])
            _draw_error(error_axes, run.t, error[:, joint], decades[joint])
            _draw_torque(torque_axes, one, joint, cut[:, joint], None if outside is None else outside[:, joint])
            position_axes.set_ylabel(short_name(run.joint_names[joint]), fontweight="bold", color=INK)
            if len(set(run.units)) > 1:
                of = run.units[joint]
                for axes, unit in zip(grid[joint], (of.position, of.position, of.torque), strict=True):
                    axes.annotate(f"[{unit}]", (0.0, 1.0), xycoords="axes fraction", va="bottom", fontsize=7,
                                  color=NOTE)  # fmt: skip
        draw_changes(grid[: run.nv].flat, run)
        _dress(figure, grid, run, fraction, observed=outside is not None)
        if tool is not None:
            assert robot is not None
            _draw_tool(figure, grid[-1], one, robot, tool)
    return Path(path)


def _observed(external: ObservedTorques, run: Run, start: int) -> Float[np.ndarray, "rows n"]:
    """What was observed in one start; raises ArgumentError if that was in another run."""
    if external.torque.shape != run.q.shape:
        raise ArgumentError(
            f"external has torques of shape {external.torque.shape} for a run of shape {run.q.shape}; give what"
            " MomentumObserver.observe returned for this run."
        )
    return external.torque.reshape(len(run.t), -1, run.nv)[:, start]


def heading_of(run: Run, robot: Robot | None = None, title: str = "") -> Heading:
    """Title ("": arm and law) and settings, and what the errors of one start amount to, if they can be summed up."""
    title, stopped = title or f"{arm_in_words(run)}: {law_in_words(run)}", {"stopped": run.info.get("stopped")}
    if len(run.t) < 3 or not np.isfinite(run.q).all():
        return Heading(title, settings_in_words(run), verdict_of(stopped) if stopped["stopped"] else None)
    verdict = verdict_of(figures(run, robot) | stopped, interrupted=run.info.get("interrupted") is True)
    return Heading(title, settings_in_words(run), verdict)


def _draw_tool(figure: Figure, row: np.ndarray, run: Run, robot: Robot, tool: dict[str, Any]) -> None:
    """Errors of the tool's position and orientation, and its path, seen along the direction in which it is thinnest."""
    errors = tool_errors(run, robot)
    row[0].set_ylabel(short_name(tool["frame"]), fontweight="bold", color=INK)
    titles = ["distance from the path [m]", "angle from its orientation [rad]"]
    shown = [errors.position, errors.orientation]
    for axes, title, error in zip(row, titles, shown if tool.get("orientation") == "hold" else shown[:1], strict=False):
        _draw_error(axes, run.t, error, _decades(error))
        axes.set_title(title, loc="left", fontsize=8.5, color=INK)
        draw_changes([axes], run)
    if tool.get("orientation") != "hold":
        row[1].set_axis_off()
    place = row[2].get_subplotspec()
    row[2].remove()
    axes = figure.add_subplot(place)
    asked, actual = (robot.pose(q, tool["frame"])[:, :3, 3] for q in (run.q_ref, run.q))
    across, up = np.sort(np.argsort(np.ptp(asked, axis=0))[1:])
    axes.plot(asked[:, across], asked[:, up], **_WIDE)
    axes.plot(actual[:, across], actual[:, up], color=ACTUAL)
    axes.plot(*asked[0, [across, up]], "o", color=REFERENCE, markersize=4)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title("path [m]", loc="left", fontsize=8.5, color=INK)
    axes.set_xlabel("xyz"[across])
    axes.set_ylabel("xyz"[up])


def _draw_position(axes: Axes, t: Float[np.ndarray, " rows"], q: Float[np.ndarray, " rows"],
                   q_ref: Float[np.ndarray, " rows"]) -> None:  # fmt: skip
    axes.plot(*thin(t, q_ref), **_WIDE)
    axes.plot(*thin(t, q), color=ACTUAL)
    axes.yaxis.set_major_locator(MaxNLocator(4))


def _draw_stops(axes: Axes, t: Float[np.ndarray, " rows"], q: Float[np.ndarray, " rows"], v: Float[np.ndarray, " rows"],
                joint: JointData) -> None:  # fmt: skip
    """The position limits that the joint comes near, and the stretches beyond them or its velocity limit."""
    reach = max(float(np.ptp(q)), 0.05 * (joint.upper - joint.lower) if np.isfinite(joint.upper - joint.lower) else 0.0)
    for stop in (joint.lower, joint.upper):
        if np.isfinite(stop) and min(abs(q.min() - stop), abs(q.max() - stop)) < 0.5 * reach:
            axes.axhline(stop, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
    outside, fast = (q < joint.lower) | (q > joint.upper), np.abs(v) > joint.velocity
    said = []
    for flags, color, what in ((outside, ERROR, "outside its range"), (fast, FAST, "above its velocity limit")):
        bars = [(t[begin], t[min(end, len(t) - 1)] - t[begin]) for begin, end in stretches(flags)]
        axes.broken_barh(bars, (0.0, 1.0), transform=axes.get_xaxis_transform(), color=color, alpha=0.18, linewidth=0)
        said += [f"{what} {percent(flags.mean(), 1)} of the time"] if flags.any() else []
    axes.annotate("; ".join(said), (1.0, 1.0), xycoords="axes fraction", ha="right", va="bottom", fontsize=7,
                  color=ERROR)  # fmt: skip


def _decades(error: Float[np.ndarray, "*any"]) -> tuple[float, float]:
    """The axis of |error|, at most nine decades."""
    finite = error[np.isfinite(error) & (error > 0.0)]
    top = 10.0 ** np.ceil(np.log10(finite.max())) if len(finite) else 1.0
    low = max(10.0 ** np.floor(np.log10(np.percentile(finite, 0.5))) if len(finite) else 0.1, 1e-9 * top)
    return min(low, 0.1 * top), top


def _draw_error(axes: Axes, t: Float[np.ndarray, " rows"], error: Float[np.ndarray, " rows"],
                decades: tuple[float, float]) -> None:  # fmt: skip
    """|error| on a logarithmic scale; exact zeros are not drawn."""
    axes.set_yscale("log")
    axes.set_ylim(*decades)
    axes.plot(*thin(t, np.where(error > 0.0, error, np.nan)), color=ERROR, linewidth=1.0)
    axes.yaxis.set_major_locator(LogLocator(numticks=5))
    axes.yaxis.set_minor_locator(NullLocator())


def _draw_torque(axes: Axes, run: Run, joint: int, cut: Bool[np.ndarray, " rows"],
                 outside: Float[np.ndarray, " rows"] | None) -> None:  # fmt: skip
    """Torque of a joint, disturbance and what was observed, on an axis that fits all; shaded where it is saturated.

    A limit is drawn where it is on that axis.
    """
    t, tau, limit = run.t, run.tau[:, joint], float(run.effort_limit[joint])
    least = _NARROWEST * float(t[-1] - t[0])
    bars = [(t[begin], max(t[min(end, len(t) - 1)] - t[begin], least)) for begin, end in stretches(cut)]
    axes.broken_barh(bars, (0.0, 1.0), transform=axes.get_xaxis_transform(), color=SATURATED, alpha=0.6, linewidth=0)
    if run.disturbance.any():
        axes.plot(*thin(t[:-1], run.disturbance[:-1, joint]), color=VIOLET, linewidth=0.9)
    axes.plot(*thin(t, tau), color=TORQUE, linewidth=1.0)
    if outside is not None:
        axes.plot(*thin(t, outside), **_OBSERVED)
    axes.autoscale_view()
    low, high = axes.get_ylim()
    for side in (-limit, limit) if np.isfinite(limit) else ():
        axes.axhline(side, color=LIMIT, linewidth=0.9, linestyle=(0, (5, 3)))
    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(MaxNLocator(4))
    peak = np.nanmax(np.abs(tau), initial=0.0)
    note = f"limit ±{limit:g} (peak {percent(peak / limit)})" if np.isfinite(limit) else "no limit"
    axes.annotate(note, (1.0, 1.0), xycoords="axes fraction", ha="right", va="bottom", fontsize=7, color=NOTE)


def _dress(figure: Figure, grid: np.ndarray, run: Run, cut: float, observed: bool) -> None:
    """Titles, the legend and the time axis."""
    kinds = {(of.position, of.position, of.torque) for of in run.units}
    beside = [f" [{unit}]" for unit in kinds.pop()] if len(kinds) == 1 else ["", "", ""]  # else each row has its own
    for axes, title in zip(
        grid[0], map("".join, zip(("position", "|error|", "torque"), beside, strict=True)), strict=True
    ):
        axes.set_title(title, loc="left", fontsize=9.5, color=INK, pad=9)
    for axes in grid.flat:  # a shared axis would be slower
        axes.set_xlim(*time_span(run))
        axes.tick_params(axis="x", labelbottom=axes in grid[-1])
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    handles = [
        figure.axes[0].plot([], [], color=ACTUAL, label="actual")[0],
        figure.axes[0].plot([], [], **_WIDE, label="reference")[0],
        figure.axes[2].axvspan(
            np.nan, np.nan, color=SATURATED, alpha=0.6, label=f"saturated ({percent(cut, 2)} of the time)"
        ),
    ]
    if run.disturbance.any():
        handles.append(figure.axes[2].plot([], [], color=VIOLET, label="disturbance")[0])
    if observed:
        handles.append(figure.axes[2].plot([], [], **_OBSERVED, label="from outside, by the momentum")[0])
    if changes_of(run):
        handles.append(figure.axes[0].plot([], [], label="the plant changes", **_CHANGE)[0])
    shown = handles if cut else [*handles[:2], *handles[3:]]
    figure.legend(handles=shown, loc="outside lower right", ncols=6, frameon=False)  # above, a long title may reach it


def time_span(run: Run) -> tuple[float, float]:
    """The time axis of a run [s]; one second for a run of one instant."""
    return float(run.t[0]), float(run.t[-1] if run.t[-1] > run.t[0] else run.t[0] + 1.0)


def draw_changes(each: Iterable[Axes], run: Run) -> None:
    """Dotted lines at the times at which another plant took over."""
    for axes in each:
        for t in changes_of(run):
            axes.axvline(t, **_CHANGE)


def one_start(run: Run, start: int) -> Run:
    """The run with one start alone; raises ArgumentError if it has no such start."""
    arrays = {name: x.reshape(len(run.t), -1, x.shape[-1]) for name, x in run.signals.items()}
    starts = arrays["q"].shape[1]
    if not 0 <= start < starts:
        raise ArgumentError(f"{option('start', start)} does not exist: the run has starts 0 to {starts - 1}.")
    only: dict[str, Any] = {name: np.array(values[:, start]) for name, values in arrays.items()}
    return replace(run, **only)


def thin(t: Float[np.ndarray, " rows"], y: Float[np.ndarray, " rows"]) -> tuple[np.ndarray, np.ndarray]:
    """The curve with at most MAX_POINTS points, the extremes of every stretch, so that no peak is lost."""
    if len(t) <= MAX_POINTS:
        return t, y
    width = -(-2 * len(t) // MAX_POINTS)
    rows = np.arange(len(t))
    padded = np.pad(rows, (0, -len(t) % width), mode="edge").reshape(-1, width)
    values = y[padded]
    least = np.where(np.isfinite(values), values, np.inf).argmin(axis=1)
    most = np.where(np.isfinite(values), values, -np.inf).argmax(axis=1)
    every = np.arange(len(padded))
    picked = np.unique(np.concatenate([padded[every, least], padded[every, most], rows[[0, -1]]]))
    return t[picked], y[picked]


def stretches(flags: Bool[np.ndarray, " rows"]) -> list[tuple[int, int]]:
    """Half-open ranges of rows where the flag holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]


def short_name(name: str) -> str:
    """The name of a joint or link, without its middle if it is long, with dollar signs escaped for matplotlib."""
    half = (_LONGEST - 1) // 2
    return (name if len(name) <= _LONGEST else f"{name[:half]}…{name[-half:]}").replace("$", r"\$")
