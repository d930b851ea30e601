"""Loads that an arm carries besides what its description and its options state."""

import xml.etree.ElementTree as ET
from collections.abc import Iterable

from nbs_pin.robots.catalogue import find
from nbs_pin.robots.places import tool_frame
from nbs_pin.robots.robot import Robot
from nbs_pin.robots.urdf_options import Payload, layered, read_options


def carrying(robot: Robot, loads: Iterable[tuple[str, Payload]]) -> Robot:
    """The arm with more loads, each at a link ("" is the arm's end), which add up with those that it has there.

    One at a link that carries another is fixed to the link of that load, which has the same frame. As one body they
    could be a rod without an inertia about itself, which MuJoCo refuses.

    Raises:
        RobotError: If there is no such link.
    """
    options = layered(find(robot.source).options, robot.options)
    own = read_options({"payload": options.get("payload")}).payload
    last = end_link(robot)
    taken = {link or last for link in own}
    for link, load in loads:
        at = link or last
        while at in taken:
            at = f"payload_{at}"
        taken.add(at)
        inertia = [[load.inertia[k] for k in row] for row in ((0, 1, 2), (1, 3, 4), (2, 4, 5))]
        robot = robot.with_payload(at, load.mass, load.com, inertia)
    return robot


def end_link(robot: Robot) -> str:
    """The link that carries a load for which none is named: the only one without a child, apart from payloads.

    Where there are several, it is the frame of the tool.
    """
    arm = ET.fromstring(robot.urdf.xml)
    ends = {link.get("name", "") for link in arm.iterfind("link")}
    for joint in arm.iterfind("joint"):
        parent, child = (joint.find(end) for end in ("parent", "child"))
        if parent is not None and child is not None:
            at, on = parent.get("link", ""), child.get("link", "")
            ends.discard(on if on == f"payload_{at}" else at)
    return ends.pop() if len(ends) == 1 else tool_frame(robot)
