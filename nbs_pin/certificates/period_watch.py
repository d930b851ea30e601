"""Check of a closed loop whose state is known exactly, one control period after the other, as in a simulation."""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.assumptions import DIFFERENCES, EPS, ROUNDING, decayed, in_which_time, noticeable
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.encoders import Limits
from nbs_pin.certificates.energy_balance import Balance
from nbs_pin.certificates.glance import BITS, Glance, bound, labels
from nbs_pin.certificates.loop_model import LoopModel
from nbs_pin.kernels import periods, verdicts, watching as at


class WatchMemory(NamedTuple):
    """Memory of a `Watch` of exact states between instants."""

    began: float
    """Time of the first instant [s]."""
    t: float
    """Time of the last instant [s]."""
    initial: float
    """V at the first instant [J]."""
    proved: float
    """Bound of V that is proved for held torques from there [J]; inf if none is."""
    basis: str
    """What else a verdict has to say of the bounds from there."""
    bounds: Float[np.ndarray, " errors"]
    """Bounds of ‖z1‖ and each |z1_i| at the first instant [rad]."""
    widest: Float[np.ndarray, " errors"]
    """The same from the largest V that is promised [rad]."""
    last: Float[np.ndarray, "7 n"]
    """The last sample."""
    storage: float
    """V at the last instant [J]."""
    excess: float = 0.0
    """Energy that inadmissible torques can have supplied and that has not decayed [J]."""
    held: float = 0.0
    """Energy that holding the torque has supplied and that has not decayed [J]."""
    ratio: float = 1.0
    """Largest ratio of torque to bound so far, at least 1."""
    broken: tuple[Assumption, ...] = ()
    """Assumptions that have failed so far."""
    has_gap: bool = False
    """Whether an instant was not finite, so that what torques did then is not known."""
    is_lost: bool = False
    """Whether the last instant was."""


class PeriodWatch:
    """The check, for one certificate."""

    def __init__(self, certificate: Certificate) -> None:
        verdicts.compile_verdicts()
        periods.compile_judge()
        self.certificate = certificate
        self.limits = Limits.of(certificate, np.zeros(certificate.controller.nv))
        self._labels = labels(certificate)

    @cached_property
    def model(self) -> LoopModel:
        """Law and model."""
        return LoopModel.of(self.certificate.controller)

    def begin(self, t: float, sample: Float[np.ndarray, "7 n"]) -> tuple[Glance, WatchMemory]:
        """What the first instant shows, and the memory after it."""
        initial, certificate = self.model.storage(sample), self.certificate
        proved, basis = certificate.held_storage(initial), in_which_time(certificate, initial)
        largest = bound(certificate, initial, proved, 0.0) or 1.0
        (size, joints), (most, mosts) = certificate.from_start(initial), certificate.from_start(largest)
        bounds, widest = np.array([size, *joints]), np.array([most, *mosts])
        memory = WatchMemory(t, t, initial, proved, basis, bounds, widest, sample, initial)
        z1 = certificate.controller.dynamics.difference(sample[at.Q], sample[at.Q_REF])
        return self._glance(memory, np.asarray(z1), None, False), memory

    def step(self, memory: WatchMemory, t: float, sample: Float[np.ndarray, "7 n"]) -> tuple[Glance, WatchMemory]:
        """What this instant shows, and the memory for the next one."""
        h, before, n = t - memory.t, memory.last, sample.shape[1]
        if not h > 0.0:
            raise ArgumentError(f"the instant t = {t} s is not after the last one, {memory.t} s; give them in order.")
        z1, found = np.empty(n), np.empty(periods.FINDINGS)
        if memory.is_lost:  # torques are compared again from here on
            memory = memory._replace(t=t, last=sample, storage=self.model.storage(sample), is_lost=False)
            z1 = np.asarray(self.certificate.controller.dynamics.difference(sample[at.Q], sample[at.Q_REF]))
            return self._glance(memory, z1, None, False), memory
        bits = verdicts.instant(before, sample, z1, h, self.limits.rows)
        terms, vectors = self.model.period(before, sample, h, memory.storage)
        periods.judge_period(terms, vectors.copy(), before, sample, h, *self.limits, found)
        decay = self.certificate.level.c
        memory = memory._replace(
            t=t,
            last=sample,
            storage=float(terms[periods.STORAGE]),
            excess=decayed(memory.excess, float(found[periods.POWER]), h, decay),
            held=decayed(memory.held, float(terms[periods.HELD]), h, decay),
            ratio=max(memory.ratio, float(found[periods.EXCESS])),
        )
        glance = self._glance(memory, z1, _balance(terms, vectors), bool(found[periods.GREATEST_IS_LAG]))
        failed = {name for bit, name in BITS.items() if bits & bit}
        if found[periods.IS_UNEXPLAINED]:
            failed |= {Assumption.MODEL, Assumption.DISTURBANCE}
        is_held = memory.held > noticeable(self.certificate, h) * glance.promise
        if is_held or (glance.excesses and found[periods.IS_BEHIND]):
            failed.add(Assumption.TIME)
        broken = memory.broken
        if not failed.issubset(broken):
            broken = tuple(name for name in Assumption if name in broken or name in failed)
        return glance._replace(failed=tuple(failed)), memory._replace(broken=broken)

    def lost(self, memory: WatchMemory) -> WatchMemory:
        """The memory after an instant that is not finite."""
        return memory._replace(has_gap=True, is_lost=True)

    def _glance(
        self, memory: WatchMemory, z1: Float[np.ndarray, " n"], flow: Balance | None, lag_is_greatest: bool
    ) -> Glance:
        certificate, start = self.certificate, (memory.initial, memory.proved)
        largest, promise = bound(certificate, *start, 0.0), bound(certificate, *start, memory.t - memory.began)
        bounds = (math.sqrt(promise / largest) if largest > 0.0 else 1.0) * memory.bounds
        values = np.array([memory.storage, math.sqrt(z1 @ z1), *np.abs(z1)])
        promised = np.array([promise, *bounds])
        over = ~(values <= promised * (1.0 + ROUNDING) + EPS * (1.0 + memory.initial))
        excesses, is_wrong = tuple(self._labels[k] for k in over.nonzero()[0].tolist()), False
        if excesses:
            lifted = promise * (1.0 + DIFFERENCES) + memory.excess
            reached = math.sqrt(lifted / (largest or 1.0)) * memory.widest
            scaled = memory.ratio * bounds if math.isfinite(memory.ratio) else np.full(len(bounds), np.inf)
            accounted = np.array([lifted, *(np.minimum(reached, scaled) * (1.0 + DIFFERENCES))])
            is_wrong = not memory.has_gap and bool((over & (values > accounted)).any())
        cause = (Assumption.TIME,) if lag_is_greatest else (Assumption.MODEL, Assumption.DISTURBANCE)
        return Glance(
            storage=memory.storage,
            promise=promise,
            errors=values[1:],
            bounds=bounds,
            excesses=excesses,
            is_wrong=is_wrong,
            cause=() if flow is None else cause,
            balance=flow,
        )


def _balance(terms: Float[np.ndarray, " terms"], vectors: Float[np.ndarray, "4 n"]) -> Balance:
    """As rows of one period."""
    change, potential, damping, disturbance, held, saturation = terms[periods.CHANGE : periods.SIZE_Q, None]
    z2, unexplained, lag, cut = vectors[:, None]
    norms = terms[None, periods.SIZE_Q : periods.TERMS]
    return Balance(
        change, potential, damping, disturbance, held, saturation, z2, unexplained, lag, cut, state_norms=norms
    )
