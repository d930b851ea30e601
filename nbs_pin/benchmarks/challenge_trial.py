"""One run of a law on a task: the loop with what its readings and torques pass through, and its figures."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.arrays import JointArray, Vectors
from nbs_pin.base.records import Reference, Run
from nbs_pin.benchmarks.challenge_tasks import DURATION, PERIOD, SETTLED, Course, Task
from nbs_pin.controllers.controller import Controller
from nbs_pin.robots.robot import Robot
from nbs_pin.simulation.loop import Loop
from nbs_pin.simulation.metrics import error
from nbs_pin.simulation.simulate import simulate


@dataclass(frozen=True)
class Figures:
    """What a run came to."""

    rms: float
    """Root mean square of ‖z1‖ from `SETTLED` on [rad]."""
    peak: float
    """Largest |z1_i| from then on [rad]."""
    saturated: float
    """Share of the control periods, from the first on, in which some joint is at its effort limit."""
    worst: tuple[float, ...]
    """Largest |z1_i| of each joint from then on [rad]."""
    left: str = ""
    """The limit of the arm that the run went beyond, empty if none."""


class Passed(NamedTuple):
    """What a loop through a condition remembers."""

    k: int
    memory: Any
    """That of the law."""
    last: JointArray
    """The reading before this one."""
    waiting: tuple[JointArray, ...]
    """Torques on their way."""


class Through(Controller):
    """A law that reads what encoders give and whose torques come late; it is called half a period ahead.

    It predicts the state that it hands to the law like `simulate`, but from the readings.
    """

    def __init__(self, law: Controller, task: Task, plant: Any, before: JointArray) -> None:
        self.law, self._condition, self._before = law.compile(), task.condition, before
        loop = Loop.of(plant, law.nv, DURATION, PERIOD, plant_step=None, effort_limit=None, lookahead=None)
        self._schedule, self._leads = (found := loop.schedule(task.reference)), found.leads.tolist()
        turn = np.where(task.robot.prismatic, 1.0, 2.0 * np.pi)
        self._step = None if task.condition.bits is None else turn / 2.0**task.condition.bits

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.law.nv

    def initial_memory(self, q: Vectors) -> Passed:
        """As if the arm had always moved as it does at the start; no torque is on its way yet."""
        late = tuple(np.zeros(self.nv) for _ in range(self._condition.delay))
        return Passed(0, self.law.initial_memory(q), self._read(self._before), late)

    def step(self, memory: Passed, q: Vectors, v: Vectors, reference: Reference, period: float) -> tuple[Any, Passed]:
        """The torque that arrives now, and what is remembered."""
        k, target = memory.k, self._schedule.target
        seen = self._read(q)
        speed = v if self._step is None else (seen - memory.last) / period
        lead, change = self._leads[k], self._leads[k] * self._schedule.desired.a[k]
        aim = Reference(target.q[k], target.v[k], target.a[k])
        ahead = seen + lead * (speed + 0.5 * change), speed + change
        torque, inner = self.law.step(memory.memory, *ahead, aim, period)
        now, *later = (*memory.waiting, torque)
        return now, Passed(k + 1, inner, seen, tuple(later))

    def _read(self, q: JointArray) -> JointArray:
        return q if self._step is None else np.asarray(self._step * np.rint(q / self._step))


def run_task(law: Controller, course: Course, motion: str, condition: str) -> Run:
    """The run of a law on a task, from the start of the course.

    Raises:
        ArgumentError: If the law gives no torques.
        SimulationDiverged: If a torque or the state is not finite.
    """
    task, plant, (q0, v0) = course.task(motion, condition), course.plant(condition), course.start(motion)
    plain = task.condition.bits is None and task.condition.delay == 0
    through = law if plain else Through(law, task, plant, q0 - PERIOD * v0)
    lookahead = None if plain else 0.0
    return simulate(
        plant,
        through,
        task.reference,
        DURATION,
        PERIOD,
        q0=q0,
        v0=v0,
        effort_limit=task.effort_limit,
        lookahead=lookahead,
        check=False,
    )


def figures_of(run: Run, robot: Robot) -> Figures:
    """What the run came to."""
    late = run.t >= SETTLED - 1e-9 * run.period
    z1 = np.abs(error(run)[late])
    at_limit = (np.abs(run.tau[:-1]) >= run.effort_limit).any(axis=-1)
    return Figures(
        rms=float(np.sqrt(np.mean(np.sum(z1 * z1, axis=-1)))),
        peak=float(z1.max()),
        saturated=float(at_limit.mean()),
        worst=tuple(z1.max(axis=0).tolist()),
        left=_left(run, robot),
    )


def _left(run: Run, robot: Robot) -> str:
    """The first limit of the arm that the run went beyond, in words."""
    kinds = {
        "left its position range": (run.q < robot.lower) | (run.q > robot.upper),
        "was faster than its velocity limit": np.abs(run.v) > robot.velocity_limit,
    }
    for said, beyond in kinds.items():
        if beyond.any():
            k, i = np.argwhere(beyond)[0]
            return f"joint '{run.joint_names[i]}' {said} at t = {run.t[k]:.3f} s"
    return ""
