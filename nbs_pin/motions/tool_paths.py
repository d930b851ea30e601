"""Paths of a tool in space: circle, line, a curve through waypoints; positions [m] and, where stated, orientations.

A path is a curve over s from 0 to 1 in the base frame of the arm. How its joints follow is `joint_paths.py`, and when,
`tool_motions.py`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from nbs_pin.base.arguments import checked, either, maybe, number, numbers, numbers_or_one
from nbs_pin.base.checks import told
from nbs_pin.base.doors import argument
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import Shown
from nbs_pin.base.units import measured

_PLANES = {"xy": (0.0, 0.0, 1.0), "xz": (0.0, -1.0, 0.0), "yz": (1.0, 0.0, 0.0)}
_SAMPLES = 2001
"""Points of which a length is summed."""
_POINT = numbers(3, unit="m")
_RIGHT_ANGLE = 1e-6
"""Least part of a direction across another."""


def _plane(name: str, value: Any) -> np.ndarray:
    """The normal of a plane, which is named or given by it."""
    if isinstance(value, str):
        if value not in _PLANES:
            raise ArgumentError(f"{name} '{value:.40}' is unknown; give one of {', '.join(_PLANES)}, or its normal.")
        return np.array(_PLANES[value])
    normal = numbers(3)(name, value)
    if not np.linalg.norm(normal) > _RIGHT_ANGLE:
        raise ArgumentError(f"{name} is {told(value)}, expected a normal, which is not zero; give one such as 0, 0, 1.")
    return np.asarray(normal / np.linalg.norm(normal))


@dataclass(frozen=True, eq=False, repr=False)
class ToolPath(Shown):
    """A path of a frame of an arm: positions, and orientations if the path states them.

    It is made by `circle`, `line`, `through` or `load`. Curves are at least twice continuously differentiable in s.
    """

    name: str
    """What it is, for figures and messages."""
    curve: Callable[[np.ndarray], np.ndarray]
    """Position [m] at s in [0, 1]: shape (...) to (..., 3)."""
    turning: Callable[[np.ndarray], np.ndarray] | None = None
    """Rotation matrix at s: shape (...) to (..., 3, 3); None leaves the orientation to the motion."""
    duration: float | None = None
    """Time that a path with times takes, t = s · duration [s]; None for a path without."""

    def _facts(self) -> Iterable[str]:
        return self.name, measured(self.length, "m")

    @property
    def length(self) -> float:
        """Length of the curve [m]."""
        points = self.curve(np.linspace(0.0, 1.0, _SAMPLES))
        return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())

    @checked(s=number(least=0.0, most=1.0))
    def travelled(self, s: float) -> float:
        """Length of the curve from its beginning to s [m]."""
        points = self.curve(np.linspace(0.0, s, _SAMPLES))
        return float(np.linalg.norm(np.diff(points, axis=0), axis=-1).sum())

    @checked(s=numbers_or_one(), orientation=numbers(3, 3))
    def poses(
        self, s: Float[np.ndarray, "*batch"], orientation: Float[np.ndarray, "3 3"]
    ) -> Float[np.ndarray, "*batch 4 4"]:
        """Homogeneous poses at s, with `orientation` where the path states none."""
        poses = np.zeros((*np.shape(s), 4, 4))
        poses[..., :3, :3] = orientation if self.turning is None else self.turning(np.asarray(s))
        poses[..., :3, 3] = self.curve(np.asarray(s))
        poses[..., 3, 3] = 1.0
        return poses

    @classmethod
    @checked(start=_POINT, radius=number(above=0.0, most=1e3, unit="m"))
    def circle(cls, start: Any, radius: float, plane: Any = "xy") -> "ToolPath":
        """A full circle of that radius [m] that begins and ends at the point `start` (3,) [m], counterclockwise.

        `plane` is "xy", "xz", "yz" or a normal (3,). The centre lies from the start towards the origin of the base,
        along the plane, so that the start is the point of the circle that is farthest from the base.

        Example:
            >>> import nbs_pin as nbs
            >>> nbs.ToolPath.circle([0.5, 0.0, 0.4], 0.1).curve(0.5).round(12)
            array([0.3, 0. , 0.4])
        """
        normal = _plane(argument("ToolPath.circle", "plane"), plane)
        outward = start - (start @ normal) * normal
        if np.linalg.norm(outward) < _RIGHT_ANGLE:  # on the axis through the base: any direction will do
            outward = np.eye(3)[np.argmin(np.abs(normal))]
            outward = outward - (outward @ normal) * normal
        first = radius * outward / np.linalg.norm(outward)
        second, centre = np.cross(normal, first), start - first

        def curve(s: np.ndarray) -> np.ndarray:
            angle = 2.0 * np.pi * np.asarray(s)[..., None]
            return np.asarray(centre + np.cos(angle) * first + np.sin(angle) * second)

        return cls(f"circle of radius {radius:g} m", curve)

    @classmethod
    @checked(start=_POINT, displacement=_POINT)
    def line(cls, start: Any, displacement: Any) -> "ToolPath":
        """A straight line from the point `start` (3,) [m] by `displacement` (3,) [m].

        Example:
            >>> import nbs_pin as nbs
            >>> nbs.ToolPath.line([0.5, 0.0, 0.4], [0.0, 0.2, 0.0]).curve(0.5)
            array([0.5, 0.1, 0.4])
        """
        if not np.linalg.norm(displacement) > 0.0:
            raise ArgumentError("ToolPath.line: displacement is zero; give where the line leads, such as 0, 0.2, 0.")
        return cls("line", lambda s: start + np.asarray(s)[..., None] * displacement)

    @classmethod
    @checked(
        positions=numbers(None, 3, unit="m"),
        orientations=maybe(either(numbers(None, 4), numbers(None, 3, 3))),
        times=maybe(numbers(None, unit="s")),
    )
    def through(cls, positions: Any, orientations: Any = None, times: Any = None) -> "ToolPath":
        """A smooth curve through waypoints: a cubic spline of positions and one of rotations, both C².

        Args:
            positions: Points (k, 3) [m], at least two.
            orientations: Unit quaternions (k, 4) as x, y, z, w, or rotation matrices (k, 3, 3); None states none.
            times: Increasing times (k,) [s], from which the path takes its timing; None spaces the points by their
                distances, so that the tool is nearly as fast everywhere.

        Raises:
            ArgumentError: If shapes do not fit, points coincide, times do not increase or a rotation is none.

        Example:
            >>> import nbs_pin as nbs
            >>> nbs.ToolPath.through([[0.5, -0.2, 0.3], [0.5, 0.0, 0.5], [0.5, 0.2, 0.3]]).curve(0.5)
            array([0.5, 0. , 0.5])
        """
        knots = _knots(positions, times)
        if len(knots) == 2:
            span = positions[1] - positions[0]
            points = lambda s: positions[0] + np.asarray(s)[..., None] * span  # noqa: E731
        else:
            points = CubicSpline(knots, positions, axis=0, bc_type="not-a-knot" if len(knots) > 3 else "natural")
        turning = None if orientations is None else _turning(knots, _rotations(orientations, len(knots)))
        duration = None if times is None else float(times[-1] - times[0])
        return cls(f"path through {len(knots)} points", points, turning, duration)


def _knots(positions: np.ndarray, times: np.ndarray | None) -> np.ndarray:
    """Values of s at the waypoints, from 0 to 1."""
    if len(positions) < 2:
        raise ArgumentError(f"a path through {len(positions)} points; give at least two.")
    if times is not None:
        if times.shape != (len(positions),) or not (np.diff(times) > 0.0).all():
            raise ArgumentError(
                f"times of shape {times.shape} for {len(positions)} points, expected one for each, increasing; "
                "correct them."
            )
        return _distinct((times - times[0]) / (times[-1] - times[0]))
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=-1)
    if not (steps > 0.0).all():
        k = int(np.argmin(steps))
        raise ArgumentError(
            f"the points {k + 1} and {k + 2} of the path are the same, {positions[k].tolist()}; leave one out, or give "
            "times."
        )
    along = np.concatenate([[0.0], np.cumsum(steps)])
    return _distinct(along / along[-1])


def _distinct(knots: np.ndarray) -> np.ndarray:
    """The values; raises ArgumentError where two waypoints cannot be told apart after rounding."""
    if not (np.diff(knots) > 0.0).all():
        k = int(np.argmin(np.diff(knots)))
        raise ArgumentError(
            f"the points {k + 1} and {k + 2} of the path are too near to each other for a path of its length; leave one"
            " out, or bring the far ones nearer."
        )
    return knots


def _rotations(orientations: np.ndarray, count: int) -> Rotation:
    """The rotations of quaternions or matrices; raises ArgumentError unless they are `count` rotations."""
    if len(orientations) != count:
        raise ArgumentError(f"{len(orientations)} orientations for {count} points; give one for each point.")
    quaternions = orientations.ndim == 2
    wrong = (
        np.abs(np.linalg.norm(orientations, axis=-1) - 1.0) > 1e-3
        if quaternions
        else np.abs(orientations @ orientations.swapaxes(-1, -2) - np.eye(3)).max(axis=(-2, -1)) > 1e-3
    )
    if wrong.any() or (not quaternions and (np.linalg.det(orientations) < 0.0).any()):
        k = int(np.argmax(wrong))
        raise ArgumentError(
            f"the orientation of point {k + 1} is no rotation; give unit quaternions x, y, z, w or rotation matrices."
        )
    return Rotation.from_quat(orientations) if quaternions else Rotation.from_matrix(orientations)


def _turning(knots: np.ndarray, rotations: Rotation) -> Callable[[np.ndarray], np.ndarray]:
    spline = RotationSpline(knots, rotations)

    def turning(s: np.ndarray) -> np.ndarray:
        s = np.asarray(s)
        return np.asarray(spline(s.ravel()).as_matrix()).reshape(*s.shape, 3, 3)

    return turning
