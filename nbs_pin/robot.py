"""A robot arm: one validated URDF, read once, and what Pinocchio makes of it."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from jaxtyping import Bool, Float

from nbs_pin.arrays import Array, array_namespace
from nbs_pin.catalogue import find
from nbs_pin.urdf import JointData, Urdf, read_urdf


@dataclass(frozen=True, eq=False)
class Robot:
    """A fixed-base arm with nq = nv = n joints.

    A `continuous` joint is an unbounded revolute joint whose tracking error is wrapped (`difference`); locked joints
    are fixed. `urdf` is the one description that Pinocchio, MuJoCo and the drawings are built from.
    """

    name: str
    source: str
    """What `load_robot` was given: a catalogue name or a path."""
    urdf: Urdf
    model: pin.Model
    gravity_vector: Float[np.ndarray, "3"]
    """Gravitational acceleration in the base frame [m/s²]."""

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(self.model.nv)

    @property
    def joints(self) -> tuple[JointData, ...]:
        """The moving joints, in Pinocchio's order."""
        by_name = {joint.name: joint for joint in self.urdf.joints}
        return tuple(by_name[name] for name in self.model.names[1:])

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the moving joints, in Pinocchio's order."""
        return tuple(self.model.names[1:])

    @property
    def effort_limit(self) -> Float[np.ndarray, " n"]:
        """Largest |τ| [N·m, N for a prismatic joint], inf where none is stated."""
        return np.array([joint.effort for joint in self.joints])

    @property
    def velocity_limit(self) -> Float[np.ndarray, " n"]:
        """Largest |v| [rad/s, m/s], inf where none is stated."""
        return np.array([joint.velocity for joint in self.joints])

    @property
    def lower(self) -> Float[np.ndarray, " n"]:
        """Lower position limit [rad, m], −inf on continuous joints."""
        return np.array([joint.lower for joint in self.joints])

    @property
    def upper(self) -> Float[np.ndarray, " n"]:
        """Upper position limit [rad, m], inf on continuous joints."""
        return np.array([joint.upper for joint in self.joints])

    @property
    def damping(self) -> Float[np.ndarray, " n"]:
        """Viscous joint friction of the URDF [N·m·s/rad]."""
        return np.array([joint.damping for joint in self.joints])

    @property
    def friction(self) -> Float[np.ndarray, " n"]:
        """Coulomb joint friction of the URDF [N·m]."""
        return np.array([joint.friction for joint in self.joints])

    @property
    def continuous(self) -> Bool[np.ndarray, " n"]:
        """True where the error wraps to (−π, π]."""
        return np.array([joint.continuous for joint in self.joints])

    @property
    def sha256(self) -> str:
        """Fingerprint of the description and gravity: equal when the dynamics are equal."""
        return hashlib.sha256(self.urdf.xml + self.gravity_vector.tobytes()).hexdigest()

    def difference(self, q: Float[Array, "*batch n"], q_ref: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
        """z1 = q ⊖ q_ref [rad], wrapped to (−π, π] on continuous joints."""
        return configuration_difference(q, q_ref, self.continuous)


def configuration_difference(
    q: Float[Array, "*batch n"], q_ref: Float[Array, "*batch n"], continuous: Bool[np.ndarray, " n"] | None
) -> Float[Array, "*batch n"]:
    """Q ⊖ q_ref [rad]: plain subtraction, wrapped to (−π, π] where `continuous` is true (None: nowhere).

    The wrap makes every law that uses it discontinuous at |z1_i| = π (docs/theory.md §1).
    """
    z1 = q - q_ref
    if continuous is None or not continuous.any():
        return z1
    xp = array_namespace(z1)
    turns = xp.ceil((z1 - np.pi) / (2.0 * np.pi))
    return z1 - 2.0 * np.pi * turns * xp.asarray(continuous.astype(float), dtype=z1.dtype)


def load_robot(
    name_or_path: str | Path,
    *,
    gravity: float | Iterable[float] | None = None,
    lock: Iterable[str] | None = None,
) -> Robot:
    """The arm of a bundled URDF, of example-robot-data by short name, or of a `.urdf` or `.xacro` file.

    gravity: downward acceleration [m/s²] or a vector in the base frame; None takes the catalogue's, else 9.81.
    lock: joints to fix at zero; None takes the catalogue's list.
    Raises RobotNotFound for a name or path that leads nowhere, RobotError for a description that would give a wrong
    model, and MissingExtra for a `.xacro` without the `xacro` extra.
    """
    entry = find(str(name_or_path))
    urdf = read_urdf(entry.path, lock=entry.lock if lock is None else tuple(lock), zero_limits=entry.zero_limits)
    model = pin.buildModelFromXML(urdf.xml.decode())
    vector = np.asarray(entry.gravity if gravity is None else gravity, dtype=float)
    vector = np.array([0.0, 0.0, -float(vector)]) if vector.ndim == 0 else vector
    model.gravity.linear = vector
    return Robot(entry.name or urdf.name, str(name_or_path), urdf, model, vector)
