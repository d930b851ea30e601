"""Friction and rotor inertia of joints: what the file states, and what is given in its place."""

from typing import NamedTuple

from nbs_pin.base.doors import BLANK, option
from nbs_pin.robots.urdf_checks import Joint
from nbs_pin.robots.urdf_options import UrdfOptions
from nbs_pin.robots.urdf_source import Node

_GIVEN = {"damping": "viscous_friction", "friction": "coulomb_friction", "armature": "armature"}
"""The option that gives a field of `Drive`."""
_LARGEST = 1e9
"""Largest coefficient of friction and rotor inertia that a joint can have."""


class Drive(NamedTuple):
    """What the drive adds to a joint, zero where nothing is stated."""

    damping: float
    """Viscous friction [N·m·s/rad, N·s/m]."""
    friction: float
    """Coulomb friction [N·m, N]."""
    armature: float
    """Rotor inertia as the joint feels it, I_r·N² for a rotor behind a gear of ratio N [kg·m², kg]."""


def read_drives(robot: Node, joints: list[Joint], options: UrdfOptions) -> dict[str, Drive]:
    """The drives of the moving joints by name; each element `<dynamics>` then states damping, friction and armature.

    The armature is the one given, `<dynamics armature=…>`, `motor_inertia`·`gear_ratio`² of `<dynamics>`, or
    `options.rotor_inertia`·N² with the reduction N of the joint's transmission, in this order; URDF itself has none.

    Raises:
        RobotError: If a value is not a number ≥ 0, or a rotor inertia is given for a joint without a transmission.
    """
    ratios = _reductions(robot)
    return {joint.name: _drive(joint, ratios, options) for joint in joints if joint.moves}


def _drive(joint: Joint, ratios: dict[str, float], options: UrdfOptions) -> Drive:
    stated = joint.node.child("dynamics")
    values = {key: options.drive(joint.name, name) for key, name in _GIVEN.items()}
    if stated is not None:
        for key in Drive._fields:
            values[key] = _number(stated, key) if values[key] is None else values[key]
        rotor = _number(stated, "motor_inertia")
        if rotor is not None and values["armature"] is None:
            ratio = stated.number("gear_ratio", 1.0)
            values["armature"] = rotor * ratio**2
    rotor = options.drive(joint.name, "rotor_inertia")
    if rotor is not None and values["armature"] is None:
        if joint.name not in ratios:
            remedy = f"give what the joint feels, I·N² ({option('armature', {joint.name: BLANK})})"
            raise joint.node.refuse("a rotor inertia is given, but no transmission states its reduction", remedy)
        values["armature"] = rotor * ratios[joint.name] ** 2
    drive = Drive(*(values[key] or 0.0 for key in Drive._fields))
    _write(joint, drive)
    return drive


def _number(dynamics: Node, key: str) -> float | None:
    """A coefficient that <dynamics> states, or None; raises RobotError unless it is within [0, _LARGEST]."""
    if key not in dynamics.element.attrib:
        return None
    value = dynamics.number(key, least=0.0)
    if value > _LARGEST:
        raise dynamics.refuse(f"{key} {value:g} is beyond {_LARGEST:g}", f"fix <dynamics {key}=…>")
    return value


def _write(joint: Joint, drive: Drive) -> None:
    """Let <dynamics> state the drive; where all is zero, the element stays as it is in the file."""
    element = joint.node.element.find("dynamics")
    if element is None:
        if not any(drive):
            return
        element = joint.node.new("dynamics").element
    for key in ("motor_inertia", "gear_ratio"):  # Pinocchio prints a line for each attribute that it does not know
        element.attrib.pop(key, None)
    if "damping" not in element.attrib and "friction" not in element.attrib:  # Pinocchio's reader wants one of them
        element.set("damping", "0.0")
    for key, value in drive._asdict().items():
        if value or key in element.attrib:
            element.set(key, repr(float(value)))


def _reductions(robot: Node) -> dict[str, float]:
    """The gear ratio N of each joint that has a transmission: `mechanicalReduction`, of the joint or its actuator.

    Transmissions of ros2_control call it `mechanical_reduction`.
    """
    ratios: dict[str, float] = {}
    for transmission in robot.element.iter("transmission"):
        for joint in transmission.findall("joint"):
            for element in (*transmission.findall("actuator"), joint):
                for tag in ("mechanicalReduction", "mechanical_reduction"):
                    found = element.find(tag)
                    if found is not None and joint.get("name"):
                        ratios[str(joint.get("name"))] = robot.at(found).content()
    return ratios
