"""Motion of the bodies of a rigid tree as 4×4 matrices: torques that are linear in bodies, for numpy and torch.

A point x of body b lies at T_b(q)(x, 1). With the joint velocities v and w and accelerations a, its acceleration less
gravity is A_b(x, 1), A_b = Σ ∂_iT a_i + Σ ∂_i∂_jT v_i w_j − [0 | g]; its velocity at μ is U_b(x, 1), U_b = Σ ∂_iT μ_i.
For a body with the pseudo-inertia P = ∫ (x, 1)(x, 1)ᵀ dm the power of the torque M a + C(q, v) w + G at μ is therefore

    μᵀτ = tr(U P Aᵀ) = tr(L P),  L = ½(UᵀA + AᵀU),

with the Christoffel C, as ∂_iT and ∂_i∂_jT are the derivatives of an embedding whose metric is M (docs/theory.md §10).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nbs_pin.base.arrays import Array, array_namespace, constant_like
from nbs_pin.dynamics.rigid_tree import RigidTree


class BodyFields(NamedTuple):
    """Motion of every body of a tree, matrices (..., 4, 4) in the base frame."""

    parents: Sequence[int]
    """−1 is the base."""
    joints: list[Array]
    """J_i, body i in its parent's frame."""
    slopes: list[Array]
    """∂_iT_i."""
    accelerations: list[Array]
    """A_i."""

    def velocities(self, mu: Array) -> list[Array]:
        """U of every body at the joint velocities μ (..., n)."""
        found: list[Array] = []
        for i, up in enumerate(self.parents):
            own = self.slopes[i] * mu[..., i, None, None]
            found.append(own if up < 0 else found[up] @ self.joints[i] + own)
        return found

    def torque(self, bodies: Sequence[Array | None]) -> Array:
        """τ (..., n) of bodies with these pseudo-inertias (..., 4, 4) in their own frames, None for no body."""
        xp, n = array_namespace(self.slopes[0]), len(self.parents)
        loads = [0.0 * x if p is None else x @ p for x, p in zip(self.accelerations, bodies, strict=True)]
        tau = [xp.zeros(())] * n
        for i in reversed(range(n)):
            tau[i] = xp.sum(self.slopes[i] * loads[i], axis=(-2, -1))
            if self.parents[i] >= 0:
                loads[self.parents[i]] = loads[self.parents[i]] + loads[i] @ xp.swapaxes(self.joints[i], -1, -2)
        return xp.stack(tau, axis=-1)


def body_fields(tree: RigidTree, gravity: np.ndarray, q: Array, v: Array, w: Array, a: Array) -> BodyFields:
    """The fields at (..., n) positions, velocities and accelerations; gravity (3,) [m/s²] in the base frame."""
    weight = np.zeros((4, 4))
    weight[:3, 3] = -gravity
    fall, base = constant_like(q, weight), constant_like(q, np.eye(4)) + 0.0 * q[..., :1, None]
    placed, at_v, at_w, bent = [base], [0.0 * base], [0.0 * base], [0.0 * base]  # T, ∂T v, ∂T w, ∂T a + ∂∂T v w
    joints, slopes = [], []
    for i in range(tree.nv):
        joint, slope, bend = _joint(tree, i, q[..., i, None, None])
        up, x, y = int(tree.parents[i]) + 1, v[..., i, None, None], w[..., i, None, None]
        own = placed[up] @ slope
        curved = (at_v[up] @ slope) * y + (at_w[up] @ slope) * x + (placed[up] @ bend) * (x * y)
        bent.append(bent[up] @ joint + own * a[..., i, None, None] + curved)
        at_v.append(at_v[up] @ joint + own * x)
        at_w.append(at_w[up] @ joint + own * y)
        placed.append(placed[up] @ joint)
        joints.append(joint)
        slopes.append(own)
    return BodyFields([int(i) for i in tree.parents], joints, slopes, [x + fall for x in bent[1:]])


def _joint(tree: RigidTree, i: int, q: Array) -> tuple[Array, Array, Array]:
    """J_i(q_i) and its first two derivatives, for q_i of shape (..., 1, 1)."""
    xp, rotation = array_namespace(q), tree.rotation[i]
    still, cosine, sine, along = (np.zeros((4, 4)) for _ in range(4))
    still[:3, 3], still[3, 3] = tree.position[i], 1.0
    if tree.prismatic[i]:
        still[:3, :3], along[:3, 3] = rotation, rotation[:, 2]
        slope = constant_like(q, along) + 0.0 * q
        return constant_like(q, still) + q * slope, slope, 0.0 * slope
    still[:3, 2] = rotation[:, 2]
    cosine[:3, :2] = rotation[:, :2]
    sine[:3, 0], sine[:3, 1] = rotation[:, 1], -rotation[:, 0]
    c, s = xp.cos(q), xp.sin(q)
    fixed, even, odd = (constant_like(q, x) for x in (still, cosine, sine))
    return fixed + c * even + s * odd, c * odd - s * even, -c * even - s * odd
