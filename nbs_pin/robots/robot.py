"""A robot arm: its checked URDF and the Pinocchio model built from it."""

import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from array_api_compat import device
from jaxtyping import Bool, Float, Int

from nbs_pin.base.arguments import a, checked, mapping, maybe, path
from nbs_pin.base.arrays import JointArray, Vectors, array_namespace, as_vectors
from nbs_pin.base.checks import SMALLEST, PerJoint, floats, is_usual, told
from nbs_pin.base.exceptions import ArgumentError, RobotError
from nbs_pin.base.storable import storable
from nbs_pin.robots.catalogue import find
from nbs_pin.robots.kinematics import Kinematics
from nbs_pin.robots.mass_matrix import weak_joints
from nbs_pin.robots.urdf import JointData, Urdf, read_urdf
from nbs_pin.robots.urdf_checks import lock_too
from nbs_pin.robots.urdf_options import UrdfOptions, read_options


@storable(("name", "source", "options", "sha256", "effort_limit"))
@dataclass(frozen=True, eq=False, repr=False)
class Robot(Kinematics):
    """A fixed-base arm with nq = nv = n joints, as returned by `load_robot`.

    A `continuous` joint is an unbounded revolute joint whose tracking error is wrapped (`difference`); locked joints
    are fixed. Pinocchio, MuJoCo and the drawings are all built from `urdf`.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link").with_effort_limit([50.0, 20.0])
        >>> robot.joint_names, robot.effort_limit
        (('joint1', 'joint2'), array([50., 20.]))
    """

    name: str
    source: str
    """A catalogue name, or the full path of the file."""
    urdf: Urdf
    model: pin.Model
    gravity_vector: Float[np.ndarray, "3"]
    """Gravitational acceleration in the base frame [m/s²]."""
    options: dict[str, Any] = field(default_factory=dict)
    """Further arguments of `load_robot`, storable as JSON: load_robot(source, **options) gives this arm."""

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(self.model.nv)

    def __repr__(self) -> str:
        return f"Robot({self.name!r}, {self.nv} joints)"

    @cached_property
    def joints(self) -> tuple[JointData, ...]:
        """The moving joints, in Pinocchio's order."""
        by_name = {joint.name: joint for joint in self.urdf.joints}
        return tuple(by_name[name] for name in self.model.names[1:])

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the moving joints, in Pinocchio's order."""
        return tuple(self.model.names[1:])

    @property
    def effort_limit(self) -> JointArray:
        """Largest |τ| [N·m, N for a prismatic joint], inf where none is stated."""
        return np.array([joint.effort for joint in self.joints])

    @property
    def velocity_limit(self) -> JointArray:
        """Largest |v| [rad/s, m/s], inf where none is stated."""
        return np.array([joint.velocity for joint in self.joints])

    @property
    def lower(self) -> JointArray:
        """Lower position limit [rad, m], −inf on continuous joints."""
        return np.array([joint.lower for joint in self.joints])

    @property
    def upper(self) -> JointArray:
        """Upper position limit [rad, m], inf on continuous joints."""
        return np.array([joint.upper for joint in self.joints])

    @property
    def sampling_range(self) -> tuple[JointArray, JointArray]:
        """(lower, upper) for sampling configurations [rad, m]: the position limits, ∓π where there is none."""
        lower, upper = self.lower, self.upper
        low = np.where(np.isfinite(lower), lower, np.minimum(-np.pi, upper - 2.0 * np.pi))
        return low, np.where(np.isfinite(upper), upper, np.maximum(np.pi, lower + 2.0 * np.pi))

    @property
    def one_turn_range(self) -> tuple[JointArray, JointArray]:
        """(lower, upper) of distinct configurations [rad, m]: `sampling_range`, rotary joints cut to one turn."""
        lower, upper = self.sampling_range
        longer, middle = ~self.prismatic & (upper - lower > 2.0 * np.pi), 0.5 * (lower + upper)
        return np.where(longer, middle - np.pi, lower), np.where(longer, middle + np.pi, upper)

    @property
    def damping(self) -> JointArray:
        """Viscous joint friction of the URDF [N·m·s/rad]."""
        return np.array([joint.damping for joint in self.joints])

    @property
    def friction(self) -> JointArray:
        """Coulomb joint friction of the URDF [N·m]."""
        return np.array([joint.friction for joint in self.joints])

    @property
    def continuous(self) -> Bool[np.ndarray, " n"]:
        """True for joints whose error is wrapped to (−π, π]."""
        return np.array([joint.continuous for joint in self.joints])

    @property
    def prismatic(self) -> Bool[np.ndarray, " n"]:
        """True for prismatic joints."""
        return np.array([joint.prismatic for joint in self.joints])

    @property
    def parents(self) -> Int[np.ndarray, " n"]:
        """The parent of each joint: 0 for the base, i + 1 for joint i."""
        return np.array(list(self.model.parents)[1:], dtype=np.int64)

    @property
    def sha256(self) -> str:
        """SHA-256 of links, joints, stated limits and gravity, independent of visual and collision geometry."""
        return hashlib.sha256(self.urdf.without_geometry() + self.gravity_vector.tobytes()).hexdigest()

    def as_described(self) -> "Robot":
        """The arm with `model` built from the URDF again: an edit of `model` does not show in `sha256`."""
        model = _build_model(self.urdf)
        model.gravity.linear = self.gravity_vector
        return replace(self, model=model)

    def difference(self, q: Vectors, q_ref: Vectors) -> Vectors:
        """z1 = q ⊖ q_ref [rad], wrapped to (−π, π] on continuous joints."""
        q, q_ref = as_vectors(self.nv, q=q, q_ref=q_ref)
        return configuration_difference(q, q_ref, self.continuous)

    def with_effort_limit(self, limit: PerJoint) -> "Robot":
        """The same arm with other effort limits; the XML of its URDF and its `sha256` stay the same.

        Args:
            limit: One number > 0 or one per joint [N·m, N for a prismatic joint], inf for no limit.

        Raises:
            ArgumentError: If a limit is not > 0 or the number of limits is wrong.
        """
        effort = floats("effort limit", limit)
        if effort.shape not in ((), (self.nv,)) or not (effort >= SMALLEST).all():
            raise ArgumentError(
                f"effort limit is {told(limit)}, expected one number > 0 or {self.nv} of them [N·m]; np.inf means none."
            )
        by_name = dict(zip(self.joint_names, np.full(self.nv, effort).tolist(), strict=True))
        joints = tuple(replace(joint, effort=by_name[joint.name]) for joint in self.urdf.joints)
        urdf = replace(self.urdf, joints=joints)
        return replace(self, urdf=urdf, model=_with_limits(self.model.copy(), urdf))


ARM = a(Robot, "an arm, as load_robot returns it")
"""The check of an argument that is an arm."""


def configuration_difference(q: Vectors, q_ref: Vectors, continuous: Bool[np.ndarray, " n"] | None) -> Vectors:
    """q ⊖ q_ref [rad]: plain subtraction, wrapped to (−π, π] where `continuous` is true (None: nowhere).

    The wrap makes every law that uses it discontinuous at |z1_i| = π (docs/theory.md §1).
    """
    z1 = q - q_ref
    if continuous is None or not continuous.any():
        return z1
    xp = array_namespace(z1)
    turns = xp.ceil((z1 - np.pi) / (2.0 * np.pi))
    return z1 - 2.0 * np.pi * turns * xp.asarray(continuous.astype(float), dtype=z1.dtype, device=device(z1))


@checked(name_or_path=path, xacro_args=maybe(mapping))
def load_robot(
    name_or_path: str | Path,
    *,
    gravity: float | Iterable[float] | None = None,
    lock: Iterable[str] | Mapping[str, float] | None = None,
    zero_limits: str | None = None,
    limits: Mapping[str, Mapping[str, float | None]] | None = None,
    repair: bool | None = None,
    inertia_from: str | None = None,
    xacro_args: Mapping[str, Any] | None = None,
    package_dirs: Iterable[str | Path] | None = None,
) -> Robot:
    """Load an arm by name or from a `.urdf` or `.xacro` file.

    Joints that mimic another are locked where the other is at zero, and named in a warning.

    Args:
        name_or_path: A name in `ROBOT_NAMES` (bundled or from example-robot-data), or the path of a file.
        gravity: Downward acceleration [m/s²] or a vector in the base frame. None takes the catalogue's, else 9.81.
        lock: Joints to fix at zero, or a dict of where to fix them [rad, m]. None takes the catalogue's list.
        zero_limits: "refuse" joints that state no limits, an effort or velocity that is not > 0, or an empty range at
            zero, or read these as "unlimited". None takes the catalogue's, else "refuse".
        limits: Limits in place of the file's, by joint ("*" for all) and by "lower", "upper" [rad, m], "effort"
            [N·m, N] and "velocity" [rad/s, m/s]; None for no limit.
        repair: Take the nearest inertia that a rigid body can have where the file states one that none has.
        inertia_from: "file", or "shapes" to fill the shapes of bodies without mass with 1000 kg/m³, as a guess.
        xacro_args: Values of the arguments of a `.xacro` file.
        package_dirs: Folders with ROS packages, for `$(find …)` and package:// in the file. Also searched are packages
            around and beside the file, ROS_PACKAGE_PATH and AMENT_PREFIX_PATH.

    Raises:
        RobotNotFound: If no such name or file exists.
        RobotError: If the description would give a wrong model.
        ArgumentError: If an argument is of another type or out of range.
        MissingExtra: If the file must be expanded by xacro and the extra `xacro` is not installed.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.load_robot("panda")
        Robot('panda', 7 joints)
    """
    entry = find(str(name_or_path))
    told = {
        "lock": entry.lock if lock is None else lock,
        "zero_limits": entry.zero_limits if zero_limits is None else zero_limits,
        "limits": limits,
        "repair": repair,
        "inertia_from": inertia_from,
        "xacro_args": xacro_args,
        "package_dirs": package_dirs,
    }
    options = read_options(told)
    urdf = read_urdf(entry.path, options)
    vector = _gravity_vector(entry.gravity if gravity is None else gravity)
    model = _build_model(urdf)
    model.gravity.linear = vector
    given = {"gravity": gravity, **told, "lock": lock, "zero_limits": zero_limits}
    stored = {"gravity": vector.tolist(), **options.stored()}
    said = {key: stored[key] for key, value in given.items() if value is not None}
    robot = Robot(entry.name or urdf.name, entry.name or str(entry.path), urdf, model, vector, said)
    _check_inertia(robot, options)
    return robot


def _gravity_vector(gravity: float | Iterable[float]) -> Float[np.ndarray, "3"]:
    """The gravity vector in the base frame [m/s²]; raises ArgumentError unless it is one or three finite numbers."""
    if isinstance(gravity, Iterable) and not isinstance(gravity, np.ndarray | str):
        gravity = list(islice(gravity, 4))
    vector = floats("gravity", gravity)
    if vector.shape not in ((), (3,)) or not is_usual(vector):
        raise ArgumentError(
            f"gravity is {told(gravity)}, expected one finite number (downward) or three; give e.g. 9.81."
        )
    return np.array([0.0, 0.0, -float(vector)]) if vector.ndim == 0 else vector


def _build_model(urdf: Urdf) -> pin.Model:
    """The Pinocchio model with the limits of `urdf.joints`; raises RobotError if it cannot be built."""
    try:
        model = pin.buildModelFromXML(urdf.without_geometry().decode())
    except (ValueError, RuntimeError) as error:
        raise RobotError(f"{urdf.path}: Pinocchio cannot build it ({error}); simplify the file.") from error
    return _with_limits(model, urdf)


def _with_limits(model: pin.Model, urdf: Urdf) -> pin.Model:
    """The model, its limits set to those of `urdf.joints`."""
    by_name = {joint.name: joint for joint in urdf.joints}
    joints = [by_name[name] for name in model.names[1:]]
    effort, velocity = (np.array([getattr(joint, key) for joint in joints]) for key in ("effort", "velocity"))
    model.lowerPositionLimit = np.array([joint.lower for joint in joints])
    model.upperPositionLimit = np.array([joint.upper for joint in joints])
    model.lowerEffortLimit, model.upperEffortLimit = -effort, effort
    model.lowerVelocityLimit, model.upperVelocityLimit = -velocity, velocity
    return model


def _check_inertia(robot: Robot, options: UrdfOptions) -> None:
    """Raise RobotError unless M(q) ≻ 0 in every pose within the limits."""
    names, problem = weak_joints(robot.model, robot.lower, robot.upper)
    if not names:
        return
    joints = ET.fromstring(robot.urdf.xml).findall("joint")
    own = next((joint for joint in joints if joint.get("name") == names[0]), None)
    unsaid = own is not None and own.find("axis") is None
    problem += "; it states no <axis>, which URDF reads as 1 0 0" if unsaid else ""
    remedy = f"{'add <axis xyz=…>, ' if unsaid else ''}give the links behind it inertia about its axis"
    raise RobotError(
        f"{robot.urdf.path}: joint '{names[0]}': {problem}; {remedy}, or lock it ({lock_too(options, names)})."
    )
