"""Joints along a path of the tool: q(s) as a quintic spline through configurations that meet the path to rounding.

Nodes are doubled until the spline itself, between them, misses the path by less than `FINE`. The spline is the motion:
what it misses is known, and its derivatives are exact. A path is refused at the point where the frame cannot follow.
"""

from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline, make_interp_spline

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import units
from nbs_pin.motions.inverse_kinematics import InverseKinematics, pose_error
from nbs_pin.motions.tool_paths import ToolPath

FINE = 1e-8
"""Error between nodes at which no more are added [m, rad]."""
COARSE = 1e-6
"""Largest error between nodes of a path that is followed [m, rad]."""
SINGULAR = 0.01
"""Least singular value of the Jacobian, with lengths over the reach: below it joints are much faster than the tool."""
_FIRST, _MOST = 64, 4096
"""Intervals between nodes, at first and at most."""
_BETWEEN = np.array([0.21, 0.5, 0.79])
"""Where the error is measured in every interval."""
_BISECTIONS = 12


@dataclass(frozen=True, eq=False)
class JointPath:
    """q(s) for s in [0, 1], four times continuously differentiable."""

    spline: BSpline
    missed: float
    """Largest distance of the frame from its path between the nodes [m]."""
    turned: float
    """Largest angle from the orientation of the path between the nodes [rad]; 0 if it is free."""

    def __call__(self, s: Float[np.ndarray, "*batch"], order: int = 0) -> Float[np.ndarray, "*batch n"]:
        """The derivative of that order of q by s."""
        return np.asarray(self.spline(s, order))

    def bound(self, order: int) -> JointArray:
        """Bound of the derivative of that order of each joint: its largest spline coefficient."""
        return np.asarray(np.abs(self.spline.derivative(order).c).max(axis=0))


def joint_path(inverse: InverseKinematics, path: ToolPath) -> JointPath:
    """The joints along the path, from the configuration nearest to the posture that begins it.

    The orientation of the frame in the posture is kept where the path states none.

    Raises:
        ArgumentError: At the first point that is out of reach, singular, beyond a joint limit or not smooth.
    """
    orientation = inverse.robot.pose(inverse.posture, inverse.frame)[:3, :3]
    s = np.linspace(0.0, 1.0, _FIRST + 1)
    q = _first_nodes(inverse, path, orientation, s)
    while True:
        _check_nodes(inverse, path, orientation, s, q)
        spline = make_interp_spline(s, q, k=5, axis=0)
        between = (s[:-1, None] + np.diff(s)[:, None] * _BETWEEN).ravel()
        error = pose_error(inverse.robot.pose(spline(between), inverse.frame), path.poses(between, orientation))
        missed, turned = (np.linalg.norm(part, axis=-1) for part in (error[:, :3], error[:, 3:]))
        turned = turned if inverse.hold else np.zeros_like(turned)
        worst = np.maximum(missed, turned)
        if worst.max() <= FINE or (len(s) > _MOST and worst.max() <= COARSE):
            return JointPath(spline, float(missed.max()), float(turned.max()))
        if len(s) > _MOST:
            at = float(between[np.argmax(worst)])
            place = _place(path, at, path.poses(np.array(at), orientation))
            raise ArgumentError(
                f"{place} bends more sharply than the joints can follow, or makes them jump (a spline through {len(s)} "
                f"points misses it by {worst.max():.2g} m or rad); smooth the path, or begin in another posture."
            )
        middle = 0.5 * (s[1:] + s[:-1])
        added = [_met(inverse, path, orientation, x, guess) for x, guess in zip(middle, spline(middle), strict=True)]
        order = np.argsort(np.concatenate([s, middle]))
        s, q = np.concatenate([s, middle])[order], np.concatenate([q, np.array(added)])[order]


def _first_nodes(
    inverse: InverseKinematics, path: ToolPath, orientation: Float[np.ndarray, "3 3"], s: Float[np.ndarray, " nodes"]
) -> Float[np.ndarray, "nodes n"]:
    """Configurations along the path, each from those before it."""
    nodes = [_met(inverse, path, orientation, s[0], inverse.posture)]
    for k in range(1, len(s)):
        guess = nodes[-1] if k == 1 else 2.0 * nodes[-1] - nodes[-2]
        found = inverse.solve(guess, path.poses(s[k], orientation))
        if not found.exact:
            _refuse_first(inverse, path, orientation, (float(s[k - 1]), float(s[k])), nodes[-1])
        nodes.append(found.q)
    return np.array(nodes)


def _met(
    inverse: InverseKinematics, path: ToolPath, orientation: Float[np.ndarray, "3 3"], s: float, guess: JointArray
) -> JointArray:
    """The configuration at s; raises ArgumentError if there is none near the guess."""
    found = inverse.solve(guess, path.poses(np.array(s), orientation))
    if not found.exact:
        _refuse(inverse, path, orientation, (float(s), float(s)), guess)
    return found.q


def _refuse_first(
    inverse: InverseKinematics,
    path: ToolPath,
    orientation: Float[np.ndarray, "3 3"],
    span: tuple[float, float],
    q: JointArray,
) -> NoReturn:
    """Raise ArgumentError at the first point of the span that is not met; its beginning is."""
    met, lost = span
    for _ in range(_BISECTIONS):
        middle = 0.5 * (met + lost)
        found = inverse.refine(q, path.poses(np.array(middle), orientation))
        met, lost, q = (middle, lost, found.q) if found.exact else (met, middle, q)
    _refuse(inverse, path, orientation, (lost, span[1]), q)


def _refuse(
    inverse: InverseKinematics,
    path: ToolPath,
    orientation: Float[np.ndarray, "3 3"],
    span: tuple[float, float],
    q: JointArray,
) -> NoReturn:
    """Raise ArgumentError at the beginning of the span, with what the frame misses at its end."""
    first, then = span
    pose = path.poses(np.array(then), orientation)
    nearest = inverse.solution(inverse.approach(q, pose), pose)
    there = "there" if first == then else f"at {path.travelled(then):.4g} m"
    turned = f" and {nearest.turned:.3g} rad" if inverse.hold else ""
    free = f", or let the orientation free ({option('orientation', 'free')})" if inverse.hold else ""
    raise ArgumentError(
        f"{_place(path, first, path.poses(np.array(first), orientation))} is out of reach of '{inverse.frame}', which "
        f"misses it {there} by {1e3 * nearest.missed:.3g} mm{turned} (smallest singular value "
        f"{inverse.steadiness(nearest.q):.2g}); make the path smaller, begin elsewhere{free}."
    )


def _place(path: ToolPath, s: float, pose: Float[np.ndarray, "4 4"]) -> str:
    """A point of the path, in words."""
    x, y, z = pose[:3, 3]
    return f"the {path.name} at {path.travelled(s):.4g} m ({s:.1%} of it), x, y, z = {x:.4g}, {y:.4g}, {z:.4g} m,"


def _check_nodes(
    inverse: InverseKinematics,
    path: ToolPath,
    orientation: Float[np.ndarray, "3 3"],
    s: Float[np.ndarray, " nodes"],
    q: Float[np.ndarray, "nodes n"],
) -> None:
    """Raise ArgumentError at the first node that is singular or beyond a joint limit."""
    robot = inverse.robot
    steady = inverse.steadiness(q)
    beyond = (q < robot.lower) | (q > robot.upper)
    wrong = (steady < SINGULAR) | beyond.any(axis=-1)
    if not wrong.any():
        return
    k = int(np.argmax(wrong))
    place = _place(path, float(s[k]), path.poses(s[k], orientation))
    if steady[k] < SINGULAR:
        raise ArgumentError(
            f"{place} is singular for '{inverse.frame}': the smallest singular value of its Jacobian is "
            f"{steady[k]:.2g}, expected at least {SINGULAR:g}; lead the path elsewhere or begin in another posture."
        )
    i = int(np.argmax(beyond[k]))
    (unit,) = units("position", [robot.joints[i].prismatic])
    raise ArgumentError(
        f"{place} needs {q[k, i]:.4g} {unit} of joint '{robot.joint_names[i]}', outside [{robot.lower[i]:.4g}, "
        f"{robot.upper[i]:.4g}]; lead the path elsewhere or begin in another posture."
    )
