"""Torques and accelerations of a rigid tree for many states."""

import numpy as np

from nbs_pin.kernels.jit import kernel
from nbs_pin.kernels.trees import tree_acceleration, tree_torque


@kernel
def tree_torques(
    q: np.ndarray,
    v: np.ndarray,
    w: np.ndarray,
    a: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    tau: np.ndarray,
) -> None:
    """`trees.tree_torque` of rows (m, n)."""
    for k in range(len(q)):
        tree_torque(q[k], v[k], w[k], a[k], layout, weights, work, tau[k])


@kernel
def tree_accelerations(
    q: np.ndarray,
    v: np.ndarray,
    tau: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    work: np.ndarray,
    factor: np.ndarray,
    a: np.ndarray,
) -> None:
    """`trees.tree_acceleration` of rows (m, n); factor (n, n) is left as the last row's."""
    for k in range(len(q)):
        tree_acceleration(q[k], v[k], tau[k], layout, weights, work, factor, a[k])
