"""What a certificate promises and assumes, and how a motion shows that it did not hold.

Whatever the cause, a promise can only be broken by torques that are not admissible: with V̇ ≤ −c(V − V∞) for admissible
ones, V exceeds what was promised by at most the energy that the rest of the torque has brought, less what has decayed.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.certify import Certificate
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.energy_balance import Balance, LoopSamples, beyond
from nbs_pin.controllers.lyapunov_law import LyapunovLaw

WRONG = "the certificate is wrong"
"""What is said when none of the assumptions accounts for what happened."""
ROUNDING, DIFFERENCES = 1e-9, 1e-3
"""Shares of a promise: the error of V itself, and of energies summed over periods."""
NOTICEABLE = 0.01
"""Share of what V may be that a held torque may bring before it is reported."""
_EPS = float(np.finfo(float).eps)
_OF_RATE = 0.1
_OF_BOUND, _OF_TORQUE = 1e-2, 1e-3  # torques below these shares are not told from the error of differences


def check_certificate(certificate: Any) -> None:
    """Raises ArgumentError unless it is a certificate."""
    if not isinstance(certificate, Certificate):
        raise ArgumentError(f"a {type(certificate).__name__} promises nothing; give the certificate that certify made.")


def sentence(at: str, is_kept: bool, is_wrong: bool, failed: Mapping[Assumption, str], *, is_recorded: bool) -> str:
    """The verdict; at: what broke the promise and when. failed: the assumptions that failed, and when.

    is_recorded: whether disturbance and model can be told apart.
    """
    said = {name: name + when for name, when in failed.items()}
    if not is_recorded and Assumption.MODEL in said and Assumption.DISTURBANCE in said:
        said[Assumption.MODEL] = f"{Assumption.MODEL}, or {said.pop(Assumption.DISTURBANCE)}"
    named = "; ".join(said.values())
    if is_kept:
        return "promise kept" + (f", though this failed: {named}" if named else "")
    if not is_wrong:
        return f"promise broken{at}; of its assumptions this failed: {named}"
    why = f"this failed and does not account for it: {named}" if named else "none of its assumptions failed"
    return f"promise broken{at}, {why}: {WRONG}"


def listed(excesses: Sequence[str]) -> str:
    """What went beyond its bound, in a few words."""
    return ", ".join(excesses[:3]) + (" and others" if len(excesses) > 3 else "")


class Promise(NamedTuple):
    """What a certificate promises of V, ‖z1‖ and each |z1_i|, the quantities (2 + n), from a start."""

    certificate: Certificate
    initial: float
    """V(0) [J]."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the quantities."""
        return ("V", "‖z1‖", *(f"|z1| of {name}" for name in self.certificate.joint_names))

    def bounds(self, t: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "rows quantities"]:
        """What they were not to exceed, t [s] after the start [J, rad].

        Bounds of z1 go with √Φ, and Φ ≤ V ≤ its promise: from V(0) > V∞ they fall as the root of that promise does.
        """
        storage, first = self.certificate.storage_bound(t, self.initial), self._largest
        fallen = np.sqrt(storage / first) if first > 0.0 else np.ones(len(t))
        size, joints = self.certificate.from_start(self.initial)
        return np.column_stack([storage, np.outer(fallen, [size, *joints])])

    def exceeded(
        self, values: Float[np.ndarray, "rows quantities"], bounds: Float[np.ndarray, "rows quantities"]
    ) -> Bool[np.ndarray, "rows quantities"]:
        """Where a bound is broken by more than rounding."""
        return np.asarray(values > bounds * (1.0 + ROUNDING) + _EPS * (1.0 + self.initial))

    def accounted(
        self,
        bounds: Float[np.ndarray, "rows quantities"],
        energy: Float[np.ndarray, " rows"],
        ratio: Float[np.ndarray, " rows"],
    ) -> Float[np.ndarray, "rows quantities"]:
        """What they can be at most when torques beyond the admissible ones brought that energy [J].

        ratio: how many times the bound torques have been so far, ≥ 1 and inf where that says nothing. Bounds are
        proportional to the disturbance, so those of z1 grow no more than `ratio` times; nor do they pass the root of V.
        """
        storage, top = bounds[:, 0] * (1.0 + DIFFERENCES) + energy, self._largest or 1.0
        size, joints = self.certificate.from_start(top)
        from_storage = np.outer(np.sqrt(storage / top), [size, *joints])
        scaled = np.full_like(from_storage, np.inf)
        np.multiply(ratio[:, None], bounds[:, 1:], out=scaled, where=np.isfinite(ratio)[:, None])
        return np.column_stack([storage, np.minimum(from_storage, scaled) * (1.0 + DIFFERENCES)])

    @property
    def _largest(self) -> float:
        """What V never exceeds [J]."""
        return max(self.initial, self.certificate.storage)


def quantities(
    storage: Float[np.ndarray, " rows"], z1: Float[np.ndarray, "rows n"]
) -> Float[np.ndarray, "rows quantities"]:
    """V [J], ‖z1‖ and each |z1_i| [rad]."""
    return np.column_stack([storage, np.linalg.norm(z1, axis=-1), np.abs(z1)])


class Setting(NamedTuple):
    """What torques are held against."""

    admissible: Admissible
    granted: Float[np.ndarray, " periods"]
    """What a learned model's error may be [N·m]."""
    told: Float[np.ndarray, " periods"]
    """Torques below this are not told from the error of differences over a period [N·m]."""

    @classmethod
    def of(cls, certificate: Certificate, flow: Balance, at: LoopSamples) -> "Setting":
        """Of the periods between those instants."""
        admissible, mismatch, step = certificate.admissible, certificate.mismatch, np.diff(at.t)
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


def failures(
    flow: Balance,
    setting: Setting,
    jumped: Mapping[Assumption, Bool[np.ndarray, " periods"]],
    held: Bool[np.ndarray, " periods"],
    is_broken: bool,
    recorded: Float[np.ndarray, "rows n"] | None,
) -> dict[Assumption, Bool[np.ndarray, " periods"]]:
    """The assumptions that failed by more than can be told from the error of differences, and when.

    jumped: as `jumps` finds it. held: when what the held torque has brought is worth reporting; where a promise
    `is_broken`, any of it is.
    recorded: the disturbance [N·m]; where it is None or zero, model and disturbance cannot be told apart, and what is
    unexplained is said of both.
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
    """What torques beyond the admissible ones can have done, whatever their cause: power [W], and times the bound.

    Torques count as greater than they seem by what cannot be told. V̇ beyond the sum of its terms is the error of taking
    those in the middle of a period, and counts as power too.
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
    """What is left of the energy that a power has brought, and c = `decay` [1/s] took away, at every row [J]."""
    energy = np.zeros(len(power) + 1)
    for k, (more, step) in enumerate(zip(power.tolist(), steps.tolist(), strict=True)):
        energy[k + 1] = decayed(float(energy[k]), more, step, decay)
    return energy


def decayed(energy: float, power: float, step: float, decay: float) -> float:
    """What is left of an energy after a step, with the power that came in; never less than nothing."""
    return max(energy * float(np.exp(-decay * step)) + power * step, 0.0)


def greatest(
    flow: Balance, admissible: Admissible, recorded: Float[np.ndarray, "rows n"] | None
) -> tuple[Assumption, ...]:
    """Which of the small excesses, none told apart by itself, was the greatest."""
    unexplained = np.linalg.norm(beyond(admissible, flow.unexplained), axis=-1).max()
    if np.linalg.norm(flow.lag, axis=-1).max() >= unexplained:
        return (Assumption.TIME,)
    if recorded is None or not recorded.any():
        return Assumption.MODEL, Assumption.DISTURBANCE
    return (Assumption.MODEL,)


def is_cut(flow: Balance) -> Bool[np.ndarray, " periods"]:
    """Whether another torque acted than was asked for."""
    return np.asarray((flow.cut != 0.0).any(axis=-1))


JUMPS = (Assumption.WRAP, Assumption.REFERENCE)
"""Assumptions without which V itself jumps, so that no power accounts for what it does."""


def jumps(controller: LyapunovLaw, at: LoopSamples) -> dict[Assumption, Bool[np.ndarray, " periods"]]:
    """When an error leapt from one end of its turn to the other, and when the reference is no motion with a velocity.

    Between two instants a smooth reference moves by the mean of its velocities, but for a share of these and of their
    change; so does its velocity by the mean of its accelerations, which may jump.
    """
    z1, robot = controller.dynamics.difference(at.q, at.q_ref), controller.dynamics.robot
    wrapped = np.zeros(len(z1) - 1, dtype=bool)
    if robot is not None:
        wrapped = (np.abs(np.diff(z1, axis=0)) > np.pi)[:, robot.continuous].any(axis=-1)
    broken = wrapped & False
    for x, rate in ((at.q_ref, at.v_ref), (at.v_ref, at.a_ref)):
        step = np.diff(at.t)[:, None]
        rest = np.abs(np.diff(x, axis=0) - 0.5 * step * (rate[1:] + rate[:-1]))
        change, size = np.abs(np.diff(rate, axis=0)), np.abs(rate[1:]) + np.abs(rate[:-1])
        allowed = step * (change + _OF_RATE * size) + ROUNDING * (1.0 + np.abs(x[1:]))
        broken = broken | (rest > allowed).any(axis=-1)
    return {Assumption.WRAP: np.asarray(wrapped), Assumption.REFERENCE: np.asarray(broken)}
