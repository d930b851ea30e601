"""The largest eigenvalue of the inertia matrix over all poses, from finitely many of them.

In each joint that turns, xᵀM(q)x is a trigonometric polynomial of degree 2 that is nowhere negative, so its greatest
value is at most its greatest at N equally spaced angles ÷ cos²(π/N); in each that slides it is convex, so the ends of
the travel are enough. Joints at the end of the arm, which change M little, need no samples: the energy of what lies
behind such a joint is replaced by a constant one that is never less (`_settled`). docs/certificates.md has the proofs.

An energy is a symmetric matrix over (v, ω, q̇): the twist of a body's frame, in that frame, and all joint rates. Leading
axes are the poses, one axis per joint that varies.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray, Matrices
from nbs_pin.base.rounding import largest_eigenvalues
from nbs_pin.dynamics.rigid_tree import RigidTree, cross
from nbs_pin.inertia.lever_arms import lever_arms

FEWEST, MOST = 5, 48
"""Angles per joint."""
ROUGH = 1000
"""Poses by which plans are chosen."""
TURN = 64
"""Angles at which the energy behind a settled joint is looked at."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Which joints are sampled, at how many angles."""

    settled_from: int
    """This joint and all after it are settled: replaced by constant energies."""
    turning: int
    """How many joints that turn are sampled."""
    angles: int

    @property
    def factor(self) -> float:
        """Greatest value of the polynomial ÷ its greatest sample, at most."""
        return math.cos(math.pi / self.angles) ** (-2 * self.turning)


def pose_grid_bound(tree: RigidTree, weight: Float[np.ndarray, "n n"], poses: int) -> float:
    """At least max_q λ_max(W^-½ M(q) W^-½), with about so many poses sampled; no joint may slide without end."""
    whiten = np.linalg.inv(np.linalg.cholesky(weight))
    scales = _scales(tree, 1.0 / np.diag(weight))

    def roughly(plan: Plan) -> float:
        angles = min(plan.angles, max(4, _angles(ROUGH, plan.turning)))
        return plan.factor * _greatest_sample(tree, plan.settled_from, angles, whiten, scales)

    plan = min(_plans(tree, poses), key=roughly)
    return plan.factor * _greatest_sample(tree, plan.settled_from, plan.angles, whiten, scales)


def _plans(tree: RigidTree, poses: int) -> list[Plan]:
    """Joints settled from each joint back, and as many angles for the others as the number of poses allows."""
    present, plans = np.flatnonzero(~tree.absent), []
    for first in [*present.tolist(), tree.nv]:
        before = present[present < first]
        turning = int(np.sum(~tree.prismatic[before]))
        angles = _angles(poses >> (len(before) - turning), turning)
        if angles >= FEWEST:
            plans.append(Plan(first, turning, angles))
    return plans


def _angles(poses: int, joints: int) -> int:
    """How many angles each joint gets."""
    return min(MOST, math.floor(poses ** (1.0 / joints) + 1e-9)) if joints else MOST


def _greatest_sample(
    tree: RigidTree,
    settled_from: int,
    angles: int,
    whiten: Float[np.ndarray, "n n"],
    scales: Float[np.ndarray, "n size"],
) -> float:
    """The greatest eigenvalue among the samples, with the energies of settled joints.

    The first joint that varies is taken one position at a time, which keeps the arrays small.
    """
    motions = [_motions(tree, i, _positions(tree, i, TURN if i >= settled_from else angles)) for i in range(tree.nv)]
    varying = [i for i in range(min(settled_from, tree.nv)) if len(motions[i]) > 1]
    outer, inner = (varying[0], varying[1:]) if varying else (-1, [])
    behind = [*_bodies(tree), np.zeros(motions[0].shape[1:])]
    for i in reversed(range(outer + 1, tree.nv)):
        if i >= settled_from:
            seen = _settled(behind[i], motions[i], scales[i], turns=not bool(tree.prismatic[i]))
        else:
            axes = [len(motions[i]) if i == j else 1 for j in inner]
            seen = _seen(behind[i], motions[i].reshape(*axes, *motions[i].shape[1:]))
        behind[tree.parents[i]] = behind[tree.parents[i]] + seen
    greatest = 0.0
    for at in motions[outer] if varying else motions[0]:
        energies = list(behind)
        for i in reversed(range(outer + 1)):
            seen = _seen(energies[i], at if i == outer else motions[i][0])
            energies[tree.parents[i]] = energies[tree.parents[i]] + seen
        greatest = _greater(greatest, whiten @ energies[-1][..., 6:, 6:] @ whiten.T)
    return greatest


def _greater(greatest: float, matrices: Matrices) -> float:
    """The greatest eigenvalue so far; matrices whose Frobenius norm is less need no spectrum."""
    candidates = matrices[np.linalg.norm(matrices, axis=(-2, -1)) > greatest]
    return max(greatest, float(np.max(largest_eigenvalues(candidates), initial=0.0)))


def _seen(energy: Float[np.ndarray, "*b m m"], motion: Float[np.ndarray, "*c m m"]) -> Float[np.ndarray, "*d m m"]:
    """An energy of a body's twist as one of its parent's."""
    return np.swapaxes(motion, -1, -2) @ energy @ motion


def _settled(
    energy: Float[np.ndarray, "m m"],
    motions: Float[np.ndarray, "samples m m"],
    scales: Float[np.ndarray, " m"],
    turns: bool,
) -> Float[np.ndarray, "m m"]:
    """An energy of the parent's twist that is never less, wherever the joint is.

    The mean, and γ times a positive definite A on whose scale what is left stays within ±1/γ: at every angle if at 64,
    since what is left is a trigonometric polynomial of degree 2. Of two A the one that adds less is taken.
    """
    seen = _seen(energy, motions)
    mean = seen.mean(axis=0)
    left = (seen - mean) / scales / scales[:, None]
    values, vectors = np.linalg.eigh(left)
    magnitude = np.mean((vectors * np.abs(values)[:, None, :]) @ np.swapaxes(vectors, 1, 2), axis=0)
    identity = np.eye(len(scales))
    ridge = 1e-2 * np.trace(magnitude) / len(scales) + 1e-12 * np.linalg.norm(mean / scales / scales[:, None])
    between = math.cos(2.0 * math.pi / len(motions)) if turns else 1.0
    added = []
    for shape in (identity, magnitude + ridge * identity):
        half = np.linalg.inv(np.linalg.cholesky(shape))
        scaled = half @ left @ half.T
        greatest = max(float(largest_eigenvalues(scaled).max()), float(largest_eigenvalues(-scaled).max()))
        added.append(greatest / between * shape)
    return mean + min(added, key=np.trace) * scales * scales[:, None]


def _positions(tree: RigidTree, i: int, angles: int) -> Float[np.ndarray, " samples"]:
    """Where joint i is looked at [rad, m]."""
    if tree.prismatic[i]:
        return np.array(tree.stops(i))
    return np.zeros(1) if tree.absent[i] else 2.0 * np.pi * np.arange(angles) / angles


def _motions(tree: RigidTree, i: int, q: Float[np.ndarray, " samples"]) -> Float[np.ndarray, "samples m m"]:
    """The matrix that takes (parent's twist, rates) to (twist of body i, rates), at each q_i."""
    rotation, position = tree.placed(i, q)
    motions = np.tile(np.eye(6 + tree.nv), (len(q), 1, 1))
    back = np.swapaxes(rotation, 1, 2)
    motions[:, :3, :3] = motions[:, 3:6, 3:6] = back
    motions[:, :3, 3:6] = -back @ cross(position)
    motions[:, 2 if tree.prismatic[i] else 5, 6 + i] = 1.0
    return motions


def _bodies(tree: RigidTree) -> list[Float[np.ndarray, "m m"]]:
    """Twice the kinetic energy of each body and its rotor."""
    energies = []
    for i in range(tree.nv):
        energy = np.zeros((6 + tree.nv, 6 + tree.nv))
        energy[:6, :6] = tree.spatial_inertia(i)
        energy[6 + i, 6 + i] = tree.armature[i]
        energies.append(energy)
    return energies


def _scales(tree: RigidTree, weights: JointArray) -> Float[np.ndarray, "n m"]:
    """Per joint, 1 ÷ how large the parent's twist and the rates can be when Σ q̇²/w ≤ 1: where a constant energy costs
    alike. Any positive numbers give a true bound.
    """
    levers = lever_arms(tree, weights)
    length = np.linalg.norm(tree.position, axis=1).sum() + np.linalg.norm(tree.centre, axis=1).max()
    scales = np.ones((tree.nv, 6 + tree.nv))
    for i, p in enumerate(tree.parents.tolist()):
        turning = sum(weights[j] for j in tree.path(p) if not tree.prismatic[j]) if p >= 0 else 0.0
        spin = turning + 1e-6 * weights.max()
        speed = float(levers[p](np.zeros(3))) + 1e-3 * spin * length**2 if p >= 0 else 1.0
        scales[i] = 1.0 / np.sqrt(np.concatenate([np.full(3, speed), np.full(3, spin), weights]))
    return scales
