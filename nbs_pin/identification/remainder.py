"""What a fitted model leaves of the torque, joint by joint: how much, what would explain it, what to try next."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.doors import where_printed
from nbs_pin.base.units import percent
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.identification.datasets import Dataset, trajectory_slices

EFFECTS = ("constant", "v", "sign v", "√|v| sign v", "a", "|τ| sign v", "τ earlier or later")
"""What the residual is regressed on, one at a time; the last is the torque less that some samples away."""
_SIGN = 0.01
"""Speed within which sign v is smooth [rad/s]."""
_SHIFTS = (-20, -10, -5, -3, -2, -1, 1, 2, 3, 5, 10, 20)
"""Samples by which the torque is shifted."""
_LEFT, _MUCH = 0.01, 0.2
"""Share of the torque's variance that is worth an explanation, and share of what is left that one effect explains."""
_TRIES = {
    "constant": ("offset", "an offset of the torque of {joints}"),
    "v": ("friction", "viscous friction of {joints}"),
    "sign v": ("friction", "Coulomb friction of {joints}"),
    "√|v| sign v": ("friction", "friction of {joints} that is not linear in speed"),
    "a": ("rotor_inertia", "rotor inertia of {joints}"),
    "|τ| sign v": ("friction", "friction of {joints} that grows with the load"),
}
"""Per effect the argument of `fit` that learns it, and what it means."""


@dataclass(frozen=True, eq=False)
class Remainder:
    """Torque measured minus predicted, of some data."""

    mean: JointArray
    """Mean [N·m]."""
    rms: JointArray
    """Root mean square [N·m]."""
    nmse: JointArray
    """Mean square over the variance of the torque; NaN where the torque is constant."""
    explained: Float[np.ndarray, "effects n"]
    """Share of the mean square that a multiple of each of `EFFECTS` would explain: > 0 but for the constant, as the
    others cannot have the other sign; with it a delay in one direction would look like one in the other."""
    delay: JointArray
    """Time by which the torque would have to be moved later for the last of them [s]."""

    @property
    def unexplained(self) -> float:
        """Mean over the joints of `nmse`, of those whose torque varies."""
        known = self.nmse[np.isfinite(self.nmse)]
        return float(known.mean()) if known.size else 0.0

    @property
    def gains(self) -> Float[np.ndarray, " effects"]:
        """Share of `unexplained` that each effect would explain."""
        weighted = self.explained * np.nan_to_num(self.nmse)
        return np.asarray(weighted.mean(axis=1) / max(float(np.nan_to_num(self.nmse).mean()), 1e-300))

    @property
    def cause(self) -> str:
        """The argument of `fit` that learns the effect which explains most, empty if there is none."""
        best = int(np.argmax(self.gains))
        return _TRIES.get(EFFECTS[best], ("",))[0] if self.gains[best] >= _MUCH else ""

    def plain(self) -> dict[str, Any]:
        """The numbers for JSON: lists per joint, the shares by effect, None for NaN."""
        return {
            "mean_Nm": self.mean.tolist(),
            "rms_Nm": self.rms.tolist(),
            "nmse": [x if np.isfinite(x) else None for x in self.nmse.tolist()],
            "explained_by": dict(zip(EFFECTS, self.explained.tolist(), strict=True)),
            "delay_s": self.delay.tolist(),
        }


def remainder(model: DynamicsProvider, data: Dataset, friction: JointFriction | None) -> Remainder:
    """What the model with its friction leaves of the torques of the data."""
    needed = model.reference_torque(data.q, data.v, data.v, data.a)
    left = data.tau - (needed if friction is None else needed + friction.feedforward(data.v, needed))
    side = np.tanh(data.v / _SIGN)
    effects = (np.ones_like(left), data.v, side, np.sqrt(np.abs(data.v)) * side, data.a, np.abs(needed) * side)
    explained = [_share(left, effect, signed=k == 0) for k, effect in enumerate(effects)]
    shifted = [_share(left, data.tau - _moved(data, shift)) for shift in _SHIFTS]
    best = np.argmax(shifted, axis=0)
    variance, squares = data.tau.var(axis=0), np.square(left).mean(axis=0)
    varies = variance > 1e-12 * max(float(variance.max()), float(np.square(data.tau).max()))
    return Remainder(
        mean=left.mean(axis=0),
        rms=np.sqrt(squares),
        nmse=np.where(varies, squares / np.where(varies, variance, 1.0), np.nan),
        explained=np.array([*explained, np.max(shifted, axis=0)]),
        delay=-np.array(_SHIFTS)[best] * _step(data),
    )


def next_try(found: Remainder, joints: Sequence[str], asked: Mapping[str, bool | None]) -> str:
    """The one thing to try next, as a sentence without its full stop; empty if little is left.

    Of the effects it names the one that would explain most of the unexplained share of the torque's variance, in the
    mean over the joints. `asked` holds the arguments friction, offset and rotor_inertia of the fit.
    """
    total, gain, nmse = found.unexplained, found.gains, np.nan_to_num(found.nmse)
    if total < _LEFT:
        return ""
    effect = int(np.argmax(gain))
    if gain[effect] < _MUCH:
        return (
            f"{total:.2g} of the torque's variance is left, and no single effect explains much of it: move the arm "
            "more, or look for what the model lacks (a load, springs, a wrong geometry)"
        )
    name, concerned = EFFECTS[effect], found.explained[effect] * nmse > 0.5 * (found.explained[effect] * nmse).max()
    which = " and ".join(joint for joint, has in zip(joints, concerned, strict=True) if has)
    share = f"{percent(gain[effect])} of what is left ({total:.2g} of the torque's variance)"
    if name not in _TRIES:
        delay = float(np.median(found.delay[concerned]))
        when = "later" if delay > 0.0 else "earlier"
        return (
            f"{share} would be explained by torques {abs(delay):.3g} s {when}: the log's signals are not of one instant"
        )
    argument, said = _TRIES[name]
    meaning = said.format(joints=which)
    if asked.get(argument) is not False:
        return f"{share} would be explained by {meaning}, which was learned: these data are unlike those of the fit"
    flag = {"rotor_inertia": "--rotors"}.get(argument, f"--{argument}")
    remedy = where_printed(python=f"leave out {argument}=False", shell=f"leave out {flag} off")
    return f"{share} would be explained by {meaning}; {remedy} to learn it"


def _share(
    left: Float[np.ndarray, "samples n"], effect: Float[np.ndarray, "samples n"], *, signed: bool = False
) -> JointArray:
    """Share of the mean square of each joint's residual that a multiple of the effect explains, > 0 unless signed."""
    product = (left * effect).sum(axis=0)
    size = np.square(left).sum(axis=0) * np.square(effect).sum(axis=0)
    counts = (size > 0.0) & (signed | (product > 0.0))
    return np.divide(np.square(product), size, out=np.zeros_like(size), where=counts)


def _moved(data: Dataset, shift: int) -> Float[np.ndarray, "samples n"]:
    """The torque of the sample `shift` rows later in the same trajectory, its last one beyond the end."""
    moved = data.tau.copy()
    for rows in trajectory_slices(data.trajectory):
        order = np.clip(np.arange(rows.start, rows.stop) + shift, rows.start, rows.stop - 1)
        moved[rows] = data.tau[order]
    return moved


def _step(data: Dataset) -> float:
    """Median time between samples of a trajectory [s], zero if all samples are alone."""
    steps = [np.diff(data.t[rows]) for rows in trajectory_slices(data.trajectory)]
    every = np.concatenate(steps)
    return float(np.median(every)) if every.size else 0.0
