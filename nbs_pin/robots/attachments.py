"""What is added to a description before it is checked: a payload, a tool, and how the base is mounted."""

import difflib
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from nbs_pin.base.doors import BLANK, option, where_printed
from nbs_pin.robots.description import read_description
from nbs_pin.robots.packages import Packages
from nbs_pin.robots.urdf_checks import MOVING, nearest_to_zero
from nbs_pin.robots.urdf_options import Payload, UrdfOptions
from nbs_pin.robots.urdf_source import Node, shorten

MOUNT = "mount"
"""The link to which a base that is tilted or displaced is fixed."""
_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def attach(robot: Node, options: UrdfOptions, packages: Packages) -> UrdfOptions:
    """Add the payloads, the tool and the mount of the options to the <robot> element.

    The link of a payload is called payload_LINK, and a payload may name one of those before it.
    A tool's moving joints become locked where they are nearest to zero, which a warning says; the options returned have
    these locks, beside those that were given.

    Raises:
        RobotError: If a frame is not a link of the arm, or the tool's description cannot be read.
    """
    if options.tool is not None:
        options = _add_tool(robot, options)
    last = tip(robot) if "" in options.payload else ""
    if last in options.payload and "" in options.payload:
        problem = f"the payload of the last link '{last}' is given twice, with its name and without"
        raise robot.refuse(problem, "give one of them")
    for frame, payload in options.payload.items():  # the link of one may carry the next
        _add_payload(robot, _frame(robot, frame or last, "payload"), payload)
    if any(options.base_rpy) or any(options.base_xyz):
        root = _ends(robot, parents=True)[0]
        _free_name(robot, MOUNT)
        robot.new("link", name=MOUNT)
        _fix(robot, MOUNT, root, options.base_xyz, options.base_rpy)
    return options


def tip(robot: Node) -> str:
    """The only link that has no child; raises RobotError if there are several."""
    ends = _ends(robot, parents=False)
    if len(ends) != 1:
        how = where_printed(python=f"payload={{'{ends[0]}': 2.0}}", shell=f"--payload 2@{ends[0]}")
        raise robot.refuse(
            f"it has {len(ends)} last links ({', '.join(ends[:8])})", f"name the link to attach to, as in {how}"
        )
    return ends[0]


def _add_payload(robot: Node, frame: str, payload: Payload) -> None:
    """A link with the payload's inertia, fixed to the link `frame`."""
    name = f"payload_{frame}"
    _free_name(robot, name)
    link = robot.new("link", name=name)
    inertial = link.new("inertial")
    inertial.new("origin", {"xyz": _text(payload.com)})
    inertial.new("mass", {"value": repr(payload.mass)})
    inertial.new("inertia", dict(zip(_INERTIA, map(repr, payload.inertia), strict=True)))
    _fix(robot, frame, name)


def _add_tool(robot: Node, options: UrdfOptions) -> UrdfOptions:
    """The links and joints of the tool, its base fixed to a link of the arm."""
    tool = options.tool
    assert tool is not None
    frame = _frame(robot, tool.frame, "tool")
    source = read_description(tool.file, options, Packages(tool.file, options.package_dirs), is_tool=True).robot
    robot.places.update(source.places)
    base = _ends(source, parents=True)[0]
    own = {(part.tag, part.get("name")) for part in robot.element}
    parts = [part for part in source.element if part.tag in ("link", "joint", "material")]
    clash = any(part.tag != "material" and (part.tag, part.get("name")) in own for part in parts)
    prefix = f"{source.element.get('name') or 'tool'}_" if clash else ""
    for part in parts:
        if part.tag != "material":
            part.set("name", prefix + part.get("name", ""))
            for child in part:
                if child.tag in ("parent", "child"):
                    child.set("link", prefix + child.get("link", ""))
                elif child.tag == "mimic":
                    child.set("joint", prefix + child.get("joint", ""))
        if (part.tag, part.get("name")) not in own:
            robot.element.append(part)
    _absolute_meshes(source, Packages(tool.file, options.package_dirs))
    _fix(robot, frame, prefix + base, tool.xyz, tool.rpy)
    moving = {
        joint.text("name"): nearest_to_zero(joint)
        for joint in source.named("joint")
        if joint.element.get("type") in MOVING and joint.element.find("mimic") is None
    }
    new = {name: place for name, place in moving.items() if name not in options.lock}
    if new:
        text = f"{tool.file}: the tool's joints are locked: {', '.join(f'{n!r} at {x:g}' for n, x in new.items())}"
        first = next(iter(new))
        warnings.warn(f"{text}; lock them elsewhere by {option('lock', {first: BLANK})}.", stacklevel=2)
    return replace(options, lock={**new, **options.lock})


def _absolute_meshes(source: Node, packages: Packages) -> None:
    """Name the tool's meshes by whole paths, since the arm's file is in another folder."""
    for mesh in source.element.iter("mesh"):
        name = mesh.get("filename", "")
        if "://" not in name and not Path(name).is_absolute():
            mesh.set("filename", str(packages.file.parent / name))
        elif name.startswith("package://"):
            package, _, rest = name.removeprefix("package://").partition("/")
            folder = packages.find(package)
            mesh.set("filename", str(folder / rest) if folder is not None else name)


def _frame(robot: Node, frame: str, what: str) -> str:
    """The link of that name, the arm's tip for the empty name; raises RobotError if there is none."""
    if not frame:
        return tip(robot)
    names = [link.get("name", "") for link in robot.element.findall("link")]
    if frame not in names:
        near = difflib.get_close_matches(frame, names, n=3) or names[-8:]
        raise robot.refuse(f"no link '{shorten(frame)}' for the {what}", f"give one such as {', '.join(near)}")
    return frame


def _free_name(robot: Node, name: str) -> None:
    for part in robot.element:
        if part.tag in ("link", "joint") and part.get("name") == name:
            raise robot.at(part).refuse(f"the name '{name}' is needed for what is added", f"rename the {part.tag}")


def _ends(robot: Node, *, parents: bool) -> list[str]:
    """The links that have no parent, or no child."""
    names = [link.get("name", "") for link in robot.element.findall("link")]
    role = "child" if parents else "parent"
    bound = {end.get("link") for joint in robot.element.findall("joint") for end in joint.findall(role)}
    ends = [name for name in names if name not in bound]
    if not ends:
        raise robot.refuse("every link has a parent" if parents else "every link has a child", "give a tree")
    return ends


def _fix(robot: Node, parent: str, child: str, xyz: Iterable[float] = (), rpy: Iterable[float] = ()) -> None:
    """A fixed joint between two links."""
    joint = robot.new("joint", {"type": "fixed"}, f"{child}_fixed")
    joint.new("parent", {"link": parent})
    joint.new("child", {"link": child})
    joint.new("origin", {"xyz": _text(xyz) or "0 0 0", "rpy": _text(rpy) or "0 0 0"})


def _text(values: Iterable[float]) -> str:
    return " ".join(map(repr, values))
