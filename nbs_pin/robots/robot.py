"""A robot arm: its checked URDF and the Pinocchio model built from it."""

import hashlib
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

from nbs_pin.base.arguments import a, checked, mapping, maybe, number, path, text
from nbs_pin.base.arrays import JointArray, Vectors, array_namespace, as_vectors
from nbs_pin.base.checks import SMALLEST, PerJoint, floats, is_usual, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.shown import Cells, Shown, joints_told, spread
from nbs_pin.base.storable import storable
from nbs_pin.base.units import several, units, units_of
from nbs_pin.robots.catalogue import Entry, find
from nbs_pin.robots.kinematics import Kinematics
from nbs_pin.robots.pinocchio_model import build_model, check_inertia, with_limits
from nbs_pin.robots.urdf import JointData, Urdf, read_urdf
from nbs_pin.robots.urdf_options import layered, read_options


@storable(("name", "source", "options", "sha256", "effort_limit"))
@dataclass(frozen=True, eq=False, repr=False)
class Robot(Shown, Kinematics):
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
    """Gravitational acceleration in the frame of the root link [m/s²]."""
    options: dict[str, Any] = field(default_factory=dict)
    """Further arguments of `load_robot`, storable as JSON: load_robot(source, **options) gives this arm."""

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(self.model.nv)

    def _facts(self) -> Iterable[str]:
        mass, kinds = sum(body.mass for body in self.model.inertias), units("torque", self.prismatic)
        efforts = (spread("", self.effort_limit[[kind == unit for kind in kinds]], unit) for unit in sorted({*kinds}))
        return repr(self.name), joints_told(self.nv), f"{mass:.3g} kg", f"effort{' and'.join(efforts)}"

    def _cells(self) -> Cells:
        of = zip(self.joints, units_of(self.prismatic), strict=True)
        rows = [(joint.name, f"{joint.lower:.3g} to {joint.upper:.3g} {unit.position}",
                 f"{joint.velocity:.3g} {unit.velocity}", f"{joint.effort:.3g} {unit.torque}")
                for joint, unit in of]  # fmt: skip
        return Cells(("joint", "position", "velocity", "effort"), rows)

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
        """Viscous joint friction [N·m·s/rad, N·s/m], zero where none is stated."""
        return np.array([joint.damping for joint in self.joints])

    @property
    def friction(self) -> JointArray:
        """Coulomb joint friction [N·m, N], zero where none is stated."""
        return np.array([joint.friction for joint in self.joints])

    @property
    def armature(self) -> JointArray:
        """Rotor inertia as each joint feels it, I_r·N² for a rotor behind a gear of ratio N [kg·m², kg].

        M(q) contains it: M = M_bodies(q) + diag(armature) (docs/theory.md §1).
        """
        return np.array([joint.armature for joint in self.joints])

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
        model = build_model(self.urdf)
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
                f"effort limit is {told(limit)}, expected one number > 0 or {self.nv} of them "
                f"[{several(units('torque', self.prismatic))}]; np.inf means none."
            )
        by_name = dict(zip(self.joint_names, np.full(self.nv, effort).tolist(), strict=True))
        joints = tuple(replace(joint, effort=by_name[joint.name]) for joint in self.urdf.joints)
        urdf = replace(self.urdf, joints=joints)
        return replace(self, urdf=urdf, model=with_limits(self.model.copy(), urdf))

    @property
    def has_bodies(self) -> bool:
        """Whether its bodies are those of the description, and not balls in place of them (inertia_from="links")."""
        return self.options.get("inertia_from") != "links"

    def with_armature(self, armature: PerJoint | Mapping[str, float]) -> "Robot":
        """The same arm with this rotor inertia, as the joints feel it [kg·m², kg].

        Args:
            armature: One number ≥ 0, one per joint, or a dict by joint for some of them.

        Raises:
            ArgumentError: If a number is negative or not finite, or the number of numbers is wrong.

        Example:
            >>> import nbs_pin as nbs
            >>> nbs.load_robot("two_link").with_armature([0.2, 0.1]).armature
            array([0.2, 0.1])
        """
        return self._again(armature=self._by_name("armature", armature))

    def with_friction(
        self,
        coulomb: PerJoint | Mapping[str, float] | None = None,
        viscous: PerJoint | Mapping[str, float] | None = None,
    ) -> "Robot":
        """The same arm with this joint friction in place of its own: Coulomb [N·m, N], viscous [N·m·s/rad, N·s/m].

        Each is one number ≥ 0, one per joint, or a dict by joint; None keeps what the arm has. A plant applies it with
        joint_friction="keep". Raises ArgumentError like `with_armature`.
        """
        given = {"coulomb_friction": coulomb, "viscous_friction": viscous}
        return self._again(**{name: self._by_name(name, x) for name, x in given.items() if x is not None})

    @checked(frame=text, mass=number(above=0.0, unit="kg"))
    def with_payload(
        self, frame: str, mass: float, com: Iterable[float] = (0.0, 0.0, 0.0), inertia: Any = 0.0
    ) -> "Robot":
        """The same arm with a load fixed to the link `frame`, in place of one that it already carries there.

        Args:
            frame: A link; "" is the last one.
            mass: Mass [kg], > 0.
            com: Centre of mass in the frame of the link [m].
            inertia: About the centre of mass, in the directions of the link's frame [kg·m²]: a 3×3 matrix, three
                principal moments, or 0 for a point mass.

        Raises:
            ArgumentError: If a number is out of range.
            RobotError: If there is no such link, or no body has this inertia.
        """
        load = {"mass": mass, "com": com, "inertia": inertia}
        return self._again(payload={**self.options.get("payload", {}), frame: load})

    @checked(file=path, frame=text)
    def with_tool(
        self,
        file: str | Path,
        frame: str = "",
        xyz: Iterable[float] = (0.0, 0.0, 0.0),
        rpy: Iterable[float] = (0.0, 0.0, 0.0),
    ) -> "Robot":
        """The same arm with the tool of a description, its base fixed to the link `frame` ("": the last).

        xyz [m] and rpy [rad] place the tool's base in that link. Its joints are locked where they are nearest to zero,
        or where `lock` says. Raises RobotError if the tool cannot be read or there is no such link.
        """
        return self._again(tool={"file": str(file), "frame": frame, "xyz": xyz, "rpy": rpy})

    def _by_name(self, what: str, values: PerJoint | Mapping[str, float]) -> dict[str, float]:
        """One number or one per joint by the names of the joints; some joints of a mapping, the others' kept."""
        if isinstance(values, Mapping):
            own = {"coulomb_friction": self.friction, "viscous_friction": self.damping}.get(what, self.armature)
            return dict(zip(self.joint_names, own.tolist(), strict=True)) | dict(values)
        numbers = floats(what, values)
        if numbers.shape not in ((), (self.nv,)):
            raise ArgumentError(f"{what} is {told(values)}, expected one number or {self.nv}, one per joint.")
        return dict(zip(self.joint_names, np.full(self.nv, numbers).tolist(), strict=True))

    def _again(self, **options: Any) -> "Robot":
        """The arm loaded again with other arguments of `load_robot`, with the effort limits of this one."""
        again = load_robot(self.source, **{**self.options, **options})
        same = np.array_equal(again.effort_limit, self.effort_limit)
        return again if same else again.with_effort_limit(self.effort_limit)


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
    armature: float | Mapping[str, float] | None = None,
    rotor_inertia: float | Mapping[str, float] | None = None,
    viscous_friction: float | Mapping[str, float] | None = None,
    coulomb_friction: float | Mapping[str, float] | None = None,
    payload: float | Mapping[str, Any] | None = None,
    tool: str | Path | Mapping[str, Any] | None = None,
    base_rpy: Iterable[float] | None = None,
    base_xyz: Iterable[float] | None = None,
) -> Robot:
    """Load an arm by name, from a `.urdf`, `.xacro` or MJCF file, or from a `.toml` file that adds to one.

    Joints that mimic another are locked where the other is at zero, and named in a warning. A `.toml` file has the
    `description` (name or path) and any of the arguments below. What is given here by joint, link or name is added to
    what the catalogue and the `.toml` file give, and comes before it; an empty list or dict clears that. All else takes
    its place, as one number for all joints does.

    Args:
        name_or_path: A name in `ROBOT_NAMES` (bundled or from example-robot-data), the path of a file, or
            "robot_descriptions:NAME" for a description of that package, such as robot_descriptions:fr3_mj_description.
        gravity: Downward acceleration [m/s²] or a vector in the world frame. None takes the catalogue's or
            that of an MJCF file, else 9.81.
        lock: Joints to fix at zero, or a dict of where to fix them [rad, m].
        zero_limits: "refuse" joints that state no limits, an effort or velocity that is not > 0, or an empty range at
            zero, or read these as "unlimited". None takes the catalogue's, else "refuse".
        limits: Limits in place of the file's, by joint ("*" for all) and by "lower", "upper" [rad, m], "effort"
            [N·m, N] and "velocity" [rad/s, m/s]; None for no limit.
        repair: Take the nearest inertia that a rigid body can have where the file states one that none has.
        inertia_from: "file", or "shapes" to fill the shapes of bodies without mass with 1000 kg/m³, as a guess, or
            "links" to take only the geometry, with balls for bodies, as for an arm whose bodies are to be learned.
        xacro_args: Values of the arguments of a `.xacro` file.
        package_dirs: Folders with ROS packages, for `$(find …)` and package:// in the file. Also searched are packages
            around and beside the file, ROS_PACKAGE_PATH and AMENT_PREFIX_PATH.
        armature: Rotor inertia that the joint feels [kg·m², kg], a number or a dict by joint, in place of the file's.
        rotor_inertia: Inertia of the rotor itself [kg·m²], likewise; the joint feels it times N² of its transmission.
        viscous_friction: Viscous joint friction [N·m·s/rad, N·s/m], likewise, in place of the file's.
        coulomb_friction: Coulomb joint friction [N·m, N], likewise, in place of the file's.
        payload: A mass [kg] at the last link, or a dict from links to a mass or to a dict of mass, com [m], inertia.
        tool: A description whose base is fixed to the last link, or a dict of file, frame, xyz [m], rpy [rad].
        base_rpy: Roll, pitch, yaw of the base in the world [rad]: (π, 0, 0) hangs the arm from the ceiling.
        base_xyz: Position of the base in the world [m].

    Raises:
        RobotNotFound: If no such name or file exists.
        RobotError: If the description would give a wrong model.
        ArgumentError: If an argument is of another type or out of range.
        MissingExtra: If the file must be expanded by xacro and the extra `xacro` is not installed, or a description
            is asked of robot_descriptions and the extra `descriptions` is not.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.load_robot("panda")
        Robot('panda', 7 joints, 17.5 kg, effort 12 to 87 N·m)
    """
    given = dict(
        gravity=gravity, lock=lock, zero_limits=zero_limits, limits=limits, repair=repair, inertia_from=inertia_from,
        xacro_args=xacro_args, package_dirs=package_dirs, armature=armature, rotor_inertia=rotor_inertia,
        viscous_friction=viscous_friction, coulomb_friction=coulomb_friction, payload=payload, tool=tool,
        base_rpy=base_rpy, base_xyz=base_xyz,
    )  # fmt: skip
    return _load(find(str(name_or_path)), {name: value for name, value in given.items() if value is not None})


def _load(entry: Entry, given: dict[str, Any]) -> Robot:
    """The arm of a catalogue's entry or a file, with the arguments of `load_robot` that were given."""
    told = layered(entry.options, given)
    gravity = _gravity_vector(told.pop("gravity", 9.81))
    options = read_options(told)
    urdf = read_urdf(entry.path, options)
    is_stated = urdf.gravity is not None and "gravity" not in entry.options.keys() | given.keys()
    vector = np.array(urdf.gravity) if is_stated else gravity
    model = build_model(urdf)
    model.gravity.linear = vector
    stored = {"gravity": vector.tolist(), **options.stored()}
    said = {name: stored[name] for name in given}
    robot = Robot(entry.name or urdf.name, entry.name or str(entry.source), urdf, model, vector, said)
    check_inertia(urdf, model, options)
    return robot


def _gravity_vector(gravity: float | Iterable[float]) -> Float[np.ndarray, "3"]:
    """The gravity vector in the base frame [m/s²]; raises ArgumentError unless it is one or three finite numbers."""
    if isinstance(gravity, Iterable) and not isinstance(gravity, np.ndarray | str):
        try:
            gravity = list(islice(gravity, 4))
        except Exception as error:  # an iterable may raise anything
            raise ArgumentError(
                f"gravity is {told(gravity)}, which cannot be iterated over; give e.g. 9.81."
            ) from error
    vector = floats("gravity", gravity)
    if vector.shape not in ((), (3,)) or not is_usual(vector):
        raise ArgumentError(
            f"gravity is {told(gravity)}, expected one finite number (downward) or three; give e.g. 9.81."
        )
    return np.array([0.0, 0.0, -float(vector)]) if vector.ndim == 0 else vector
