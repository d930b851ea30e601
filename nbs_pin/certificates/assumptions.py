"""Bounds along a motion, and the assumptions of its certificate that the motion violates.

Admissible torques give V̇ ≤ −c(V − V∞). Hence only inadmissible torques, whatever their cause, can lift V above its
bound, and by no more than the energy that they have supplied, less what has decayed since.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.energy_balance import Balance, LoopSamples, beyond
from nbs_pin.certificates.sampled_motion import unexplained_steps
from nbs_pin.controllers.lyapunov_law import LyapunovLaw

WRONG = "the certificate is wrong"
"""The verdict if no violated assumption accounts for an exceeded bound."""
LARGEST = 1e30
"""Largest size of a sample: products of larger ones overflow."""
ROUNDING, DIFFERENCES = 1e-9, 1e-3
"""Relative tolerances of a bound: for V itself, and for energies summed over periods."""
EPS = float(np.finfo(float).eps)
"""Absolute one of V and of errors, per unit of 1 + V(0)."""
_NOTICEABLE = 0.01
_MOST = 0.4  # above this h(ω + ν) a period is no longer sound
_OF_BOUND, _OF_TORQUE = 1e-2, 1e-3  # smaller torques are within the error of finite differences


def check_certificate(certificate: Any) -> None:
    """Raises ArgumentError unless it is a `Certificate`."""
    if not isinstance(certificate, Certificate):
        raise ArgumentError(
            f"certificate is a {type(certificate).__name__}; give the certificate that certify made (for an "
            "AdaptiveLaw there is transient_bound)."
        )
    if certificate.bodies is not None:
        raise ArgumentError(
            "a run is checked by its balance of power, which needs exact bodies; give one without uncertainty."
        )


def sentence(
    at: str, is_kept: bool, is_wrong: bool, failed: Mapping[Assumption, str], *, is_recorded: bool, unseen: str = ""
) -> str:
    """The verdict. at: the exceeded bounds and the time. failed: the violated assumptions with their times.

    is_recorded: whether the disturbance is recorded, so that it can be distinguished from a model error; from readings
    of encoders neither can be told from a false measurement. unseen: what was not compared with its bound, and when.
    """
    said = {name: name + when for name, when in failed.items()}
    if not is_recorded and Assumption.MODEL in said and Assumption.DISTURBANCE in said:
        like = [said.pop(name) for name in (Assumption.MEASUREMENT, Assumption.DISTURBANCE) if name in said]
        said[Assumption.MODEL] = ", or ".join([Assumption.MODEL, *like])
    named = "; ".join(said.values())
    if is_kept:
        kept = f"no bound was exceeded, but {unseen}" if unseen else "promise kept"
        return kept + (f"{';' if unseen else ', though'} assumptions failed: {named}" if named else "")
    if not is_wrong:
        return f"promise broken{at}" + (f"; assumptions that failed: {named}" if named else "")
    why = f"for which the failed assumptions do not account ({named})" if named else "though no assumption failed"
    return f"promise broken{at}, {why}: {WRONG}"


def looks_like(suspects: Sequence[str]) -> str:
    """The end of a verdict that names simple faults, each of which would explain the torques."""
    return f"; this looks like {' or '.join(suspects)}" if suspects else ""


def in_which_time(certificate: Certificate, initial: float) -> str:
    """The end of a verdict by bounds of continuous time, where a start with V(0) = `initial` [J] has no others."""
    if not certificate.is_continuous_from(initial):
        return ""
    from_here = f"; from V(0) = {initial:.3g} J nothing is proved for held torques"
    return f"{from_here}, and the bounds are those of continuous time"


def listed(excesses: Sequence[str]) -> str:
    """The names of the exceeded bounds, at most three."""
    return ", ".join(excesses[:3]) + (" and others" if len(excesses) > 3 else "")


class Promise(NamedTuple):
    """A certificate's bounds of V, ‖z1‖ and each |z1_i|, the 2 + n quantities, from a start."""

    certificate: Certificate
    initial: float
    """V(0) [J]."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities."""
        return ("V", "‖z1‖", *(f"|z1| of {name}" for name in self.certificate.joint_names))

    def bounds(self, t: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "rows quantities"]:
        """The bounds, t [s] after the start [J, rad].

        Bounds of z1 are proportional to √Φ, and Φ ≤ V: from V(0) > V∞ they decay as the root of the bound of V.
        """
        storage, first = self.certificate.storage_bound(t, self.initial), self._largest
        fallen = np.sqrt(storage / first) if first > 0.0 else np.ones(len(t))
        size, joints = self.certificate.from_start(self.initial)
        return np.column_stack([storage, np.outer(fallen, [size, *joints])])

    def exceeded(
        self, values: Float[np.ndarray, "rows quantities"], bounds: Float[np.ndarray, "rows quantities"]
    ) -> Bool[np.ndarray, "rows quantities"]:
        """Where a bound is exceeded by more than rounding errors, or a value is no number."""
        return np.asarray(~(values <= bounds * (1.0 + ROUNDING) + EPS * (1.0 + self.initial)))

    def accounted(
        self,
        bounds: Float[np.ndarray, "rows quantities"],
        energy: Float[np.ndarray, " rows"],
        ratio: Float[np.ndarray, " rows"],
    ) -> Float[np.ndarray, "rows quantities"]:
        """The largest values that are possible after inadmissible torques have supplied that energy [J].

        ratio: the largest ratio of torque to bound so far, ≥ 1, inf if a bound is 0. The bounds of z1 are proportional
        to the disturbance, so they grow at most by this factor, and at most as the root of V does.
        """
        storage, top = bounds[:, 0] * (1.0 + DIFFERENCES) + energy, self._largest or 1.0
        size, joints = self.certificate.from_start(top)
        from_storage = np.outer(np.sqrt(storage / top), [size, *joints])
        scaled = np.full_like(from_storage, np.inf)
        np.multiply(ratio[:, None], bounds[:, 1:], out=scaled, where=np.isfinite(ratio)[:, None])
        return np.column_stack([storage, np.minimum(from_storage, scaled) * (1.0 + DIFFERENCES)])

    @property
    def _largest(self) -> float:
        """The largest value that V can take [J]."""
        return float(self.certificate.storage_bound(np.zeros(1), self.initial)[0])


def quantities(
    storage: Float[np.ndarray, " rows"], z1: Float[np.ndarray, "rows n"]
) -> Float[np.ndarray, "rows quantities"]:
    """V [J], ‖z1‖ and each |z1_i| [rad]."""
    return np.column_stack([storage, np.linalg.norm(z1, axis=-1), np.abs(z1)])


def not_finite(
    at: LoopSamples, joint_names: Sequence[str], recorded: Float[np.ndarray, "rows n"] | None = None
) -> tuple[Bool[np.ndarray, " rows"], str]:
    """Which rows hold a number that is not finite or beyond `LARGEST`, and a name for the first; empty if none does."""
    named = [("q", at.q), ("v", at.v), ("q_d", at.q_ref), ("v_d", at.v_ref), ("a_d", at.a_ref)]
    named += [("the torque", at.tau), ("the command", at.tau_command)]
    named += [] if recorded is None else [("the recorded disturbance", recorded)]
    numbers = np.stack([x for _, x in named])
    bad = ~(np.abs(numbers) <= LARGEST)
    rows = bad.any(axis=(0, 2))
    if not rows.any():
        return rows, ""
    row = int(rows.argmax())
    which, joint = np.argwhere(bad[:, row])[0]
    value = float(numbers[which, row, joint])
    why = f"is {value:.3g}, too large for any arm" if math.isfinite(value) else "is not finite"
    return rows, f"{named[which][0]} of {joint_names[joint]}, which {why}"


def noticeable(certificate: Certificate, step: Float[np.ndarray, "*periods"] | float) -> Float[np.ndarray, "*periods"]:
    """Share of the bound of V that holding the torque may supply over periods [s] before it is reported.

    A held torque lags by a share h(ω + ν) of the fastest decay of z2, which at a sound period is no fault of the loop.
    """
    k = certificate.comparison
    expected = step * (k.omega + k.nu) if math.isfinite(k.nu) else 0.0 * step
    return np.asarray(np.where(expected <= _MOST, np.maximum(expected, _NOTICEABLE), _NOTICEABLE))


class Setting(NamedTuple):
    """The limits that torques are compared with."""

    admissible: Admissible
    granted: Float[np.ndarray, " periods"]
    """Allowance for the error of a learned model [N·m]."""
    told: Float[np.ndarray, " periods"]
    """Torques below this are within the error of finite differences over a period [N·m]."""

    @classmethod
    def of(cls, certificate: Certificate, flow: Balance, at: LoopSamples) -> "Setting":
        """The limits in the periods between those instants."""
        admissible, mismatch, step = certificate.admissible, certificate.mismatch, np.diff(at.t)
        size = float(np.linalg.norm(admissible.box)) if admissible.box is not None else admissible.radius or 0.0
        q, v = flow.state_norms[:, 0], flow.state_norms[:, 1]
        speed = np.linalg.norm(at.v, axis=-1)
        torque = np.linalg.norm(at.tau[:-1], axis=-1) + np.linalg.norm(flow.unexplained, axis=-1)
        fastest = np.maximum(speed[1:], speed[:-1])
        granted = np.linalg.norm(certificate.friction.gap.torque(0.5 * (at.v[1:] + at.v[:-1])), axis=-1)
        granted = granted if mismatch is None else granted + mismatch.bound(q, v)
        return cls(admissible, granted, _OF_BOUND * size + (_OF_TORQUE + (step * fastest) ** 2) * torque)

    def beyond(self, torque: Float[np.ndarray, "periods n"]) -> Float[np.ndarray, " periods"]:
        """Distance of each torque from the admissible set and the allowance [N·m]."""
        return np.asarray(np.linalg.norm(beyond(self.admissible, torque, self.granted), axis=-1))


def failures(
    flow: Balance,
    setting: Setting,
    jumped: Mapping[Assumption, Bool[np.ndarray, " periods"]],
    held: Bool[np.ndarray, " periods"],
    is_broken: bool,
    recorded: Float[np.ndarray, "rows n"] | None,
) -> dict[Assumption, Bool[np.ndarray, " periods"]]:
    """The assumptions that were violated by more than the error of finite differences, and when.

    jumped: from `jumps`. held: when the energy supplied by holding the torque is worth reporting; if a bound
    `is_broken`, any of it is. recorded: the recorded disturbance [N·m]; if it is None or zero, an unexplained torque
    is attributed to both model and disturbance, which cannot be distinguished.
    """
    told, admissible = setting.told, setting.admissible
    rest = beyond(admissible, flow.unexplained, setting.granted)
    unexplained = np.linalg.norm(rest, axis=-1) > told
    found = {Assumption.EFFORT: is_cut(flow), **jumped}
    found[Assumption.TIME] = held | (is_broken & (setting.beyond(flow.unexplained - rest + flow.lag) > told))
    if recorded is None or not recorded.any():
        found[Assumption.MODEL] = found[Assumption.DISTURBANCE] = unexplained
    else:
        low, high = np.minimum(recorded[:-1], recorded[1:]), np.maximum(recorded[:-1], recorded[1:])
        other = np.linalg.norm(flow.unexplained - np.clip(flow.unexplained, low, high), axis=-1)
        found[Assumption.MODEL] = unexplained & (other > told)
        found[Assumption.DISTURBANCE] = (beyond(admissible, recorded[:-1] / (1.0 + ROUNDING)) != 0.0).any(axis=-1)
    return {name: found[name] for name in Assumption if name in found and found[name].any()}


def excess_of(flow: Balance, setting: Setting) -> tuple[Float[np.ndarray, " periods"], Float[np.ndarray, " periods"]]:
    """The most that inadmissible torques can have done, whatever their cause: power [W], and ratio to their bound.

    Torques are enlarged by the error of finite differences. An excess of V̇ over the sum of its terms, which are
    evaluated in the middle of a period, counts as power too.
    """
    torque = flow.unexplained + flow.lag + flow.cut
    size = np.linalg.norm(torque, axis=-1)
    torque = torque * (1.0 + setting.told / np.where(size > 0.0, size, 1.0))[:, None]
    terms = flow.potential + flow.damping + flow.disturbance + flow.held + flow.saturation
    power = np.linalg.norm(flow.z2, axis=-1) * setting.beyond(torque) + np.maximum(flow.change - terms, 0.0)
    box, radius = setting.admissible.box, setting.admissible.radius
    torque = torque - beyond(setting.admissible, torque) + beyond(setting.admissible, torque, setting.granted)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.linalg.norm(torque, axis=-1, keepdims=True) / radius if box is None else np.abs(torque) / box
    return power, np.maximum(np.where(np.isnan(ratio), 1.0, ratio).max(axis=-1), 1.0)  # 0 ÷ 0 is within the bound


def summed(
    power: Float[np.ndarray, " periods"], steps: Float[np.ndarray, " periods"], decay: float
) -> Float[np.ndarray, " rows"]:
    """The energy that a power has supplied, decaying at the rate c = `decay` [1/s], at every row [J]."""
    energy = np.zeros(len(power) + 1)
    for k, (more, step) in enumerate(zip(power.tolist(), steps.tolist(), strict=True)):
        energy[k + 1] = decayed(float(energy[k]), more, step, decay)
    return energy


def decayed(energy: float, power: float, step: float, decay: float) -> float:
    """An energy after one step of decay and supplied power, at least 0 [J]."""
    return max(energy * float(np.exp(-decay * step)) + power * step, 0.0)


def greatest(
    flow: Balance, admissible: Admissible, recorded: Float[np.ndarray, "rows n"] | None
) -> tuple[Assumption, ...]:
    """The assumption with the largest excess, if none of the excesses is significant by itself."""
    unexplained = np.linalg.norm(beyond(admissible, flow.unexplained), axis=-1).max()
    if np.linalg.norm(flow.lag, axis=-1).max() >= unexplained:
        return (Assumption.TIME,)
    if recorded is None or not recorded.any():
        return Assumption.MODEL, Assumption.DISTURBANCE
    return (Assumption.MODEL,)


def is_cut(flow: Balance) -> Bool[np.ndarray, " periods"]:
    """Whether the applied torque differs from the commanded one."""
    return np.asarray((flow.cut != 0.0).any(axis=-1))


JUMPS = (Assumption.WRAP, Assumption.REFERENCE)
"""Assumptions whose violation lets V jump, so that no power accounts for its change."""


def jumps(controller: LyapunovLaw, at: LoopSamples) -> dict[Assumption, Bool[np.ndarray, " periods"]]:
    """When the error of a continuous joint wrapped around, and when the reference contradicts its own derivatives."""
    z1, robot = controller.dynamics.difference(at.q, at.q_ref), controller.dynamics.robot
    wrapped, continuous = np.zeros(len(z1) - 1, dtype=bool), None if robot is None else robot.continuous
    if continuous is not None:
        wrapped = (np.abs(np.diff(z1, axis=0)) > np.pi)[:, continuous].any(axis=-1)
    broken = wrapped & False
    for rest, allowed in unexplained_steps(at.t, at.q_ref, at.v_ref, at.a_ref, continuous):
        broken = broken | (rest > allowed).any(axis=-1)
    return {Assumption.WRAP: np.asarray(wrapped), Assumption.REFERENCE: np.asarray(broken)}


def stops(certificate: Certificate, at: LoopSamples) -> dict[Assumption, Bool[np.ndarray, " periods"]]:
    """When a joint is at a position limit, or beyond it."""
    robot = certificate.robot
    q = at.q[1:]
    reached = np.zeros(q.shape, dtype=bool) if robot is None else (q <= robot.lower) | (q >= robot.upper)
    return {Assumption.STOPS: np.asarray(reached.any(axis=-1))}
