"""Friction and rotor inertia of joints: what the file states, and what is given in its place."""

from typing import NamedTuple

from nbs_pin.base.doors import BLANK, option
from nbs_pin.robots.urdf_checks import Joint
from nbs_pin.robots.urdf_options import LARGEST_DRIVE, UrdfOptions
from nbs_pin.robots.urdf_source import Node, plain_number

_GIVEN = {"damping": "viscous_friction", "friction": "coulomb_friction", "armature": "armature"}
"""The option that gives a field of `Drive`."""


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

    The armature is the one given, or `options.rotor_inertia`·N² with the reduction N of the joint's transmission; else
    `<dynamics armature=…>`, or `motor_inertia`·`gear_ratio`² of `<dynamics>`. URDF itself has none of it.

    Raises:
        RobotError: If a value is not a number ≥ 0, or a rotor inertia is given for a joint without a transmission.
    """
    ratios = _reductions(robot)
    return {joint.name: _drive(joint, ratios, options) for joint in joints if joint.moves}


def _drive(joint: Joint, ratios: dict[str, Node], options: UrdfOptions) -> Drive:
    stated = joint.node.child("dynamics")
    values = {key: options.drive(joint.name, name) for key, name in _GIVEN.items()}
    rotor = options.drive(joint.name, "rotor_inertia")
    if rotor is not None and values["armature"] is None:
        if joint.name not in ratios:
            remedy = f"give what the joint feels, I·N² ({option('armature', {joint.name: BLANK})})"
            raise joint.node.refuse("a rotor inertia is given, but no transmission states its reduction", remedy)
        values["armature"] = _behind(joint.node, rotor, ratios[joint.name].content())
    if stated is not None:
        for key in Drive._fields:
            number = _number(stated, key)  # checked also where another value is given
            values[key] = number if values[key] is None else values[key]
        motor, ratio = _number(stated, "motor_inertia"), stated.number("gear_ratio", 1.0)
        if motor is not None and values["armature"] is None:
            values["armature"] = _behind(stated, motor, ratio)
    drive = Drive(*(values[key] or 0.0 for key in Drive._fields))
    _write(joint, drive)
    return drive


def _behind(node: Node, rotor: float, ratio: float) -> float:
    """The inertia of a rotor behind a gear; raises RobotError if it is none that a joint can feel."""
    felt = rotor * ratio * ratio
    if not felt <= LARGEST_DRIVE:
        raise node.refuse(f"a rotor of {rotor:g} kg·m² behind a gear of {ratio:g} is beyond reason", "correct one")
    return felt


def _number(dynamics: Node, key: str) -> float | None:
    """A coefficient that <dynamics> states, or None; raises RobotError unless it is within [0, LARGEST_DRIVE]."""
    if key not in dynamics.element.attrib:
        return None
    value = dynamics.number(key, least=0.0)
    if value > LARGEST_DRIVE:
        raise dynamics.refuse(f"{key} {value:g} is beyond {LARGEST_DRIVE:g}", f"fix <dynamics {key}=…>")
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


def without_rotor(robot: Node, drives: dict[str, Drive], options: UrdfOptions) -> tuple[str, ...]:
    """The joints whose transmission states a reduction other than 1, while nothing states a rotor inertia."""
    stated = {name: plain_number((node.element.text or "").strip()) for name, node in _reductions(robot).items()}
    geared = [name for name, ratio in stated.items() if ratio is not None and abs(ratio) != 1.0 and name in drives]
    return tuple(name for name in geared if not drives[name].armature and options.drive(name, "armature") is None)


def _reductions(robot: Node) -> dict[str, Node]:
    """The elements with the gear ratio N of joints: `mechanicalReduction` of a transmission, its actuator or its joint.

    Transmissions of ros2_control call it `mechanical_reduction`.
    """
    found: dict[str, Node] = {}
    for transmission in robot.element.iter("transmission"):
        for joint in transmission.findall("joint"):
            for element in (transmission, *transmission.findall("actuator"), joint):
                for tag in ("mechanicalReduction", "mechanical_reduction"):
                    stated = element.find(tag)
                    if stated is not None and joint.get("name"):
                        found[str(joint.get("name"))] = robot.at(stated)
    return found
