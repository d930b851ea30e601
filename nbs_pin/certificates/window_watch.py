"""Check of a closed loop whose state is read from encoders, one control instant after the other.

Torques are compared as means over a window: an admissible disturbance keeps its mean in the box whatever it does, and
readings tell the mean to within a bound that follows from the encoder step (docs/certificates.md §12).
"""

import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.assumptions import ROUNDING, in_which_time
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.encoders import Encoders, Limits
from nbs_pin.certificates.glance import BITS, Glance, bound, labels
from nbs_pin.certificates.loop_model import LoopModel
from nbs_pin.kernels import verdicts, watching as at

UNEXPLAINED = (Assumption.MODEL, Assumption.MEASUREMENT, Assumption.DISTURBANCE)
"""What a torque that the readings do not explain can come from."""
_UNEVEN = 1e-2  # share of a period by which instants may be off their raster


class WindowMemory(NamedTuple):
    """Memory of a `Watch` of encoder readings between instants."""

    began: float
    """Time of the first instant [s]."""
    t: float
    """Time of the last instant [s]."""
    initial: float
    """Upper bound of V at the first instant [J]."""
    proved: float
    """Bound of V that is proved for held torques from there [J]; inf if none is."""
    basis: str
    """What else a verdict has to say of the bounds from there."""
    first: float
    """Bound of V at the first instant [J]."""
    bounds: Float[np.ndarray, " errors"]
    """Bounds of ‖z1‖ and each |z1_i| at the first instant [rad]."""
    samples: Float[np.ndarray, "last 7 n"]
    """The last samples, three at most."""
    period: float = math.nan
    """Time between instants [s]; NaN before the second one."""
    half: int = 0
    """Half the length of the window [periods]."""
    history: Float[np.ndarray, "rows 8 n"] = np.empty((0, at.SIGNALS, 0))
    """Signals of the instants in the window and shortly before."""
    filled: int = 0
    """How many of them there are."""
    ratio: float = 1.0
    """Largest ratio of torque to bound so far."""
    broken: tuple[Assumption, ...] = ()
    """Assumptions that have failed so far."""
    compared: float = math.nan
    """Time of the last instant at which V and torques were compared [s]; NaN before the first."""
    has_gap: bool = False
    """Whether an instant was not finite or missing, so that what torques did then is not known."""


class WindowWatch:
    """The check, for one certificate and one kind of encoder."""

    def __init__(self, certificate: Certificate, encoders: Encoders) -> None:
        verdicts.compile_verdicts()
        self.certificate, self.encoders = certificate, encoders
        self.resolution = encoders.resolution(certificate)
        self.limits = Limits.of(certificate, self.resolution)
        self._names = certificate.joint_names
        self._labels = labels(certificate)
        self._reach = 0.5 * np.array([np.linalg.norm(self.resolution), *self.resolution])

    @cached_property
    def model(self) -> LoopModel:
        """Law and model."""
        return LoopModel.of(self.certificate.controller)

    def begin(self, t: float, sample: Float[np.ndarray, "7 n"]) -> tuple[Glance, WindowMemory]:
        """What the first instant shows, and the memory after it."""
        memory = WindowMemory(t, t, 0.0, math.inf, "", 0.0, np.zeros(0), sample[None])
        memory = self._promising(memory, sample, math.inf)
        return self._first(memory), memory

    def step(self, memory: WindowMemory, t: float, sample: Float[np.ndarray, "7 n"]) -> tuple[Glance, WindowMemory]:
        """What this instant shows, and the memory for the next one."""
        period = t - memory.t
        if not period > 0.0:
            raise ArgumentError(f"the instant t = {t} s is not after the last one, {memory.t} s; give them in order.")
        if not len(memory.samples):
            memory = memory._replace(t=t, samples=sample[None])
            if math.isnan(memory.period):  # how well the start is known takes two instants in a row
                memory = self._promising(memory._replace(began=t), sample, math.inf)
            return self._first(memory), memory
        z1 = np.empty(len(self.resolution))
        bits = verdicts.instant(memory.samples[-1], sample, z1, period, self.limits.rows)
        failed = tuple(name for bit, name in BITS.items() if bits & bit) if bits else ()
        memory, told = self._in_time(memory, period), None
        samples = np.concatenate([memory.samples[-2:], sample[None]])
        changes: dict[str, Any] = {"t": t, "samples": samples}
        if len(samples) == 3:
            history, filled = self._with(memory, self.model.observe(samples, memory.period))
            changes |= {"history": history, "filled": filled}
            if filled == len(history):
                told = self._window(memory, history)
                changes |= {"ratio": max(memory.ratio, told.ratio), "compared": t}
        memory = memory._replace(**changes)
        glance = self._glance(memory, z1, told, failed)
        if not set(memory.broken).issuperset(glance.failed):
            broken = tuple(name for name in Assumption if name in memory.broken or name in glance.failed)
            memory = memory._replace(broken=broken)
        return glance, memory

    def _first(self, memory: WindowMemory) -> Glance:
        """What an instant shows that none precedes."""
        dynamics, sample = self.certificate.controller.dynamics, memory.samples[-1]
        return self._glance(memory, np.asarray(dynamics.difference(sample[at.Q], sample[at.Q_REF])), None, ())

    def lost(self, memory: WindowMemory) -> WindowMemory:
        """The memory after an instant that is not finite: the window begins anew."""
        return memory._replace(samples=memory.samples[:0], filled=0, has_gap=True)

    def _promising(self, memory: WindowMemory, sample: Float[np.ndarray, "7 n"], period: float) -> WindowMemory:
        """The memory with the bounds from the state of a sample, whose velocity is differenced over `period` [s]."""
        e = self.certificate.controller.errors(sample[at.Q], *sample[at.V : at.A_REF + 1])
        mean = np.zeros((at.SIGNALS, sample.shape[1]))
        mean[at.Z1], mean[at.Z2] = e.z1, e.z2
        (phi, more, kinetic, slack), _ = self.model.centre(mean, sample[at.Q], self.resolution, period)
        initial = max(float(phi + more), 0.0) + (math.sqrt(kinetic) + math.sqrt(slack)) ** 2
        size, joints = self.certificate.from_start(initial)
        proved, basis = self.certificate.held_storage(initial), in_which_time(self.certificate, initial)
        first, bounds = bound(self.certificate, initial, proved, 0.0), np.array([size, *joints])
        return memory._replace(initial=initial, proved=proved, basis=basis, first=first, bounds=bounds)

    def _in_time(self, memory: WindowMemory, period: float) -> WindowMemory:
        """The memory with a window for this period [s]; it begins anew where instants are not evenly spaced."""
        if abs(period - memory.period) <= _UNEVEN * memory.period:
            return memory
        if math.isnan(memory.period):
            memory = self._promising(memory._replace(began=memory.t), memory.samples[-1], period)
        else:
            memory = memory._replace(has_gap=True)
        half = self.encoders.half_width(self.certificate, period)
        history = np.zeros((2 * half - 1 + at.LAGS, at.SIGNALS, len(self.resolution)))
        return memory._replace(samples=memory.samples[-1:], period=period, half=half, history=history, filled=0)

    @staticmethod
    def _with(memory: WindowMemory, signals: Float[np.ndarray, "8 n"]) -> tuple[Float[np.ndarray, "rows 8 n"], int]:
        """The history after an instant of those signals, and how much of it is filled."""
        history = np.empty_like(memory.history)
        history[:-1], history[-1] = memory.history[1:], signals
        return history, min(memory.filled + 1, len(history))

    def _window(self, memory: WindowMemory, history: Float[np.ndarray, "rows 8 n"]) -> "_Told":
        """What the window at the end of a history says."""
        half, h, n = memory.half, memory.period, len(self.resolution)
        mean, more, found = np.empty((at.SIGNALS, n)), np.empty((at.MORE, n)), np.empty(verdicts.WINDOW)
        at.average(history, half, mean, more)
        q = history[at.LAGS + half - 1, at.READING]
        centre, share = self.model.centre(mean, q, self.resolution, half * h)
        phi, phi_slack, kinetic, slack = centre.tolist()
        verdicts.judge_window(mean, history, more, share, h, half, q, *self.limits, found)
        moved = 2.0 * half * h * float(found[verdicts.MOVES])
        least = max(math.sqrt(kinetic) - math.sqrt(slack), 0.0) ** 2 / (1.0 + moved)
        failed = UNEXPLAINED if found[verdicts.EXCEEDS] else ()
        if found[verdicts.DELAY] or found[verdicts.LATE]:
            failed = (*failed, Assumption.TIME)
        if found[verdicts.RUBS]:
            failed = (*failed, Assumption.FRICTION)
        suspects = self._suspects(mean, more, found, 2.0 * half * h) if failed else ()
        return _Told(phi + kinetic, max(phi - phi_slack, 0.0) + least, float(found[verdicts.RATIO]), failed, suspects)

    def _suspects(self, mean: np.ndarray, more: np.ndarray, found: np.ndarray, length: float) -> tuple[str, ...]:
        """Simple faults each of which would explain the mean torque over a window of that length [s]."""
        moved = length * (mean[at.SPEED] - mean[at.Z2])  # what v_r asks for
        rest, room = more[at.SPREAD], self.limits.rows[verdicts.BOX]
        room = np.minimum(room, self.limits.numbers[verdicts.RADIUS]) + more[at.VARIED]
        still = more[at.FROZEN].astype(bool) & (np.abs(moved) > 4.0 * self.resolution)
        names = [f"readings of {self._names[i]} that do not change" for i in np.flatnonzero(still)]
        if found[verdicts.DELAY]:
            names.append(f"a torque that acts {found[verdicts.DELAY]:.0f} periods late")
        if found[verdicts.LATE]:
            names.append("commands that are not the law's of their instant")
        if found[verdicts.EXCEEDS] and np.count_nonzero(rest) == 1:
            i = int(np.flatnonzero(rest)[0])
            u, torque, is_clear = mean[at.U, i], mean[at.TORQUE, i], abs(mean[at.TORQUE, i]) > 2.0 * room[i]
            if is_clear and abs(u + 2.0 * torque) <= room[i]:
                names.append(f"a torque of {self._names[i]} with the wrong sign")
            if is_clear and abs(u + torque) <= room[i]:
                names.append(f"a torque of {self._names[i]} that does not act")
        return tuple(names)

    def _glance(
        self, memory: WindowMemory, z1: JointArray, told: "_Told | None", failed: tuple[Assumption, ...]
    ) -> Glance:
        certificate, t, start = self.certificate, memory.t - memory.began, (memory.initial, memory.proved)
        fallen = math.sqrt(bound(certificate, *start, t) / memory.first) if memory.first > 0.0 else 1.0
        errors, bounds, excesses = np.empty(len(z1) + 1), np.empty(len(z1) + 1), []
        if verdicts.judge_errors(z1, self._reach, memory.bounds, fallen, errors, bounds):
            over = errors - self._reach > bounds * (1.0 + ROUNDING)
            excesses = [self._labels[k + 1] for k in over.nonzero()[0].tolist()]
        promise = bound(certificate, *start, t - (0.0 if told is None else 2.0 * memory.half * memory.period))
        if told is not None and not told.least <= promise * (1.0 + ROUNDING):
            excesses.insert(0, "V")
        failed = failed if told is None else (*failed, *told.failed)
        is_wrong = False
        if excesses and told is not None and not (memory.has_gap or memory.broken or failed):
            largest = memory.initial * math.exp(-certificate.level.c * t) + memory.ratio**2 * certificate.storage
            is_wrong = told.least > max(largest, promise) or bool((errors - self._reach > memory.ratio * bounds).any())
        suspects = () if told is None else told.suspects
        storage = math.nan if told is None else told.storage
        return Glance(storage, promise, errors, bounds, tuple(excesses), is_wrong, UNEXPLAINED, failed, suspects)


class _Told(NamedTuple):
    """What a window says."""

    storage: float
    """V at the means [J]."""
    least: float
    """What V was at least at some instant of the window [J]."""
    ratio: float
    failed: tuple[Assumption, ...]
    suspects: tuple[str, ...]
