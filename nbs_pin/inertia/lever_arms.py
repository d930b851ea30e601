"""Lever arms: the maximum over all poses of Σ_i w_i ρ_i², with ρ_i the distance of a point of a body from joint axis i.

For a point r of body i, V_i(r) = w_i ρ_i(r)² + max over q_i of V_parent(r in the parent's frame), with ρ² = 1 for a
prismatic joint. V_i is convex in r, as a maximum of convex functions of affine maps, and invariant under rotation about
the axis of a revolute joint i. Hence linear interpolation in a table over (distance from the axis, height along it) is
an upper bound, and so is the maximum over the corners of a polygon around the circle that r describes.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray, Scalars
from nbs_pin.dynamics.rigid_tree import RigidTree

CELLS, CORNERS = 48, 48
"""Cells of a table in the radial direction, and corners of the polygon around a circle."""
Levers: TypeAlias = Callable[[Float[np.ndarray, "*batch 3"]], Scalars]


def lever_arms(tree: RigidTree, weights: JointArray) -> list[Levers]:
    """Upper bounds of V_i for the weights w ≥ 0, as functions of points in frame i [m]; no joint may be `endless`."""
    radius = _radii(tree)
    levers: list[Levers] = []
    for i in range(tree.nv):
        parent = tree.parents[i]
        before = levers[parent] if parent >= 0 else _at_rest
        if tree.prismatic[i]:
            levers.append(_sliding(tree, i, float(weights[i]), before))
        else:
            levers.append(_turning(tree, i, float(weights[i]), before, float(radius[i])))
    return levers


def _at_rest(points: Float[np.ndarray, "*batch 3"]) -> Scalars:
    """V of the base."""
    return np.zeros(points.shape[:-1])


def _radii(tree: RigidTree) -> JointArray:
    """Radius of each body's table [m]: it covers the centres of mass, cells and polygons of all bodies behind it."""
    radius = np.maximum(np.linalg.norm(tree.centre, axis=1), 1e-9)
    for i in range(tree.nv - 1, 0, -1):
        p, stops = tree.parents[i], np.array(tree.stops(i) if tree.prismatic[i] else (0.0,))
        if p >= 0:
            away = np.linalg.norm(tree.placed(i, stops)[1], axis=1).max()
            read = radius[i] if tree.prismatic[i] else (radius[i] + 1.5 * _step(radius[i])) / np.cos(np.pi / CORNERS)
            radius[p] = max(radius[p], 1.000001 * (away + read))
    return radius


def _step(radius: float) -> float:
    """Cell size of a table that is evaluated up to the radius [m]."""
    return radius / (CELLS - 1)


def _sliding(tree: RigidTree, i: int, weight: float, before: Levers) -> Levers:
    """V_i of a prismatic joint: convex in the travel, hence the larger of the values at its ends."""
    stops = np.array(tree.stops(i))
    rotation, ends = tree.rotation[i], tree.placed(i, stops)[1]

    def value(points: Float[np.ndarray, "*batch 3"]) -> Scalars:
        return np.asarray(weight + np.max([before(points @ rotation.T + end) for end in ends], axis=0))

    return value


def _turning(tree: RigidTree, i: int, weight: float, before: Levers, radius: float) -> Levers:
    """V_i of a revolute joint, as a table over a half-plane through its axis."""
    angles = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    corners = np.stack([np.cos(angles), np.sin(angles)], axis=-1) / np.cos(np.pi / CORNERS)
    step = _step(radius)
    outward = step * np.arange(CELLS + 1)
    along = step * np.arange(-CELLS, CELLS + 1)
    points = np.zeros((CELLS + 1, 2 * CELLS + 1, CORNERS, 3))
    points[..., :2] = outward[:, None, None, None] * corners
    points[..., 2] = along[:, None]
    reached = before(points @ tree.rotation[i].T + tree.position[i]).max(-1)
    table = weight * outward[:, None] ** 2 + reached

    def value(points: Float[np.ndarray, "*batch 3"]) -> Scalars:
        rho, height = np.hypot(points[..., 0], points[..., 1]) / step, points[..., 2] / step + CELLS
        a = np.clip(rho.astype(int), 0, CELLS - 1)
        b = np.clip(height.astype(int), 0, 2 * CELLS - 1)
        s, t = rho - a, height - b
        with np.errstate(invalid="ignore"):  # 0·inf at points outside the table
            inner = (1.0 - t) * table[a, b] + t * table[a, b + 1]
            outer = (1.0 - t) * table[a + 1, b] + t * table[a + 1, b + 1]
            between = (1.0 - s) * inner + s * outer
        return np.where(np.linalg.norm(points, axis=-1) <= 1.0000005 * radius, between, np.inf)

    return value
