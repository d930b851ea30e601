"""Check of a run against a certificate: V beside its bound, and the assumptions that failed."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.arguments import a, checked, count, maybe, writable
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import RUN, Run
from nbs_pin.base.shown import Shown
from nbs_pin.certificates.assumptions import (
    JUMPS,
    Promise,
    Setting,
    check_certificate,
    excess_of,
    failures,
    greatest,
    in_which_time,
    is_cut,
    jumps,
    listed,
    looks_like,
    not_finite,
    noticeable,
    quantities,
    sentence,
    stops,
    summed,
)
from nbs_pin.certificates.certificate import CERTIFICATE, Certificate
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.encoders import Encoders
from nbs_pin.certificates.energy_balance import Balance, LoopSamples, balance, storage_of
from nbs_pin.certificates.glance import Glance, labels
from nbs_pin.certificates.seen_torque import SeenTorque, seen_torque
from nbs_pin.certificates.window_watch import UNEXPLAINED, WindowWatch

COLUMNS = ("t", "V", "V_bound")
"""The first columns of what `Monitored.save` writes."""


@dataclass(frozen=True, eq=False, repr=False)
class Monitored(Shown):
    """V and the errors along one motion, their certified bounds, the terms of V̇, and the assumptions that failed.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, plant = nbs.NeuralBackstepping.for_robot(robot), nbs.DynamicsPlant.for_robot(robot)
        >>> run = nbs.simulate(plant, law, nbs.Sinusoid.for_robot(robot), 0.2, 0.001)
        >>> seen = nbs.monitor(run, nbs.certify(law, [5.0, 5.0]))
        >>> seen.verdict, seen.is_wrong
        ('promise kept', False)
    """

    t: Float[np.ndarray, " rows"]
    """Time [s]."""
    storage: Float[np.ndarray, " rows"]
    """V [J]."""
    promise: Float[np.ndarray, " rows"]
    """Bound of V, from V(0) [J]."""
    error: Float[np.ndarray, " rows"]
    """‖z1‖ [rad]."""
    error_bound: Float[np.ndarray, " rows"]
    """Bound of ‖z1‖, from V(0) [rad]; from V(0) > V∞ it decays with the bound of V."""
    joint_errors: Float[np.ndarray, "rows n"]
    """|z1_i| [rad]."""
    joint_bounds: Float[np.ndarray, "rows n"]
    """Bound of each |z1_i| [rad]."""
    joint_names: tuple[str, ...]
    balance: Balance
    """V̇ and its terms between consecutive rows, (rows − 1, …)."""
    saturated: Bool[np.ndarray, " periods"]
    """Whether the torque was saturated between consecutive rows."""
    excesses: dict[str, Bool[np.ndarray, " rows"]]
    """The exceeded bounds by name, "V", "‖z1‖" or "|z1| of JOINT", and when."""
    failures: dict[Assumption, Bool[np.ndarray, " periods"]]
    """The assumptions that failed, and when."""
    is_recorded: bool
    """Whether the run records a disturbance; without one, MODEL and DISTURBANCE cannot be distinguished."""
    is_wrong: bool
    """Whether a bound was exceeded by more than the failed assumptions account for."""
    compared: Bool[np.ndarray, " rows"]
    """When V and torques were compared with their bounds: from encoders, when a window of readings was full."""
    external: SeenTorque
    """The torque from outside as the momentum shows it, beside the declared disturbance; no part of the verdict."""
    suspects: tuple[str, ...] = ()
    """From encoders: simple faults each of which would explain the torques of the last window with any."""
    basis: str = ""
    """What else the verdict has to say of the bounds."""

    def _facts(self) -> Iterable[str]:
        return f"{len(self.t)} rows", self.verdict

    @checked(path=writable)
    def save(self, path: str | Path) -> Path:
        """Write times, V and its bound, and each joint's |z1| with its bound as a CSV file; returns its path."""
        joints = [f"{kind}_{name}" for kind in ("error", "bound") for name in self.joint_names]
        rows = np.column_stack([self.t, self.storage, self.promise, self.joint_errors, self.joint_bounds])
        return write_csv(Path(path), [*COLUMNS, *joints], rows.tolist())

    @cached_property
    def exceeded(self) -> Bool[np.ndarray, " rows"]:
        """Where V, ‖z1‖ or some |z1_i| exceeds its bound."""
        return np.logical_or.reduce(list(self.excesses.values()), axis=0) | np.zeros(len(self.t), dtype=bool)

    @property
    def broken(self) -> tuple[Assumption, ...]:
        """The assumptions that failed."""
        return tuple(self.failures)

    @property
    def is_kept(self) -> bool:
        """Whether V, ‖z1‖ and every |z1_i| stayed within their bounds; False if V was never compared with its own."""
        return not self.excesses and bool(self.compared.any())

    @property
    def blind(self) -> float:
        """For how long V and torques were not compared after the first time that they were [s]; inf if never."""
        if not self.compared.any():
            return np.inf
        first = int(np.argmax(self.compared))
        return float(np.diff(self.t)[first:][~self.compared[first + 1 :]].sum())

    @property
    def verdict(self) -> str:
        """One sentence: whether the bounds were kept, and which assumptions failed."""
        failed = {name: f" (t = {self.t[:-1][when][0]:.4g} s)" for name, when in self.failures.items()}
        exceeding, unseen = tuple(self.excesses), ""
        at = f" at t = {self.t[self.exceeded][0]:.4g} s by {listed(exceeding)}" if exceeding else ""
        if self.blind > 0.0:
            when = f"for {self.blind:.4g} s" if self.compared.any() else "at any time"
            unseen = f"V and torques were not compared {when}"
        said = sentence(at, not exceeding, self.is_wrong, failed, is_recorded=self.is_recorded, unseen=unseen)
        return said + looks_like(self.suspects) + self.basis


@checked(
    run=RUN,
    certificate=CERTIFICATE,
    start=count(0),
    encoders=maybe(a(Encoders, "Encoders, such as Encoders.of_bits(16)")),
)
def monitor(run: Run, certificate: Certificate, *, start: int = 0, encoders: Encoders | None = None) -> Monitored:
    """Check a run, simulated or logged, against a certificate of its controller.

    The torque that the model does not explain is found from differences of v, so noise counts as disturbance unless
    `encoders` states it. The certificate is called wrong (`is_wrong`) if V or an error exceeds its bound by more than
    the energy supplied by inadmissible torques, whatever their cause, accounts for. The hold of the torque is reported
    if it has supplied a noticeable share of the bound of V, or if a bound is exceeded. A number that is not finite, or
    beyond 1e30, breaks the promise.

    Args:
        run: A run of the certified controller.
        certificate: From `certify`.
        start: Which start of a batched run.
        encoders: How the positions in the run were measured; None for exact states, as `simulate` records them. The run
            is then checked as by a `Watch` with these encoders, by means over a window, whose errors follow from the
            encoder step (docs/certificates.md §12), and the recorded disturbance is not used.

    Raises:
        ArgumentError: If the run is of another arm or has less than two rows, or an argument has the wrong type.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> controller = nbs.NeuralBackstepping.for_robot(robot)
        >>> plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot))
        >>> run = nbs.simulate(plant, controller, nbs.Sinusoid.for_robot(robot), 0.2, 0.001)
        >>> nbs.monitor(run, nbs.certify(controller, [5.0, 5.0])).verdict
        'promise kept'
    """
    check_certificate(certificate)
    _check_run(run, certificate, start)
    at, recorded, lost, what = _without_gaps(run, start, certificate.joint_names)
    if encoders is not None:
        return _read(certificate, encoders, at, lost, what)
    return _exact(certificate, at, recorded, lost, what)


def _exact(
    certificate: Certificate,
    at: LoopSamples,
    recorded: Float[np.ndarray, "rows n"],
    lost: Bool[np.ndarray, " rows"],
    what: str,
) -> Monitored:
    """The check of exact states; `lost` are the rows with `what`, a number that is not finite."""
    controller = certificate.controller
    storage, z1 = storage_of(controller, at), controller.dynamics.difference(at.q, at.q_ref)
    flow = balance(controller, at.rows(slice(-1)), at.rows(slice(1, None)), np.diff(storage))
    promise, values = Promise(certificate, float(storage[0])), quantities(storage, z1)
    bounds = promise.bounds(at.t - at.t[0])
    over = promise.exceeded(values, bounds) & ~lost[:, None]
    setting, steps, decay = Setting.of(certificate, flow, at), np.diff(at.t), certificate.level.c
    held = summed(flow.held, steps, decay)[1:] > noticeable(certificate, steps) * bounds[1:, 0]
    jumped = jumps(controller, at) | stops(certificate, at)
    failed = _outside(failures(flow, setting, jumped, held, bool(over.any()), recorded), lost)
    power, ratio = excess_of(flow, setting)
    accounted = promise.accounted(bounds, summed(power, steps, decay), np.maximum.accumulate(np.append(1.0, ratio)))
    known = ~np.maximum.accumulate(lost)[:, None]  # a gap hides torques
    is_wrong = not any(name in failed for name in JUMPS) and bool((over & known & (values > accounted)).any())
    if over.any() and not failed and not is_wrong and not lost.any():
        failed = dict.fromkeys(greatest(flow, certificate.admissible, recorded), power > 0.0)
    return Monitored(
        t=at.t,
        storage=storage,
        promise=bounds[:, 0],
        error=values[:, 1],
        error_bound=bounds[:, 1],
        joint_errors=values[:, 2:],
        joint_bounds=bounds[:, 2:],
        joint_names=certificate.joint_names,
        balance=flow,
        saturated=is_cut(flow),
        excesses=_excesses(promise, over) | ({what: lost} if what else {}),
        failures=failed,
        is_recorded=bool(recorded.any()),
        is_wrong=is_wrong,
        compared=~lost,
        external=seen_torque(certificate, at, lost),
        basis=in_which_time(certificate, promise.initial),
    )


def _read(
    certificate: Certificate, encoders: Encoders, at: LoopSamples, lost: Bool[np.ndarray, " rows"], what: str
) -> Monitored:
    """The check of a run that was read from encoders; `lost` are the rows with `what`, a number that is not finite."""
    way, samples, memory = WindowWatch(certificate, encoders), np.stack(at[1:], axis=1), None
    rows, names, nothing = len(at.t), labels(certificate), np.full(certificate.controller.nv + 1, np.nan)
    seen: list[Glance] = []
    for k in range(rows):
        if lost[k]:
            memory = None if memory is None else way.lost(memory)
            seen.append(Glance(np.nan, np.nan, nothing, nothing, (what,), False))
            continue
        glance, memory = (
            way.begin(float(at.t[k]), samples[k]) if memory is None else way.step(memory, float(at.t[k]), samples[k])
        )
        seen.append(glance)
    flow = balance(certificate.controller, at.rows(slice(-1)), at.rows(slice(1, None)), np.zeros(rows - 1))
    failed = {name: np.array([name in x.failed for x in seen[1:]]) for name in Assumption}
    excesses = {name: np.array([name in x.excesses for x in seen]) for name in (*names, *([what] if what else []))}
    if any(x.excesses for x in seen) and not what and not any(when.any() for when in failed.values()):
        failed |= {name: np.array([bool(x.excesses) for x in seen[1:]]) for name in UNEXPLAINED}
    suspects = [x.suspects for x in seen if x.suspects]
    errors, bounds = (np.array([getattr(x, name) for x in seen]) for name in ("errors", "bounds"))
    return Monitored(
        t=at.t,
        storage=np.array([x.storage for x in seen]),
        promise=np.array([x.promise for x in seen]),
        error=errors[:, 0],
        error_bound=bounds[:, 0],
        joint_errors=errors[:, 1:],
        joint_bounds=bounds[:, 1:],
        joint_names=certificate.joint_names,
        balance=flow,
        saturated=is_cut(flow),
        excesses={name: when for name, when in excesses.items() if when.any()},
        failures={name: when for name, when in failed.items() if when.any()},
        is_recorded=False,
        is_wrong=any(x.is_wrong for x in seen),
        compared=np.array([np.isfinite(x.storage) for x in seen]),
        external=seen_torque(certificate, at, lost),
        basis="" if memory is None else memory.basis,
        suspects=suspects[-1] if suspects else (),
    )


def _outside(
    failed: dict[Assumption, Bool[np.ndarray, " periods"]], lost: Bool[np.ndarray, " rows"]
) -> dict[Assumption, Bool[np.ndarray, " periods"]]:
    """The failures in periods whose rows are both finite."""
    whole = ~(lost[1:] | lost[:-1])
    return {name: when & whole for name, when in failed.items() if (when & whole).any()}


def _excesses(promise: Promise, over: Bool[np.ndarray, "rows quantities"]) -> dict[str, Bool[np.ndarray, " rows"]]:
    return {name: over[:, k] for k, name in enumerate(promise.names) if over[:, k].any()}


def _without_gaps(
    run: Run, start: int, joint_names: tuple[str, ...]
) -> tuple[LoopSamples, Float[np.ndarray, "rows n"], Bool[np.ndarray, " rows"], str]:
    """The samples with rows that are not finite replaced by the last finite one, the disturbance, these rows, and why.

    Raises ArgumentError if no row is finite, or a time is not.
    """
    at, recorded = LoopSamples.of(run).rows(start), run.disturbance.reshape(len(run.t), -1, run.nv)[:, start]
    if not np.isfinite(at.t).all():
        raise ArgumentError("a time of the run is not finite; correct the times.")
    lost, what = not_finite(at, joint_names, recorded)
    if lost.all():
        raise ArgumentError("no row of the run is finite; give a run that did not diverge at once.")
    rows = np.arange(len(lost))
    last = np.maximum.accumulate(np.where(lost, -1, rows))
    last[last < 0] = int(np.argmin(lost))
    return at.rows(last)._replace(t=at.t), recorded[last], lost, what


def _check_run(run: Run, certificate: Certificate, start: int) -> None:
    if not isinstance(run, Run):
        raise ArgumentError(f"a {type(run).__name__} is not a Run; give what simulate returned or Run.load read.")
    if run.estimates is not None:
        raise ArgumentError(
            "the run is of a law that adapts, which no certificate is of; give it to transient_bound(…).check."
        )
    robot, nv = certificate.robot, certificate.controller.nv
    if robot is not None and run.robot_sha256 not in ("", robot.sha256):
        raise ArgumentError(
            f"the run is of the arm '{run.robot}' (sha256 {run.robot_sha256[:12]}…), the certificate of {robot.name} "
            f"({robot.sha256[:12]}…); give a run of that arm."
        )
    starts = int(np.prod(run.q.shape[1:-1], dtype=int))
    if run.nv != nv or len(run.t) < 2 or not 0 <= start < starts:
        raise ArgumentError(
            f"the run has {run.nv} joints, {len(run.t)} rows and {starts} starts, expected {nv} joints, at least "
            f"two rows and the start {start}; give a run of the certificate's controller."
        )
