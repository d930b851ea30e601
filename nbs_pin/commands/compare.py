"""`nbs-pin compare`: errors of a model of an arm against Pinocchio's."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from nbs_pin.accuracy.compare import ModelErrors, compare
from nbs_pin.accuracy.error_maps import ErrorMap, error_map, telling_joints
from nbs_pin.accuracy.relative_errors import check_joints
from nbs_pin.base.checks import PerJoint
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.base.plain import plain
from nbs_pin.base.progress import waiting
from nbs_pin.base.records import Run
from nbs_pin.base.shown import joints_told
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.base.units import by_quantity, counted, percent, several, units_of, weighed
from nbs_pin.cli.compare import Compare
from nbs_pin.cli.values import SAVED, OptionError
from nbs_pin.commands.results import Results, drawing, keywords, table, tell
from nbs_pin.controllers.gains import gains_for_robot
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.datasets import load_dataset
from nbs_pin.motions.references import Sinusoid
from nbs_pin.reports.error_charts import plot_model_errors
from nbs_pin.reports.verdicts import verdict_of
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.simulate import simulate
from nbs_pin.storage.checkpoints import load, load_with

FILES = ("errors.png", "errors.csv", SUMMARY)
"""Files of `write_results`."""
TRAJECTORIES = 374
"""Starts with which the bound on δ holds for 95 % of further ones, at confidence 1 − 1e-6 (`accuracy/mismatch.py`)."""
_ENDINGS = ("", ".nbs", ".urdf", ".xacro", ".xml", ".toml")
_PRINTED = {"mass_matrix": "M", "coriolis": "C v", "gravity": "G", "inverse": "torque", "forward": "acceleration"}


def run(options: Compare, console: Console, notes: Console) -> None:
    """Compare, write and print; raises NbsPinError or OSError."""
    with notes.status(f"loading {options.model}"):
        if options.model.endswith(SAVED) and options.against is None:
            options.arm.refuse_without_arm(f"'{options.model}' names its arm; give it with --against")
        truth = None if options.against is None else load_robot(options.against, **options.arm.given())
        model = model_of(options.model, truth, **options.arm.given())
        robot = _arm(options, model) if truth is None else truth
        region = _region(options, robot)
        recorded = None if options.along is None else Run.load(options.along)
    results = Results.of(options, robot.name, robot, against=robot.source)
    results = results.check(FILES, options.force, whose="another comparison")
    given = keywords(options, compare_models) | region | {"joints": _pair(options, robot.nv), "run": recorded}
    title = f"{Path(options.model).name} against {robot.name}"
    with results.made() as folder:
        result = compare_models(model, robot, **given, progress=True)
        with notes.status(f"drawing the page into {folder}"):
            found = write_results(result, robot, results, title)
    _print(console, title, found, verbose=options.verbose)
    results.show(console, FILES)


class Comparison(NamedTuple):
    """Errors of a model, their map over two joints, and the reason if there is no closed loop."""

    errors: ModelErrors
    heat: ErrorMap | None
    """None for an arm with one joint."""
    missing: str
    """Why there is no closed loop, empty if there is one."""


def model_of(text: str, truth: Robot | None = None, **load_options: Any) -> DynamicsProvider:
    """The model in a .nbs file, the model of a controller in a .nbs file, or Pinocchio's model of an arm.

    truth: the true arm, which the model in a file gets if the file is for it.

    Raises:
        ArgumentError: If the controller has no model or the file has another extension; errors of loading otherwise.
    """
    if Path(text).suffix not in _ENDINGS:
        raise ArgumentError(
            f"'{text}' is neither a model nor an arm; give a .nbs file with a model, or an arm by name or as a .urdf, "
            ".xacro or MJCF file."
        )
    if not text.endswith(".nbs"):
        return PinocchioDynamics(load_robot(text, **load_options))
    stored: Any = load(text) if truth is None else load_with(text, truth)
    if isinstance(stored, DynamicsProvider):
        return stored
    if isinstance(stored, ModelLaw):
        return stored.dynamics
    raise ArgumentError(f"{text} contains a {type(stored).__name__}, which has no model of its arm; give one that has.")


def compare_models(
    model: DynamicsProvider,
    robot: Robot,
    *,
    samples: int = 2_000,
    speed: PerJoint = 2.0,
    seed: int = 1,
    box: Sequence[PerJoint] | None = None,
    joints: tuple[int, int] | None = None,
    run: Run | None = None,
    trajectories: int = TRAJECTORIES,
    frequency: float = 1.0,
    progress: bool = False,
) -> Comparison:
    """Compare a model with Pinocchio's of the arm, on a box of states and along a closed loop.

    `samples`, `speed`, `seed` and `box` are those of `compare`, `joints` those of the map, from 0 (None takes
    `telling_joints`). `run` is the closed loop on this arm; None simulates `closed_loop` from `trajectories` starts.

    Raises:
        ArgumentError: If arguments do not fit, or the run is of another arm or with joint friction.
    """
    truth = PinocchioDynamics(robot)
    check_joints(model, truth)
    missing = "no closed loop was run"
    if run is not None:
        if run.robot_sha256 != robot.sha256:
            raise ArgumentError(f"the run is of the arm '{run.robot}', not of {robot.name}; give one of that arm.")
        plant = str(run.info.get("plant", ""))
        if "joint_friction=" in plant and "joint_friction=drop" not in plant:
            raise ArgumentError(
                "joint friction acted in the run, so its torques do not determine v̇; record one without it."
            )
        missing = ""
    elif trajectories:
        try:
            run, missing = (
                closed_loop(model, robot, trajectories, frequency=frequency, seed=seed, progress=progress),
                "",
            )
        except SimulationDiverged as error:  # a model so wrong that its law is unstable is a result, too
            missing = f"the closed loop diverged\n{str(error)[:60]} …"
    with waiting("comparing", progress):
        errors = compare(model, truth, samples, speed, seed, box, run)
        if robot.nv < 2:
            return Comparison(errors, None, missing)
        pair = telling_joints(model, truth, errors.box) if joints is None else joints
        return Comparison(errors, error_map(model, truth, errors.box, pair), missing)


def closed_loop(
    model: DynamicsProvider,
    robot: Robot,
    starts: int = TRAJECTORIES,
    *,
    frequency: float = 1.0,
    bandwidth: float = 8.0,
    start_error: float = 0.3,
    duration: float = 2.0,
    period: float = 0.004,
    seed: int = 1,
    progress: bool = False,
) -> Run:
    """Simulate neural backstepping with the model, with the gains for the exact model, on the exact plant.

    The starts are at rest, drawn independently and uniformly within ±`start_error` [rad] of the start of
    `Sinusoid.for_robot` at `frequency` [rad/s]; the arm's effort limits act. bandwidth [rad/s], duration, period [s].

    Raises:
        SimulationDiverged: If a motion diverges.
    """
    truth = PinocchioDynamics(robot)
    gains = gains_for_robot(robot, truth, bandwidth=bandwidth, period=period)
    controller = NeuralBackstepping.for_robot(robot, dynamics=model, gains=gains)
    reference = Sinusoid.for_robot(robot, frequency)
    away = np.random.default_rng((seed, 2)).uniform(-start_error, start_error, (starts, robot.nv))
    return simulate(
        DynamicsPlant(truth),
        controller,
        reference,
        duration,
        period,
        q0=reference(0.0).q + away,
        plant_step=period,
        progress=progress,
    )


def figures(result: Comparison, robot: Robot) -> dict[str, Any]:
    """All results as JSON can store them, with units in the keys; None for numbers that are not finite."""
    e, m = result.errors, result.errors.mismatch
    numbers: dict[str, Any] = {
        "relative_error": e.errors._asdict(),
        "torque_nmse": e.torque_nmse,
        "joints": list(robot.joint_names),
        "units": by_quantity(robot.prismatic),
        "torque_rms_Nm": e.torque_rms,
        "torque_deviation_Nm": e.torque_deviation,
        "eigenvalue_margin_kgm2": e.eigenvalue_margin,
        "mass_ratio": e.mass_ratio,
        "energy_drift": e.energy_drift,
        "energy_drift_own": None if e.motion is None else float(np.max(e.motion.own)),
        "energy_drift_floor": None if e.motion is None else float(np.max(e.motion.floor)),
        "scale_factor": e.scale.factor,
        "scale_error": e.scale.error,
        "by_speed": [{"at": at, **x._asdict()} for at, x in zip(*e.by_speed, strict=True)],
        "by_distance": [{"at": at, **x._asdict()} for at, x in zip(*e.by_distance, strict=True)],
        "box": {"lower_rad": e.box.lower, "upper_rad": e.box.upper, "speed_rad_per_s": e.box.speed},
        "along_run": None if e.along_run is None else e.along_run._asdict(),
        "mismatch": None,
        "no_closed_loop_because": result.missing or None,
    }
    if m is not None:
        numbers["mismatch"] = {
            "a_Nm_per_rad": m.a,
            "b_Nms_per_rad": m.b,
            "c_Nm": m.c,
            "violation_chance": m.violation,
            "doubt": m.doubt,
            "trajectories": m.trajectories,
            "rms_Nm": m.rms,
            "largest_Nm": float(m.size.max()),
        }
    found: dict[str, Any] = plain(numbers)
    return found


def write_results(result: Comparison, robot: Robot, results: Results, title: str) -> dict[str, Any]:
    """Write `FILES` and return the figures; raises OSError if they cannot be written."""
    found = figures(result, robot)
    with results.replaced((FILES[1], FILES[0]), found) as draft:
        write_csv(draft / FILES[1], ("figure", "where", "value"), list(_rows(found, robot)))
    of = units_of(robot.prismatic)
    labels = [f"{name} [{unit.position}]" for name, unit in zip(robot.joint_names, of, strict=True)]
    why = result.missing or "no closed loop was run"
    with drawing(results.folder / FILES[0]) as path:
        given: dict[str, Any] = {
            "title": title,
            "joints": labels,
            "units": of,
            "missing": why,
            "verdict": verdict_of(found),
        }
        plot_model_errors(result.errors, result.heat, path, **given)
    return found


def _rows(found: dict[str, Any], robot: Robot) -> Iterator[tuple[str, str, Any]]:
    """Every figure as a row of the table: name, where it holds, value."""
    for name, value in found["relative_error"].items():
        yield f"{name}_error", "box", value
    for region, kind in (("by_speed", "speed ×"), ("by_distance", "distance ×")):
        for entry in found[region]:
            for name, value in entry.items():
                if name != "at":
                    yield f"{name}_error", f"{kind} {entry['at']:g}", value
    for name, value in (found["along_run"] or {}).items():
        yield f"{name}_error", "closed loop", value
    for name in ("torque_nmse", "eigenvalue_margin_kgm2", "energy_drift", "energy_drift_own", "energy_drift_floor",
                 "scale_factor", "scale_error"):  # fmt: skip
        yield name, "box", found[name]
    for name, value in zip(("mass_ratio_least", "mass_ratio_most"), found["mass_ratio"], strict=True):
        yield name, "box", value
    for name in ("torque_rms_Nm", "torque_deviation_Nm"):
        for joint, value in zip(robot.joint_names, found[name], strict=True):
            yield name, joint, value
    for name, value in (found["mismatch"] or {}).items():
        if name == "rms_Nm":
            for joint, torque in zip(robot.joint_names, value, strict=True):
                yield "mismatch_rms_Nm", joint, torque
        else:
            yield f"mismatch_{name}", "closed loop", value


def _arm(options: Compare, model: DynamicsProvider) -> Robot:
    """The arm that the file names as the true one; raises OptionError if it names none."""
    if model.robot is None or not options.model.endswith(SAVED):
        raise OptionError(f"'{options.model}' does not name its true arm; give --against ROBOT.")
    return model.robot


def _region(options: Compare, robot: Robot) -> dict[str, Any]:
    """The region to compare in: the box of the data, or the arm's."""
    if options.data is None:
        return {"speed": 2.0 if options.speed is None else options.speed}
    data = load_dataset(options.data)
    if data.nv != robot.nv:
        raise OptionError(
            f"--data '{options.data}' has {joints_told(data.nv)} and {robot.name} {robot.nv}; give data of it."
        )
    lower, upper, fastest = data.q.min(axis=0), data.q.max(axis=0), abs(data.v).max(axis=0)
    return {"box": (lower, upper), "speed": fastest if options.speed is None else options.speed}


def _pair(options: Compare, nv: int) -> tuple[int, int] | None:
    """The joints of the maps, counted from 0."""
    if options.joints is None:
        return None
    first, second = (int(part) for part in options.joints.split(","))
    if first == second or max(first, second) > nv:
        raise OptionError(f"--joints is '{options.joints}'; give two different ones of 1 to {nv}.")
    return first - 1, second - 1


def _print(console: Console, title: str, figures: dict[str, Any], *, verbose: bool) -> None:
    """Print the error of the torque, the errors over the box and along the run, and figures of the whole model."""
    along = figures["along_run"]
    shown = table(title, "box", *([] if along is None else ["closed loop"]), first="relative error of")
    for key, name in _PRINTED.items():
        values = (figures["relative_error"], *([] if along is None else [along]))
        shown.add_row(name, *(_number(of[key]) for of in values))
    low, high = figures["mass_ratio"]
    verdict = verdict_of(figures)
    lines = (
        *verdict.more,
        f"torque nMSE {_number(figures['torque_nmse'])}; least eigenvalue of the model's M "
        f"{_number(figures['eigenvalue_margin_kgm2'])} kg·m²; {weighed({'M': _number(low)})} ≤ model's M ≤ "
        f"{weighed({'M': _number(high)})}",
        f"torque × {figures['scale_factor']:.6g} fits best, with a relative error of {_number(figures['scale_error'])}",
        f"free motion: true energy drifts by {_number(figures['energy_drift'])} of the kinetic energy "
        f"(integrator alone {_number(figures['energy_drift_floor'])})",
        *_mismatch_lines(figures),
    )
    tell(console, f"{title}: {verdict.said}", lines, [shown], verbose=verbose)


def _mismatch_lines(figures: dict[str, Any]) -> list[str]:
    found = figures["mismatch"]
    if found is None:
        return [" ".join(figures["no_closed_loop_because"].split())]
    a, b, c = (_number(found[name]) for name in ("a_Nm_per_rad", "b_Nms_per_rad", "c_Nm"))
    bound = f"closed loop: ‖δ‖ ≤ {weighed({'‖q‖': a, '‖v‖': b}, c, several(figures['units']['torque']))}"
    if found["violation_chance"] >= 1.0:
        few = counted(found["trajectories"], "start is", "starts are")
        return [f"{bound} on this run; {few} too few to bound further ones"]
    return [
        f"{bound} on {counted(found['trajectories'], 'start')}; a further one exceeds it with a chance of at most "
        f"{percent(found['violation_chance'], 2)}, confidence 1 − {found['doubt']:g} (probabilistic, for starts drawn "
        "alike)"
    ]


def _number(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.3g}"
