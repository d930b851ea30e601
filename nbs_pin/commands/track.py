"""`nbs-pin track`: simulate an arm that follows a motion; write run, summary, figure and replay."""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.text import Text

from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.npz import LARGEST
from nbs_pin.base.progress import waiting
from nbs_pin.base.records import Reference, Run
from nbs_pin.base.units import by_quantity, column, several
from nbs_pin.cli.track import Track
from nbs_pin.cli.values import OptionError, parse_disturbance, plain_numbers
from nbs_pin.commands.inputs import arm_of, law_of
from nbs_pin.commands.results import SUMMARY, Results, drawing, keywords, table
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.gains import sample_configurations
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.motions.by_name import motion_of
from nbs_pin.motions.disturbances import Disturbance
from nbs_pin.motions.references import DesiredMotion, Sinusoid, check_reference
from nbs_pin.reports.plotting import plot_tracking
from nbs_pin.reports.replay import replay
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation import metrics
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.loop import LONGEST_PLANT_STEP
from nbs_pin.simulation.plant import Plant
from nbs_pin.simulation.registry import build_plant
from nbs_pin.simulation.simulate import simulate
from nbs_pin.simulation.tool_errors import tool_errors, tool_of

FILES = ("run.npz", "tracking.png", "replay.html", SUMMARY)
"""Files of `write_results`."""
_NOTICEABLE = 1.0  # compilation times above this are printed [s]
_ROWS_OF_ARRAYS = 8  # arrays of a Run with one number per row and joint


def run(options: Track, console: Console, notes: Console) -> None:
    """Track, write and print; raises NbsPinError or OSError."""
    if options.start is not None and options.start_error:
        raise OptionError("--start and --start-error were both given; choose one.")
    with notes.status(f"loading {options.robot}"):
        robot = arm_of(options)
    settings = {**options.units(), **options.tool.given(), "duration": options.duration}
    with notes.status(f"planning {options.reference}"):
        motion, length = motion_of(
            options.reference, robot, frequency=options.frequency, period=options.period, **settings
        )
    duration = options.duration or length
    results = Results.of(options, robot.name, robot, robot=robot.source, duration=duration)
    results = results.check(FILES, options.force)
    given = keywords(options, track) | {
        "reference": motion,
        "duration": duration,
        "start": _start(options, robot.nv),
        "disturbance": parse_disturbance(options.disturbance).build(robot.nv, options.period, options.seed),
    }
    with results.made() as folder:
        recorded, compile_time, wall_time = track(robot, **given, progress=True)
        recorded.info.update(reference=options.reference, **results.facts)
        found = figures(recorded, robot) | {"joint_stops": options.joint_stops}
        found["not_simulated"] = not_simulated(robot, options.joint_friction)
        with notes.status(f"writing run, picture and replay into {folder}"):
            times = {"compile_time_s": compile_time, "wall_time_s": wall_time}
            write_results(recorded, results, robot, found, seed=options.seed, **times)
    _print(console, f"{robot.name}, {options.controller} in {options.plant}", found, compile_time, wall_time)
    results.show(console, FILES)


class Tracked(NamedTuple):
    """A run and the time it took."""

    run: Run
    compile_time: float
    """Time to compile the law, or to load its machine code from disk [s]."""
    wall_time: float
    """Time to simulate [s]."""


def track(
    robot: Robot,
    *,
    plant: Plant | str = "mujoco",
    controller: Controller | str = "nbs",
    reference: DesiredMotion | None = None,
    duration: float = 10.0,
    period: float = 0.001,
    bandwidth: float = 8.0,
    start_error: float = 0.0,
    start: Sequence[float] | None = None,
    disturbance: Disturbance | None = None,
    joint_friction: str = "drop",
    joint_stops: str = "drop",
    integrator: str | None = None,
    plant_step: float | None = None,
    lookahead: float | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Tracked:
    """Simulate an arm that follows a feasible motion; `Robot.with_effort_limit` sets other effort limits.

    plant, controller: by name (`build_plant`, `law_of`) or built. reference: None takes
    `Sinusoid.for_robot(robot)`. start_error: initial error of every joint, with alternating sign, at rest [rad]; 0
    starts on the reference. start: configuration to start from at rest [rad], in place of `start_error`.
    joint_friction: "keep" simulates the URDF's friction, fed forward by laws that model it. joint_stops:
    "keep" stops joints at their position limits. integrator: of a plant by
    name, None its usual one. plant_step, lookahead [s]: as in `simulate`. seed: of the network weights.

    Raises:
        ArgumentError: If the motion violates the arm's position, velocity or effort limits, or settings do not fit.
        SimulationDiverged: If the simulation diverges.
    """
    friction = JointFriction.of(robot) if joint_friction == "keep" else None
    reference = Sinusoid.for_robot(robot) if reference is None else reference
    _check_size(robot.nv, duration, period)
    check_reference(reference, robot, duration, joint_friction=joint_friction)
    if not isinstance(controller, Controller):
        controller = law_of(controller, robot, bandwidth=bandwidth, period=period, friction=friction, seed=seed)
    if not isinstance(plant, Plant):
        plant = build_plant(plant, robot, integrator=integrator, joint_friction=joint_friction, joint_stops=joint_stops)
    if start is None and start_error:
        start = Reference(*reference(0.0)).q + start_error * (-1.0) ** np.arange(robot.nv)
    begun = time.perf_counter()
    with waiting("compiling the law", progress):
        controller.compile()  # so that what `simulate` takes is simulation alone
    before = time.perf_counter()
    run = simulate(
        plant,
        controller,
        reference,
        duration,
        period,
        q0=start,
        plant_step=_plant_step(plant, robot, period) if plant_step is None else plant_step,
        effort_limit=robot.effort_limit,
        lookahead=lookahead,
        disturbance=disturbance,
        progress=progress,
    )
    return Tracked(run, before - begun, time.perf_counter() - before)


def figures(run: Run, robot: Robot | None = None) -> dict[str, Any]:
    """`metrics.summary` of the run and the RMS error over its last 30 %, as JSON can store them.

    With a robot, also how far each joint left its position range, as the plants have no joint stops, and how far the
    tool was from its path, if it followed one. `units` says in what the numbers of each joint are: those of one that
    slides are in m and N, whatever the key says.
    """
    values = metrics.summary(run)
    values["units"] = by_quantity(run.slides)
    values["rms_error_last_30_percent_rad"] = metrics.rms_error(run, 0.7 * float(run.t[-1])).tolist()
    if robot is not None:
        beyond = np.maximum(robot.lower - run.q, run.q - robot.upper).reshape(-1, run.nv)
        values["outside_position_range_rad"] = np.maximum(beyond.max(axis=0), 0.0).tolist()
        tool = tool_of(run)
        if tool is not None:
            values["tool"] = tool | tool_errors(run, robot).figures()
    return values


def not_simulated(robot: Robot, joint_friction: str) -> list[str]:
    """What the description states and the run leaves out, each with the option that takes it in."""
    left_out = []
    if joint_friction == "drop" and (robot.damping.any() or robot.friction.any()):
        most = {"viscous": robot.damping, "Coulomb": robot.friction}
        kinds = " and ".join(f"{kind} up to {x.max():.3g}" for kind, x in most.items() if x.any())
        left_out.append(f"joint friction, {kinds}: {option('joint_friction', 'keep')}")
    names = robot.urdf.without_rotor
    if names:
        text = f"rotor inertia of {', '.join(names)}, which have a gear but state no rotor"
        left_out.append(f"{text}: {option('rotor_inertia', {names[0]: BLANK})}")
    return left_out


def write_results(run: Run, results: Results, robot: Robot, figures: dict[str, Any], **more: Any) -> None:
    """Write `FILES`, the run and summary.json first; a picture that cannot be drawn is told in a warning.

    `more` are further entries of summary.json. Raises OSError if something cannot be written.
    """
    folder = results.folder
    with results.replaced(FILES, figures, **more) as draft:
        run.save(draft / FILES[0])
    with drawing(folder / FILES[1]) as path:
        plot_tracking(run, path, robot=robot)
    with drawing(folder / FILES[2]) as path:
        replay(run, path, robot)


def _check_size(nv: int, duration: float, period: float) -> None:
    size = _ROWS_OF_ARRAYS * 8.0 * nv * duration / period
    if size > LARGEST:
        raise ArgumentError(
            f"{duration:g} s at a period of {period:g} s would record {size / 1e9:.3g} GB, at most "
            f"{LARGEST / 1e9:.3g} GB are kept; give a shorter duration or a longer period."
        )


def _plant_step(plant: Plant, robot: Robot, period: float) -> float | None:
    """A step short enough for RK4 to follow the plant's joint friction [s], or None for the usual one."""
    if not isinstance(plant, DynamicsPlant) or plant.friction is None:
        return None
    # Friction is a damper of this slope near rest; RK4 is stable up to 2.78 of its fastest time constant.
    slope = plant.friction.viscous + plant.friction.coulomb / plant.friction.transition
    mass = plant.dynamics.mass_matrix(sample_configurations(robot, 200))
    fastest = float(np.linalg.eigvals(np.linalg.solve(mass, np.diag(slope))).real.max())
    return period / int(np.ceil(period / min(LONGEST_PLANT_STEP, 2.0 / max(fastest, 1.0)) - 1e-9))


def _start(options: Track, nv: int) -> list[float] | None:
    """The configuration to start from [rad], or None; raises OptionError if the number of joints differs."""
    start = None if options.start is None else plain_numbers(options.start)
    if start is not None and len(start) != nv:
        raise OptionError(f"--start '{options.start}' has {len(start)} numbers for {nv} joints; give one per joint.")
    return start


def _print(console: Console, title: str, figures: dict[str, Any], compile_time: float, wall_time: float) -> None:
    """Print a row per joint, then figures of the whole arm; `figures` from the function of that name."""
    lengths, forces = figures["units"]["position"], figures["units"]["torque"]
    errors = {
        "RMS error": "rms_error_rad",
        f"after {figures['late_after_s']:g} s": "rms_error_late_rad",
        "last 30 %": "rms_error_last_30_percent_rad",
    }
    columns = [column(name, [f"{e:.2e}" for e in figures[key]], lengths) for name, key in errors.items()]
    columns += [
        column("peak", [f"{peak:.4g}" for peak in figures["joint_peak_torque_Nm"]], forces),
        column("limit", ["none" if x is None else f"{x:.4g}" for x in figures["effort_limit_Nm"]], forces),
    ]
    shown = table(title, *(heading for heading, _ in columns))
    for joint, *cells in zip(figures["joints"], *(cells for _, cells in columns), strict=True):
        shown.add_row(Text(joint), *cells)
    console.print(shown)
    for line in _lines(figures, compile_time, wall_time):
        console.print(line, highlight=False, markup=False)


def _converged(figures: dict[str, Any]) -> str:
    """The time after which the error stays below the paper's threshold, in words."""
    time = figures["convergence_time_s"]
    return "not within the run" if time is None else f"{time:.3f} s"


def _tool_lines(figures: dict[str, Any]) -> list[str]:
    """The errors of the tool along its path, if it followed one."""
    if "tool" not in figures:
        return []
    tool = figures["tool"]
    line = (
        f"'{tool['frame']}' along the {tool['path']}: RMS error {1e3 * tool['rms_position_error_m']:.2g} mm, peak "
        f"{1e3 * tool['peak_position_error_m']:.2g} mm"
    )
    if tool["orientation"] == "hold":
        line += (
            f"; orientation {tool['rms_orientation_error_rad']:.2g} rad, peak "
            f"{tool['peak_orientation_error_rad']:.2g} rad"
        )
    return [line]


def _lines(figures: dict[str, Any], compile_time: float, wall_time: float) -> list[str]:
    saturated, late = figures["saturated_fraction"], figures["saturated_fraction_late"]
    units = figures["units"]["position"]
    remedy = f": {option('joint_stops', 'keep')} stops it" if figures["joint_stops"] == "drop" else ""
    outside = zip(figures["joints"], figures["outside_position_range_rad"], units, strict=True)
    return [
        *_tool_lines(figures),
        f"converged (‖error‖ < 0.1 {several(units)} to the end): {_converged(figures)}",
        f"some joint at its effort limit: {saturated:.2%} of the time, {late:.2%} after {figures['late_after_s']:g} s",
        *(f"{joint} left its range by {excess:.3g} {unit}{remedy}"
          for joint, excess, unit in outside if excess > 0.0),
        *([f"not simulated: {'; '.join(figures['not_simulated'])}"] if figures["not_simulated"] else []),
        *([f"compiled the law in {compile_time:.1f} s, once on this machine"] if compile_time > _NOTICEABLE else []),
        f"simulated {figures['duration_s']:g} s in {wall_time:.1f} s",
    ]  # fmt: skip
