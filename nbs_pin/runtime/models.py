"""What compiled models need beside their engine."""

import math

import numpy as np

from nbs_pin.runtime.jit import kernel


@kernel
def halves(v: np.ndarray, v_r: np.ndarray, mean: np.ndarray, half: np.ndarray) -> None:
    """½(v + v_r) → mean, ½(v − v_r) → half: the velocities of the two RNEA of a reference torque."""
    for i in range(len(v)):
        mean[i], half[i] = 0.5 * (v[i] + v_r[i]), 0.5 * (v[i] - v_r[i])


@kernel
def two_link_torques(
    q: np.ndarray, v: np.ndarray, v_r: np.ndarray, a_r: np.ndarray, constants: np.ndarray, tau: np.ndarray
) -> None:
    """M(q) a_r + C(q, v) v_r + G(q) → tau [N·m] of `dynamics.analytic`, rows (rows, 2).

    constants: its shoulder, forearm, coupling and two weights.
    """
    shoulder, forearm, coupling, upper, lower = constants
    for k in range(len(q)):
        c, h = coupling * math.cos(q[k, 1]), coupling * math.sin(q[k, 1])
        elbow = lower * math.cos(q[k, 0] + q[k, 1])
        a1, a2, v1, v2 = a_r[k, 0], a_r[k, 1], v[k, 0], v[k, 1]
        coriolis = -h * v2 * v_r[k, 0] - h * (v1 + v2) * v_r[k, 1]
        weight = upper * math.cos(q[k, 0]) + elbow
        tau[k, 0] = (shoulder + forearm + 2.0 * c) * a1 + (forearm + c) * a2 + coriolis + weight
        tau[k, 1] = (forearm + c) * a1 + forearm * a2 + h * v1 * v_r[k, 0] + elbow
