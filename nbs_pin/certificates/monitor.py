"""A certificate held against what happens: V beside its promise along a run, and which assumption failed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.certificates.assumptions import (
    DIFFERENCES,
    EPS,
    ROUNDING,
    WRAP,
    Setting,
    excess_of,
    failures,
    greatest,
    is_cut,
    sentence,
    unaccounted,
    wraps,
)
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.energy_balance import Balance, Instants, balance, storage_of
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.exceptions import ArgumentError
from nbs_pin.mismatch import Mismatch
from nbs_pin.state import Run


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
        return sentence(at, self.is_kept, self.is_wrong, named)


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
    setting = Setting.of(certificate, mismatch, flow, at)
    failed = failures(flow, setting, wraps(controller, z1), recorded)
    over = storage > promise * (1.0 + ROUNDING) + EPS * (1.0 + initial)
    outside = size > bound * (1.0 + ROUNDING)
    power, ratio = excess_of(flow, setting)
    # Bounds are proportional to the disturbance: torques that are s times the admissible ones have s times the bound.
    scale = np.maximum.accumulate(np.concatenate([[1.0], ratio])) * (1.0 + DIFFERENCES)
    wrong = over & unaccounted(storage, promise, power, np.diff(at.t), certificate.level.c)
    is_wrong = WRAP not in failed and bool((wrong | (outside & (size > scale * bound))).any())
    if (over | outside).any() and not failed and not is_wrong:
        failed = {greatest(flow, certificate.admissible, recorded): power > 0.0}
    return Monitored(
        t=at.t,
        storage=storage,
        promise=promise,
        error=size,
        error_bound=bound,
        balance=flow,
        saturated=is_cut(flow),
        exceeded=over | outside,
        failures=failed,
        is_wrong=is_wrong,
    )
