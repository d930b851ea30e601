"""What an adaptive law does not know of an arm: bodies between nothing and a largest one, and numbers of its joints.

A body has the pseudo-inertia P = K X Kᵀ with 0 ≺ X ≺ 1: it can exist, and is less than the largest body P̄ = KKᵀ. A
number is lowest + width·x with 0 < x < 1 (docs/theory.md §10).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.computed_torque import ComputedTorque
from nbs_pin.controllers.gains import effective_inertia, gains_for_robot
from nbs_pin.controllers.model_law import ModelLaw
from nbs_pin.dynamics.pinocchio_tree import tree_frames
from nbs_pin.export.adaptation import Adapting, Load
from nbs_pin.kernels.adaptation import PER_BODY, PER_NUMBER
from nbs_pin.kernels.layout import NumberCode, Packed
from nbs_pin.kernels.symmetric4 import FARTHEST
from nbs_pin.kernels.tree_layout import ARMATURE, BASE, BODY, MASS
from nbs_pin.robots.places import place_of, tool_frame
from nbs_pin.robots.robot import Robot

ADAPTS = ("load", "links", "friction", "rotors", "offsets")
"""What a law can adapt: a load at a frame, bodies of links, joint friction, rotor inertia, constant torques."""
LOAD_AT = "load at "
"""What the name of a load begins with, before its link."""
KINDS = {
    NumberCode.VISCOUS: ("viscous friction", "damping"),
    NumberCode.COULOMB: ("Coulomb friction", "torque"),
    NumberCode.ROTOR: ("rotor inertia", "inertia"),
    NumberCode.OFFSET: ("constant torque", "torque"),
    NumberCode.ACCELERATION: ("constant acceleration", "acceleration"),
}
"""What numbers are, and their quantity in `base/units.py`."""
NO_MASS = 1e-3
"""Below this mass [kg] a load has no centre to speak of."""
UPPER = np.triu_indices(4)
_LEAST_SHARE = 1e-4  # what every direction of a body begins with, where the model has less, as a share of the largest
_REACH = 2.0  # a link's largest body, as a multiple of the one that the model has
_LENGTH, _SPREAD = 0.05, 0.02  # what a link's largest body has besides, so that a point mass is within it [m, share]
_FRICTION = 0.1  # largest friction, at the velocity limit if viscous, as a share of the effort limit
_BEND = 1e-5  # friction may seem to be below zero by what bends a joint by this much [rad, m]
_LIGHTER = 0.2  # how much lighter all joints together may seem
_ANY = 1e-3  # a bandwidth [rad/s], on which the stiffness does not depend
_UNLIMITED = 100.0  # effort [N·m] of a joint that states none
_FAST = np.pi  # velocity [rad/s] of a joint that states none


class UnknownBody(NamedTuple):
    """A body that is not known, in the frame of its joint's body in the tree."""

    name: str
    """"load at LINK", or the joint that carries the body."""
    joint: int
    factor: Float[np.ndarray, "4 4"]
    """K [√kg·m, √kg]."""
    start: Float[np.ndarray, "4 4"]
    """Q₀."""
    known: Float[np.ndarray, "4 4"]
    """Pseudo-inertia of what it replaces in the model."""
    place: Float[np.ndarray, "4 4"]
    """Placement of the frame that carries the load, or of the joint's frame, in which estimates are told."""
    is_load: bool
    """Whether estimates are told without the known body."""


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
        own = [body.start[UPPER] for body in self.bodies]
        return np.concatenate([*own, [number.start for number in self.numbers]])

    def packed(self, rates: np.ndarray, leak: float, output: tuple[int, np.ndarray]) -> Packed:
        """For `kernels/adaptation.py`: rates γ of every body, then every number; code and numbers of the output."""
        layout = [len(self.bodies), len(self.numbers), output[0], *(body.joint for body in self.bodies)]
        weights = [np.array([leak, self.transition]), output[1]]
        for body, rate in zip(self.bodies, rates, strict=False):
            p = body.known
            known = [p[3, 3], *p[:3, 3], *p[:3, :3][np.triu_indices(3)]]
            weights.append(np.hstack([body.factor.ravel(), body.start[UPPER], known, rate]))
            assert len(weights[-1]) == PER_BODY
        for number, rate in zip(self.numbers, rates[len(self.bodies) :], strict=True):
            layout += [number.code, number.joint]
            weights.append(np.array([number.lowest, number.width, number.start, number.known, rate]))
            assert len(weights[-1]) == PER_NUMBER
        return Packed(np.array(layout, dtype=np.int64), np.concatenate(weights))

    def adapting(self, rates: np.ndarray, leak: float, output: tuple[int, np.ndarray], period: float) -> Adapting:
        """For C, with the longest control period [s]."""
        bodies = [body.name if body.is_load else f"the body of {body.name}" for body in self.bodies]
        kinds = dict.fromkeys(KINDS[number.code][0] for number in self.numbers)
        load = next((_load_in_c(k, body) for k, body in enumerate(self.bodies) if body.is_load), None)
        return Adapting(self.packed(rates, leak, output), self.start, period, (*bodies, *kinds), load)


def _load_in_c(k: int, body: UnknownBody) -> Load:
    back = np.linalg.inv(body.place)
    known = back @ body.known @ back.T
    return Load(k, body.name.removeprefix(LOAD_AT), back @ body.factor, known[:, 3], NO_MASS)


class Carrier(NamedTuple):
    """Where a load is carried."""

    name: str
    """The link."""
    joint: int
    place: Float[np.ndarray, "4 4"]
    """Placement of the link in the frame of the joint's body in the tree, whose z is the axis of the joint."""

    @classmethod
    def of(cls, robot: Robot, frame: str | None) -> "Carrier":
        """The link of this name; None: the arm's end."""
        joint, _ = place_of(robot, frame)
        name = tool_frame(robot) if frame is None else frame
        placement = next(f.placement for f in robot.model.frames if f.name == name and f.type == pin.FrameType.BODY)
        return cls(name, joint - 1, into_tree(robot)[joint - 1] @ placement.homogeneous)

    def largest(self, mass: float, radius: float, across: float) -> Float[np.ndarray, "4 4"]:
        """P̄ ⪰ P for loads of at most this mass [kg] in an ellipsoid at the link's origin, by the axis and across [m].

        A point w = (x, 1) with xᵀR⁻¹x ≤ 1 has wᵀ diag(2R, 2)⁻¹ w ≤ 1, so a load there has P ⪯ m̄ diag(2R, 2).
        """
        origin = self.place[:, 3]
        return 2.0 * mass * (np.diag([across**2, across**2, radius**2, 0.0]) + origin[:, None] * origin)


def unknown_load(tree: Packed, carrier: Carrier, largest: Float[np.ndarray, "4 4"]) -> UnknownBody:
    """The body of a link with a load up to this pseudo-inertia."""
    known = model_body(tree, carrier.joint)
    return _between(LOAD_AT + carrier.name, carrier.joint, known, known + largest, carrier.place, True)


def unknown_links(robot: Robot, tree: Packed, names: Sequence[str]) -> list[UnknownBody]:
    """The bodies behind these joints, all without names, up to twice what the model has; those without mass are left.

    Raises ArgumentError for a name that no joint has.
    """
    wrong = [name for name in names if name not in robot.joint_names]
    if wrong:
        raise ArgumentError(f"{robot.name} has no joint '{wrong[0]}'; give some of {', '.join(robot.joint_names)}.")
    found, places = [], into_tree(robot)
    for i, name in enumerate(robot.joint_names):
        known = model_body(tree, i)
        if known[3, 3] > 0.0 and (not names or name in names):
            more = _SPREAD * known[3, 3] * np.diag([_LENGTH**2] * 3 + [0.0])
            found.append(_between(name, i, known, _REACH * (known + more), places[i], False))
    if not found:
        raise ArgumentError(f"no link of {robot.name} has mass; adapt a load instead.")
    return found


def _between(
    name: str, joint: int, known: np.ndarray, largest: np.ndarray, place: np.ndarray, is_load: bool
) -> UnknownBody:
    """A body up to the largest one that begins as the known one, apart from shares below 1e-4 or above 1 − 1e-4."""
    values, vectors = np.linalg.eigh(largest)
    if not values[0] > 0.0:
        raise ArgumentError(
            f"{name}: no body has this inertia, a pseudo-inertia with the eigenvalue {values[0]:.3g}; correct it."
        )
    factor = vectors * np.sqrt(values)
    share = np.linalg.solve(factor, np.linalg.solve(factor, known).T)
    shares, own = np.linalg.eigh(0.5 * (share + share.T))
    start = (own * _logit(np.clip(shares, _LEAST_SHARE, 1.0 - _LEAST_SHARE))) @ own.T
    return UnknownBody(name, joint, factor, start, known, place, is_load)


def unknown_numbers(law: ModelLaw, kind: str, period: float) -> list[UnknownNumber]:
    """Friction or offset of every joint, which begin as what the law has; offsets of computed torque accelerate."""
    robot, friction, dynamics = law.dynamics.robot, law.friction, law.dynamics
    assert robot is not None
    effort = np.where(np.isfinite(robot.effort_limit), robot.effort_limit, _UNLIMITED)
    speed = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, _FAST)
    n, zero, largest = robot.nv, np.zeros(robot.nv), _FRICTION * effort
    if kind == "offsets":
        accelerates = isinstance(law, ComputedTorque)
        code = NumberCode.ACCELERATION if accelerates else NumberCode.OFFSET
        most = effort / effective_inertia(robot, dynamics) if accelerates else effort
        return [UnknownNumber(code, i, -x, 2.0 * x, 0.0, 0.0) for i, x in enumerate(most)]
    own = (zero, zero) if friction is None else (friction.viscous, friction.coulomb)
    below = _BEND * gains_for_robot(robot, dynamics, bandwidth=_ANY, period=period).stiffness
    kinds = (NumberCode.VISCOUS, 1.0 / speed, own[0]), (NumberCode.COULOMB, np.ones(n), own[1])
    return [
        _number(code, i, x[i] * largest[i], known[i], x[i] * below[i]) for code, x, known in kinds for i in range(n)
    ]


def unknown_rotors(law: ModelLaw, tree: Packed, most: JointArray) -> list[UnknownNumber]:
    """Rotor inertia of every joint, which begins as what the model has, up to twice that and this [kg·m², kg]."""
    robot = law.dynamics.robot
    assert robot is not None
    below = _LIGHTER / robot.nv * effective_inertia(robot, law.dynamics)
    rotors = tree.weights[BASE:].reshape(-1, BODY)[:, ARMATURE]
    return [_number(NumberCode.ROTOR, i, most[i], rotors[i], below[i]) for i in range(robot.nv)]


def _number(code: NumberCode, i: int, most: float, known: float, below: float) -> UnknownNumber:
    """A number from −below to most and twice what is known, which begins as that."""
    width = most + 2.0 * known + below
    return UnknownNumber(code, i, -below, width, float(_logit((known + below) / width)), known)


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
    return np.asarray(np.clip(np.log(x) - np.log1p(-np.asarray(x)), -FARTHEST, FARTHEST))
