"""Paths of the tool in the shell: the error of the tool in every result, and what is refused."""

import json
import re

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.units import measured
from nbs_pin.motions.by_name import motion_of
from nbs_pin.reports import plotting
from tests.commands import printed_by, refusal, summary


@pytest.fixture(scope="module")
def circle(tmp_path_factory):
    """A folder with a circle of two_link, and what was printed."""
    folder = tmp_path_factory.mktemp("tool") / "run"
    options = ("--reference", "circle:0.3", "--duration", "2", "--frame", "tip", "--out", folder)
    return folder, printed_by("track", "two_link", *options)


def page_data(folder):
    text = (folder / "replay.html").read_text()
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    return data["runs"][0]["scene"]


def decoded(text):
    import base64

    return np.frombuffer(base64.b64decode(text), dtype="<f4").reshape(-1, 3)


def test_the_run_knows_its_path_and_the_summary_its_error(circle):
    folder, printed = circle
    run, robot = nbs.Run.load(folder / "run.npz"), nbs.load_robot("two_link")
    tool = summary(folder)["figures"]["tool"]
    assert run.info["tool"] == {"frame": "tip", "orientation": "free", "path": "circle of radius 0.3 m"}
    assert tool == run.info["tool"] | nbs.tool_errors(run, robot).figures()
    assert tool["rms_position_error_m"] < 1e-6
    assert tool["rms_position_error_m"] <= tool["peak_position_error_m"]
    asked = robot.pose(run.q_ref, "tip")[:, :3, 3]
    centre = 0.5 * (asked.min(axis=0) + asked.max(axis=0))
    np.testing.assert_allclose(np.linalg.norm(asked - centre, axis=-1), 0.3, atol=1e-4)
    np.testing.assert_allclose(asked[0], asked[-1], atol=1e-9)
    off = measured(tool["rms_position_error_m"], "m")
    assert f"'tip' along the circle of radius 0.3 m is off in position {off} RMS" in printed


def test_the_errors_of_the_tool_are_those_of_its_distance_and_angle(circle):
    folder, _ = circle
    run, robot = nbs.Run.load(folder / "run.npz"), nbs.load_robot("two_link")
    run.q[:] = run.q_ref + np.array([0.0, 0.01])  # the second link turns by 0.01 rad about its joint
    errors = nbs.tool_errors(run, robot)
    np.testing.assert_allclose(errors.position, 2.0 * np.sin(0.005), rtol=1e-9)
    np.testing.assert_allclose(errors.orientation, 0.01, rtol=1e-9)
    np.testing.assert_allclose(nbs.tool_errors(run, robot, "link1").position, 0.0, atol=1e-15)
    with pytest.raises(nbs.ArgumentError, match="no link or joint 'hand'"):
        nbs.tool_errors(run, robot, "hand")


def test_the_picture_has_a_row_for_the_tool(circle, tmp_path, monkeypatch):
    folder, _ = circle
    drawn = []
    monkeypatch.setattr(plotting, "_draw_tool", lambda figure, row, run, robot, tool: drawn.append((robot, tool)))
    run = nbs.Run.load(folder / "run.npz")
    nbs.plot_tracking(run, tmp_path / "loaded.png")
    nbs.plot_tracking(run, tmp_path / "given.png", robot=nbs.load_robot("two_link"))
    assert [(robot.name, tool["frame"]) for robot, tool in drawn] == [("two_link", "tip")] * 2
    monkeypatch.undo()
    with_tool = nbs.plot_tracking(run, tmp_path / "with.png").read_bytes()
    run.info.pop("tool")
    assert nbs.plot_tracking(run, tmp_path / "without.png").read_bytes() != with_tool


def test_the_replay_draws_the_path_and_the_trace_of_the_frame(circle):
    folder, _ = circle
    robot, data = nbs.load_robot("two_link"), page_data(folder)
    path = decoded(data["path"])
    centre = 0.5 * (path.min(axis=0) + path.max(axis=0))
    np.testing.assert_allclose(np.linalg.norm(path - centre, axis=-1), 0.3, atol=1e-3)
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    assert len(path) > 100
    assert steps.max() < 0.03
    tip = robot.model.frames[robot.frame_id("tip")]
    at = {"body": tip.parentJoint, "point": tip.placement.translation.tolist()}
    assert data["tips"] == [{"name": "tip", **at}]


def test_a_run_without_a_path_has_none_in_its_replay(tmp_path):
    printed_by("track", "two_link", "--duration", "0.1", "--out", tmp_path / "run")
    assert page_data(tmp_path / "run")["path"] == ""
    assert "tool" not in summary(tmp_path / "run")["figures"]


def test_the_fastest_circle_takes_whole_periods_and_is_shorter(tmp_path):
    printed_by("track", "two_link", "--reference", "circle:0.3", "--fastest", "--out", tmp_path / "run")
    run = nbs.Run.load(tmp_path / "run" / "run.npz")
    assert run.t[-1] < 1.0
    assert not run.v_ref[-1].any()
    assert summary(tmp_path / "run")["settings"]["tool"] == {"fastest": True}


def test_a_file_of_the_tool_is_told_from_one_of_the_joints(tmp_path):
    robot = nbs.load_robot("two_link")
    begin = robot.pose(nbs.tool_posture(robot, "tip"), "tip")[:3, 3]
    rows = begin + np.linspace(0.0, 1.0, 6)[:, None] * [0.2, 0.0, 0.1]
    tool, joints = tmp_path / "tool.csv", tmp_path / "joints.csv"
    np.savetxt(tool, rows, delimiter=",", header="x,y,z", comments="")
    np.savetxt(
        joints,
        np.linspace(0.0, 1.0, 6)[:, None] * [1.0, 0.1, 0.1],
        delimiter=",",
        header="t,joint1,joint2",
        comments="",
    )
    settings = {"frequency": 1.0, "period": 0.001}
    motion, length = motion_of(str(tool), robot, duration=3.0, frame="tip", **settings)
    assert isinstance(motion, nbs.ToolMotion)
    assert length == pytest.approx(3.0)
    np.testing.assert_allclose(robot.pose(motion(3.0).q, "tip")[:3, 3], rows[-1], atol=1e-8)
    assert isinstance(motion_of(str(joints), robot, **settings)[0], nbs.Sampled)


@pytest.mark.parametrize(("options", "words"), [
    ("--reference circle", "give circle:RADIUS or circle:RADIUS@xz with lengths in m, such as circle:0.1"),
    ("--reference circle:0.1@up", "plane 'up' is unknown"),
    ("--reference circle:nan", "radius is nan"),
    ("--reference line:1,2", "give line:DX,DY,DZ with lengths in m"),
    ("--reference circel:1", "did you mean circle?"),
    ("--reference circle:3", "is out of reach of 'tip'"),
    ("--reference circle:0.1 --frame hand", "no link or joint 'hand'"),
    ("--reference circle:0.1 --orientation hold", "--orientation free"),
    ("--reference circle:0.1 --posture=1", "the posture has 1 numbers for 2 joints"),
    ("--reference circle:0.3 --duration 0.01", "give at least --duration"),
    ("--reference circle:0.3 --duration 2 --fastest", "--fastest finds the duration of the path"),
    ("--frame tip", "--frame tip is for a path of the tool, and the reference is 'sinusoid'"),
])  # fmt: skip
def test_what_cannot_be_followed_is_refused_in_one_sentence(options, words, tmp_path, capsys):
    code = cli.main(["track", "two_link", *options.split(), "--out", str(tmp_path / "run")])
    assert words in refusal(code, capsys)
    assert not (tmp_path / "run").exists()


def test_certify_takes_paths_of_the_tool(tmp_path):
    options = ("--disturbance", "1", "--reference", "circle:0.3", "--frame", "tip", "--out", tmp_path / "run")
    assert "PROVED" in printed_by("certify", "two_link", *options)
    assert summary(tmp_path / "run")["settings"]["tool"] == {"frame": "tip"}
