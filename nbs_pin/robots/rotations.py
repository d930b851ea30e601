"""Rotations of MJCF as those of URDF: quaternions and axes to matrices, and matrices to roll, pitch and yaw."""

import math

import numpy as np
from jaxtyping import Float

Matrix3 = Float[np.ndarray, "3 3"]


def from_quaternion(quaternion: Float[np.ndarray, "4"]) -> Matrix3:
    """The rotation of a quaternion (w, x, y, z) that is not zero."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def about(axis: Float[np.ndarray, "3"], angle: float) -> Matrix3:
    """The rotation about a unit vector by an angle [rad]."""
    half = 0.5 * angle
    return from_quaternion(np.array([math.cos(half), *(math.sin(half) * axis)]))


def to_rpy(rotation: Matrix3) -> tuple[float, float, float]:
    """(r, p, y) with rotation = Rz(y) Ry(p) Rx(r) [rad], to rounding in every attitude.

    y is found after r is fixed, from entries that stay of size one where cos(p) vanishes: with s and c of r,
    y = atan2(s R02 − c R01, c R11 − s R12).
    """
    m = rotation
    roll = math.atan2(m[2, 1], m[2, 2])
    pitch = math.atan2(-m[2, 0], math.hypot(m[0, 0], m[1, 0]))
    s, c = math.sin(roll), math.cos(roll)
    return roll, pitch, math.atan2(s * m[0, 2] - c * m[0, 1], c * m[1, 1] - s * m[1, 2])
