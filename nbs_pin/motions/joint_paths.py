"""Joints along a path of the tool: q(s) as a quintic spline through configurations that meet the path to rounding.

Nodes are doubled until the spline itself, between them, misses the path by less than `FINE`. The spline is the motion:
what it misses is known, and its derivatives are exact. A path is refused at the point where the frame cannot follow.
"""

from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from jaxtyping import Float
from scipy.interpolate import BSpline, PPoly, make_interp_spline

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.doors import option
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.units import percent, units
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

    def turns(self) -> Float[np.ndarray, " points"]:
        """All s where a joint turns back: with the ends, every joint is largest and least at one of them."""
        first = self.spline.derivative()
        joints = (PPoly.from_spline((first.t, column, first.k)) for column in first.c.T)
        found = np.concatenate([joint.roots(discontinuity=False, extrapolate=False) for joint in joints])
        return np.asarray(np.sort(found[np.isfinite(found)]))  # not a number where a joint rests


def joint_path(inverse: InverseKinematics, path: ToolPath) -> JointPath:
    """The joints along the path, from the configuration nearest to the posture that begins it.

    The orientation of the frame in the posture is kept where the path states none.

    Raises:
        ArgumentError: At the first point that is out of reach, singular, beyond a joint limit or not smooth.
    """
    followed = _Followed(inverse, path, inverse.robot.pose(inverse.posture, inverse.frame)[:3, :3])
    s = np.linspace(0.0, 1.0, _FIRST + 1)
    q = followed.first_nodes(s)
    while True:
        followed.check(s, q)
        spline = make_interp_spline(s, q, k=5, axis=0)
        between = (s[:-1, None] + np.diff(s)[:, None] * _BETWEEN).ravel()
        error = pose_error(inverse.robot.pose(spline(between), inverse.frame), followed.poses(between))
        missed, turned = (np.linalg.norm(part, axis=-1) for part in (error[:, :3], error[:, 3:]))
        turned = turned if inverse.hold else np.zeros_like(turned)
        worst = np.maximum(missed, turned)
        if worst.max() <= FINE or (len(s) > _MOST and worst.max() <= COARSE):
            joints = JointPath(spline, float(missed.max()), float(turned.max()))
            followed.check(joints.turns(), joints(joints.turns()))
            return joints
        if len(s) > _MOST:
            raise ArgumentError(
                f"{followed.place(float(between[np.argmax(worst)]))} bends more sharply than the joints can follow, or "
                f"makes them jump (a spline through {len(s)} points misses it by {worst.max():.2g} m or rad); smooth "
                "the path, or begin in another posture."
            )
        middle = 0.5 * (s[1:] + s[:-1])
        added = [followed.met(float(x), guess) for x, guess in zip(middle, spline(middle), strict=True)]
        order = np.argsort(np.concatenate([s, middle]))
        s, q = np.concatenate([s, middle])[order], np.concatenate([q, np.array(added)])[order]


@dataclass(frozen=True, eq=False)
class _Followed:
    """A path that a frame follows, and the refusals at its points."""

    inverse: InverseKinematics
    path: ToolPath
    orientation: Float[np.ndarray, "3 3"]
    """Of the frame where the path states none."""

    def poses(self, s: Float[np.ndarray, "*batch"] | float) -> Float[np.ndarray, "*batch 4 4"]:
        """The poses of the frame along the path."""
        return self.path.poses(np.asarray(s), self.orientation)

    def first_nodes(self, s: Float[np.ndarray, " nodes"]) -> Float[np.ndarray, "nodes n"]:
        """Configurations along the path, each from those before it."""
        nodes = [self.met(float(s[0]), self.inverse.posture)]
        for k in range(1, len(s)):
            guess = nodes[-1] if k == 1 else 2.0 * nodes[-1] - nodes[-2]
            found = self.inverse.solve(guess, self.poses(s[k]))
            if not found.exact:
                self._refuse_first(float(s[k - 1]), float(s[k]), nodes[-1])
            nodes.append(found.q)
        return np.array(nodes)

    def met(self, s: float, guess: JointArray) -> JointArray:
        """The configuration at s; raises ArgumentError if there is none near the guess."""
        found = self.inverse.solve(guess, self.poses(s))
        if not found.exact:
            self._refuse(s, s, guess)
        return found.q

    def _refuse_first(self, met: float, end: float, q: JointArray) -> NoReturn:
        """Raise ArgumentError at the first point after `met` that is not met; `end` is not."""
        lost = end
        for _ in range(_BISECTIONS):
            middle = 0.5 * (met + lost)
            found = self.inverse.refine(q, self.poses(middle))
            met, lost, q = (middle, lost, found.q) if found.exact else (met, middle, q)
        self._refuse(lost, end, q)

    def _refuse(self, first: float, then: float, q: JointArray) -> NoReturn:
        """Raise ArgumentError at the point `first`, with what the frame misses at `then`."""
        inverse, pose = self.inverse, self.poses(then)
        nearest = inverse.solution(inverse.approach(q, pose), pose)
        there = "there" if first == then else f"at {self.path.travelled(then):.4g} m"
        turned = f" and {nearest.turned:.3g} rad" if inverse.hold else ""
        free = f", or let the orientation free ({option('orientation', 'free')})" if inverse.hold else ""
        raise ArgumentError(
            f"{self.place(first)} is out of reach of '{inverse.frame}', which misses it {there} by "
            f"{1e3 * nearest.missed:.3g} mm{turned} (smallest singular value {inverse.steadiness(nearest.q):.2g}); "
            f"make the path smaller, begin elsewhere{free}."
        )

    def place(self, s: float) -> str:
        """A point of the path, in words."""
        x, y, z = self.poses(s)[:3, 3]
        at = f"the {self.path.name} at {self.path.travelled(s):.4g} m ({percent(s, 1)} of it)"
        return f"{at}, x, y, z = {x:.4g}, {y:.4g}, {z:.4g} m,"

    def check(self, s: Float[np.ndarray, " points"], q: Float[np.ndarray, "points n"]) -> None:
        """Raise ArgumentError at the first of these points that is singular or beyond a joint limit."""
        robot = self.inverse.robot
        steady = self.inverse.steadiness(q)
        beyond = (q < robot.lower) | (q > robot.upper)
        wrong = (steady < SINGULAR) | beyond.any(axis=-1)
        if not wrong.any():
            return
        k = int(np.argmax(wrong))
        if steady[k] < SINGULAR:
            raise ArgumentError(
                f"{self.place(float(s[k]))} is singular for '{self.inverse.frame}': the smallest singular value of its "
                f"Jacobian is {steady[k]:.2g}, expected at least {SINGULAR:g}; lead the path elsewhere or begin in "
                "another posture."
            )
        i = int(np.argmax(beyond[k]))
        (unit,) = units("position", [robot.joints[i].prismatic])
        raise ArgumentError(
            f"{self.place(float(s[k]))} needs {q[k, i]:.4g} {unit} of joint '{robot.joint_names[i]}', outside "
            f"[{robot.lower[i]:.4g}, {robot.upper[i]:.4g}]; lead the path elsewhere or begin in another posture."
        )
