"""Loads that the model does not include, as disturbances: a payload and an error of gravity.

Each is a box |τ_d,i| ≤ b_i along a reference: the peak torque of the load on the reference itself, times a margin for
deviations from it. It is EMPIRICAL, as the margin is a choice. The torque of a gravity error depends on q alone and is
also bounded for every q by lever arms, which is PROVED.
"""

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, positive
from nbs_pin.base.claims import Claim, Group, Label
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.sampled_motion import INSTANTS, SampledMotion
from nbs_pin.motions.references import DesiredMotion
from nbs_pin.robots.places import place_of, tool_frame
from nbs_pin.robots.robot import Robot

MARGIN = 1.5
"""Default factor on the peak torque along the reference, for deviations from it."""
_OUTWARD = 1.0 + 1e-9
"""Each bound is enlarged by this factor, far more than the rounding of the operations behind it."""
_ROUNDING = 1e-12


def payload(
    robot: Robot,
    mass: float,
    reference: DesiredMotion,
    *,
    frame: str | None = None,
    position: Float[np.ndarray, "3"] | None = None,
    duration: float = 10.0,
    margin: float = MARGIN,
) -> Admissible:
    """The torque of a point mass [kg] that the model does not include, by its weight and inertia along the reference.

    `frame` is the link that carries it (None: `tool_frame`), `position` its position in that frame [m] (None: the
    origin). The bound is `margin` times the peak of |ΔM a + ΔC v + ΔG| over `duration` [s].

    Raises:
        ArgumentError: If a number is out of range or the link does not exist.
    """
    positive("the payload", mass, "kg")
    joint, at = place_of(robot, frame, position)
    loaded = robot.model.copy()
    loaded.appendBodyToJoint(joint, pin.Inertia(mass, at, np.zeros((3, 3))), pin.SE3.Identity())
    desired = SampledMotion.of(reference, robot.nv, duration).rows
    torques = [np.array(_rnea(loaded, desired)) - np.array(_rnea(robot.model, desired))]
    what = f"a payload of {mass:g} kg at {frame or tool_frame(robot)}"
    return _along(what, np.abs(torques[0]).max(axis=0), margin, duration)


def gravity_error(
    robot: Robot,
    error: float,
    reference: DesiredMotion | None = None,
    *,
    duration: float = 10.0,
    margin: float = MARGIN,
) -> Admissible:
    """Gravity that differs from the model's by a vector of at most `error` [m/s²], in any direction.

    For a base tilted by α it is 2‖g‖ sin(α/2). Torques of gravity are linear in g, so the worst direction is exact.
    Without a reference the bound holds for every q (PROVED, by lever arms), else along it, times the margin.

    Raises:
        ArgumentError: If a number is out of range or a prismatic joint has no position limits.
    """
    positive("the gravity error", error, "m/s²")
    what = f"a gravity error of {error:g} m/s²"
    bodies = [(j, inertia.mass, inertia.lever) for j, inertia in enumerate(robot.model.inertias) if j > 0]
    everywhere = (
        error * sum((mass * longest_levers(robot, j, at) for j, mass, at in bodies), np.zeros(robot.nv)) * _OUTWARD
    )
    if reference is None:
        return _load(what, everywhere, Label.PROVED, "‖Δg‖ × Σ mass × the longest lever arm, a sum of link lengths")
    desired, columns = SampledMotion.of(reference, robot.nv, duration).rows, []
    for axis in np.eye(3):
        model = robot.model.copy()
        model.gravity.linear = axis
        columns.append(_rnea(model, Reference(desired.q, 0.0 * desired.v, 0.0 * desired.a)))
    peak = error * np.linalg.norm(np.array(columns), axis=0).max(axis=0)
    return _along(what, peak, margin, duration, most=everywhere)


def total(*parts: Admissible) -> Admissible:
    """The sum of disturbances, a ball of balls or else a box; raises ArgumentError unless their joints are the same."""
    boxes = [part.box for part in parts if part.box is not None]
    radius = sum(part.radius for part in parts if part.radius is not None)
    if not parts or len({len(box) for box in boxes}) > 1:
        raise ArgumentError("total adds disturbances of one arm; give at least one, all for the same joints.")
    claims = tuple(claim for part in parts for claim in part.claims)
    if not boxes:
        return Admissible(radius=radius, claims=claims)
    return Admissible(box=sum(boxes, np.full(len(boxes[0]), radius)), claims=claims)


def longest_levers(robot: Robot, joint: int, at: Float[np.ndarray, "3"]) -> JointArray:
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


def _rnea(model: pin.Model, desired: Reference) -> list[np.ndarray]:
    """Torques [N·m] at every instant."""
    data = model.createData()
    return [np.array(pin.rnea(model, data, *row)) for row in zip(*desired, strict=True)]


def _along(what: str, peak: JointArray, margin: float, duration: float, most: PerJoint = np.inf) -> Admissible:
    """The bound margin × peak, or `most` where that is less."""
    if not 1.0 <= margin < np.inf:
        raise ArgumentError(f"margin is {margin}, expected a finite number of at least 1; 1.5 is usual.")
    because = (
        f"{margin:g} × the peak over {INSTANTS} instants of {duration:g} s of the reference; "
        "deviations from it may need more"
    )
    return _load(what, np.minimum(margin * peak, most), Label.EMPIRICAL, because)


def _load(what: str, box: JointArray, label: Label, because: str) -> Admissible:
    largest = Claim(f"{what}, largest |τ_d,i|", float(box.max()), "N·m", label, because, Group.LOADS)
    return Admissible(box=box, claims=(largest,))
