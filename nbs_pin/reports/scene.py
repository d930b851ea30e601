"""The arm of a run as meshcat draws it: commands that build it, its poses over time, where to look from, its tips."""

import base64
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import umsgpack  # type: ignore[import-untyped]
from jaxtyping import Float, Int
from meshcat.commands import SetObject, SetTransform
from meshcat.geometry import MeshPhongMaterial, TriangularMeshGeometry
from meshcat.path import Path as ScenePath

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Run
from nbs_pin.reports.pages import encoded
from nbs_pin.robots.carrying import end_link
from nbs_pin.robots.robot import Robot
from nbs_pin.robots.visuals import Tip, Visual, link_visuals, tips
from nbs_pin.simulation.run_figures import loads_of
from nbs_pin.simulation.tool_errors import tool_of

FRAME_RATE = 50.0
"""Frames per second of run time [1/s]; the page interpolates between them."""
FARTHEST = 1e6
"""Configurations beyond this are not drawn [rad, m]."""
LEAST_FRAMES = 300
"""Frames of a short run along a path of the tool, whose trace is not to have corners."""
MAX_POINTS = 400
"""Most points of such a path."""
SHORTEST_PATH = 1e-6
"""Shorter ones are not drawn [m]."""
DENSITY = 2700.0
"""Of the balls that stand for loads [kg/m³]."""
MAX_FRAMES = 12_000
"""Longer runs get fewer frames per second, so that the page stays small."""


def scene_of(run: Run, robot: Robot, package_dirs: Iterable[str | Path] = ()) -> dict[str, Any]:
    """All that the page draws of a run with one start; a mesh that cannot be drawn is named in a warning.

    Raises:
        ArgumentError: If the run is not finite.
    """
    tool = tool_of(run)
    rows = _frame_rows(run.t, LEAST_FRAMES if tool else 0)
    q, q_ref = run.q[rows], run.q_ref[rows]
    if not (np.isfinite(q).all() and np.isfinite(q_ref).all()):
        raise ArgumentError("the run has configurations that are not finite: show the part before it diverged.")
    if max(np.abs(q).max(), np.abs(q_ref).max()) > FARTHEST:
        raise ArgumentError(f"the run has configurations beyond ±{FARTHEST:g}: show the part before it diverged.")
    poses = np.stack([body_poses(robot, q), body_poses(robot, q_ref)], axis=1)
    visuals = link_visuals(robot, package_dirs)
    return {
        "bodies": [body_node(body)[1] for body in range(robot.model.njoints)],
        "links": {
            frame.name: (frame.parentJoint, frame.placement.homogeneous.T.ravel().tolist())
            for frame in robot.model.frames
            if frame.type == pin.FrameType.BODY
        },
        "tips": [{"name": tip.name, "body": tip.joint, "point": tip.point.tolist()} for tip in tips_of(run, robot)],
        "loads": _loads(run, robot),
        "path": "" if tool is None else encoded(_path(robot, run.q_ref, tool["frame"])),
        "view": _view(robot, visuals, poses),
        "commands": [base64.b64encode(umsgpack.packb(command)).decode() for command in scene_commands(robot, visuals)],
        "times": encoded(run.t[rows], np.float64),
        "poses": encoded(poses),
    }


def tips_of(run: Run, robot: Robot) -> list[Tip]:
    """The tips of the arm, first the frame that followed a path or else the end of the last joint."""
    ends = list(tips(robot)[::-1])
    tool = tool_of(run)
    if tool is not None:
        found = robot.model.frames[robot.frame_id(tool["frame"])]
        first = Tip(tool["frame"], int(found.parentJoint), np.array(found.placement.translation))
        ends = [first, *(tip for tip in ends if tip.name != first.name)]
    return ends


def positions(robot: Robot, tips: Iterable[Tip], q: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows tips 3"]:
    """Where the tips are in the base frame [m]."""
    data, tips = robot.model.createData(), list(tips)
    points = np.empty((len(q), len(tips), 3))
    for row, configuration in enumerate(q):
        pin.forwardKinematics(robot.model, data, configuration)
        points[row] = [data.oMi[tip.joint].act(tip.point) for tip in tips]
    return points


def body_poses(robot: Robot, q: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "rows bodies 7"]:
    """Poses of the fixed base and of the body behind each joint, in the base frame: (x, y, z [m], qx, qy, qz, qw)."""
    data = robot.model.createData()
    poses = np.empty((len(q), robot.model.njoints, 7))
    for row, configuration in enumerate(q):
        pin.forwardKinematics(robot.model, data, configuration)
        poses[row] = [pin.SE3ToXYZQUAT(placement) for placement in data.oMi]
    return poses


def _path(robot: Robot, q_ref: Float[np.ndarray, "rows n"], frame: str) -> Float[np.ndarray, "points 3"]:
    """The path that the tool was to follow [m], points at nearly even distances; none if it went nowhere."""
    points = robot.pose(q_ref, frame)[:, :3, 3]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
    if along[-1] < SHORTEST_PATH:
        return points[:0]
    return np.asarray(points[np.unique(np.searchsorted(along, np.linspace(0.0, along[-1], MAX_POINTS)))])


def _loads(run: Run, robot: Robot) -> list[dict[str, Any]]:
    """Balls for the loads that appeared in the plant: the body that carries each, its centre there [m], its times [s].

    They have the size that aluminium of their mass has. One at a link that this arm does not have is left out.
    """
    balls = []
    for load in loads_of(run):
        link, centre = load["link"] or end_link(robot), np.array(load.get("com_m", np.zeros(3)), dtype=float)
        if not robot.model.existFrame(link, pin.FrameType.BODY) or centre.shape != (3,):
            continue
        frame = robot.model.frames[robot.model.getFrameId(link, pin.FrameType.BODY)]
        place = {"body": int(frame.parentJoint), "point": (frame.placement * centre).tolist()}
        radius = float(np.cbrt(3.0 * abs(load["mass_kg"]) / (4.0 * np.pi * DENSITY)))
        balls.append({**place, "radius": radius, "from": load["from_s"], "until": load["until_s"]})
    return balls


def _frame_rows(t: Float[np.ndarray, " rows"], least: int = 0) -> Int[np.ndarray, " frames"]:
    """Rows to show, nearest to an even clock, the last included: every frame is a state the run recorded."""
    count = min(max(int((t[-1] - t[0]) * FRAME_RATE) + 2, least), MAX_FRAMES)
    after = np.searchsorted(t, np.linspace(t[0], t[-1], count) - 1e-9 * (t[-1] - t[0]))
    return np.unique(np.minimum(after, len(t) - 1))


def body_node(body: int) -> tuple[str, str]:
    """The node of the scene that a body of the arm has."""
    return "actual", f"body{body}"


def scene_commands(robot: Robot, visuals: tuple[Visual, ...]) -> list[dict[str, Any]]:
    """The meshcat commands that build the arm: a node per body, under it a node per shape."""
    commands = [SetTransform(np.eye(4), ScenePath(body_node(body))) for body in range(robot.model.njoints)]
    for index, visual in enumerate(visuals):
        frame = robot.model.frames[robot.model.getFrameId(visual.link, pin.FrameType.BODY)]
        node = ScenePath((*body_node(frame.parentJoint), f"shape{index}"))
        geometry = TriangularMeshGeometry(visual.vertices.astype(np.float32), visual.faces.astype(np.uint32))
        commands += [
            SetObject(geometry, _material(visual), node),
            SetTransform(frame.placement.homogeneous @ visual.placement, node),
        ]
    return [command.lower() for command in commands]


def _material(visual: Visual) -> MeshPhongMaterial:
    shares = [min(max(channel, 0.0), 1.0) for channel in visual.color]
    red, green, blue = (round(255 * share) for share in shares[:3])
    return MeshPhongMaterial(
        color=(red << 16) + (green << 8) + blue, opacity=shares[3], specular=0x2A2A2A, shininess=38
    )


def _view(robot: Robot, visuals: tuple[Visual, ...], poses: Float[np.ndarray, "frames 2 bodies 7"]) -> dict[str, Any]:
    """The view in which the whole motion of both arms is visible, and the cell width of the grid [m]."""
    picked = poses[np.unique(np.linspace(0, len(poses) - 1, 40).astype(int))].reshape(-1, *poses.shape[2:])
    points = [np.zeros((1, 3))]
    for visual in visuals:
        frame = robot.model.frames[robot.model.getFrameId(visual.link, pin.FrameType.BODY)]
        box = np.array(np.meshgrid(*np.stack([visual.vertices.min(0), visual.vertices.max(0)], axis=1))).reshape(3, -1)
        placement = frame.placement.homogeneous @ visual.placement
        corners = placement[:3, :3] @ box + placement[:3, 3:]
        for pose in picked[:, frame.parentJoint]:
            points.append(np.asarray(pin.XYZQUATToSE3(pose).rotation @ corners).T + pose[:3])
    cloud = np.concatenate(points)
    target = 0.5 * (cloud.min(axis=0) + cloud.max(axis=0))
    radius = max(float(np.linalg.norm(cloud - target, axis=1).max()), 1e-2)
    spread, axes = np.linalg.eigh(np.cov(cloud[:, :2], rowvar=False))
    across = axes[:, 0] * (-1.0 if axes[1, 0] > 0.0 else 1.0)
    flat = spread[0] < 0.1 * spread[1]
    direction = np.array([*(across if flat else (0.65, -0.76)), 0.3])
    cell = min((10.0**k * digit for k in range(-4, 4) for digit in (1.0, 2.0, 5.0)), key=lambda c: abs(c - radius / 5))
    outward = np.random.default_rng(0).normal(size=(160, 3))
    return {
        "cloud": cloud[np.unique((cloud @ outward.T).argmax(axis=0))].tolist(),
        "target": target.tolist(),
        "radius": radius,
        "direction": (direction / np.linalg.norm(direction)).tolist(),
        "cell": float(f"{cell:.1g}"),
    }
