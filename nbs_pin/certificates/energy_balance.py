"""Energy balance of V: its rate over each control period, its terms, and the torques behind them.

The law is designed in continuous time. The torque that acts on the arm differs from it by

    w = (M̂v̇ + Ĉv + Ĝ + friction − τ) + (τ_command − law) + (τ − τ_command) = unexplained + held + cut,

and V̇ = −∇ΦᵀΛ∇Φ − z2ᵀ((ωM̂ + D)z2 + f(v) − f(φ)) + z2ᵀw for every model, exact or learned, with M̂ in V and
in w. So a certificate needs no other assumption than that w is admissible (docs/certificates.md).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.records import Reference, Run
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.dynamics.equations import inverse_dynamics

_BATCH = 4096  # states that are evaluated at once


class LoopSamples(NamedTuple):
    """Samples of a closed loop at any number of control instants."""

    t: Float[np.ndarray, "*rows"]
    """Time [s]."""
    q: Float[np.ndarray, "*rows n"]
    """Configuration [rad]."""
    v: Float[np.ndarray, "*rows n"]
    """Velocity [rad/s]."""
    q_ref: Float[np.ndarray, "*rows n"]
    """Desired configuration [rad]."""
    v_ref: Float[np.ndarray, "*rows n"]
    """Desired velocity [rad/s]."""
    a_ref: Float[np.ndarray, "*rows n"]
    """Desired acceleration [rad/s²]."""
    tau: Float[np.ndarray, "*rows n"]
    """Torque applied from that instant on [N·m]."""
    tau_command: Float[np.ndarray, "*rows n"]
    """Commanded torque [N·m]."""

    @classmethod
    def of(cls, run: Run) -> "LoopSamples":
        """All instants of a run, sorted by start: (starts, rows, …)."""
        starts = int(np.prod(run.q.shape[1:-1], dtype=int))
        named = (run.q, run.v, run.q_ref, run.v_ref, run.a_ref, run.tau, run.tau_command)
        rows = (x.reshape(len(run.t), starts, run.nv).swapaxes(0, 1) for x in named)
        return cls(np.tile(run.t, (starts, 1)), *rows)

    def rows(self, which: Any) -> "LoopSamples":
        """Those rows of every field."""
        return LoopSamples(*(x[which] for x in self))


class Balance(NamedTuple):
    """V̇ over control periods and its terms, at the middle of each; `change` is the sum of the five others."""

    change: Float[np.ndarray, "*rows"]
    """V̇ from the change of V [W]."""
    potential: Float[np.ndarray, "*rows"]
    """−∇ΦᵀΛ∇Φ [W]."""
    damping: Float[np.ndarray, "*rows"]
    """−z2ᵀ((ωM + D)z2 + f(v) − f(φ)) [W] with the friction f that is fed forward."""
    disturbance: Float[np.ndarray, "*rows"]
    """z2ᵀτ_d [W] with the unexplained torque as τ_d."""
    held: Float[np.ndarray, "*rows"]
    """z2ᵀ(τ_command − law) [W]: the effect of holding the torque."""
    saturation: Float[np.ndarray, "*rows"]
    """z2ᵀ(τ − τ_command) [W]."""
    z2: Float[np.ndarray, "*rows n"]
    """v − φ [rad/s]."""
    unexplained: Float[np.ndarray, "*rows n"]
    """M̂v̇ + Ĉv + Ĝ + friction − τ [N·m]: disturbance and model error."""
    lag: Float[np.ndarray, "*rows n"]
    """τ_command − law [N·m]."""
    cut: Float[np.ndarray, "*rows n"]
    """τ − τ_command [N·m]."""
    state_norms: Float[np.ndarray, "*rows 2"]
    """‖q‖ [rad] and ‖v‖ [rad/s]."""


def storage_of(controller: LyapunovLaw, at: LoopSamples) -> Float[np.ndarray, "*rows"]:
    """V at the instants [J]."""
    return _in_parts(controller.storage, at.q, at.v, at.q_ref, at.v_ref)[0]


def balance(
    controller: LyapunovLaw,
    before: LoopSamples,
    after: LoopSamples,
    change: Float[np.ndarray, "*rows"],
    law: MemorylessController | None = None,
) -> Balance:
    """V̇ and its terms between each instant and the next one, to second order in the time between them.

    change: the increase of V [J]. law: the compiled controller, for speed. Positions of continuous joints count modulo
    a turn.
    """
    h, asked = (after.t - before.t)[..., None], (controller if law is None else law).torque
    apart = controller.dynamics.difference
    q, q_ref = before.q + apart(after.q, before.q), before.q_ref + apart(after.q_ref, before.q_ref)
    q, v = _middle(before.q, q, before.v, after.v, h), 0.5 * (before.v + after.v)
    target = Reference(
        _middle(before.q_ref, q_ref, before.v_ref, after.v_ref, h),
        _middle(before.v_ref, after.v_ref, before.a_ref, after.a_ref, h),
        0.5 * (before.a_ref + after.a_ref),
    )
    wanted, needed, lost, z2, friction = _in_parts(
        lambda *rows: (asked(*rows[:2], *rows[3:]), *_powers(controller, *rows)),
        q,
        v,
        (after.v - before.v) / h,
        *target,
    )
    unexplained, lag, cut = needed - before.tau, before.tau_command - wanted, before.tau - before.tau_command
    return Balance(
        change=change / h[..., 0],
        potential=-lost[..., 0],
        damping=-lost[..., 1] - _dot(z2, friction),
        disturbance=_dot(z2, unexplained),
        held=_dot(z2, lag),
        saturation=_dot(z2, cut),
        z2=z2,
        unexplained=unexplained,
        lag=lag,
        cut=cut,
        state_norms=np.stack([np.linalg.norm(q, axis=-1), np.linalg.norm(v, axis=-1)], axis=-1),
    )


def beyond(
    admissible: Admissible, torque: Float[np.ndarray, "*rows n"], allowance: Float[np.ndarray, "*rows"] | float = 0.0
) -> Float[np.ndarray, "*rows n"]:
    """The part of each torque outside the admissible set [N·m], its norm reduced by `allowance`."""
    if admissible.box is not None:
        rest = torque - np.clip(torque, -admissible.box, admissible.box)
    else:
        size = np.linalg.norm(torque, axis=-1, keepdims=True)
        rest = torque * np.maximum(1.0 - (admissible.radius or 0.0) / np.where(size > 0.0, size, 1.0), 0.0)
    size = np.linalg.norm(rest, axis=-1)
    granted = np.maximum(1.0 - allowance / np.where(size > 0.0, size, 1.0), 0.0)
    return np.asarray(rest * granted[..., None])


def _powers(
    controller: LyapunovLaw,
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    q_ref: np.ndarray,
    v_ref: np.ndarray,
    a_ref: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """The torque of this motion, the two losses of V, z2, and the friction torque in excess of f(φ)."""
    e, dynamics, friction = controller.errors(q, v, q_ref, v_ref, a_ref), controller.dynamics, controller.friction
    needed, extra = inverse_dynamics(dynamics, q, v, a), np.zeros_like(q)
    if friction is not None:
        needed, extra = needed + friction.torque(v), friction.torque(v) - friction.torque(e.v_r)
    return needed, np.stack(controller.losses(q, e), axis=-1), e.z2, extra


def _middle(x0: np.ndarray, x1: np.ndarray, rate0: np.ndarray, rate1: np.ndarray, h: np.ndarray) -> np.ndarray:
    """The value in the middle of a step h, by cubic Hermite interpolation."""
    return np.asarray(0.5 * (x0 + x1) + 0.125 * h * (rate0 - rate1))


def _in_parts(function: Callable[..., Any], *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """The function of rows (…, n), evaluated in batches."""
    shape, n = arrays[0].shape[:-1], arrays[0].shape[-1]
    rows = [np.ascontiguousarray(x).reshape(-1, n) for x in arrays]
    found = []
    for k in range(0, max(len(rows[0]), 1), _BATCH):
        value = function(*(x[k : k + _BATCH] for x in rows))
        found.append(value if isinstance(value, tuple) else (value,))
    return tuple(np.concatenate(x).reshape((*shape, *x[0].shape[1:])) for x in zip(*found, strict=True))


def _dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray((x * y).sum(axis=-1))
