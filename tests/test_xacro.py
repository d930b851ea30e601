"""A .xacro file is expanded, its includes beside it, and goes through the same checks as a URDF."""

import sys

import pytest

from nbs_pin.base.exceptions import MissingExtra, RobotError
from nbs_pin.robots.robot import load_robot
from nbs_pin.robots.urdf import read_urdf


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
