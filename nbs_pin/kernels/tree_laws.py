"""A whole law on a rigid tree: from the state to the torque in one kernel."""

import numpy as np
from numba import boolean, float64, int64, void

from nbs_pin.kernels.jit import compile_for, kernel
from nbs_pin.kernels.laws import law_row
from nbs_pin.kernels.layout import PD_GRAVITY, Packed
from nbs_pin.kernels.tree_layout import tree_workspace
from nbs_pin.kernels.trees import tree_torque

_ROW, _ROWS = float64[::1], float64[:, ::1]
_PARTS = (int64[::1], float64[::1], int64[::1], float64[::1], float64[::1])


def tree_law_workspace(law: Packed, tree: Packed) -> int:
    """How many numbers of scratch space `tree_law` and `tree_laws` need."""
    return 3 * int(law.layout[1]) + max(int(law.layout[7]), tree_workspace(tree))


def compile_tree_laws() -> None:
    """Compile both kernels for float64 arrays, so that no first call waits for the compiler."""
    compile_for(tree_law, boolean(*[_ROW] * 5, *_PARTS, _ROW))
    compile_for(tree_laws, void(*[_ROWS] * 5, *_PARTS, _ROWS))


@kernel
def tree_law(
    q: np.ndarray,
    v: np.ndarray,
    q_ref: np.ndarray,
    v_ref: np.ndarray,
    a_ref: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    tree: np.ndarray,
    bodies: np.ndarray,
    work: np.ndarray,
    tau: np.ndarray,
) -> bool:
    """M a_r + C v_r + G + feedback [N·m] → tau, (n,); False, and nothing done, unless all states are (n,).

    layout, weights: of the law. tree, bodies: layout and weights of the tree.
    """
    n = layout[1]
    v_r, a_r, feedback, room = work[:n], work[n : 2 * n], work[2 * n : 3 * n], work[3 * n :]
    if not law_row(q, v, q_ref, v_ref, a_ref, layout, weights, room, v_r, a_r, feedback):
        return False
    # Gravity alone does not depend on v: a v that is no number must not spoil it.
    tree_torque(q, v_r if layout[0] == PD_GRAVITY else v, v_r, a_r, tree, bodies, room, tau)
    for i in range(n):
        tau[i] += feedback[i]
    return True


@kernel
def tree_laws(
    q: np.ndarray,
    v: np.ndarray,
    q_ref: np.ndarray,
    v_ref: np.ndarray,
    a_ref: np.ndarray,
    layout: np.ndarray,
    weights: np.ndarray,
    tree: np.ndarray,
    bodies: np.ndarray,
    work: np.ndarray,
    tau: np.ndarray,
) -> None:
    """`tree_law` for every row of arrays (rows, n)."""
    for i in range(len(q)):
        tree_law(q[i], v[i], q_ref[i], v_ref[i], a_ref[i], layout, weights, tree, bodies, work, tau[i])
