"""Runs for the tools that others have: MCAP for Foxglove, PlotJuggler, Rerun and ROS 2, CSV for everything else."""

import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from nbs_pin.base.arguments import a, checked, choice, count, either, many, maybe, readable, writable
from nbs_pin.base.csv_files import read_csv
from nbs_pin.base.doors import argument, option
from nbs_pin.base.exceptions import ArgumentError, NbsPinError
from nbs_pin.base.exports import SIGNALS, kind_of
from nbs_pin.base.records import RUN, RUN_FORMAT, Run, as_json, check_numbers
from nbs_pin.certificates.monitor import COLUMNS, Monitored
from nbs_pin.identification.log_bags import MEASURED
from nbs_pin.reports.external import external_torque
from nbs_pin.reports.plotting import one_start
from nbs_pin.reports.run_bags import DESCRIPTION, FACTS, PARTS, Topic, instants, write_bag
from nbs_pin.reports.run_tables import write_table
from nbs_pin.robots.named import robot_of
from nbs_pin.robots.robot import ARM, Robot, configuration_difference

_TOPICS = {"states": MEASURED, "external": "/external_torque"}
"""Topics that are not called like their signals."""
_LATEST = 2**31
"""Times of ROS 2 end here [s]."""


class _Signal(NamedTuple):
    """What is exported of a run under one name."""

    names: tuple[str, ...]
    numbers: Mapping[str, tuple[str, Float[np.ndarray, "rows n"]]]
    """By the quantity, one of `PARTS` or acceleration: what columns of CSV are called, and the numbers."""
    units: Mapping[str, Sequence[str]]
    """By the quantity, one for each name."""

    @property
    def parts(self) -> list[str]:
        """The quantities that a message has."""
        return [part for part in self.numbers if part in PARTS]


@checked(
    run=RUN,
    path=writable,
    robot=maybe(ARM),
    start=count(0),
    signals=maybe(many(choice(*SIGNALS), 1, len(SIGNALS), "signals")),
    monitored=maybe(either(a(Monitored, "what monitor returned"), readable)),
)
def export_run(
    run: Run,
    path: str | Path,
    robot: Robot | None = None,
    *,
    start: int = 0,
    signals: Sequence[str] | None = None,
    monitored: Monitored | str | Path | None = None,
) -> Path:
    """Write a run for other tools, as the end of the path says; returns the path (docs/howto/tools.md).

    .mcap, with the extra `logs`, is for Foxglove, PlotJuggler, Rerun and `ros2 bag`: a message of type JointState for
    each row and signal, with the names of the joints, and the arm as /robot_description. .csv has a column for each
    number, q_JOINT [rad]. Numbers are those of the run, bit for bit; `import_run` and `load_log` read both.

    Args:
        run: The run.
        path: The file, replaced atomically; missing folders are created.
        robot: The arm. None loads the one that the run names, if it is still there.
        start: Which start of a batched run to write.
        signals: "states" (q, v, tau), "reference", "command" (torque before the limits), "error", "disturbance",
            "estimates" of a law that adapts, "external" (what a momentum observer makes of the run). None takes what
            cannot be computed from the rest: states and reference, and the command where a limit cut it, a disturbance
            and estimates if there are any.
        monitored: What `monitor` returned for this start, or the file that its `save` wrote: V and its bound are
            written too.

    Raises:
        ArgumentError: If the path ends otherwise, there is no such start or signal, numbers are not finite, or robot or
            `monitored` do not fit the run.
        MissingExtra: If the extra `logs` is not installed.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
        >>> run = nbs.simulate(nbs.MujocoPlant(robot), law, reference, 0.1, 0.001)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = nbs.export_run(run, f"{folder}/run.csv", signals=["states", "error"])
        ...     print(file.read_text().partition(",q_joint2")[0])
        t [s],q_joint1 [rad]
    """
    path, kind = Path(path), kind_of("export_run", path)
    check_numbers("export_run", run)
    if robot is not None and robot.joint_names != run.joint_names:
        raise ArgumentError(
            f"the run moves joints {', '.join(run.joint_names)} but {robot.name} has {', '.join(robot.joint_names)}: "
            "give the robot that ran."
        )
    one = one_start(run, start)
    found = {name: _signal(name, one, robot) for name in signals or _usual(one)}
    if monitored is not None:
        found["certificate"] = _certificate(one, monitored)
    if kind == "csv":
        write_table(path, one.t, dict(_columns(found)))
        return path
    topics = {
        _TOPICS.get(name, f"/{name}"): Topic(of.names, {part: of.numbers[part][1] for part in of.parts})
        for name, of in found.items()
    }
    stamps = _stamps(one)
    write_bag(path, stamps, topics, {FACTS: _facts(one, stamps), **_description(one, robot, path)})
    return path


def _usual(run: Run) -> Iterator[str]:
    """The signals that cannot be computed from others."""
    yield from ("states", "reference")
    if not np.array_equal(run.tau_command, run.tau):
        yield "command"
    if run.disturbance.any():
        yield "disturbance"
    if run.estimates is not None:
        yield "estimates"


def _signal(name: str, run: Run, robot: Robot | None) -> _Signal:
    """A signal of a run with one start."""
    numbers: dict[str, tuple[str, Any]]
    match name:
        case "states":
            numbers = {"position": ("q", run.q), "velocity": ("v", run.v), "effort": ("tau", run.tau)}
        case "reference":
            numbers = {
                "position": ("qref", run.q_ref), "velocity": ("vref", run.v_ref), "acceleration": ("aref", run.a_ref)
            }  # fmt: skip
        case "error":
            error = configuration_difference(run.q, run.q_ref, run.continuous)
            numbers = {"position": ("qerror", error), "velocity": ("verror", run.v - run.v_ref)}
        case "command":
            numbers = {"effort": ("command", run.tau_command)}
        case "external":
            torque = external_torque(run, robot_of(run) if robot is None else robot)
            numbers = {"effort": ("external", torque)}
        case "disturbance":
            numbers = {"effort": ("disturbance", run.disturbance)}
        case _:
            return _estimates(run)
    units = {part: [getattr(of, "torque" if part == "effort" else part) for of in run.units] for part in numbers}
    return _Signal(run.joint_names, numbers, units)


def _estimates(run: Run) -> _Signal:
    """What the law learned, by the names in `info`, which have the units."""
    if run.estimates is None:
        raise ArgumentError(
            "the run has no estimates, as its law does not adapt; leave them out, as in "
            f"{option('signals', list(SIGNALS[:2]))}."
        )
    width = run.estimates.shape[-1]
    stated = run.info.get("estimates")
    names = stated if isinstance(stated, list) and len(stated) == width else range(1, width + 1)
    return _Signal(tuple(map(str, names)), {"position": ("estimate", run.estimates)}, {"position": [""] * width})


def _certificate(run: Run, monitored: Monitored | str | Path) -> _Signal:
    """V and its bound along the run."""
    if isinstance(monitored, Monitored):
        t, values = monitored.t, np.column_stack([monitored.storage, monitored.promise])
        errors = monitored.joint_errors
    else:
        joints = [f"error_{name}" for name in run.joint_names]
        header, table = read_csv(Path(monitored), (*COLUMNS, *joints))
        errors = table[:, [header.index(name) for name in joints]]
        t, *of = (table[:, header.index(name)] for name in COLUMNS)
        values = np.column_stack(of)
    own = np.abs(configuration_difference(run.q, run.q_ref, run.continuous))
    if not np.array_equal(t, run.t) or not np.allclose(errors, own, rtol=1e-6, atol=1e-12, equal_nan=True):
        raise ArgumentError(
            f"{argument('export_run', 'monitored', monitored)} is of another run; give what was made of this one."
        )
    return _Signal(("V", "bound"), {"position": ("certificate", values)}, {"position": ["J", "J"]})


def _columns(signals: Mapping[str, _Signal]) -> Iterator[tuple[str, np.ndarray]]:
    for of in signals.values():
        for part, (kind, values) in of.numbers.items():
            for name, unit, column in zip(of.names, of.units[part], values.T, strict=True):
                yield f"{kind}_{name} [{unit}]" if unit else f"{kind}_{name}", column


def _stamps(run: Run) -> Int[np.ndarray, " rows"]:
    """The times in [ns], of runs that begin before 0 from their beginning; raises ArgumentError for others."""
    t = run.t - min(run.t[0], 0.0)
    stamps = np.round(1e9 * t).astype(np.int64) if t[-1] < _LATEST else np.zeros(1, dtype=np.int64)
    if t[-1] >= _LATEST or (np.diff(stamps) <= 0).any():
        raise ArgumentError(
            f"t goes to {t[-1]:.6g} s in steps of {np.diff(t).min(initial=np.inf):.3g} s, and messages have times up to"
            f" {_LATEST} s in whole nanoseconds; export to .csv."
        )
    return stamps


def _facts(run: Run, stamps: Int[np.ndarray, " rows"]) -> str:
    """What a run has besides its rows, as JSON; with its times, where stamps and period do not give them."""
    begins = min(float(run.t[0]), 0.0)
    exact = np.array_equal(instants(stamps, run.period, begins), run.t)
    return json.dumps(
        {
            "format": RUN_FORMAT,
            "begins": begins,
            "period": run.period,
            "effort_limit": [limit if math.isfinite(limit) else None for limit in run.effort_limit.tolist()],
            "continuous": run.continuous.tolist(),
            "prismatic": None if run.prismatic is None else run.prismatic.tolist(),
            "robot": run.robot,
            "robot_sha256": run.robot_sha256,
            "robot_options": json.loads(as_json("robot_options", run.robot_options)),
            "info": json.loads(as_json("info", run.info)),
            **({} if exact else {"t": run.t.tolist()}),
        }
    )


def _description(run: Run, robot: Robot | None, path: Path) -> dict[str, str]:
    """The URDF of the arm, if it is known."""
    if robot is None and run.robot:
        try:
            robot = robot_of(run)
        except NbsPinError as error:
            warnings.warn(f"{path} has no {DESCRIPTION}: {error}", stacklevel=4)
    return {} if robot is None else {DESCRIPTION: robot.urdf.xml.decode("ascii")}
