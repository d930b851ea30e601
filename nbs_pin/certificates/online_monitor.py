"""Check of a closed loop against a certificate while it runs."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np

from nbs_pin.base.arguments import a, check_fields, maybe
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import floats, real, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import Shown
from nbs_pin.certificates.assumptions import JUMPS, LARGEST, check_certificate, listed, looks_like, not_finite, sentence
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.encoders import Encoders
from nbs_pin.certificates.energy_balance import Balance, LoopSamples
from nbs_pin.certificates.glance import Glance
from nbs_pin.certificates.period_watch import PeriodWatch, WatchMemory
from nbs_pin.certificates.window_watch import WindowMemory, WindowWatch

_ROWS = ("q", "v", "the reference's q", "the reference's v", "the reference's a", "tau", "tau_command")


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
    blind: float = 0.0
    """For how long V and torques have not been compared [s]: from encoders, until a window of readings is full."""

    @property
    def is_kept(self) -> bool:
        """Whether nothing that is compared now exceeds its bound; while `blind`, V and torques are not compared."""
        return not self.excesses


@dataclass(frozen=True, eq=False, repr=False)
class Watch(Shown):
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
        check_fields(self, encoders=maybe(a(Encoders, "Encoders, such as Encoders.of_bits(16)")))

    def _facts(self) -> Iterable[str]:
        return repr(self.certificate), "exact states" if self.encoders is None else repr(self.encoders)

    @cached_property
    def _way(self) -> PeriodWatch | WindowWatch:
        return PeriodWatch(self.certificate) if self.encoders is None else WindowWatch(self.certificate, self.encoders)

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

        The torque `tau` acts from t on [N·m]. A number that is not finite, or beyond 1e30, breaks the promise at this
        instant and is left out of the memory. Any number of threads may use one Watch, each loop with its own memory.
        Raises ArgumentError unless t is finite and after the previous instant.
        """
        instant = real(t)
        if instant is None or not abs(instant) <= LARGEST:
            raise ArgumentError(f"the instant is t = {told(t)} s, expected a finite time; give the time of the sample.")
        t, way = instant, cast(Any, self._way)
        if memory is not None and type(memory) is not (WindowMemory if self.encoders else WatchMemory):
            raise ArgumentError("the memory is that of a Watch of another kind; give the one that this Watch returned.")
        if not isinstance(reference, tuple) or len(reference) != len(Reference._fields):
            raise ArgumentError(f"the reference is {told(reference)}, expected a Reference of q, v and a; give one.")
        n = self.certificate.controller.nv
        rows = [floats(name, row) for name, row in zip(_ROWS, (q, v, *reference, tau, tau_command), strict=True)]
        if [row.shape for row in rows] != [(n,)] * len(rows):
            raise ArgumentError(
                f"the sample has rows of shapes {[row.shape for row in rows]}, expected ({n},) each: q, v, the "
                "reference's q, v and a, tau and tau_command; give one number per joint."
            )
        sample = np.concatenate(rows).reshape(len(rows), n)
        if not (np.vdot(sample, sample) <= LARGEST**2 or (np.abs(sample) <= LARGEST).all()):  # the first is faster
            _, what = not_finite(LoopSamples(np.zeros(1), *sample[:, None]), self.certificate.joint_names)
            return self._lost(memory, what, t), None if memory is None else way.lost(memory)
        glance, memory = way.begin(t, sample) if memory is None else way.step(memory, t, sample)
        return _said(glance, memory), memory

    def _lost(self, memory: WatchMemory | WindowMemory | None, what: str, t: float) -> Watched:
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
            blind=0.0 if memory is None else _blind(memory, t),
        )


def _blind(memory: WatchMemory | WindowMemory, t: float) -> float:
    """For how long V and torques have not been compared at time t [s]."""
    if isinstance(memory, WatchMemory):
        return 0.0
    return t - (memory.began if math.isnan(memory.compared) else memory.compared)


def _said(glance: Glance, memory: WatchMemory | WindowMemory) -> Watched:
    broken, blind = memory.broken, _blind(memory, memory.t)
    is_wrong = glance.is_wrong and not any(name in JUMPS for name in broken)
    if glance.excesses and not broken and not is_wrong:
        broken = glance.cause
    verdict = "promise kept"
    if glance.excesses or broken or math.isnan(glance.storage):
        unseen = f"V and torques have not been compared for {blind:.4g} s" if math.isnan(glance.storage) else ""
        at, failed = f" by {listed(glance.excesses)}", dict.fromkeys(broken, "")
        verdict = sentence(at, not glance.excesses, is_wrong, failed, is_recorded=False, unseen=unseen)
        verdict += looks_like(glance.suspects)
    verdict += memory.basis
    return Watched(
        storage=glance.storage,
        promise=glance.promise,
        error=float(glance.errors[0]),
        error_bound=float(glance.bounds[0]),
        joint_errors=glance.errors[1:],
        joint_bounds=glance.bounds[1:],
        excesses=glance.excesses,
        broken=broken,
        balance=glance.balance,
        verdict=verdict,
        suspects=glance.suspects,
        blind=blind,
    )
