"""The simulation of a sampled control loop, recorded as a Run."""

import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.arguments import DURATION, MOST_PERIODS, PERIOD, called, checked, count, flag, function, maybe, number
from nbs_pin.base.checks import all_finite, floats
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged, TooLarge
from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Reference, Run
from nbs_pin.controllers.controller import CONTROLLER, Controller
from nbs_pin.motions.disturbances import Disturbance, TorqueNoise
from nbs_pin.motions.references import MOTION, DesiredMotion
from nbs_pin.simulation.guards import check_loop
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.plant import PLANT, Plant
from nbs_pin.simulation.processes import in_processes

_MEMORY = "/dev/shm"
MOST_STREAMED = 10**12
"""Most control periods of a motion that is recorded in blocks."""
_RECORDED = ("q", "v", "tau", "tau_command", "disturbance")


_LOOP = {
    "plant": PLANT,
    "controller": CONTROLLER,
    "reference": MOTION,
    "duration": DURATION,
    "period": PERIOD,
    "plant_step": maybe(PERIOD),
    "disturbance": maybe(function(3, "a disturbance, a function of t, q and v that returns torques, or None")),
    "lookahead": maybe(number(least=0.0, most=1000.0, unit="s")),
    "check": flag,
    "progress": flag,
}


@checked(**_LOOP, workers=count(1, 1024, "processes"))
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
    workers: int = 1,
    check: bool = True,
    progress: bool = False,
) -> Run:
    """The motion of the plant under the controller, sampled at the control instants.

    Every period the compiled controller receives the state and the reference. Its torque is clipped to the effort
    limits and held until the next instant, while the plant takes its steps under τ + τ_d.

    Args:
        plant: The simulated arm.
        controller: The control law.
        reference: The desired motion.
        duration: A whole number of periods [s].
        period: Control period [s], a whole number of plant steps.
        q0: Start (..., n) [rad]; leading axes simulate many starts at once. None takes the reference's q and v.
        v0: Start [rad/s]; None is at rest if q0 is given.
        plant_step: Plant step [s]; None takes the longest one of at most 1 ms that divides the period.
        effort_limit: Largest |τ| [N·m], a number or one per joint, inf for none; None takes that of the arm.
        disturbance: Any callable τ_d(t, q, v) [N·m]; evaluated at every plant step and held over it.
        lookahead: How far ahead [s] the law is evaluated, on the reference of that time and the state predicted with
            its acceleration. A held torque acts half a period late on average; None takes half a period, which removes
            that lag (the tracking error of panda at 1 kHz falls tenfold). 0 is the plain sampled law.
        workers: Processes that share the starts along the first axis of q0. `TorqueNoise` is the same for any number;
            another disturbance is called with the starts of one process at a time.
        check: First compare the motion with the position, velocity and effort limits of the plant's arm, the start with
            its position limits, and the law's arm with the plant's. False simulates what the arm cannot do.
        progress: Show a progress bar on a terminal after 2 s.

    Raises:
        ArgumentError: If arguments are out of range or do not match, or `check` finds a fault.
        SimulationDiverged: If a torque or the state is not finite, or the engine warns; it states the time.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> plant, law = nbs.MujocoPlant(robot), nbs.NeuralBackstepping.for_robot(robot)
        >>> nbs.simulate(plant, law, nbs.Hold([0.3, 0.2]), duration=0.1, period=0.001).q.shape
        (101, 2)
    """
    loop = _closed(plant, controller, duration, period, plant_step, effort_limit, lookahead, disturbance)
    start = loop.start(reference, q0, v0)
    if check:
        check_loop(loop, controller, reference, start)
    loop.check_size(math.prod(start[0].shape[:-1]), recorded_numbers(loop.law))
    if workers > 1:
        return _shared(loop, reference, start, workers)
    return _block(loop, reference, 0, loop.steps, start, None, progress)[0]


def _shared(loop: "_Closed", reference: DesiredMotion, start: tuple[np.ndarray, np.ndarray], workers: int) -> Run:
    """The run of all starts, simulated in slices by several processes and joined along the first batch axis."""
    q0, v0 = start
    if q0.ndim < 2:
        raise ArgumentError(f"workers share starts, but q0 has shape {q0.shape}; give q0 of shape (starts, ..., nv).")
    bounds = np.linspace(0, len(q0), min(workers, len(q0)) + 1).astype(int).tolist()
    shares = list(pairwise(bounds))
    shape = (len(_RECORDED), loop.steps + 1, *q0.shape)
    with tempfile.TemporaryDirectory(dir=_roomy(8 * math.prod(shape))) as folder:
        # Every process writes its starts into this file; its pages stay mapped while the run refers to them.
        file = str(Path(folder) / "run.npy")
        rows = np.lib.format.open_memmap(file, mode="w+", dtype=float, shape=shape)
        tasks = [
            (file, (first, end), _of_starts(loop, first, end, len(q0)), reference, q0, v0) for first, end in shares
        ]
        shared = list(in_processes(_share, tasks, workers))
    first, seen = shared[0][0], [estimates for _, estimates in shared if estimates is not None]
    stored = {name: getattr(first, name) for name in ("q_ref", "v_ref", "a_ref")}
    references: dict[str, np.ndarray] = {
        name: np.array(np.broadcast_to(x, rows[0].shape)) for name, x in stored.items()
    }
    references |= {"estimates": np.concatenate(seen, axis=1)} if seen else {}
    return replace(first, **{name: np.asarray(row) for name, row in zip(_RECORDED, rows, strict=True)}, **references)


def _roomy(size: int) -> str | None:
    """A folder in memory with room for `size` bytes, or None for the default place."""
    return _MEMORY if os.path.isdir(_MEMORY) and shutil.disk_usage(_MEMORY).free > 2 * size else None


def _of_starts(loop: "_Closed", first: int, end: int, count: int) -> "_Closed":
    """The loop for some of `count` starts, which have the same noise as among all of them."""
    noise = loop.disturbance
    return replace(loop, disturbance=replace(noise, share=(first, end, count))) if type(noise) is TorqueNoise else loop


def _share(
    file: str, share: tuple[int, int], loop: "_Closed", reference: DesiredMotion, q0: np.ndarray, v0: np.ndarray
) -> tuple[Run, np.ndarray | None]:
    """The simulation of one worker: writes its starts into the file, returns the first of them and all estimates."""
    own = slice(*share)
    run, _ = _block(loop, reference, 0, loop.steps, (q0[own], v0[own]), None, False)
    rows = np.lib.format.open_memmap(file, mode="r+")
    for row, name in zip(rows, _RECORDED, strict=True):
        row[:, own] = getattr(run, name)
    one = {name: getattr(run, name)[:, :1] for name in (*_RECORDED, "q_ref", "v_ref", "a_ref")}
    return replace(run, **one, estimates=None), run.estimates


@checked(**_LOOP, block=count(1, MOST_PERIODS, "periods"))
def stream(
    plant: Plant,
    controller: Controller,
    reference: DesiredMotion,
    duration: float,
    period: float,
    *,
    block: int = 1000,
    q0: Any = None,
    v0: Any = None,
    plant_step: float | None = None,
    effort_limit: Any = None,
    disturbance: Disturbance | None = None,
    lookahead: float | None = None,
    check: bool = True,
    progress: bool = False,
) -> Iterator[Run]:
    """`simulate` with bounded memory, for hours of motion: one Run per `block` control periods.

    Each run begins at the instant and state in which the one before ended. Together they are the run of `simulate`, if
    `controller.step` depends only on its arguments: it is called twice at the border of two blocks. All other arguments
    and the errors are those of `simulate`.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> plant, law = nbs.DynamicsPlant.for_robot(robot), nbs.PD.for_robot(robot)
        >>> [len(run.t) for run in nbs.stream(plant, law, nbs.Hold([0.3, 0.2]), 0.2, 0.001, block=100)]
        [101, 101]
    """
    loop = _closed(plant, controller, duration, period, plant_step, effort_limit, lookahead, disturbance, MOST_STREAMED)
    start = loop.start(reference, q0, v0)
    if check:
        check_loop(loop, controller, reference, start)
    return _blocks(loop, reference, start, block, progress)


def _blocks(
    loop: "_Closed", reference: DesiredMotion, state: tuple[np.ndarray, np.ndarray], block: int, progress: bool
) -> Iterator[Run]:
    memory = None
    for first in tracked(range(0, loop.steps, block), "simulating", progress):
        run, memory = _block(loop, reference, first, min(block, loop.steps - first), state, memory, False)
        state = run.q[-1].copy(), run.v[-1].copy()  # copies, since the reader may modify the run
        yield run


@dataclass(frozen=True, eq=False)
class _Closed(Loop):
    """A loop with its controller and disturbance."""

    law: Controller
    name: str
    disturbance: Disturbance | None


def _closed(
    plant: Plant,
    controller: Controller,
    duration: float,
    period: float,
    plant_step: float | None,
    effort_limit: Any,
    lookahead: float | None,
    disturbance: Disturbance | None,
    most: float | None = None,
) -> _Closed:
    settings = {"plant_step": plant_step, "effort_limit": effort_limit, "lookahead": lookahead}
    loop = Loop.of(plant, controller.nv, duration, period, **settings, most=most)
    return _Closed(**vars(loop), law=_compiled(controller), name=controller.law_name, disturbance=disturbance)


def recorded_numbers(law: Controller) -> int:
    """How many numbers a law has recorded of its memory in each row of a run."""
    seen = law.recorded(law.initial_memory(np.zeros(law.nv)))
    return 0 if seen is None else int(np.size(seen))


def _compiled(controller: Controller) -> Controller:
    """The compiled form; the controller itself if `compile` is that of another base, such as torch.nn.Module."""
    law = controller.compile()
    return law if isinstance(law, Controller) else controller


def _block(
    loop: _Closed,
    reference: DesiredMotion,
    first: int,
    steps: int,
    start: tuple[np.ndarray, np.ndarray],
    memory: Any,
    progress: bool,
) -> tuple[Run, Any]:
    """The rows of `steps` periods from the control instant `first` on, and the controller's memory at their end."""
    times, ahead, desired, target = loop.schedule(reference, first, steps)
    leads = ahead.tolist()
    run = loop.blank_run(times, desired, *start, controller=loop.name)
    run.info.update(getattr(reference, "notes", {}))
    memory = loop.law.initial_memory(run.q[0]) if first == 0 else memory
    begun = loop.law.recorded(memory)
    seen = None if begun is None else np.zeros((steps + 1, *np.shape(begun)))
    # No overflow warnings: every torque and state is checked, and reported with its time.
    with np.errstate(over="ignore", invalid="ignore"):
        for k in tracked(range(steps), "simulating", progress):
            if seen is not None:
                seen[k] = loop.law.recorded(memory)
            tau, memory = _control(loop, run, k, leads[k], target, memory)
            run.q[k + 1], run.v[k + 1] = _advance(loop, run, k, tau)
        if seen is not None:
            seen[steps] = loop.law.recorded(memory)
        _control(loop, run, steps, leads[steps], target, memory)  # recorded; a following block computes it again
    if seen is not None:
        values, run.info["estimates"] = loop.law.estimates(seen)
        run = replace(run, estimates=values)
    return run, memory


def _control(loop: _Closed, run: Run, k: int, lead: float, target: Reference, memory: Any) -> tuple[np.ndarray, Any]:
    """The torque of row k, evaluated `lead` [s] ahead and recorded in the run, and the memory after it."""
    q, v, tau, dv = run.q[k], run.v[k], run.tau[k], lead * run.a_ref[k]
    aim = Reference(target.q[k], target.v[k], target.a[k])
    try:
        command, memory = loop.law.step(memory, q + lead * (v + 0.5 * dv), v + dv, aim, loop.period)
    except TooLarge as error:
        raise SimulationDiverged(f"the loop has diverged at t = {float(run.t[k]):g} s: {loop.name}: {error}") from error
    # Checked before clipping, which can turn NaN into full effort.
    run.tau_command[k] = command = _checked(command, q.shape, loop.name, float(run.t[k]))
    np.maximum(np.minimum(command, loop.limit, out=tau), -loop.limit, out=tau)
    return tau, memory


def _advance(loop: _Closed, run: Run, k: int, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The state one period after row k; records the disturbance at its start."""
    # Copies: a plant that writes into its arguments must not change the record.
    q, v, t, step = run.q[k].copy(), run.v[k].copy(), float(run.t[k]), loop.step
    try:
        for j in range(loop.substeps):
            total = tau
            if loop.disturbance is not None:
                torque = _disturbance(loop.disturbance, t + j * step, q, v)
                total = tau + torque
                if j == 0:
                    run.disturbance[k] = torque
            q, v = loop.plant.at(t + j * step).step(q, v, total, step)
    except SimulationDiverged as error:
        raise SimulationDiverged(f"after t = {t:g} s: {error}") from error
    return q, v


def _checked(command: Any, shape: tuple[int, ...], name: str, t: float) -> np.ndarray:
    command = floats(f"{name}'s torque", command)
    if command.shape != shape:
        raise ArgumentError(
            f"{name} gave a torque of shape {command.shape} at t = {t:g} s, expected {shape}; "
            "return one torque per joint for every start."
        )
    if not all_finite(command):
        raise SimulationDiverged(
            f"{name} commanded the torque {command} at t = {t:g} s, expected finite numbers; "
            "check for a division by zero or an unstable gain."
        )
    return command


def _disturbance(disturbance: Disturbance, t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    torque = floats("the disturbance", called("the disturbance", disturbance, t, q, v))
    if torque.shape not in (q.shape, q.shape[-1:]):
        raise ArgumentError(
            f"the disturbance at t = {t:g} s has shape {torque.shape}, expected {q.shape}; return one torque per joint."
        )
    if not all_finite(torque):
        raise SimulationDiverged(f"the disturbance at t = {t:g} s is {torque}, expected finite torques; correct it.")
    return torque
