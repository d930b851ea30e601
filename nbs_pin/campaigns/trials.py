"""One trial of a campaign: the arm, law, motion and plant that its values name, its run, and the run's figures."""

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.plain import plain
from nbs_pin.base.records import Run
from nbs_pin.campaigns.campaign import Trial, generator
from nbs_pin.cli.values import SAVED, parse_disturbance
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.registry import build_law
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.by_name import motion_of
from nbs_pin.motions.references import DesiredMotion, check_reference
from nbs_pin.robots.carrying import carrying
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.robots.urdf_options import Payload
from nbs_pin.simulation import metrics
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.fused import Fused
from nbs_pin.simulation.guards import check_start
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.plant import Plant
from nbs_pin.simulation.plant_steps import stable_step
from nbs_pin.simulation.simulate import simulate
from nbs_pin.storage.checkpoints import load

_KEPT = 64
"""Arms, laws and motions that are kept for further trials."""
_MAKING = threading.RLock()  # models of Pinocchio have scratch space of their own


class Figures(NamedTuple):
    """What a trial came to, over all joints; those of one that slides are in m and N.

    Example:
        >>> import tempfile
        >>> import nbs_pin as nbs
        >>> campaign = nbs.Campaign({"robot": "two_link", "duration": 0.2})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     table = nbs.run_campaign(campaign, folder)
        >>> table.rows[0].figures.saturated_share
        0.0
    """

    rms_error_rad: float
    """RMS error of the joint where it is largest."""
    late_rms_error_rad: float
    """The same over the last 30 % of the time."""
    peak_error_rad: float
    """Largest error of a joint."""
    final_error_rad: float
    """Largest error of a joint at the end."""
    worst_joint: str
    """The joint of the largest RMS error."""
    unit: str
    """Unit of its errors, "rad" or "m"."""
    converged_s: float | None
    """Time from which ‖z1‖² stays below 0.01; None if there is none."""
    peak_torque_Nm: float
    """Largest applied torque."""
    peak_effort_share: float | None
    """Largest applied torque over the effort limit of its joint; None without limits."""
    saturated_share: float
    """Share of the control periods in which a limit cut a torque off."""
    outside_range_rad: float
    """How far a joint left its position range at most."""


def figures_of(trial: Trial) -> dict[str, Any]:
    """The figures of a trial, as JSON can store them.

    Raises NbsPinError where the arm cannot be read, something does not fit it, or the run diverges.
    """
    run, robot = run_of(trial)
    z1 = metrics.error(run)
    rms, size = metrics.rms_error(run), np.abs(z1)
    worst = int(rms.argmax())
    with np.errstate(invalid="ignore"):
        share = metrics.joint_peak_torque(run) / run.effort_limit
    beyond = np.maximum(robot.lower - run.q, run.q - robot.upper)
    return dict(
        plain(
            Figures(
                rms_error_rad=float(rms.max()),
                late_rms_error_rad=float(metrics.rms_error(run, 0.7 * float(run.t[-1])).max()),
                peak_error_rad=float(size.max()),
                final_error_rad=float(size[-1].max()),
                worst_joint=run.joint_names[worst],
                unit=run.units[worst].position,
                converged_s=float(metrics.convergence_time(run)),
                peak_torque_Nm=float(metrics.peak_torque(run)),
                peak_effort_share=float(share.max()) if np.isfinite(run.effort_limit).any() else None,
                saturated_share=float(metrics.saturated_fraction(run)),
                outside_range_rad=max(0.0, float(beyond.max())),
            )._asdict()
        )
    )


def run_of(trial: Trial) -> tuple[Run, Robot]:
    """The run of a trial, and the arm that the law knows; raises as `figures_of` does."""
    with _MAKING:
        made, robot = _made(trial)
    run = made()
    run.info.update(trial=trial.number, settings=plain(trial.values), seed=trial.seed)
    return run, robot


def is_fused(trial: Trial) -> bool:
    """Whether the trial is one kernel, so that threads can share trials of its kind. Raises as `figures_of` does."""
    with _MAKING:
        made, _ = _made(trial)
    return isinstance(getattr(made, "__self__", None), Fused)


def _made(trial: Trial) -> tuple[Callable[[], Run], Robot]:
    """What makes the run, and the arm."""
    values, arm = trial.values, (trial.values["robot"], json.dumps(trial.arm, sort_keys=True))
    period, kept = values["period"], values["friction"] == "keep"
    robot = _arm(*arm, values["effort_share"])
    motion, duration = _motion(arm, values["reference"], values["frequency"], period, values["duration"])
    _check(arm, values["effort_share"], motion, duration, kept)
    law = _law(arm, values["effort_share"], values["law"], values["bandwidth"], period, kept, values["law_seed"])
    plant = _plant(trial, arm)
    settings: dict[str, Any] = {
        "q0": _start(trial, robot, motion),
        "plant_step": values["plant_step"] or stable_step(plant, robot, period),
        "effort_limit": robot.effort_limit,
        "disturbance": parse_disturbance(values["disturbance"], "disturbance").build(
            robot.nv, period, int(generator(trial.seed, trial.sample, "noise").integers(2**31))
        ),
        "check": False,  # the law is to meet loads and limits that it does not know
    }
    where = (plant, law, motion, duration, period)
    fused = Fused.of(*where, **settings)
    return partial(simulate, *where, **settings) if fused is None else fused.run, robot


@lru_cache(_KEPT)
def _arm(source: str, options: str, effort_share: float) -> Robot:
    robot = load_robot(source, **json.loads(options))
    return robot if effort_share == 1.0 else robot.with_effort_limit(effort_share * robot.effort_limit)


@lru_cache(_KEPT)
def _motion(
    arm: tuple[str, str], reference: str, frequency: float, period: float, duration: float | None
) -> tuple[DesiredMotion, float]:
    """The motion, which does not depend on the effort that is left, and its duration [s], all of a tool's path."""
    motion, length = motion_of(reference, _arm(*arm, 1.0), frequency=frequency, period=period, duration=duration)
    return motion, duration or length


@lru_cache(_KEPT)
def _check(arm: tuple[str, str], effort_share: float, motion: DesiredMotion, duration: float, kept: bool) -> None:
    """Raise ArgumentError if the arm that the law knows cannot follow the motion."""
    check_reference(motion, _arm(*arm, effort_share), duration, joint_friction="keep" if kept else "drop")


@lru_cache(_KEPT)
def _law(
    arm: tuple[str, str], effort_share: float, law: str, bandwidth: float, period: float, kept: bool, seed: int
) -> Controller:
    robot = _arm(*arm, effort_share)
    if law.endswith(SAVED):
        stored = load(law, robot)
        if not isinstance(stored, Controller):
            raise ArgumentError(f"{law} contains a {type(stored).__name__}, a model; give a file with a controller.")
        return stored
    friction = JointFriction.of(robot) if kept else None
    return build_law(law, robot, bandwidth=bandwidth, period=period, friction=friction, seed=seed)


def _plant(trial: Trial, arm: tuple[str, str]) -> Plant:
    """The arm as it really is: with its load, the errors of its bodies and friction that the law does not know."""
    values, robot = trial.values, _carrying(arm, trial.values["payload"])
    known = JointFriction.of(robot) if values["friction"] == "keep" else JointFriction(*np.zeros((2, robot.nv)))
    friction = JointFriction(known.viscous + values["unknown_viscous"], known.coulomb + values["unknown_coulomb"])
    rubs = bool(friction.viscous.any() or friction.coulomb.any())
    if values["plant"] == "mujoco":
        if values["inertia_error"]:
            raise ArgumentError('inertia_error is for plant = "pinocchio"; leave one of them out.')
        return MujocoPlant(robot, values["integrator"] or "implicitfast", friction if rubs else "drop")
    if values["inertia_error"]:
        errors = generator(trial.seed, trial.sample, "inertia_error")
        robot = replace(robot, model=_with_errors(robot.model, 0.01 * values["inertia_error"], errors))
    return DynamicsPlant(PinocchioDynamics(robot), values["integrator"] or "rk4", friction if rubs else None)


@lru_cache(_KEPT)
def _carrying(arm: tuple[str, str], mass: float) -> Robot:
    robot = _arm(*arm, 1.0)
    return carrying(robot, [("", Payload(mass))]) if mass else robot


def _with_errors(model: pin.Model, share: float, errors: np.random.Generator) -> pin.Model:
    """The model with each mass, with the inertia about its centre, and each coordinate of the centre within ±share."""
    changed = model.copy()
    for k in range(1, model.njoints):
        body = model.inertias[k]
        scale, *moved = 1.0 + share * errors.uniform(-1.0, 1.0, 4)
        changed.inertias[k] = pin.Inertia(scale * body.mass, np.array(moved) * body.lever, scale * body.inertia)
    return changed


def _start(trial: Trial, robot: Robot, motion: DesiredMotion) -> np.ndarray | None:
    """Where the arm starts at rest, within its range; None starts on the motion.

    Raises ArgumentError if the start error leads out of the range.
    """
    error, spread = trial.values["start_error"], trial.values["start_spread"]
    if not (error or spread):
        return None
    start = np.array(motion(0.0)[0]) + error * (-1.0) ** np.arange(robot.nv)
    check_start(start[None], robot)
    if spread:
        start += spread * generator(trial.seed, trial.sample, "start_spread").uniform(-1.0, 1.0, robot.nv)
        start = np.clip(start, robot.lower, robot.upper)
    return start
