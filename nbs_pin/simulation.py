"""The one time loop: a controller, a reference and a plant make a Run."""

import math
from typing import Any

import numpy as np

from nbs_pin.checks import all_finite, positive, whole
from nbs_pin.controllers.controller import Controller
from nbs_pin.disturbances import Disturbance
from nbs_pin.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.plants.plant import Plant
from nbs_pin.progress import tracked
from nbs_pin.references import DesiredMotion
from nbs_pin.state import Reference, Run

LONGEST_PLANT_STEP = 1e-3
"""Plant step taken when none is given, or the nearest shorter one that divides the period [s]."""


def simulate(
    plant: Plant,
    controller: Controller,
    reference: DesiredMotion,
    duration: float,
    period: float,
    *,
    q0: Any = None,
    v0: Any = None,
    plant_step: float | None = None,
    effort_limit: Any = None,
    disturbance: Disturbance | None = None,
    lookahead: float | None = None,
    progress: bool = False,
) -> Run:
    """The motion of `plant` under `controller` following `reference` for `duration` [s].

    Every `period` [s] the controller sees the state and the reference; its torque is clipped to the effort limits and
    held until the next instant, while the plant takes steps of `plant_step` [s] under τ + τ_d.

    duration: a whole number of periods. period: a whole number of plant steps; without `plant_step`, the longest step
    of at most 1 ms that divides it.
    q0, v0: start [rad], [rad/s]. Without q0 the start is the reference's (q and v); with q0 and no v0 it is at rest.
    Leading axes of q0 simulate many starts at once.
    effort_limit: largest |τ| [N·m], a number or one per joint; None takes the arm's (`plant.robot`), inf for none.
    disturbance: τ_d(t, q, v) [N·m], evaluated at every plant step and held over it (`disturbances.py`, any callable).
    lookahead: how far [s] ahead the controller is evaluated, on the reference of that time and the state predicted with
    the reference's acceleration. A held torque acts half a period late on average, so None takes half a period, which
    removes that lag (the tracking error of a panda at 1 kHz falls tenfold); 0 is the plain sampled law.
    progress: show a progress bar when it takes longer than 2 s at a terminal.

    Raises ArgumentError for arguments that do not fit each other, and SimulationDiverged, naming the time, when the
    controller's torque or the state is not finite or the engine warns.
    """
    if controller.nv != plant.nv:
        raise ArgumentError(
            f"the controller has {controller.nv} joints and the plant {plant.nv}; build both for one arm."
        )
    steps = whole(duration, period, "duration", "period")
    substeps = _substeps(period, plant_step)
    limit = _effort_limit(plant, effort_limit)
    lead = _lead(lookahead, period)
    times = period * np.arange(steps + 1.0)
    desired, target = (_sampled(reference, t, plant.nv) for t in (times, times + lead))
    run = _prepared(plant, desired, period, limit, *_start(desired, q0, v0))
    run.info.update(
        controller=type(controller).__name__, plant=repr(plant), plant_step=period / substeps, lookahead=lead
    )
    # Overflow needs no warning here: every torque and every state is checked, and reported with its time.
    with np.errstate(over="ignore", invalid="ignore"):
        _run_loop(run, plant, controller, target, lead, disturbance, substeps, progress)
    return run


def _run_loop(
    run: Run,
    plant: Plant,
    controller: Controller,
    target: Reference,
    lead: float,
    disturbance: Disturbance | None,
    substeps: int,
    progress: bool,
) -> None:
    """Fill the rows of the run from its first state on; `target` is the reference `lead` [s] after each instant."""
    law = controller.compile()
    memory = law.initial_memory(run.q[0])
    upper, lower, last = run.effort_limit, -run.effort_limit, len(run.t) - 1
    for k in tracked(range(last + 1), "simulating", progress):
        t, q, v, tau = float(run.t[k]), run.q[k], run.v[k], run.tau[k]
        dv = lead * run.a_ref[k]
        aim = Reference(target.q[k], target.v[k], target.a[k])
        command, memory = law.step(memory, q + lead * (v + 0.5 * dv), v + dv, aim, run.period)
        # Finite before clipped: a clip can turn a torque that is not a number into full effort.
        run.tau_command[k] = command = _checked(command, q.shape, controller, t)
        np.maximum(np.minimum(command, upper, out=tau), lower, out=tau)
        if disturbance is not None:
            run.disturbance[k] = _disturbance(disturbance, t, q, v)
        if k < last:
            run.q[k + 1], run.v[k + 1] = _advance(plant, q, v, tau, disturbance, t, run.period, substeps)


def _substeps(period: float, plant_step: float | None) -> int:
    if plant_step is not None:
        return whole(period, plant_step, "period", "plant_step")
    positive("period", period, "s")
    return max(1, math.ceil(period / LONGEST_PLANT_STEP - 1e-9))


def _lead(lookahead: float | None, period: float) -> float:
    lead = 0.5 * period if lookahead is None else lookahead
    if not 0.0 <= lead < math.inf:
        raise ArgumentError(f"lookahead is {lookahead} s, expected a finite time ≥ 0; half a period is usual.")
    return lead


def _sampled(reference: DesiredMotion, t: np.ndarray, nv: int) -> Reference:
    sampled = Reference(*(np.asarray(x, dtype=float) for x in reference(t)))
    for name, rows in sampled._asdict().items():
        if rows.shape != (t.size, nv):
            raise ArgumentError(
                f"the reference at {t.size} times gave {name} of shape {rows.shape}, expected ({t.size}, {nv}); "
                f"give it one value for each of the {nv} joints and let it take arrays of times."
            )
        if not np.isfinite(rows).all():
            k, joint = np.argwhere(~np.isfinite(rows))[0]
            raise ArgumentError(f"the reference's {name} of joint {joint} at t = {t[k]:g} s is not finite; correct it.")
    return sampled


def _start(desired: Reference, q0: Any, v0: Any) -> list[np.ndarray]:
    """Start (q, v) of one batch shape."""
    rest = desired.v[0] if q0 is None else np.zeros_like(desired.v[0])
    given = {"q0": desired.q[0] if q0 is None else q0, "v0": rest if v0 is None else v0}
    start = {name: np.asarray(value, dtype=float) for name, value in given.items()}
    nv = rest.size
    for name, x in start.items():
        if x.ndim == 0 or x.shape[-1] != nv or 0 in x.shape:
            raise ArgumentError(f"{name} has shape {x.shape}, expected (..., {nv}): one number per joint.")
        if not np.isfinite(x).all():
            raise ArgumentError(f"{name} is {x}, expected finite numbers; correct the start.")
    try:
        return list(np.broadcast_arrays(start["q0"], start["v0"]))
    except ValueError as error:
        shapes = ", ".join(f"{name} {x.shape}" for name, x in start.items())
        raise ArgumentError(f"the starts do not broadcast ({shapes}); give equal leading axes.") from error


def _prepared(
    plant: Plant, desired: Reference, period: float, limit: np.ndarray, q0: np.ndarray, v0: np.ndarray
) -> Run:
    """The run with its times, reference and start in place, and room for the rest."""
    rows, n = desired.q.shape
    shape = (rows, *q0.shape)
    q_ref, v_ref, a_ref = (np.array(np.broadcast_to(x.reshape(rows, *(1,) * (q0.ndim - 1), n), shape)) for x in desired)
    robot = plant.robot
    run = Run(
        t=period * np.arange(float(rows)),
        q=np.zeros(shape),
        v=np.zeros(shape),
        tau=np.zeros(shape),
        tau_command=np.zeros(shape),
        disturbance=np.zeros(shape),
        q_ref=q_ref,
        v_ref=v_ref,
        a_ref=a_ref,
        effort_limit=limit,
        continuous=np.zeros(n, dtype=bool) if robot is None else robot.continuous,
        joint_names=tuple(f"q{i + 1}" for i in range(n)) if robot is None else robot.joint_names,
        period=period,
        robot="" if robot is None else robot.source,
        robot_sha256="" if robot is None else robot.sha256,
    )
    run.q[0], run.v[0] = q0, v0
    return run


def _effort_limit(plant: Plant, given: Any) -> np.ndarray:
    if given is None:
        given = np.inf if plant.robot is None else plant.robot.effort_limit
    limit = np.asarray(given, dtype=float)
    if limit.shape not in ((), (plant.nv,)) or not (limit > 0.0).all():
        raise ArgumentError(
            f"effort_limit is {given}, expected one number > 0 or {plant.nv} of them [N·m]; np.inf means no limit."
        )
    return np.full(plant.nv, limit)


def _checked(command: Any, shape: tuple[int, ...], controller: Controller, t: float) -> np.ndarray:
    command = np.asarray(command, dtype=float)
    if command.shape != shape:
        raise ArgumentError(
            f"{type(controller).__name__} gave a torque of shape {command.shape} at t = {t:g} s, expected {shape}; "
            "a controller returns one torque per joint for every start."
        )
    if not all_finite(command):
        raise SimulationDiverged(
            f"{type(controller).__name__} asked for the torque {command} at t = {t:g} s, expected finite numbers; "
            "look for a division by zero or an unstable gain."
        )
    return command


def _disturbance(disturbance: Disturbance, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    torque = np.asarray(disturbance(t, q, v), dtype=float)
    if torque.shape not in (q.shape, q.shape[-1:]):
        raise ArgumentError(
            f"the disturbance at t = {t:g} s has shape {torque.shape}, expected {q.shape}; return one torque per joint."
        )
    if not all_finite(torque):
        raise SimulationDiverged(f"the disturbance at t = {t:g} s is {torque}, expected finite torques; correct it.")
    return torque


def _advance(
    plant: Plant,
    q: np.ndarray,
    v: np.ndarray,
    tau: np.ndarray,
    disturbance: Disturbance | None,
    t: float,
    period: float,
    substeps: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The state one period later."""
    step = period / substeps
    try:
        for j in range(substeps):
            total = tau if disturbance is None else tau + _disturbance(disturbance, t + j * step, q, v)
            q, v = plant.step(q, v, total, step)
    except SimulationDiverged as error:
        raise SimulationDiverged(f"after t = {t:g} s: {error}") from error
    return q, v
