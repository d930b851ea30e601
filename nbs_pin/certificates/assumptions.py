"""What a certificate assumes, and how a motion shows that it did not hold.

Whatever the cause, a promise can only be broken by torques that are not admissible: with V̇ ≤ −c(V − V∞) for admissible
ones, V exceeds what was promised by at most the energy that the rest of the torque has brought, less what has decayed.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.certificate import Certificate
from nbs_pin.certificates.energy_balance import Balance, Instants, beyond
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.mismatch import Mismatch

SATURATION = "no saturation"
DISTURBANCE = "disturbance within its bound"
MODEL = "exact model"
UNEXPLAINED = "disturbance and model error within the bound"
SAMPLING = "continuous time"
WRAP = "no error beyond ±π on a continuous joint"
ASSUMPTIONS = (SATURATION, DISTURBANCE, MODEL, UNEXPLAINED, SAMPLING, WRAP)
"""Names of the assumptions that a monitor can see fail; UNEXPLAINED where no disturbance is on record."""
WRONG = "the certificate is wrong"
"""What is said when none of them accounts for what happened."""
EPS = float(np.finfo(float).eps)
ROUNDING, DIFFERENCES = 1e-9, 1e-3
"""Shares of a promise: the error of V itself, and of energies summed over periods."""
_OF_BOUND, _OF_TORQUE = 1e-2, 1e-3  # torques below these shares are not told from the error of differences


def sentence(at: str, is_kept: bool, is_wrong: bool, broken: Sequence[str]) -> str:
    """The verdict; at: when the promise was broken. broken: the assumptions that failed."""
    named = ", ".join(broken)
    if is_kept:
        return "promise kept" + (f", though an assumption failed: {named}" if named else "")
    if not is_wrong:
        return f"promise broken{at}; what failed of its assumptions: {named}"
    why = f"{named} failed and does not account for it" if named else "none of its assumptions failed"
    return f"promise broken{at}, {why}: {WRONG}"


class Setting(NamedTuple):
    """What torques are held against."""

    admissible: Admissible
    granted: Float[np.ndarray, " periods"]
    """What a learned model's error may be [N·m]."""
    told: Float[np.ndarray, " periods"]
    """Torques below this are not told from the error of differences over a period [N·m]."""

    @classmethod
    def of(cls, certificate: Certificate, mismatch: Mismatch | None, flow: Balance, at: Instants) -> "Setting":
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


def failures(
    flow: Balance,
    setting: Setting,
    wrapped: Bool[np.ndarray, " periods"],
    recorded: Float[np.ndarray, "rows n"] | None,
) -> dict[str, Bool[np.ndarray, " periods"]]:
    """The assumptions that failed by more than can be told from the error of differences, and when."""
    told, admissible = setting.told, setting.admissible
    rest = beyond(admissible, flow.unexplained, setting.granted)
    unexplained = np.linalg.norm(rest, axis=-1) > told
    found = {SATURATION: is_cut(flow), SAMPLING: setting.beyond(flow.unexplained - rest + flow.lag) > told}
    found[WRAP] = wrapped
    if recorded is None or not recorded.any():
        found[UNEXPLAINED] = unexplained
    else:
        low, high = np.minimum(recorded[:-1], recorded[1:]), np.maximum(recorded[:-1], recorded[1:])
        other = np.linalg.norm(flow.unexplained - np.clip(flow.unexplained, low, high), axis=-1)
        found[MODEL] = unexplained & (other > told)
        found[DISTURBANCE] = (beyond(admissible, recorded[:-1] / (1.0 + ROUNDING)) != 0.0).any(axis=-1)
    return {name: found[name] for name in ASSUMPTIONS if name in found and found[name].any()}


def excess_of(flow: Balance, setting: Setting) -> tuple[Float[np.ndarray, " periods"], Float[np.ndarray, " periods"]]:
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


def unaccounted(
    storage: np.ndarray, promise: np.ndarray, power: np.ndarray, steps: np.ndarray, decay: float
) -> Bool[np.ndarray, " rows"]:
    """Where V is further beyond the promise than that power accounts for: V̇ ≤ −c(V − V∞) + power."""
    energy = np.zeros(len(storage))
    for k, (more, step) in enumerate(zip(power.tolist(), steps.tolist(), strict=True)):
        energy[k + 1] = decayed(float(energy[k]), more, step, decay)
    return np.asarray(storage > promise * (1.0 + DIFFERENCES) + energy)


def decayed(energy: float, power: float, step: float, decay: float) -> float:
    """What is left of an energy after a step, with the power that came in."""
    return energy * float(np.exp(-decay * step)) + power * step


def greatest(flow: Balance, admissible: Admissible, recorded: Float[np.ndarray, "rows n"] | None) -> str:
    """Which of the small excesses, none told apart by itself, was the greatest."""
    unexplained = np.linalg.norm(beyond(admissible, flow.unexplained), axis=-1).max()
    if np.linalg.norm(flow.lag, axis=-1).max() >= unexplained:
        return SAMPLING
    return UNEXPLAINED if recorded is None or not recorded.any() else MODEL


def is_cut(flow: Balance) -> Bool[np.ndarray, " periods"]:
    """Whether another torque acted than was asked for."""
    return np.asarray((flow.cut != 0.0).any(axis=-1))


def wraps(controller: NeuralBackstepping, z1: Float[np.ndarray, "rows n"]) -> Bool[np.ndarray, " periods"]:
    """Whether an error jumped from one end of its turn to the other."""
    robot = controller.dynamics.robot
    if robot is None:
        return np.zeros(len(z1) - 1, dtype=bool)
    return np.asarray((np.abs(np.diff(z1, axis=0)) > np.pi)[:, robot.continuous].any(axis=-1))
