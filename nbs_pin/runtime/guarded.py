"""A law behind a guard: samples in, torques that may be sent out, and a report when it stops."""

import threading
import traceback
from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.arguments import a, checked, maybe, number
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import vector_of
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import joints_told
from nbs_pin.base.units import units_of
from nbs_pin.controllers.controller import CONTROLLER, Controller, MemorylessController
from nbs_pin.dynamics.momentum_observer import OBSERVER, MomentumObserver
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.kernels import guarding as at
from nbs_pin.kernels.jit import NOT_TAKEN
from nbs_pin.robots.robot import ARM, Robot
from nbs_pin.runtime.guard import Counters, Fault, Guard, Mode
from nbs_pin.runtime.outside import Outside

LAST = 50
"""Samples of a report."""
PROBE = 0.1
"""Time between two comparisons of the law's holding torque with gravity [s]."""
_OF_GRAVITY, _OF_EFFORT = 0.5, 0.02  # a holding torque that differs by more than both is that of another arm


class Sample(NamedTuple):
    """What an arm tells at a control instant.

    Example:
        >>> import nbs_pin as nbs
        >>> arm = nbs.PlantArm(nbs.MujocoPlant(nbs.load_robot("two_link")), [0.3, 0.2], real_time=False)
        >>> arm.look()
        Sample(t=0.0, q=array([0.3, 0.2]), v=array([0., 0.]), fresh=True, external=None, fault='')
    """

    t: float
    """Time by the arm's clock [s]."""
    q: JointArray
    """Position [rad]."""
    v: JointArray
    """Velocity [rad/s]."""
    fresh: bool = True
    """Whether the arm has told anything new since the last sample."""
    external: JointArray | None = None
    """Torque from outside as the arm or an observer estimates it [N·m], None where nobody does."""
    fault: str = ""
    """What the arm says is wrong with it; it stops the guard."""


class Seen(NamedTuple):
    """One of the last samples of a report."""

    sample: Sample
    aim: Reference
    tau: JointArray
    """Torque that was sent [N·m]."""


@dataclass(frozen=True, eq=False)
class FaultReport:
    """Why a guard stopped, when, and what it had seen last.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> arm = nbs.PlantArm(nbs.MujocoPlant(robot), [0.0, 0.0], real_time=False, disturbance=lambda t, q, v: 200.0)
        >>> law, still = nbs.NeuralBackstepping.for_robot(robot), nbs.Hold([0.0, 0.0])
        >>> report = nbs.drive(arm, law, robot, still, duration=2.0).report
        >>> report.code.name in ("JUMP", "DIVERGED", "CHATTER"), len(report.samples)
        (True, 50)
    """

    code: Fault
    time: float
    """Of the last sample [s]."""
    message: str
    traceback: str
    """Of the exception that the law raised, or empty."""
    counters: Counters
    samples: tuple[Seen, ...]
    """The last samples, oldest first."""

    @property
    def t(self) -> Float[np.ndarray, " rows"]:
        """Times of the last samples [s]."""
        return np.array([seen.sample.t for seen in self.samples])

    @property
    def q(self) -> Float[np.ndarray, "rows n"]:
        """Positions in the last samples [rad]."""
        return np.array([seen.sample.q for seen in self.samples])

    @property
    def tau(self) -> Float[np.ndarray, "rows n"]:
        """Torques that were sent at the last samples [N·m]."""
        return np.array([seen.tau for seen in self.samples])

    @property
    def fresh(self) -> Bool[np.ndarray, " rows"]:
        """Which of the last samples had arrived."""
        return np.array([seen.sample.fresh for seen in self.samples])

    def __str__(self) -> str:
        return f"{self.code.name} at t = {self.time:.4g} s: {self.message}"


class Guarded:
    """A law on an arm behind a guard: every torque is finite, within the effort limits and within the torque rate.

    `step` is called once per period. A law that raises stops the arm in the same period; the exception does not leave.
    One thread at a time may use it.

    Args:
        law: The control law, compiled if it can be.
        robot: The arm, by whose model the guard holds it.
        guard: The limits; None takes `Guard.for_robot(robot)`.
        lookahead: How far ahead the law is evaluated [s], as in `simulate`; None is half a period.
        observer: What estimates the torque from outside where the arm does not tell it, and its friction; None takes
            `MomentumObserver.for_robot(robot)` if the guard has a finite `external_limit`, and none otherwise.

    Raises:
        ArgumentError: If law, robot, guard and observer are for different numbers of joints.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> guarded, aim = nbs.Guarded(nbs.PD.for_robot(robot), robot), nbs.Hold([0.3, 0.2])(0.0)
        >>> guarded.begin(aim.q, aim)
        >>> tau = guarded.step(nbs.Sample(0.0, aim.q, aim.v), aim)
        >>> guarded.step(nbs.Sample(0.001, aim.q * np.nan, aim.v), aim).tolist() == tau.tolist(), guarded.mode.name
        (True, 'DEGRADED')
    """

    @checked(
        law=CONTROLLER,
        robot=ARM,
        guard=maybe(a(Guard, "a Guard, such as Guard.for_robot(robot)")),
        lookahead=maybe(number(least=0.0, most=1.0, unit="s")),
        observer=maybe(OBSERVER),
    )
    def __init__(
        self,
        law: Controller,
        robot: Robot,
        guard: Guard | None = None,
        *,
        lookahead: float | None = None,
        observer: MomentumObserver | None = None,
    ) -> None:
        self.guard = Guard.for_robot(robot) if guard is None else guard
        if not law.nv == robot.nv == self.guard.nv:
            raise ArgumentError(
                f"the law has {joints_told(law.nv)}, the guard {self.guard.nv} and {robot.name} {robot.nv}; build all "
                "for one arm."
            )
        if observer is None and np.isfinite(self.guard.external_limit).any():
            observer = MomentumObserver.for_robot(robot)
        if observer is not None and observer.nv != robot.nv:
            raise ArgumentError(
                f"the observer has {joints_told(observer.nv)} and {robot.name} {robot.nv}; give one for it."
            )
        self._outside = None if observer is None else Outside(observer, self.guard)
        compiled = law.compile()
        self.law = compiled if isinstance(compiled, Controller) else law
        self.robot, self.lead = robot, 0.5 * self.guard.period if lookahead is None else lookahead
        self._model, self._using = PinocchioDynamics(robot), threading.Lock()
        self._unknown, self._nothing = np.full(robot.nv, np.nan), np.zeros(robot.nv)
        self._rows = [slice(k * robot.nv, (k + 1) * robot.nv) for k in range(at.KEPT)]
        self._kept = at.KEPT * robot.nv
        self._ahead_q, self._ahead_v = self._rows[at.AHEAD_Q], self._rows[at.AHEAD_V]
        self._config = self.guard.config.copy()
        self._config[at.LEAD] = self.lead
        self._every = max(1, round(PROBE / self.guard.period))
        # An integral may carry an arm in place of a model, but not where G(q) is subtracted from its torque.
        self._probed = self.guard.compensated or isinstance(self.law, MemorylessController)
        self._state: np.ndarray | None = None
        self.report: FaultReport | None = None
        """Why it stopped; None while it has not."""

    def begin(self, q: Any, aim: Reference) -> None:
        """Begin, or begin again, with an arm that is held at q [rad]; a stop is left in this way only.

        Raises:
            ArgumentError: For a law that has no gravity in it, such as PID, on an arm that adds gravity by itself.
        """
        n = self.robot.nv
        at_rest, wanted = vector_of("q", q, n, "rad"), vector_of("aim.q", aim.q, n, "rad")
        if self.guard.compensated and not self._holds(at_rest):
            raise ArgumentError(
                "the law does not give G(q) at rest, which is subtracted for an arm that adds gravity by itself; give a"
                " law with a model, such as NeuralBackstepping (in the shell nbs)."
            )
        now = wanted - self.lead * vector_of("aim.v", aim.v, n, "rad/s")  # the aim is that of a moment later
        self._state = self.guard.begin(at_rest, now, self._model.gravity(at_rest))
        self._memory, self._count, self.report = self.law.initial_memory(at_rest), 0, None
        self._sent = self.guard.vector(self._state, at.TAU)
        self._seen: deque[tuple[Sample, np.ndarray, JointArray]] = deque(maxlen=LAST)
        if self._outside is not None:
            self._outside.begin()

    @property
    def state(self) -> np.ndarray:
        """The guard's state (`kernels/guarding.py`)."""
        if self._state is None:
            raise ArgumentError("the guard has not begun; call begin(q, aim) with the position of the arm.")
        return self._state

    @property
    def mode(self) -> Mode:
        """OK, DEGRADED or STOPPED."""
        return Mode(int(self.state[at.MODE]))

    @property
    def tau(self) -> JointArray:
        """The torque that was sent last [N·m]; before the first, the one that holds the arm."""
        _ = self.state
        return self._sent.copy()

    @property
    def seen(self) -> Seen:
        """What came in last, as numbers, and what was sent for it."""
        return self._shown(*self._seen[-1])

    def gravity(self, q: JointArray) -> JointArray:
        """G(q) by the guard's model [N·m]."""
        return np.asarray(self._model.gravity(q))

    @property
    def counters(self) -> Counters:
        """What has happened since `begin`."""
        return self.guard.counters(self.state)

    def step(self, sample: Sample, aim: Reference, *, overrun: bool = False, stop: bool = False) -> JointArray:
        """The torque to send [N·m], without G(q) if the guard is for an arm that adds it.

        Args:
            sample: What the arm tells.
            aim: The reference at the time of the sample plus the lookahead.
            overrun: Whether the last step came back after the end of its period.
            stop: Whether to stop.

        Raises:
            ArgumentError: Before `begin`, and if another thread is in it.
        """
        if not self._using.acquire(False):
            raise ArgumentError("a Guarded is being used by another thread; give every thread its own.")
        try:
            return self._step(sample, aim, overrun, stop)
        finally:
            self._using.release()

    def _step(self, sample: Sample, aim: Reference, overrun: bool, stop: bool) -> JointArray:
        state, config, watched = self.state, self._config, None
        if self._outside is not None and sample.external is None and sample.fresh and state[at.MODE] < at.STOPPED:
            watched, sample = self._outside, self._numbers(sample)
            sent = self.guard.vector(state, at.TAU)
            sample = sample._replace(external=watched.seen(sample.t, sample.q, sample.v, sent))
        fault, trace = at.ARM if sample.fault else at.REQUESTED if stop else at.NONE, ""
        action, record, aim = self._taken(sample, aim, overrun)
        if watched is not None and state[at.LOST] == 0.0:
            watched.keep()
        command, gravity = self._unknown, self._unknown
        if action == at.COMPUTE and fault == at.NONE:
            try:
                command = self._command(record, aim)
                if self._probed and self._count % self._every == 0 and not self._holds(record[self._rows[at.AIM_Q]]):
                    fault = at.MODEL
                self._count += 1
            except Exception:  # a law may raise anything; its arm is stopped, and the report has the traceback
                fault, trace = at.LAW, traceback.format_exc()
        if self.guard.compensated or fault != at.NONE or action >= at.BRAKE:
            gravity = self._model.gravity(self.guard.vector(state, at.Q))
        try:
            mode = at.release(config, state, command, gravity, fault)
        except NOT_TAKEN:
            mode = at.release(config, state, self._vector(command), gravity, fault)
        tau = self._sent.copy()
        self._seen.append((sample, record, tau))
        if mode == at.STOPPED and self.report is None:
            self.report = self._reported(trace)
        return tau.copy()

    def _taken(self, sample: Sample, aim: Reference, overrun: bool) -> tuple[int, np.ndarray, Reference]:
        """What the guard says of a sample, and its record; the sample is used as it is where the kernel takes it."""
        t, q, v, fresh, outside, _ = sample
        q_ref, v_ref, a_ref = aim
        config, state, record = self._config, self._state, np.empty(self._kept)
        if outside is None:
            outside = self._nothing
        try:
            action = at.take(config, state, t, fresh, overrun, q, v, q_ref, v_ref, a_ref, outside, record)
        except NOT_TAKEN:  # lists, every second number of an array, text
            q, v, q_ref, v_ref, a_ref, outside = map(self._vector, (q, v, q_ref, v_ref, a_ref, outside))
            t, fresh, overrun, aim = _time(t), bool(fresh), bool(overrun), Reference(q_ref, v_ref, a_ref)
            action = at.take(config, state, t, fresh, overrun, q, v, q_ref, v_ref, a_ref, outside, record)
        return action, record, aim

    def _numbers(self, sample: Sample) -> Sample:
        """A sample of its own."""
        t, q, v = _time(sample.t), self._vector(sample.q), self._vector(sample.v)
        return sample._replace(t=t, q=q, v=v, fresh=bool(sample.fresh))

    def _shown(self, sample: Sample, record: np.ndarray, tau: JointArray) -> Seen:
        """What came in and went out, from what is kept of it."""
        q, v, *aim, outside, _, _ = (record[row] for row in self._rows)
        external = None if sample.external is None else outside
        return Seen(Sample(_time(sample.t), q, v, bool(sample.fresh), external, sample.fault), Reference(*aim), tau)

    def _vector(self, x: Any) -> JointArray:
        """A vector of its own; what is none of n numbers counts as not finite, which the guard judges."""
        vector = _floats(x)
        return vector if vector.shape == self._unknown.shape else self._unknown

    def _command(self, record: np.ndarray, aim: Reference) -> Any:
        if len(aim.a) != len(self._unknown):  # positions and velocities are looked at by the guard
            return self._unknown
        # From the record, which is the guard's own: the caller may write into its arrays while the law uses them.
        q, v, *aims = (record[row] for row in (self._ahead_q, self._ahead_v, *self._rows[at.AIM_Q : at.AIM_A + 1]))
        command, self._memory = self.law.step(self._memory, q, v, Reference(*aims), self.guard.period)
        return command

    def _holds(self, q: JointArray) -> bool:
        """Whether the law, at rest where it wants to be, carries the arm."""
        gravity, still = self._model.gravity(q), Reference(q, self._nothing, self._nothing)
        torque, _ = self.law.step(self.law.initial_memory(q), q, self._nothing, still, self.guard.period)
        tolerance = np.maximum(_OF_GRAVITY * np.abs(gravity).max(), _OF_EFFORT * self.guard.effort_limit)
        return bool((np.abs(torque - gravity) <= tolerance).all())

    def _reported(self, trace: str) -> FaultReport:
        code, samples = Fault(int(self.state[at.CODE])), tuple(self._shown(*kept) for kept in self._seen)
        sample = samples[-1].sample
        told = sample.fault if code is Fault.ARM else trace.strip().rsplit("\n", 1)[-1]
        if code is Fault.EXTERNAL and sample.external is not None:
            i = int(np.argmax(np.abs(sample.external) / self.guard.external_limit))
            pushed, unit = sample.external[i], units_of(self.robot.prismatic)[i].torque
            told = f"{self.robot.joint_names[i]}: {pushed:.3g} {unit}, limit {self.guard.external_limit[i]:.3g} {unit}"
        message = f"{code.sentence}{f' ({told})' if told else ''}"
        return FaultReport(code, float(self.state[at.AT]), message, trace, self.counters, samples)


def _floats(x: Any) -> np.ndarray:
    """A copy as an array of numbers; NaN for what is none, such as text or a list of lists of several lengths."""
    try:
        return np.array(x, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.array(np.nan)


def _time(x: Any) -> float:
    """A time as a number; NaN for what is none."""
    t = _floats(x)
    return float(t) if t.ndim == 0 else np.nan
