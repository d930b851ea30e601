"""Runs read back from what `export_run` wrote."""

from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.archives import parse_json
from nbs_pin.base.arguments import PERIOD, checked, maybe, number, readable
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.exports import kind_of
from nbs_pin.base.records import RUN_FORMAT, Run, check_numbers
from nbs_pin.base.units import SLIDING
from nbs_pin.identification.log_bags import MEASURED
from nbs_pin.reports.run_bags import FACTS, instants, read_bag
from nbs_pin.reports.run_tables import read_table
from nbs_pin.robots.robot import ARM, Robot

_STATED = ("effort_limit", "continuous", "prismatic", "robot", "robot_sha256", "robot_options", "info")
"""What a run has besides its rows and its period."""
_ESTIMATES = "/estimates"
_NEEDED, _FURTHER = (MEASURED, "/reference", FACTS), ("/command", "/disturbance", _ESTIMATES)
"""Topics that a run is made of; others can be computed from them."""


@checked(path=readable, robot=maybe(ARM))
def import_run(path: str | Path, robot: Robot | None = None) -> Run:
    """The run in a file that `export_run` wrote with states and reference.

    What it has is as it was, bit for bit. A .mcap file has no `a_ref`, which is differentiated. A .csv file names no
    arm, no limits and no `info`, nor the joints that turn without limit: without `robot` their whole turns are errors.

    Args:
        path: The .mcap or .csv file.
        robot: The arm, for a .csv file; that of a .mcap file is checked to have the same joints.

    Raises:
        FileFormatError: If it is damaged or no such file.
        MissingExtra: If the extra `logs` is not installed, which .mcap needs.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
        >>> run = nbs.simulate(nbs.MujocoPlant(robot), law, reference, 0.1, 0.001)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     again = nbs.import_run(nbs.export_run(run, f"{folder}/run.csv"), robot)
        >>> bool((again.q == run.q).all())
        True
    """
    path, kind = Path(path), kind_of("import_run", path)
    try:
        run = _of_table(path, robot) if kind == "csv" else _of_bag(path)
        check_numbers("Run", run)
    except ArgumentError as error:
        raise FileFormatError(f"{path}: {error}") from error
    if robot is not None and robot.joint_names != run.joint_names:
        raise FileFormatError(
            f"{path}: joints {', '.join(run.joint_names)}, and {robot.name} has {', '.join(robot.joint_names)}; give"
            " the robot that ran."
        )
    return run


def _of_bag(path: Path) -> Run:
    """The run in a .mcap file."""
    topics, texts = read_bag(path, (*_NEEDED, *_FURTHER))
    absent = [topic for topic in _NEEDED if topic not in topics and topic not in texts]
    if absent:
        raise FileFormatError(f"{path}: no {absent[0]} of a run; export it with states and reference.")
    stated = parse_json(path, FACTS, texts[FACTS])
    lacking = [name for name in ("format", "begins", "period", *_STATED) if name not in stated]
    if lacking or stated["format"] != RUN_FORMAT:
        raise FileFormatError(f"{path}: {FACTS} is not that of a '{RUN_FORMAT}'; export the run again.")
    stamps, states = topics[MEASURED]
    parts: dict[str, Any] = {}
    for topic, (own, of) in topics.items():
        if not np.array_equal(own, stamps) or (topic != _ESTIMATES and of.names != states.names):
            raise FileFormatError(f"{path}: {topic} has other rows or joints than {MEASURED}; export the run again.")
        parts |= {f"{topic}/{part}": values for part, values in of.parts.items()}
    lacking = [name for name in ("position", "velocity", "effort") if name not in states.parts]
    lacking += [f"/reference/{name}" for name in ("position", "velocity") if f"/reference/{name}" not in parts]
    if lacking:
        raise FileFormatError(f"{path}: no {lacking[0]} of a run; export it again.")
    period = PERIOD("period", stated["period"])
    t = stated.get("t", instants(stamps, period, number()("begins", stated["begins"])))
    tau, v_ref = states.parts["effort"], parts["/reference/velocity"]
    return Run(
        t=t,
        q=states.parts["position"],
        v=states.parts["velocity"],
        tau=tau,
        tau_command=parts.get("/command/effort", tau),
        disturbance=parts.get("/disturbance/effort", np.zeros_like(tau)),
        q_ref=parts["/reference/position"],
        v_ref=v_ref,
        a_ref=np.gradient(v_ref, stamps / 1e9, axis=0) if len(stamps) > 1 else np.zeros_like(v_ref),
        joint_names=tuple(states.names),
        period=period,
        estimates=parts.get(f"{_ESTIMATES}/position"),
        **{name: _inf(stated[name]) if name == "effort_limit" else stated[name] for name in _STATED},
    )


def _inf(limits: Any) -> Any:
    """Limits, where None is for none."""
    return [np.inf if limit is None else limit for limit in limits] if isinstance(limits, list) else limits


def _of_table(path: Path, robot: Robot | None) -> Run:
    """The run in a .csv file."""
    t, columns = read_table(path)
    joints = tuple(columns["q"])
    arrays = {}
    for kind in ("q", "v", "tau", "qref", "vref", "aref", "command", "disturbance"):
        of = columns.get(kind, {} if kind not in ("command", "disturbance") else columns["tau"])
        lacking = [joint for joint in joints if joint not in of]
        if lacking:
            raise FileFormatError(f"{path}: no column {kind}_{lacking[0]}; export the run with states and reference.")
        arrays[kind] = np.column_stack([of[joint][1] for joint in joints])
    if len(t) < 2:
        raise FileFormatError(f"{path}: one row, which has no period; export a longer run.")
    learned = {f"{name} [{unit}]" if unit else name: x for name, (unit, x) in columns.get("estimate", {}).items()}
    arm: dict[str, Any] = {} if robot is None else {
        "robot": robot.source, "robot_sha256": robot.sha256, "robot_options": robot.options
    }  # fmt: skip
    return Run(
        t=t,
        q=arrays["q"],
        v=arrays["v"],
        tau=arrays["tau"],
        tau_command=arrays["command"],
        disturbance=arrays["disturbance"] if "disturbance" in columns else np.zeros_like(arrays["tau"]),
        q_ref=arrays["qref"],
        v_ref=arrays["vref"],
        a_ref=arrays["aref"],
        effort_limit=np.full(len(joints), np.inf) if robot is None else robot.effort_limit,
        continuous=np.zeros(len(joints), dtype=bool) if robot is None else robot.continuous,
        prismatic=np.array([unit == SLIDING.position for unit, _ in columns["q"].values()]),
        joint_names=joints,
        period=float(f"{np.median(np.diff(t)):.9g}"),
        estimates=np.column_stack(list(learned.values())) if learned else None,
        info={"estimates": list(learned)} if learned else {},
        **arm,
    )
