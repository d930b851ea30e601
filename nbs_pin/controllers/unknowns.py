"""What an adaptive law does not know of an arm: bodies between nothing and a largest one, and numbers of its joints.

A body has the pseudo-inertia P = K X Kᵀ with 0 ≺ X ≺ 1: it can exist, and is less than the largest body P̄ = KKᵀ. A
number is lowest + width·x with 0 < x < 1 (docs/theory.md §9).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.gains import effective_inertia, largest_inertia
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.pinocchio_tree import tree_frames
from nbs_pin.kernels.adaptation import PER_BODY, PER_NUMBER
from nbs_pin.kernels.layout import NumberCode, Packed
from nbs_pin.kernels.symmetric4 import FARTHEST
from nbs_pin.kernels.tree_layout import ARMATURE, BASE, BODY, MASS
from nbs_pin.robots.places import place_of, tool_frame
from nbs_pin.robots.robot import Robot

ADAPTS = ("load", "links", "friction", "rotors", "offsets")
"""What a law can adapt: a load at a frame, bodies of links, joint friction, rotor inertia, constant torques."""
_UPPER = np.triu_indices(4)
_LEAST_LOAD = 1e-3  # first estimate of a load, as a share of the largest
_REACH = 2.0  # a link's largest body, as a multiple of the one that the model has
_LENGTH, _SPREAD = 0.05, 0.02  # what a link's largest body has besides, so that a point mass is within it [m, share]
_FRICTION, _FIRST = 0.1, 1e-3  # largest Coulomb friction and offset as a share of the effort, first estimate of that
_ROTOR, _FIRST_ROTOR = 0.25, 0.05  # largest rotor inertia, of the arm's largest; first, of the least inertia at a joint
_UNLIMITED = 100.0  # effort [N·m] of a joint that states none
_FAST = np.pi  # velocity [rad/s] of a joint that states none


class UnknownBody(NamedTuple):
    """A body that is not known, in the frame of its joint's body in the tree."""

    name: str
    joint: int
    factor: Float[np.ndarray, "4 4"]
    """K [√kg·m, √kg]."""
    start: Float[np.ndarray, "4 4"]
    """Q₀."""
    known: Float[np.ndarray, "4 4"]
    """Pseudo-inertia of what it replaces in the model."""
    frame: Float[np.ndarray, "4 4"] | None = None
    """Placement of the frame that carries a load, None for a link."""


class UnknownNumber(NamedTuple):
    """A number of a joint that is not known."""

    code: NumberCode
    joint: int
    lowest: float
    width: float
    start: float
    """Dual of the first estimate."""
    known: float
    """What it replaces in the model."""


class Unknowns(NamedTuple):
    """All that a law adapts."""

    bodies: tuple[UnknownBody, ...]
    numbers: tuple[UnknownNumber, ...]
    transition: float
    """Speed scale of Coulomb friction [rad/s]."""

    @property
    def start(self) -> np.ndarray:
        """All duals at the start."""
        own = [body.start[_UPPER] for body in self.bodies]
        return np.concatenate([*own, [number.start for number in self.numbers]])

    def packed(self, rates: np.ndarray, leak: float) -> Packed:
        """For `kernels/adaptation.py`; rates γ of every body, then every number."""
        layout = [len(self.bodies), len(self.numbers), *(body.joint for body in self.bodies)]
        weights = [np.array([leak, self.transition])]
        for body, rate in zip(self.bodies, rates, strict=False):
            p = body.known
            known = [p[3, 3], *p[:3, 3], *p[:3, :3][np.triu_indices(3)]]
            weights.append(np.hstack([body.factor.ravel(), body.start[_UPPER], known, rate]))
            assert len(weights[-1]) == PER_BODY
        for number, rate in zip(self.numbers, rates[len(self.bodies) :], strict=True):
            layout += [number.code, number.joint]
            weights.append(np.array([number.lowest, number.width, number.start, number.known, rate]))
            assert len(weights[-1]) == PER_NUMBER
        return Packed(np.array(layout, dtype=np.int64), np.concatenate(weights))


def triangle_matrices(duals: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., 4, 4) of upper triangles (..., 10)."""
    matrix = np.zeros((*duals.shape[:-1], 4, 4))
    matrix[..., _UPPER[0], _UPPER[1]] = matrix[..., _UPPER[1], _UPPER[0]] = duals
    return matrix


def unknown_load(robot: Robot, frame: str | None, mass: float, radius: float) -> UnknownBody:
    """A load of at most `mass` [kg] within `radius` [m] of the origin of a link; None takes the arm's end.

    A point w = (x, 1) with ‖x‖ ≤ r has wᵀ diag(2r², 2r², 2r², 2)⁻¹ w ≤ 1, hence P ⪯ m̄ diag(2r², 2r², 2r², 2).
    """
    joint, _ = place_of(robot, frame)
    name = tool_frame(robot) if frame is None else frame
    placement = next(f.placement for f in robot.model.frames if f.name == name and f.type == pin.FrameType.BODY)
    root = np.sqrt(2.0 * mass) * np.diag([radius, radius, radius, 1.0])
    carried = into_tree(robot)[joint - 1] @ placement.homogeneous
    return UnknownBody(name, joint - 1, carried @ root, _logit(_LEAST_LOAD) * np.eye(4), np.zeros((4, 4)), carried)


def unknown_links(robot: Robot, tree: Packed, names: Sequence[str]) -> tuple[UnknownBody, ...]:
    """The bodies behind these joints, all without names, up to twice what the model has; those without mass are left.

    Raises ArgumentError for a name that no joint has.
    """
    wrong = [name for name in names if name not in robot.joint_names]
    if wrong:
        raise ArgumentError(f"{robot.name} has no joint '{wrong[0]}'; give some of {', '.join(robot.joint_names)}.")
    found = []
    for i, name in enumerate(robot.joint_names):
        p = model_body(tree, i)
        if p[3, 3] > 0.0 and (not names or name in names):
            more = _SPREAD * p[3, 3] * np.diag([_LENGTH**2] * 3 + [0.0])
            values, vectors = np.linalg.eigh(_REACH * (p + more))
            factor = vectors * np.sqrt(values)
            share = np.linalg.solve(factor, np.linalg.solve(factor, p).T)
            shares, own = np.linalg.eigh(0.5 * (share + share.T))
            start = (own * _logit(np.clip(shares, 1e-6, 1.0 - 1e-6))) @ own.T
            found.append(UnknownBody(name, i, factor, start, p))
    if not found:
        raise ArgumentError(f"no link of {robot.name} has mass; adapt a load instead.")
    return tuple(found)


def unknown_numbers(robot: Robot, tree: Packed, kind: str, viscous: np.ndarray, coulomb: np.ndarray) -> list[UnknownNumber]:
    """Friction, rotor inertia or offset of every joint, around what the model has."""
    effort = np.where(np.isfinite(robot.effort_limit), robot.effort_limit, _UNLIMITED)
    speed = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, _FAST)
    n, found = robot.nv, []
    if kind == "offsets":
        return [UnknownNumber(NumberCode.OFFSET, i, -x, 2.0 * x, 0.0, 0.0) for i, x in enumerate(_FRICTION * effort)]
    if kind == "friction":
        largest = _FRICTION * effort
        for code, width, own in ((NumberCode.VISCOUS, largest / speed, viscous), (NumberCode.COULOMB, largest, coulomb)):
            found += [_above(code, i, width[i] + 2.0 * own[i], own[i], _FIRST * width[i]) for i in range(n)]
        return found
    dynamics = PinocchioDynamics(robot)
    width, least = _ROTOR * largest_inertia(robot, dynamics).max(), effective_inertia(robot, dynamics)
    own = np.array([tree.weights[BASE + BODY * i + ARMATURE] for i in range(n)])
    return [_above(NumberCode.ROTOR, i, width + 2.0 * own[i], own[i], _FIRST_ROTOR * least[i]) for i in range(n)]


def _above(code: NumberCode, i: int, width: float, known: float, first: float) -> UnknownNumber:
    """A number of at least zero that begins at what is known, or at `first` where that is zero."""
    share = np.clip(max(known, first) / width, 1e-6, 1.0 - 1e-6)
    return UnknownNumber(code, i, 0.0, float(width), float(_logit(share)), float(known))


def into_tree(robot: Robot) -> np.ndarray:
    """4×4 matrices that take points in the joints' frames to the bodies' frames in the tree."""
    turns = np.tile(np.eye(4), (robot.nv, 1, 1))
    turns[:, :3, :3] = np.swapaxes(tree_frames(robot.model), 1, 2)
    return turns


def model_body(tree: Packed, i: int) -> np.ndarray:
    """The pseudo-inertia of body i."""
    numbers = tree.weights[BASE + BODY * i + MASS : BASE + BODY * i + ARMATURE]
    p, upper = np.zeros((4, 4)), np.triu_indices(3)
    p[upper] = numbers[4:]
    p[:3, 3], p[3, 3] = numbers[1:4], numbers[0]
    return np.triu(p) + np.triu(p, 1).T


def _logit(x: float | np.ndarray) -> np.ndarray:
    return np.clip(np.log(x) - np.log1p(-np.asarray(x)), -FARTHEST, FARTHEST)

