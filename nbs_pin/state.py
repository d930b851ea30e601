"""Small named records that every room passes around."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.arrays import Array


class State(NamedTuple):
    """Configuration q [rad] and velocity v [rad/s], shape (..., nv)."""

    q: Array
    v: Array


class Reference(NamedTuple):
    """Desired configuration q [rad], velocity v [rad/s] and acceleration a [rad/s²], shape (..., nv)."""

    q: Array
    v: Array
    a: Array


@dataclass(frozen=True)
class Run:
    """One recorded simulation: row k of every array belongs to the time t[k], the control instant k.

    The torque in row k acts from t[k] to t[k+1]; the last row's torque was computed but not applied.
    A batch of starts adds axes between time and joint: q has shape (steps + 1, ..., nv).
    """

    t: Float[np.ndarray, " rows"]
    """Time [s]."""
    q: Float[np.ndarray, "rows *batch n"]
    """Configuration [rad]."""
    v: Float[np.ndarray, "rows *batch n"]
    """Velocity [rad/s]."""
    tau: Float[np.ndarray, "rows *batch n"]
    """Torque applied, after the effort limits [N·m]."""
    tau_command: Float[np.ndarray, "rows *batch n"]
    """Torque the controller asked for [N·m]."""
    disturbance: Float[np.ndarray, "rows *batch n"]
    """Disturbance torque τ_d at the control instants [N·m]."""
    q_ref: Float[np.ndarray, "rows *batch n"]
    """Desired configuration [rad]."""
    v_ref: Float[np.ndarray, "rows *batch n"]
    """Desired velocity [rad/s]."""
    a_ref: Float[np.ndarray, "rows *batch n"]
    """Desired acceleration [rad/s²]."""
    effort_limit: Float[np.ndarray, " n"]
    """Largest |τ| per joint [N·m], inf where none."""
    continuous: Bool[np.ndarray, " n"]
    """True for joints whose error is wrapped to (−π, π]."""
    joint_names: tuple[str, ...]
    """Names of the joints, in order."""
    period: float
    """Control period [s]."""
    robot: str = ""
    """What `load_robot` was given for the arm, or empty."""
    robot_sha256: str = ""
    """`Robot.sha256` of that arm, or empty."""
    info: dict[str, Any] = field(default_factory=dict)
    """Free notes (controller, plant, seed, versions), stored as JSON."""

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(self.q.shape[-1])
