"""A .xacro file is expanded, its includes beside it, and goes through the same checks as a URDF."""

import sys
from dataclasses import replace

import pytest

import nbs_pin as nbs
from nbs_pin.base.exceptions import MissingExtra, RobotError
from nbs_pin.reports.replay import replay
from nbs_pin.robots.robot import load_robot
from nbs_pin.robots.urdf import read_urdf
from tests.test_replay import moving_run


def write(folder, text, name):
    path = folder / name
    path.write_text(text)
    return path


XACRO = """<?xml version="1.0"?>
<robot name="xarm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:include filename="link.xacro"/>
  <link name="base"/>
  <xacro:body mass="${1 + 1}"/>
  <joint name="j" type="continuous"><parent link="base"/><child link="body"/></joint>
</robot>
"""
INCLUDED = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="body" params="mass">
  <link name="body"><inertial><mass value="${mass}"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
</xacro:macro></robot>
"""


def test_xacro_is_expanded_and_checked(tmp_path):
    write(tmp_path, INCLUDED, "link.xacro")
    robot = load_robot(write(tmp_path, XACRO, "arm & hand.urdf.xacro"))
    assert robot.name == "xarm"
    assert robot.model.inertias[1].mass == 2.0
    bad = write(tmp_path, XACRO.replace("${1 + 1}", "${-1}"), "bad.xacro")
    with pytest.raises(RobotError, match=r"link\.xacro:2: link 'body': mass value '-1\.0'"):
        read_urdf(bad)
    with pytest.raises(RobotError, match=r"bad\.xacro: xacro cannot expand it .*nope"):
        read_urdf(write(tmp_path, XACRO.replace("${1 + 1}", "${nope}"), "bad.xacro"))
    with pytest.raises(RobotError, match=r"dtd\.xacro:2: DTD"):
        read_urdf(write(tmp_path, XACRO.replace("<robot", "<!DOCTYPE robot><robot"), "dtd.xacro"))


def test_xacro_without_its_extra_names_the_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(MissingExtra, match=r"pip install 'nbs-pin\[xacro\]'"):
        read_urdf(write(tmp_path, XACRO, "arm.xacro"))


def test_a_xacro_file_that_a_file_names_is_expanded_only_if_the_user_gives_it(tmp_path, monkeypatch):
    """What is expanded can read the environment and other files into names that end up in pages."""
    arm = write(tmp_path, XACRO.replace("xarm", "$(env SECRET)").replace("${1 + 1}", "2"), "arm.xacro")
    write(tmp_path, INCLUDED, "link.xacro")
    monkeypatch.setenv("SECRET", "told")
    robot = load_robot(arm)
    assert robot.name == "told"
    run = moving_run(robot)
    link = tmp_path / "arm.urdf"
    link.symlink_to(arm)
    other = write(tmp_path, arm.read_text(), "other.urdf")  # what is in it counts, not the ending of its name
    monkeypatch.chdir(tmp_path)
    for source in (str(arm), "arm.xacro", str(link), str(other)):
        named = replace(run, robot=source)
        with pytest.raises(RobotError, match=r"a xacro file, .* give it yourself if you trust it, as robot=load_robot"):
            replay(named, tmp_path / "page.html")
    assert "told" in replay(run, tmp_path / "page.html", robot).read_text()
    nbs.save(nbs.PD.for_robot(robot), tmp_path / "law.nbs")
    with pytest.raises(RobotError, match=r"law\.nbs is of the arm .*, a xacro file"):
        nbs.load(tmp_path / "law.nbs")
    assert nbs.load(tmp_path / "law.nbs", robot).nv == 1
