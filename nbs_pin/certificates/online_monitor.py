"""Check of a closed loop against a certificate while it runs."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.certificates.assumptions import (
    JUMPS,
    Promise,
    Setting,
    check_certificate,
    decayed,
    excess_of,
    failures,
    greatest,
    jumps,
    listed,
    not_finite,
    noticeable,
    quantities,
    sentence,
)
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.encoders import Encoders
from nbs_pin.certificates.energy_balance import Balance, LoopSamples, balance, storage_of
from nbs_pin.certificates.window_watch import UNEXPLAINED, Glance, WindowMemory, WindowWatch
from nbs_pin.controllers.controller import MemorylessController


class WatchMemory(NamedTuple):
    """Memory of a `Watch` between instants."""

    began: float
    """Time of the first instant [s]."""
    initial: float
    """V at the first instant [J]."""
    last: LoopSamples
    """The previous instant."""
    storage: float
    """V at the previous instant [J]."""
    excess: float
    """Energy that inadmissible torques can have supplied and that has not decayed [J]."""
    held: float
    """Energy that holding the torque has supplied and that has not decayed [J]."""
    ratio: float
    """Largest ratio of torque to bound so far, at least 1."""
    broken: tuple[Assumption, ...]
    """Assumptions that have failed so far."""
    has_gap: bool = False
    """Whether an instant was not finite, so that what torques did since the last one is not known."""


class Watched(NamedTuple):
    """Result of a `Watch` at one instant."""

    storage: float
    """V [J]."""
    promise: float
    """Bound of V [J]."""
    error: float
    """‖z1‖ [rad]."""
    error_bound: float
    """Bound of ‖z1‖ [rad]."""
    joint_errors: JointArray
    """|z1_i| [rad]."""
    joint_bounds: JointArray
    """Bound of each |z1_i| [rad]."""
    excesses: tuple[str, ...]
    """The bounds exceeded now: "V", "‖z1‖" or "|z1| of JOINT"."""
    broken: tuple[Assumption, ...]
    """Assumptions that have failed so far."""
    balance: Balance | None
    """V̇ and its terms over the last period; None at the first instant."""
    verdict: str
    """One sentence, as in `Monitored`."""
    suspects: tuple[str, ...] = ()
    """From encoders: simple faults each of which would explain the torques of the last window."""

    @property
    def is_kept(self) -> bool:
        """Whether V, ‖z1‖ and every |z1_i| are within their bounds now."""
        return not self.excesses


class _Seen(NamedTuple):
    """V, ‖z1‖ and each |z1_i| at one instant, and their bounds."""

    values: Float[np.ndarray, " quantities"]
    bounds: Float[np.ndarray, " quantities"]
    over: Bool[np.ndarray, " quantities"]
    is_unaccounted: bool
    """Whether one exceeds what inadmissible torques can have done."""


@dataclass(frozen=True, eq=False)
class Watch:
    """Check of a closed loop against a certificate while it runs, one control instant after the other.

    The caller keeps the memory. As a live arm records no disturbance, an unexplained torque is attributed to both model
    and disturbance. Raises ArgumentError unless `certificate` is a `Certificate`.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> controller, aim = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)(0.0)
        >>> watch = nbs.Watch(nbs.certify(controller, [5.0, 5.0]))
        >>> tau = controller.torque(aim.q, aim.v, *aim)
        >>> seen, memory = watch.step(None, 0.0, aim.q, aim.v, aim, tau, tau)
        >>> seen.verdict
        'promise kept'
    """

    certificate: Certificate
    encoders: Encoders | None = None
    """How positions are measured; None for exact states, as a simulation has them."""

    def __post_init__(self) -> None:
        check_certificate(self.certificate)

    @cached_property
    def _law(self) -> MemorylessController:
        return cast(MemorylessController, self.certificate.controller.compile())

    def step(
        self,
        memory: WatchMemory | WindowMemory | None,
        t: float,
        q: JointArray,
        v: JointArray,
        reference: Reference,
        tau: JointArray,
        tau_command: JointArray,
    ) -> tuple[Watched, WatchMemory | WindowMemory | None]:
        """The result at time t [s], and the memory for the next step; `memory` is None at first.

        The torque `tau` acts from t on [N·m]. A number that is not finite breaks the promise at this instant and is
        left out of the memory. Raises ArgumentError unless t is finite and after the previous instant.
        """
        if not math.isfinite(t):
            raise ArgumentError(f"the instant is t = {t} s, expected a finite time; give the time of the sample.")
        sample = np.array([q, v, *reference, tau, tau_command], dtype=float)
        if self.encoders is not None or isinstance(memory, WindowMemory):
            return self._through_window(memory, t, sample)
        what = self._what_is_lost(sample)
        if what:
            return self._lost(memory, what), None if memory is None else memory._replace(has_gap=True)
        now = LoopSamples(np.array(t), *sample)
        storage = float(storage_of(self.certificate.controller, now))
        if memory is None:
            memory = WatchMemory(t, storage, now, storage, 0.0, 0.0, 1.0, ())
            return self._said(memory, None, self._seen(memory)), memory
        step = t - float(memory.last.t)
        if not step > 0.0:
            raise ArgumentError(
                f"the instant t = {t} s is not after the last one, {memory.last.t} s; give them in order."
            )
        both = LoopSamples(*(np.stack([a, b]) for a, b in zip(memory.last, now, strict=True)))
        change = np.array([storage - memory.storage])
        flow = balance(self.certificate.controller, both.rows(slice(1)), both.rows(slice(1, None)), change, self._law)
        setting, decay = Setting.of(self.certificate, flow, both), self.certificate.level.c
        power, ratio = (float(x[0]) for x in excess_of(flow, setting))
        memory = memory._replace(
            last=now,
            storage=storage,
            excess=decayed(memory.excess, power, step, decay),
            held=decayed(memory.held, float(flow.held[0]), step, decay),
            ratio=max(memory.ratio, ratio),
        )
        seen = self._seen(memory)
        memory = memory._replace(broken=self._broken(memory, flow, setting, both, seen))
        return self._said(memory, flow, seen), memory

    @cached_property
    def _windows(self) -> WindowWatch:
        return WindowWatch(self.certificate, self.encoders or Encoders(0.0))

    def _through_window(
        self, memory: WatchMemory | WindowMemory | None, t: float, sample: Float[np.ndarray, "7 n"]
    ) -> tuple[Watched, WatchMemory | WindowMemory | None]:
        """The result for readings of encoders."""
        if isinstance(memory, WatchMemory) or (memory is not None and self.encoders is None):
            raise ArgumentError("the memory is that of a Watch of another kind; give the one that this Watch returned.")
        what = self._what_is_lost(sample)
        if what:
            return self._lost(memory, what), None if memory is None else self._windows.lost(memory)
        if memory is None:
            memory = self._windows.begin(t, sample)
            glance = self._windows.first(memory)
        else:
            glance, memory = self._windows.step(memory, t, sample)
        return self._glanced(glance, memory.broken), memory

    def _glanced(self, glance: Glance, broken: tuple[Assumption, ...]) -> Watched:
        if glance.excesses and not broken and not glance.is_wrong:
            broken = UNEXPLAINED
        verdict = "promise kept"
        if glance.excesses or broken:
            at, failed = f" by {listed(glance.excesses)}", dict.fromkeys(broken, "")
            verdict = sentence(at, not glance.excesses, glance.is_wrong, failed, is_recorded=False)
            verdict += f"; this looks like {' or '.join(glance.suspects)}" if glance.suspects else ""
        return Watched(
            storage=glance.storage,
            promise=glance.promise,
            error=float(glance.errors[0]),
            error_bound=float(glance.bounds[0]),
            joint_errors=glance.errors[1:],
            joint_bounds=glance.bounds[1:],
            excesses=glance.excesses,
            broken=broken,
            balance=None,
            verdict=verdict,
            suspects=glance.suspects,
        )

    def _what_is_lost(self, sample: Float[np.ndarray, "7 n"]) -> str:
        """A name for the first number that is not finite, empty if there is none."""
        if np.isfinite(sample).all():
            return ""
        return not_finite(LoopSamples(np.zeros(1), *sample[:, None]), self.certificate.joint_names)[1]

    def _lost(self, memory: WatchMemory | WindowMemory | None, what: str) -> Watched:
        """The result at an instant with a number that is not finite."""
        nothing, n = math.nan, self.certificate.controller.nv
        broken = () if memory is None else memory.broken
        return Watched(
            storage=nothing,
            promise=nothing,
            error=nothing,
            error_bound=nothing,
            joint_errors=np.full(n, nothing),
            joint_bounds=np.full(n, nothing),
            excesses=(what,),
            broken=broken,
            balance=None,
            verdict=sentence(f" by {what}", False, False, dict.fromkeys(broken, ""), is_recorded=False),
        )

    def _seen(self, memory: WatchMemory) -> _Seen:
        """The last instant of the memory, with its bounds."""
        dynamics, now, promise = self.certificate.controller.dynamics, memory.last, self._promise(memory)
        values = quantities(np.array([memory.storage]), dynamics.difference(now.q, now.q_ref)[None])
        bounds = promise.bounds(np.array([float(now.t) - memory.began]))
        over = promise.exceeded(values, bounds)
        accounted = promise.accounted(bounds, np.array([memory.excess]), np.array([memory.ratio]))
        is_unaccounted = not memory.has_gap and bool((over & (values > accounted)).any())
        return _Seen(values[0], bounds[0], over[0], is_unaccounted)

    def _broken(
        self, memory: WatchMemory, flow: Balance, setting: Setting, both: LoopSamples, seen: _Seen
    ) -> tuple[Assumption, ...]:
        """The assumptions that have failed, including the last period."""
        controller = self.certificate.controller
        held = memory.held > noticeable(self.certificate, np.diff(both.t)) * seen.bounds[0]
        failed = failures(flow, setting, jumps(controller, both), held, bool(seen.over.any()), None)
        return tuple(name for name in Assumption if name in failed or name in memory.broken)

    def _said(self, memory: WatchMemory, flow: Balance | None, seen: _Seen) -> Watched:
        names = zip(self._promise(memory).names, seen.over.tolist(), strict=True)
        excesses = tuple(name for name, is_over in names if is_over)
        is_wrong = seen.is_unaccounted and not any(name in memory.broken for name in JUMPS)
        broken = memory.broken
        if excesses and flow is not None and not broken and not is_wrong:
            broken = greatest(flow, self.certificate.admissible, None)
        at, failed = f" by {listed(excesses)}", dict.fromkeys(broken, "")
        return Watched(
            storage=memory.storage,
            promise=float(seen.bounds[0]),
            error=float(seen.values[1]),
            error_bound=float(seen.bounds[1]),
            joint_errors=seen.values[2:],
            joint_bounds=seen.bounds[2:],
            excesses=excesses,
            broken=broken,
            balance=flow,
            verdict=sentence(at, not excesses, is_wrong, failed, is_recorded=False),
        )

    def _promise(self, memory: WatchMemory) -> Promise:
        return Promise(self.certificate, memory.initial)
