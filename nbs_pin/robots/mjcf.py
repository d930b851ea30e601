"""MJCF files: MuJoCo compiles them, and its model becomes the <robot> element of a URDF, checked like any other."""

import xml.etree.ElementTree as ET
from pathlib import Path

from nbs_pin.robots.mjcf_checks import Described, check_dynamics, couplings, gravity_of
from nbs_pin.robots.mjcf_files import scan
from nbs_pin.robots.mjcf_joints import read_joint
from nbs_pin.robots.mjcf_model import compile_mjcf
from nbs_pin.robots.mjcf_shapes import add_shapes
from nbs_pin.robots.mjcf_tree import Tree, build_tree, names_of
from nbs_pin.robots.urdf_options import UrdfOptions
from nbs_pin.robots.urdf_source import Node, Place

_UNNAMED = "MuJoCo Model"


def as_urdf(
    path: Path, root: Node, options: UrdfOptions, *, is_tool: bool = False
) -> tuple[Node, tuple[float, float, float]]:
    """The <robot> element that means the same as the <mujoco> element `root` of a file, and its gravity [m/s²].

    Links are named after bodies and have their frames. Joints keep their names and coordinates; those without a name
    are "joint3" if they are the third. What MJCF leaves out is no limit: a hinge without a range is continuous. A joint
    that an equality makes follow another has <mimic>. Every joint of a tool counts as locked.

    Raises:
        RobotError: If a file is missing or too large, if MuJoCo cannot compile it, or if it has a part that changes the
            dynamics and is not modelled here; names the part and what to do.
    """
    files = scan(path, root)
    compiled = compile_mjcf(files, is_tool=is_tool)
    model, names = compiled.model, names_of(compiled.model, "joint", "joint")
    locked = set(names) if is_tool else set(options.lock)
    described = Described(model, str(path), names, locked, options)
    follows = couplings(described)
    check_dynamics(described, follows)
    gravity = gravity_of(described, follows)
    name = root.element.get("model") or (path.stem if compiled.name == _UNNAMED else compiled.name)
    robot = ET.Element("robot", {"name": name or path.stem})
    named = {"joint": names, "body": names_of(model, "body", "body")}
    for (kind, k), line in compiled.lines.items():
        if line > 0 and not files.attaches:  # 0 is one of an included file, and attached files count their own lines
            files.places.setdefault((kind, named[kind][k]), Place(str(path), line))
    tree = Tree(robot, model, files, is_tool, {robot: root.place})
    build_tree(tree, [read_joint(model, k, joint, follows.get(k)) for k, joint in enumerate(names)])
    add_shapes(tree, compiled.meshes)
    return Node(tree.places, robot, f"robot '{name}'"), gravity
