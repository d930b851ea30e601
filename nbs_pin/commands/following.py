"""An arm that follows a motion under one law: the work of `nbs-pin track`."""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.npz import LARGEST
from nbs_pin.base.plain import plain
from nbs_pin.base.progress import waiting
from nbs_pin.base.records import Reference, Run
from nbs_pin.cli.payloads import TimedLoad
from nbs_pin.commands.inputs import law_of
from nbs_pin.commands.loads import kept, loaded
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.motions.disturbances import Disturbance
from nbs_pin.motions.references import DesiredMotion, Sinusoid, check_reference
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.plant import Plant
from nbs_pin.simulation.plant_steps import stable_step
from nbs_pin.simulation.registry import build_plant
from nbs_pin.simulation.run_figures import figures
from nbs_pin.simulation.simulate import recorded_numbers, stream

_ROWS_OF_ARRAYS = 8  # arrays of a Run with one number per row and joint


class Tracked(NamedTuple):
    """A run and the time it took."""

    run: Run
    compile_time: float
    """Time to compile the law, or to load its machine code from disk [s]."""
    wall_time: float
    """Time to simulate [s]."""
    interrupted: bool
    """Whether Ctrl-C ended it, so that the run is a part of what was asked for."""
    deviations: dict[str, float]
    """How far each estimate of a law that adapts may be off in the end (`AdaptiveLaw.estimate`); empty for others."""

    def figures(self, robot: Robot) -> dict[str, Any]:
        """`run_figures.figures` of the run, with these deviations."""
        return figures(self.run, robot) | ({"estimates_deviation": plain(self.deviations)} if self.deviations else {})


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
    loads: Sequence[TimedLoad] = (),
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
    loads: what a plant by name carries from some time on, unknown to the law.
    joint_friction: "keep" simulates the URDF's friction, fed forward by laws that model it. joint_stops:
    "keep" stops joints at their position limits. integrator: of a plant by
    name, None its usual one. plant_step, lookahead [s]: as in `simulate`. seed: of the network weights.

    Raises:
        ArgumentError: If the motion violates the arm's position, velocity or effort limits, or settings do not fit.
        SimulationDiverged: If the simulation diverges.
        KeyboardInterrupt: If Ctrl-C comes in the first thousand periods; later the run up to there is returned.
    """
    friction = JointFriction.of(robot) if joint_friction == "keep" else None
    reference = Sinusoid.for_robot(robot) if reference is None else reference
    _check_size(_ROWS_OF_ARRAYS * robot.nv, duration, period)
    check_reference(reference, robot, duration, joint_friction=joint_friction)
    if not isinstance(controller, Controller):
        controller = law_of(controller, robot, bandwidth=bandwidth, period=period, friction=friction, seed=seed)
    _check_size(_ROWS_OF_ARRAYS * robot.nv + recorded_numbers(controller), duration, period)
    if not isinstance(plant, Plant):
        build = partial(
            build_plant, plant, integrator=integrator, joint_friction=joint_friction, joint_stops=joint_stops
        )
        plant = loaded(robot, loads, build)
    if start is None and start_error:
        start = Reference(*reference(0.0)).q + start_error * (-1.0) ** np.arange(robot.nv)
    begun = time.perf_counter()
    with waiting("compiling kernels for this machine, once", progress):
        controller.compile()  # so that the time of the simulation is its own
    before, blocks = time.perf_counter(), list[Run]()
    try:
        for block in stream(
            plant,
            controller,
            reference,
            duration,
            period,
            q0=start,
            plant_step=stable_step(plant, robot, period) if plant_step is None else plant_step,
            effort_limit=robot.effort_limit,
            lookahead=lookahead,
            disturbance=disturbance,
            progress=progress,
        ):
            blocks.append(block)
    except KeyboardInterrupt:
        if not blocks:
            raise
    run = _joined(blocks)
    run.info.update(kept(loads))
    interrupted = len(run.t) <= round(duration / period)
    return Tracked(run, before - begun, time.perf_counter() - before, interrupted, _deviations(controller, run))


def _deviations(controller: Controller, run: Run) -> dict[str, float]:
    """How far each estimate may be off after one run."""
    if not isinstance(controller, AdaptiveLaw) or run.q.ndim != 2:
        return {}
    found = controller.estimate(run)
    assert found.deviation is not None  # as it is of a run
    return dict(zip(found.names, found.deviation.tolist(), strict=True))


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


def _joined(blocks: Sequence[Run]) -> Run:
    """The runs of `stream` as one: each begins at the instant in which the one before ended."""
    parts = [{"t": run.t, **run.signals} for run in blocks]
    rows: dict[str, Any] = {
        name: np.concatenate([*(part[name][:-1] for part in parts[:-1]), last]) for name, last in parts[-1].items()
    }
    return replace(blocks[0], **rows)


def _check_size(numbers: int, duration: float, period: float) -> None:
    size = 8.0 * numbers * duration / period
    if size > LARGEST:
        raise ArgumentError(
            f"{duration:g} s at a period of {period:g} s would record {size / 1e9:.3g} GB, at most "
            f"{LARGEST / 1e9:.3g} GB are kept; give a shorter duration or a longer period."
        )
