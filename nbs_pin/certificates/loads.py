"""Loads that the model does not include, as disturbances: a payload, joint friction, an error of gravity.

Each is a box |τ_d,i| ≤ b_i along a reference: the peak torque of the load on the reference itself, times a margin for
deviations from it. It is EMPIRICAL, as the margin is a choice. The torque of a gravity error depends on q alone and is
also bounded for every q by lever arms, which is PROVED.
"""

from typing import NamedTuple

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, floats, positive
from nbs_pin.base.claims import Claim, Group, Label, weakest
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.robots.robot import Robot

MARGIN = 1.5
"""Default factor on the peak torque along the reference, for deviations from it."""
_SAMPLES = 2001
_OUTWARD = 1.0 + 1e-9
"""Each bound is enlarged by this factor, far more than the rounding of the operations behind it."""
_ROUNDING = 1e-12


class Load(NamedTuple):
    """A disturbance and how its bound is known."""

    admissible: Admissible
    """|τ_d,i| ≤ box_i [N·m]."""
    claim: Claim
    """The largest of the joint bounds, with label and reason."""


def payload(
    robot: Robot,
    mass: float,
    reference: DesiredMotion,
    *,
    frame: str | None = None,
    position: Float[np.ndarray, "3"] | None = None,
    duration: float = 10.0,
    margin: float = MARGIN,
) -> Load:
    """The torque of a point mass [kg] that the model does not include, by its weight and inertia along the reference.

    `frame` is the link that carries it (None: `tool_frame`), `position` its position in that frame [m] (None: the
    origin). The bound is `margin` times the peak of |ΔM a + ΔC v + ΔG| over `duration` [s].

    Raises:
        ArgumentError: If a number is out of range or the link does not exist.
    """
    positive("the payload", mass, "kg")
    joint, at = _place(robot, frame, position)
    loaded = robot.model.copy()
    loaded.appendBodyToJoint(joint, pin.Inertia(mass, at, np.zeros((3, 3))), pin.SE3.Identity())
    desired = sampled(robot, reference, duration)
    torques = [np.array(_rnea(loaded, desired)) - np.array(_rnea(robot.model, desired))]
    what = f"a payload of {mass:g} kg at {frame or tool_frame(robot)}"
    return _along(what, np.abs(torques[0]).max(axis=0), margin, duration)


def friction(
    robot: Robot,
    reference: DesiredMotion | None = None,
    *,
    viscous: PerJoint | None = None,
    coulomb: PerJoint | None = None,
    duration: float = 10.0,
    margin: float = MARGIN,
) -> Load:
    """Joint friction b·v + c·sign(v) that is not fed forward: c_i everywhere, b_i|v_i| along the reference.

    `viscous` is b [N·m·s/rad], `coulomb` is c [N·m], each one number or one per joint (None: the URDF's). The margin
    scales the speeds. The bound is PROVED for Coulomb friction alone.

    Raises:
        ArgumentError: If there is no friction, or viscous friction without a reference.
    """
    b = _one_each("viscous", robot.damping if viscous is None else viscous, robot.nv)
    c = _one_each("coulomb", robot.friction if coulomb is None else coulomb, robot.nv)
    JointFriction(b, c)  # raises for invalid coefficients
    if not (b.any() or c.any()):
        raise ArgumentError(f"{robot.name} states no joint friction; give viscous and coulomb coefficients.")
    if not b.any():
        return _load("joint friction", c.copy(), Label.PROVED, "Coulomb friction never exceeds its coefficient")
    if reference is None:
        raise ArgumentError("viscous friction grows with speed; give the reference that sets the speeds.")
    peak = np.abs(sampled(robot, reference, duration).v).max(axis=0)
    return _along("joint friction", b * peak, margin, duration, constant=c)


def gravity_error(
    robot: Robot,
    error: float,
    reference: DesiredMotion | None = None,
    *,
    duration: float = 10.0,
    margin: float = MARGIN,
) -> Load:
    """Gravity that differs from the model's by a vector of at most `error` [m/s²], in any direction.

    For a base tilted by α it is 2‖g‖ sin(α/2). Torques of gravity are linear in g, so the worst direction is exact.
    Without a reference the bound holds for every q (PROVED, by lever arms), else along it, times the margin.

    Raises:
        ArgumentError: If a number is out of range or a prismatic joint has no position limits.
    """
    positive("the gravity error", error, "m/s²")
    what = f"a gravity error of {error:g} m/s²"
    bodies = [(j, inertia.mass, inertia.lever) for j, inertia in enumerate(robot.model.inertias) if j > 0]
    everywhere = error * sum((mass * _levers(robot, j, at) for j, mass, at in bodies), np.zeros(robot.nv)) * _OUTWARD
    if reference is None:
        return _load(what, everywhere, Label.PROVED, "‖Δg‖ × Σ mass × the longest lever arm, a sum of link lengths")
    desired, columns = sampled(robot, reference, duration), []
    for axis in np.eye(3):
        model = robot.model.copy()
        model.gravity.linear = axis
        columns.append(_rnea(model, Reference(desired.q, 0.0 * desired.v, 0.0 * desired.a)))
    peak = error * np.linalg.norm(np.array(columns), axis=0).max(axis=0)
    return _along(what, peak, margin, duration, most=everywhere)


def total(*loads: "Load | Admissible") -> Admissible:
    """The sum of disturbances, a ball of balls or else a box; raises ArgumentError unless their joints are the same."""
    parts = [load.admissible if isinstance(load, Load) else load for load in loads]
    boxes = [part.box for part in parts if part.box is not None]
    radius = sum(part.radius for part in parts if part.radius is not None)
    if not parts or len({len(box) for box in boxes}) > 1:
        raise ArgumentError("total adds disturbances of one arm; give at least one, all for the same joints.")
    return Admissible(box=sum(boxes, np.full(len(boxes[0]), radius))) if boxes else Admissible(radius=radius)


def tool_frame(robot: Robot) -> str:
    """The link fixed to the last joint that is farthest from it, where a tool or payload usually is."""
    frames = [f for f in robot.model.frames if f.type == pin.FrameType.BODY and f.parentJoint == robot.nv]
    return str(max(frames, key=lambda f: float(np.linalg.norm(f.placement.translation))).name)


def _place(robot: Robot, frame: str | None, position: Float[np.ndarray, "3"] | None) -> tuple[int, np.ndarray]:
    """The joint that carries the point, and the point in its frame [m]."""
    name = tool_frame(robot) if frame is None else frame
    bodies = {f.name: f for f in robot.model.frames if f.type == pin.FrameType.BODY and f.parentJoint > 0}
    if name not in bodies:
        raise ArgumentError(f"{robot.name} has no moving link '{name}'; give one of {', '.join(bodies)}.")
    at = np.zeros(3) if position is None else floats("position", position)
    if at.shape != (3,) or not np.isfinite(at).all():
        raise ArgumentError(f"position is {position}, expected three finite numbers [m]; correct it.")
    return int(bodies[name].parentJoint), np.array(bodies[name].placement.act(at))


def _levers(robot: Robot, joint: int, at: Float[np.ndarray, "3"]) -> JointArray:
    """Per joint, the largest |torque| that a unit force at a point of body `joint` can cause for any q [m].

    Revolute joint: the distance of the point from the axis, at most the sum of the link lengths between them. Prismatic
    joint: 1. Joints that do not carry the point: 0.
    """
    model, levers = robot.model, np.zeros(robot.nv)
    motions, point, beyond = model.createData().joints, at, 0.0
    while joint > 0:
        slides = robot.joints[joint - 1].prismatic
        axis = np.array(motions[joint].S)[:3] if slides else np.array(motions[joint].S)[3:]
        length = float(np.linalg.norm(point))
        # The lever arm of a point on the axis consists of rounding errors.
        levers[joint - 1] = 1.0 if slides else np.linalg.norm(np.cross(axis, point)) + beyond + _ROUNDING * length
        travel = max(abs(robot.lower[joint - 1]), abs(robot.upper[joint - 1])) if slides else 0.0
        if not np.isfinite(travel):
            raise ArgumentError(f"joint '{robot.joint_names[joint - 1]}' slides without end; give it position limits.")
        beyond += length + travel
        point, joint = np.array(model.jointPlacements[joint].translation), int(model.parents[joint])
    return levers


def sampled(robot: Robot, reference: DesiredMotion, duration: float) -> Reference:
    """The reference at evenly spaced times over `duration` [s]; raises ArgumentError if it does not fit the arm."""
    positive("duration", duration, "s")
    desired = Reference(*(np.asarray(x, dtype=float) for x in reference(np.linspace(0.0, duration, _SAMPLES))))
    if any(x.shape != (_SAMPLES, robot.nv) or not np.isfinite(x).all() for x in desired):
        raise ArgumentError(
            f"the reference is not a finite motion of the {robot.nv} joints of {robot.name}; correct it."
        )
    return desired


def _rnea(model: pin.Model, desired: Reference) -> list[np.ndarray]:
    """Torques [N·m] at every instant."""
    data = model.createData()
    return [np.array(pin.rnea(model, data, *row)) for row in zip(*desired, strict=True)]


def _along(
    what: str, peak: JointArray, margin: float, duration: float, constant: PerJoint = 0.0, most: PerJoint = np.inf
) -> Load:
    """The bound margin × peak + constant, or `most` where that is less."""
    if not 1.0 <= margin < np.inf:
        raise ArgumentError(f"margin is {margin}, expected a finite number of at least 1; 1.5 is usual.")
    because = (
        f"{margin:g} × the peak over {_SAMPLES} instants of {duration:g} s of the reference; "
        "deviations from it may need more"
    )
    return _load(what, np.minimum(margin * peak + constant, most), Label.EMPIRICAL, because)


def _load(what: str, box: JointArray, label: Label, because: str) -> Load:
    largest = Claim(f"{what}, largest |τ_d,i|", float(box.max()), "N·m", label, because, Group.LOADS)
    return Load(Admissible.of(box, len(box)), largest)


def _one_each(name: str, value: PerJoint, nv: int) -> JointArray:
    array = floats(name, value)
    if array.shape not in ((), (nv,)):
        raise ArgumentError(f"{name} is {value}, expected one number or {nv}, one per joint; correct it.")
    return np.full(nv, array)


def label_of(*loads: Load) -> Label:
    """The weakest label of the loads; PROVED without loads."""
    return weakest(*(load.claim.label for load in loads))
