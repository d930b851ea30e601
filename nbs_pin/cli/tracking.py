"""One arm, one law, one motion: the study behind `nbs-pin track`."""

import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, cast, get_args

import numpy as np

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.npz import LARGEST
from nbs_pin.base.records import Reference, Run
from nbs_pin.controllers.computed_torque import ComputedTorque
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.gains import sample_configurations
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping, paper_controller
from nbs_pin.controllers.pd import PD
from nbs_pin.controllers.pid import PID
from nbs_pin.controllers.slotine_li import SlotineLi
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.disturbances import Disturbance
from nbs_pin.motions.references import DesiredMotion, Sinusoid, check_reference
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.integrators import IntegratorName
from nbs_pin.simulation.loop import LONGEST_PLANT_STEP
from nbs_pin.simulation.plant import Plant
from nbs_pin.simulation import metrics
from nbs_pin.simulation.simulate import simulate
from nbs_pin.storage.checkpoints import load

PlantName: TypeAlias = Literal["mujoco", "pinocchio"]
"""What `build_plant` knows."""
ControllerName: TypeAlias = Literal["nbs", "nbs-paper", "slotine-li", "computed-torque", "pd-plus", "pd-gravity", "pid"]
"""What `build_controller` knows."""
Integrator: TypeAlias = Literal["rk4", "euler", "implicitfast", "semi_implicit_euler"]
"""What one plant or the other knows."""
FILES = ("run.npz", "tracking.png", "replay.html", "summary.json")
"""What `write_results` writes, the summary last."""
_ROWS_OF_ARRAYS = 8  # the arrays of a Run with a number per row and joint


class Tracked(NamedTuple):
    """A run and the time it took to simulate [s]."""

    run: Run
    wall_time: float


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
    joint_friction: Literal["drop", "keep"] = "drop",
    integrator: Integrator | None = None,
    plant_step: float | None = None,
    lookahead: float | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Tracked:
    """The arm following a motion it is able to follow; `Robot.with_effort_limit` gives its drives other limits.

    plant, controller: by name (`build_plant`, `build_controller`) or built. reference: None takes
    `Sinusoid.for_robot(robot)`. start_error: added to every joint with alternating sign, the arm then starting at rest;
    0 starts on the reference. start: the configuration [rad] to start from at rest, in place of `start_error`.
    joint_friction: "keep" lets the URDF's friction act, fed forward by laws that model it. integrator: of a plant by
    name, None its usual one. plant_step, lookahead [s]: as in `simulate`. seed: of the network weights.
    Raises ArgumentError for a motion outside the arm's position, velocity or effort limits, or settings that do not
    fit, and SimulationDiverged when the arm leaves the finite numbers.
    """
    friction = JointFriction.of(robot) if joint_friction == "keep" else None
    reference = Sinusoid.for_robot(robot) if reference is None else reference
    _check_size(robot.nv, duration, period)
    check_reference(reference, robot, duration)
    if not isinstance(controller, Controller):
        controller = build_controller(
            controller, robot, bandwidth=bandwidth, period=period, friction=friction, seed=seed
        )
    if not isinstance(plant, Plant):
        plant = build_plant(plant, robot, friction, integrator)
    if start is None and start_error:
        start = Reference(*reference(0.0)).q + start_error * (-1.0) ** np.arange(robot.nv)
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
    return Tracked(run, time.perf_counter() - before)


def build_controller(
    name: str,
    robot: Robot,
    *,
    bandwidth: float = 8.0,
    period: float = 0.001,
    friction: JointFriction | None = None,
    seed: int = 0,
) -> Controller:
    """The law of that name, tuned for the arm by its own `for_robot`; a name that ends in .nbs is a saved controller.

    bandwidth [rad/s], period [s]. friction: fed forward by every law with a model. seed: of the network weights.
    "nbs-paper" is the paper's own law (`paper_controller`) on the bundled two_link, and its networks with this arm's
    gains on every other. A saved controller is as it was saved, whatever the other arguments say.
    Raises ArgumentError for an unknown name, numbers out of range or a file for another arm; errors of `load` else.
    """
    if name.endswith(".nbs"):
        stored = load(name, robot)
        if not isinstance(stored, Controller):
            raise ArgumentError(f"{name} holds a {type(stored).__name__}, a model; give a file of a controller.")
        return stored
    if name not in get_args(ControllerName):
        raise ArgumentError(
            f"controller '{name}' is unknown; choose one of {', '.join(get_args(ControllerName))}, a .nbs "
            "file, or build one."
        )
    if name == "nbs-paper" and robot.source == "two_link":
        return paper_controller(PinocchioDynamics(robot), seed=seed)
    tuned: dict[str, Any] = {"bandwidth": bandwidth, "period": period}
    modelled = {**tuned, "friction": friction}
    make: dict[str, Callable[[], Controller]] = {
        "nbs": lambda: NeuralBackstepping.for_robot(robot, **modelled, seed=seed),
        "nbs-paper": lambda: NeuralBackstepping.for_robot(
            robot, **modelled, seed=seed, potential="paper", damping="paper"
        ),
        "slotine-li": lambda: SlotineLi.for_robot(robot, **modelled),
        "computed-torque": lambda: ComputedTorque.for_robot(robot, **modelled),
        "pd-plus": lambda: PD.for_robot(robot, **modelled, feedforward="reference"),
        "pd-gravity": lambda: PD.for_robot(robot, **modelled, feedforward="gravity"),
        "pid": lambda: PID.for_robot(robot, **tuned),
    }
    return make[name]()


def build_plant(
    name: str, robot: Robot, friction: JointFriction | None = None, integrator: Integrator | None = None
) -> Plant:
    """The arm in MuJoCo, or Pinocchio's dynamics integrated in time; with `friction` the joints have it.

    MuJoCo takes the friction of the URDF, whatever `friction` says beyond being there. integrator: None is Pinocchio's
    RK4 and the choice of `MujocoPlant`.
    Raises ArgumentError for an unknown name or integrator and RobotError for an arm that MuJoCo cannot build.
    """
    if name not in get_args(PlantName):
        raise ArgumentError(f"plant '{name}' is unknown; choose one of {', '.join(get_args(PlantName))}, or build one.")
    if name == "pinocchio":
        _check_integrator(integrator, get_args(IntegratorName))
        return DynamicsPlant(PinocchioDynamics(robot), cast(Any, integrator or "rk4"), friction)
    from nbs_pin.simulation.mujoco_plant import MujocoIntegrator, MujocoPlant

    _check_integrator(integrator, get_args(MujocoIntegrator))
    return MujocoPlant(robot, cast(Any, integrator), "drop" if friction is None else "keep")


def figures(run: Run, robot: Robot | None = None) -> dict[str, Any]:
    """`metrics.summary` of the run and the RMS error over its last 30 % [rad], as JSON can store them.

    robot: adds how far each joint went beyond its position range [rad]; no plant of ours has joint stops.
    """
    values = metrics.summary(run)
    values["rms_error_last_30_percent_rad"] = metrics.rms_error(run, 0.7 * float(run.t[-1])).tolist()
    if robot is not None:
        beyond = np.maximum(robot.lower - run.q, run.q - robot.upper).reshape(-1, run.nv)
        values["outside_position_range_rad"] = np.maximum(beyond.max(axis=0), 0.0).tolist()
    return values


def write_results(run: Run, folder: str | Path, robot: Robot, summary: dict[str, Any]) -> Path:
    """Writes `FILES` for the run into the folder, all drawn before the first takes its place; returns the folder.

    summary: what summary.json holds. Files of those names are replaced, and left alone when drawing or writing fails.
    Raises OSError when they cannot be written.
    """
    from nbs_pin.reports.plotting import plot_tracking
    from nbs_pin.reports.replay import replay

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as drafts:
        draft = Path(drafts)
        run.save(draft / "run.npz")
        plot_tracking(run, draft / "tracking.png")
        replay(run, draft / "replay.html", robot)
        (draft / "summary.json").write_text(json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
        for name in FILES:
            os.replace(draft / name, folder / name)
    return folder


def _check_integrator(integrator: str | None, known: tuple[str, ...]) -> None:
    if integrator is not None and integrator not in known:
        raise ArgumentError(f"integrator '{integrator}' is unknown to this plant; choose one of {', '.join(known)}.")


def _check_size(nv: int, duration: float, period: float) -> None:
    size = _ROWS_OF_ARRAYS * 8.0 * nv * duration / period
    if size > LARGEST:
        raise ArgumentError(
            f"{duration:g} s at a period of {period:g} s would record {size / 1e9:.3g} GB, at most "
            f"{LARGEST / 1e9:.3g} GB are kept; give a shorter duration or a longer period."
        )


def _plant_step(plant: Plant, robot: Robot, period: float) -> float | None:
    """A step [s] short enough for RK4 to follow the plant's joint friction, or None for the usual one."""
    if not isinstance(plant, DynamicsPlant) or plant.friction is None:
        return None
    # Friction is a damper of this slope near rest; RK4 is stable up to 2.78 of its fastest time constant.
    slope = plant.friction.viscous + plant.friction.coulomb / plant.friction.transition
    mass = plant.dynamics.mass_matrix(sample_configurations(robot, 200))
    fastest = float(np.linalg.eigvals(np.linalg.solve(mass, np.diag(slope))).real.max())
    return period / int(np.ceil(period / min(LONGEST_PLANT_STEP, 2.0 / max(fastest, 1.0)) - 1e-9))
