"""A certificate held against what happens: V beside its promise along a run or live, and which assumption failed."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.energy_balance import Balance, Instants, balance, beyond, storage_of
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.exceptions import ArgumentError
from nbs_pin.mismatch import Mismatch
from nbs_pin.state import Reference, Run

SATURATION = "no saturation"
DISTURBANCE = "disturbance within its bound"
MODEL = "exact model"
UNEXPLAINED = "disturbance and model error within the bound"
SAMPLING = "continuous time"
WRAP = "no error beyond ±π on a continuous joint"
ASSUMPTIONS = (SATURATION, DISTURBANCE, MODEL, UNEXPLAINED, SAMPLING, WRAP)
"""Names of the assumptions that a monitor can see fail; UNEXPLAINED where no disturbance is on record."""
WRONG = "the certificate is wrong"

_OF_BOUND, _OF_TORQUE = 1e-2, 1e-3  # torques below these shares are not told from the error of differences
_EPS = float(np.finfo(float).eps)
_ROUNDING, _DIFFERENCES = 1e-9, 1e-3  # of the promise: error of V itself, and of energies summed over periods


@dataclass(frozen=True, eq=False)
class Monitored:
    """V along one motion, what was promised of it, where it went, and which assumptions held."""

    t: Float[np.ndarray, " rows"]
    """Time [s]."""
    storage: Float[np.ndarray, " rows"]
    """V [J]."""
    promise: Float[np.ndarray, " rows"]
    """What V was not to exceed [J], from V(0)."""
    error: Float[np.ndarray, " rows"]
    """‖z1‖ [rad]."""
    error_bound: Float[np.ndarray, " rows"]
    """What ‖z1‖ was not to exceed [rad], from V(0); it falls as the promise does."""
    balance: Balance
    """V̇ and its terms between one row and the next, (rows − 1, …)."""
    saturated: Bool[np.ndarray, " periods"]
    """Whether the torque was cut between one row and the next."""
    exceeded: Bool[np.ndarray, " rows"]
    """Where V or ‖z1‖ is beyond what was promised."""
    failures: dict[str, Bool[np.ndarray, " periods"]]
    """The assumptions that failed, by name, and when."""
    is_wrong: bool
    """Whether a promise was broken that the failed assumptions do not account for."""

    @property
    def broken(self) -> tuple[str, ...]:
        """Names of the assumptions that failed."""
        return tuple(self.failures)

    @property
    def is_kept(self) -> bool:
        """Whether V and ‖z1‖ stayed within the promise."""
        return not bool(self.exceeded.any())

    @property
    def verdict(self) -> str:
        """One sentence: whether the promise was kept, and if not, which assumption failed or that none did."""
        named = [f"{name} (t = {self.t[:-1][when][0]:.4g} s)" for name, when in self.failures.items()]
        at = "" if self.is_kept else f" at t = {self.t[self.exceeded][0]:.4g} s"
        return _said(at, self.is_kept, self.is_wrong, named)


def monitor(
    run: Run,
    controller: NeuralBackstepping,
    certificate: Certificate,
    *,
    start: int = 0,
    mismatch: Mismatch | None = None,
) -> Monitored:
    """Holds a certificate against a run of the controller, simulated or logged.

    What the model leaves unexplained comes from differences of v, so noise in a log counts as disturbance. A promise is
    broken in earnest (`is_wrong`) when V exceeds it by more than the energy that torques beyond the admissible ones,
    of whatever cause, can have brought since the start. V and the model may be learned: M̂ is in both.

    start: which start of a batched run. mismatch: that of a certificate for a learned model; its bound on ‖δ‖ is
    granted beside the disturbance. Raises ArgumentError for a run of another number of joints, or of less than two
    rows.
    """
    starts = int(np.prod(run.q.shape[1:-1], dtype=int))
    if run.nv != controller.nv or len(run.t) < 2 or not 0 <= start < starts:
        raise ArgumentError(
            f"the run has {run.nv} joints, {len(run.t)} rows and {starts} starts, expected {controller.nv} joints, two "
            f"rows at least and the start {start}; give a run of this controller."
        )
    at = Instants.of(run).rows(start)
    storage, recorded = storage_of(controller, at), run.disturbance.reshape(len(run.t), starts, run.nv)[:, start]
    flow = balance(controller, at.rows(slice(-1)), at.rows(slice(1, None)), np.diff(storage))
    initial = float(storage[0])
    promise = np.asarray(certificate.storage_bound(at.t - at.t[0], initial))
    z1 = controller.dynamics.difference(at.q, at.q_ref)
    # Bounds of ‖z1‖ go with √Φ, and Φ ≤ V ≤ the promise; from V(0) = 0 there is a better one, the same at all times.
    fallen = np.sqrt(promise / promise[0]) if initial > 0.0 else np.ones(len(promise))
    size, bound = np.linalg.norm(z1, axis=-1), certificate.from_start(initial)[0] * fallen
    setting = _Setting.of(certificate, mismatch, flow, at)
    failures = _failures(flow, setting, _wraps(controller, z1), recorded)
    over = storage > promise * (1.0 + _ROUNDING) + _EPS * (1.0 + initial)
    outside = size > bound * (1.0 + _ROUNDING)
    power, ratio = _excess(flow, setting)
    # Bounds are proportional to the disturbance: torques that are s times the admissible ones have s times the bound.
    scale = np.maximum.accumulate(np.concatenate([[1.0], ratio])) * (1.0 + _DIFFERENCES)
    wrong = over & _unaccounted(storage, promise, power, np.diff(at.t), certificate.level.c)
    is_wrong = WRAP not in failures and bool((wrong | (outside & (size > scale * bound))).any())
    if (over | outside).any() and not failures and not is_wrong:
        failures = {_greatest(flow, certificate.admissible, recorded): power > 0.0}
    return Monitored(
        t=at.t,
        storage=storage,
        promise=promise,
        error=size,
        error_bound=bound,
        balance=flow,
        saturated=_is_cut(flow),
        exceeded=over | outside,
        failures=failures,
        is_wrong=is_wrong,
    )


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
        wraps = _wraps(self.controller, self.controller.dynamics.difference(both.q, both.q_ref))
        setting = _Setting.of(self.certificate, self.mismatch, flow, both)
        failed, power = _failures(flow, setting, wraps, None), float(_excess(flow, setting)[0][0])
        excess = _decayed(memory.excess, power, step, self.certificate.level.c)
        promise = float(self.certificate.storage_bound(np.array([t - memory.began]), memory.initial)[0])
        is_kept = storage <= promise * (1.0 + _ROUNDING) + _EPS * (1.0 + memory.initial)
        broken = tuple(name for name in ASSUMPTIONS if name in failed or name in memory.broken)
        is_wrong = storage > promise * (1.0 + _DIFFERENCES) + excess and WRAP not in broken
        if not is_kept and not is_wrong and not broken:
            broken = (_greatest(flow, setting.admissible, None),)
        return (
            Watched(storage, promise, is_kept, broken, flow, _said("", is_kept, is_wrong, broken)),
            WatchMemory(memory.began, memory.initial, now, storage, excess, broken),
        )


def _said(at: str, is_kept: bool, is_wrong: bool, broken: Sequence[str]) -> str:
    named = ", ".join(broken)
    if is_kept:
        return "promise kept" + (f", though an assumption failed: {named}" if named else "")
    if not is_wrong:
        return f"promise broken{at}; what failed of its assumptions: {named}"
    why = f"{named} failed and does not account for it" if named else "none of its assumptions failed"
    return f"promise broken{at}, {why}: {WRONG}"


class _Setting(NamedTuple):
    """What torques are held against."""

    admissible: Admissible
    granted: Float[np.ndarray, " periods"]
    """What a learned model's error may be [N·m]."""
    told: Float[np.ndarray, " periods"]
    """Torques below this are not told from the error of differences over a period [N·m]."""

    @classmethod
    def of(cls, certificate: Certificate, mismatch: Mismatch | None, flow: Balance, at: Instants) -> "_Setting":
        """Of the periods between those instants."""
        admissible, step = certificate.admissible, np.diff(at.t)
        size = float(np.linalg.norm(admissible.box)) if admissible.box is not None else admissible.radius or 0.0
        q, v = flow.state_norms[:, 0], flow.state_norms[:, 1]
        speed = np.linalg.norm(at.v, axis=-1)
        torque = np.linalg.norm(at.tau[:-1], axis=-1) + np.linalg.norm(flow.unexplained, axis=-1)
        fastest = np.maximum(speed[1:], speed[:-1])
        granted = np.zeros_like(q) if mismatch is None else mismatch.bound(q, v)
        return cls(admissible, granted, _OF_BOUND * size + (_OF_TORQUE + (step * fastest) ** 2) * torque)

    def beyond(self, torque: Float[np.ndarray, "periods n"]) -> Float[np.ndarray, " periods"]:
        """How far each torque is from what is admissible and granted [N·m]."""
        return np.asarray(np.linalg.norm(beyond(self.admissible, torque, self.granted), axis=-1))


def _failures(
    flow: Balance,
    setting: _Setting,
    wraps: Bool[np.ndarray, " periods"],
    recorded: Float[np.ndarray, "rows n"] | None,
) -> dict[str, Bool[np.ndarray, " periods"]]:
    """The assumptions that failed by more than can be told from the error of differences, and when."""
    told, admissible = setting.told, setting.admissible
    rest = beyond(admissible, flow.unexplained, setting.granted)
    unexplained = np.linalg.norm(rest, axis=-1) > told
    found = {SATURATION: _is_cut(flow), SAMPLING: setting.beyond(flow.unexplained - rest + flow.lag) > told}
    found[WRAP] = wraps
    if recorded is None or not recorded.any():
        found[UNEXPLAINED] = unexplained
    else:
        low, high = np.minimum(recorded[:-1], recorded[1:]), np.maximum(recorded[:-1], recorded[1:])
        other = np.linalg.norm(flow.unexplained - np.clip(flow.unexplained, low, high), axis=-1)
        found[MODEL] = unexplained & (other > told)
        found[DISTURBANCE] = (beyond(admissible, recorded[:-1] / (1.0 + _ROUNDING)) != 0.0).any(axis=-1)
    return {name: found[name] for name in ASSUMPTIONS if name in found and found[name].any()}


def _excess(flow: Balance, setting: _Setting) -> tuple[Float[np.ndarray, " periods"], Float[np.ndarray, " periods"]]:
    """What torques beyond the admissible ones can have done, whatever their cause: power [W], and times the bound.

    Torques count as greater than they seem by what cannot be told.
    """
    torque = flow.unexplained + flow.lag + flow.cut
    size = np.linalg.norm(torque, axis=-1)
    torque = torque * (1.0 + setting.told / np.where(size > 0.0, size, 1.0))[:, None]
    power = np.linalg.norm(flow.z2, axis=-1) * setting.beyond(torque)
    box, radius = setting.admissible.box, setting.admissible.radius
    torque = torque - beyond(setting.admissible, torque) + beyond(setting.admissible, torque, setting.granted)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.linalg.norm(torque, axis=-1) / radius if box is None else (np.abs(torque) / box).max(axis=-1)
    return power, np.maximum(np.where(np.isnan(ratio), np.inf, ratio), 1.0)


def _unaccounted(
    storage: np.ndarray, promise: np.ndarray, power: np.ndarray, steps: np.ndarray, decay: float
) -> Bool[np.ndarray, " rows"]:
    """Where V is further beyond the promise than that power accounts for: V̇ ≤ −c(V − V∞) + power."""
    energy = np.zeros(len(storage))
    for k, (more, step) in enumerate(zip(power.tolist(), steps.tolist(), strict=True)):
        energy[k + 1] = _decayed(float(energy[k]), more, step, decay)
    return np.asarray(storage > promise * (1.0 + _DIFFERENCES) + energy)


def _decayed(energy: float, power: float, step: float, decay: float) -> float:
    return energy * float(np.exp(-decay * step)) + power * step


def _greatest(flow: Balance, admissible: Admissible, recorded: Float[np.ndarray, "rows n"] | None) -> str:
    """Which of the small excesses, none told apart by itself, was the greatest."""
    unexplained = np.linalg.norm(beyond(admissible, flow.unexplained), axis=-1).max()
    if np.linalg.norm(flow.lag, axis=-1).max() >= unexplained:
        return SAMPLING
    return UNEXPLAINED if recorded is None or not recorded.any() else MODEL


def _is_cut(flow: Balance) -> Bool[np.ndarray, " periods"]:
    return np.asarray((flow.cut != 0.0).any(axis=-1))


def _wraps(controller: NeuralBackstepping, z1: Float[np.ndarray, "rows n"]) -> Bool[np.ndarray, " periods"]:
    """Whether an error jumped from one end of its turn to the other."""
    robot = controller.dynamics.robot
    if robot is None:
        return np.zeros(len(z1) - 1, dtype=bool)
    return np.asarray((np.abs(np.diff(z1, axis=0)) > np.pi)[:, robot.continuous].any(axis=-1))
