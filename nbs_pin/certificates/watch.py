"""A certificate held against a loop while it runs."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float

from nbs_pin.certificates.assumptions import (
    ASSUMPTIONS,
    DIFFERENCES,
    EPS,
    ROUNDING,
    WRAP,
    Setting,
    decayed,
    excess_of,
    failures,
    greatest,
    sentence,
    wraps,
)
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.energy_balance import Balance, Instants, balance, storage_of
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.exceptions import ArgumentError
from nbs_pin.mismatch import Mismatch
from nbs_pin.state import Reference


class WatchMemory(NamedTuple):
    """What a `Watch` remembers from one instant to the next."""

    began: float
    """Time of the first instant [s]."""
    initial: float
    """V at that time [J]."""
    last: Instants
    """The instant before."""
    storage: float
    """V then [J]."""
    excess: float
    """Energy that torques beyond the admissible ones can have brought and that has not decayed [J]."""
    broken: tuple[str, ...]
    """Assumptions that have failed so far."""


class Watched(NamedTuple):
    """What a `Watch` says at one instant."""

    storage: float
    """V [J]."""
    promise: float
    """What V is not to exceed [J]."""
    is_kept: bool
    """Whether it does not, now."""
    broken: tuple[str, ...]
    """Assumptions that have failed so far."""
    balance: Balance | None
    """V̇ and its terms over the last period; None at the first instant."""
    verdict: str
    """One sentence."""


@dataclass(frozen=True, eq=False)
class Watch:
    """A certificate held against a loop while it runs, one instant after the other; its memory is the caller's.

    mismatch: as in `monitor`. Of a live arm no disturbance is on record: all that is unexplained counts as one.
    """

    controller: NeuralBackstepping
    certificate: Certificate
    mismatch: Mismatch | None = None

    @cached_property
    def _law(self) -> MemorylessController:
        return cast(MemorylessController, self.controller.compile())

    def step(
        self,
        memory: WatchMemory | None,
        t: float,
        q: Float[np.ndarray, " n"],
        v: Float[np.ndarray, " n"],
        reference: Reference,
        tau: Float[np.ndarray, " n"],
        tau_command: Float[np.ndarray, " n"],
    ) -> tuple[Watched, WatchMemory]:
        """What is to be said at time t [s], and what to remember; memory is None at first, tau acts from t on [N·m].

        Raises ArgumentError for an instant that is not after the last one.
        """
        now = Instants(np.array(t), q, v, reference.q, reference.v, reference.a, tau, tau_command)
        storage = float(storage_of(self.controller, now))
        if memory is None:
            said = Watched(storage, max(storage, self.certificate.storage), True, (), None, "promise kept")
            return said, WatchMemory(t, storage, now, storage, 0.0, ())
        step = t - float(memory.last.t)
        if not step > 0.0:
            raise ArgumentError(f"the instant t = {t} s is not after the last, {memory.last.t} s; give them in order.")
        both = Instants(*(np.stack([a, b]) for a, b in zip(memory.last, now, strict=True)))
        change = np.array([storage - memory.storage])
        flow = balance(self.controller, both.rows(slice(1)), both.rows(slice(1, None)), change, self._law)
        wrapped = wraps(self.controller, self.controller.dynamics.difference(both.q, both.q_ref))
        setting = Setting.of(self.certificate, self.mismatch, flow, both)
        failed, power = failures(flow, setting, wrapped, None), float(excess_of(flow, setting)[0][0])
        excess = decayed(memory.excess, power, step, self.certificate.level.c)
        promise = float(self.certificate.storage_bound(np.array([t - memory.began]), memory.initial)[0])
        is_kept = storage <= promise * (1.0 + ROUNDING) + EPS * (1.0 + memory.initial)
        broken = tuple(name for name in ASSUMPTIONS if name in failed or name in memory.broken)
        is_wrong = storage > promise * (1.0 + DIFFERENCES) + excess and WRAP not in broken
        if not is_kept and not is_wrong and not broken:
            broken = (greatest(flow, setting.admissible, None),)
        return (
            Watched(storage, promise, is_kept, broken, flow, sentence("", is_kept, is_wrong, broken)),
            WatchMemory(memory.began, memory.initial, now, storage, excess, broken),
        )
