"""How far the bodies of an arm are from each other, with coal's distances of convex hulls."""

import copy
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.robots.robot import Robot
from nbs_pin.robots.visuals import Visual, collision_shapes

_LONGEST = 1e3
"""Range that a sliding joint without limits is taken to have [m]."""
_OF_REST = 0.9
"""Share of the distance at rest that is always enough."""
_FLAT = 1e-4
"""Least thickness of a hull, which a flat shape gets [m]."""


class SelfDistances:
    """Distances between the bodies of an arm, each shape as its convex hull.

    Links collide with their collision shapes, or with their visual ones where they state none. Left out are pairs
    on one body, pairs on bodies that one joint connects, and pairs that overlap where the arm rests: neighbours whose
    hulls do in every pose.
    """

    def __init__(self, robot: Robot, rest: JointArray, clearance: float) -> None:
        """Raises RobotError if the description is malformed."""
        shapes, self.faults = collision_shapes(robot)
        self._model, self._data = robot.model, robot.model.createData()
        self._geometry = pin.GeometryModel()
        for k, shape in enumerate(shapes):
            frame = robot.model.frames[robot.model.getFrameId(shape.link, pin.FrameType.BODY)]
            place = frame.placement * pin.SE3(shape.placement)
            self._geometry.addGeometryObject(
                pin.GeometryObject(f"{shape.link}/{k}", frame.parentJoint, place, _hull(shape))
            )
        self._links = [shape.link for shape in shapes]
        lengths = [float(np.linalg.norm(place.translation)) for place in robot.model.jointPlacements]
        slides = np.abs(np.clip(robot.sampling_range, -_LONGEST, _LONGEST)).max(axis=0) @ robot.prismatic
        corners = [np.linalg.norm(shape.vertices, axis=1).max() + np.linalg.norm(item.placement.translation)
                   for shape, item in zip(shapes, self._geometry.geometryObjects, strict=True)]  # fmt: skip
        self.reach = max(1.0, sum(lengths) + float(slides) + max(corners, default=0.0))
        """A bound of how much a distance changes per change of a joint [m/rad]; 1 or more, for those that slide."""
        bodies = [item.parentJoint for item in self._geometry.geometryObjects]
        near = {(body, int(parent)) for body, parent in enumerate(robot.model.parents)} | {(0, 0)}
        self._pair(
            [
                (i, k)
                for k, second in enumerate(bodies)
                for i, first in enumerate(bodies[:k])
                if first != second and not {(first, second), (second, first)} & near
            ]
        )
        at_rest = self(rest[None])[0]
        self._keep(at_rest > 0.0)
        self.at_rest = at_rest[at_rest > 0.0]
        """The distance of every pair where the arm rests [m]."""
        self.least = np.minimum(clearance, _OF_REST * self.at_rest)
        """The distance that every pair is to keep [m]: the clearance, or what neighbours have that are always near."""

    def _keep(self, kept: Any) -> None:
        self._pair([pair for pair, keep in zip(self._pairs, kept, strict=True) if keep])

    def _pair(self, pairs: list[tuple[int, int]]) -> None:
        self._pairs = pairs
        self._geometry.removeAllCollisionPairs()
        for pair in pairs:
            self._geometry.addCollisionPair(pin.CollisionPair(*pair))
        self._found = self._geometry.createData()

    def restricted(self, q: Float[np.ndarray, "rows n"], least: float) -> "SelfDistances":
        """The same for the pairs alone that are nearer than `least` [m] in one of the configurations."""
        other = copy.copy(self)
        other._geometry = self._geometry.copy()
        other._data = self._model.createData()
        near = np.asarray((self(q) < least).any(axis=0))
        other.at_rest, other.least = self.at_rest[near], self.least[near]
        other._keep(near)
        return other

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """The links of each pair."""
        return [(self._links[i], self._links[k]) for i, k in self._pairs]

    def __call__(self, q: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows pairs"]:
        """The distance of every pair [m], negative where they overlap."""
        distances = np.empty((len(q), len(self._pairs)))
        for row, configuration in zip(distances, q, strict=True):
            self._measure(configuration)
            row[:] = [result.min_distance for result in self._found.distanceResults]
        return distances

    def below(
        self, q: Float[np.ndarray, "rows n"], least: Float[np.ndarray, " pairs"]
    ) -> tuple[Float[np.ndarray, "rows pairs"], Float[np.ndarray, "rows pairs n"]]:
        """The distances, and the derivatives with respect to q of those below `least` [m], zero elsewhere.

        A body at p₂ moves away from one at p₁ along the normal m with mᵀ(ṗ₂ − ṗ₁).
        """
        distances, slopes = np.empty((len(q), len(self._pairs))), np.zeros((len(q), len(self._pairs), q.shape[1]))
        for row, slope, configuration in zip(distances, slopes, q, strict=True):
            self._measure(configuration)
            row[:] = [result.min_distance for result in self._found.distanceResults]
            close = np.flatnonzero(row < least)
            if not len(close):
                continue
            pin.computeJointJacobians(self._model, self._data, configuration)
            for k in close:
                result, (i, j) = self._found.distanceResults[int(k)], self._pairs[k]
                slope[k] = self._along(j, result.getNearestPoint2(), result.normal)
                slope[k] -= self._along(i, result.getNearestPoint1(), result.normal)
        return distances, slopes

    def _measure(self, q: JointArray) -> None:
        pin.computeDistances(self._model, self._data, self._geometry, self._found, q)

    def _along(self, shape: int, point: np.ndarray, normal: np.ndarray) -> JointArray:
        """The derivative of normalᵀ times a point of the shape."""
        joint = self._geometry.geometryObjects[shape].parentJoint
        if joint == 0:
            return np.zeros(self._model.nv)
        jacobian = pin.getJointJacobian(self._model, self._data, joint, pin.WORLD)
        return np.asarray(normal @ jacobian[:3] + np.cross(point, normal) @ jacobian[3:])


def _hull(shape: Visual) -> coal.Convex:
    """The convex hull of a shape; a flat one is made thicker, so that it has an inside."""
    points = np.asarray(shape.vertices, dtype=float)
    for direction in np.linalg.eigh(np.cov(points.T))[1].T:
        if np.ptp(points @ direction) < _FLAT:
            points = np.concatenate([points - 0.5 * _FLAT * direction, points + 0.5 * _FLAT * direction])
    given = coal.StdVec_Vec3s()
    given.extend(list(np.unique(points, axis=0)))
    return coal.Convex.convexHull(given, True, None)
