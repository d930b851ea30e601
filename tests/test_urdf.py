"""Whatever the validator accepts is a sound arm; whatever it refuses names file, line, element, value and remedy."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from nbs_pin.base.exceptions import ArgumentError, RobotError, RobotNotFound
from nbs_pin.robots.catalogue import ROBOT_NAMES
from nbs_pin.robots.robot import load_robot
from nbs_pin.robots.urdf import read_urdf
from nbs_pin.robots.urdf_options import UrdfOptions
from nbs_pin.robots.urdf_source import MAX_BYTES

ARM = """<?xml version="1.0"?>
<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <link name="base"/>
  <link name="l1"><inertial><origin xyz="0.5 0 0"/><mass value="1.5"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.2"/></inertial></link>
  <link name="l2"><inertial><mass value="2.5"/>
    <inertia ixx="0.3" ixy="0" ixz="0" iyy="0.3" iyz="0" izz="0.3"/></inertial></link>
  <link name="tool"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="l1"/><origin xyz="0 0 0.1" rpy="0 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="2" effort="10" velocity="3"/></joint>
  <joint name="j2" type="prismatic"><parent link="l1"/><child link="l2"/><origin xyz="1 0 0"/>
    <axis xyz="1 0 0"/><limit lower="-0.5" upper="0.5" effort="20" velocity="4"/></joint>
  <joint name="flange" type="fixed"><parent link="l2"/><child link="tool"/></joint>
</robot>
"""
TOOL = '<link name="tool"/>'
LIMIT1 = '<limit lower="-1" upper="2" effort="10" velocity="3"/>'
INERTIA2 = 'ixx="0.3" ixy="0" ixz="0" iyy="0.3" iyz="0" izz="0.3"'
BODY2 = re.search(r'<link name="l2">.*?</link>', ARM, re.S).group()


def write(folder, text, name="arm.urdf"):
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def mutated(old, new):
    assert ARM.count(old) >= 1
    return ARM.replace(old, new, 1)


def refusal(path, options=None):
    with pytest.raises(RobotError) as caught:
        read_urdf(path, options)
    message = str(caught.value)
    assert path.name in message
    assert ";" in message, "a remedy follows the problem"
    return message


# what is replaced, by what, the line the message names, and words it must contain (U4 to U20, U24)
REFUSED = {
    "U4 nan": ('"1.5"', '"nan"', 4, ["link 'l1'", "mass", "'nan'", "fix <mass value=…>"]),
    "U4 inf": ('"1.5"', '"inf"', 4, ["link 'l1'", "'inf'"]),
    "U4 negative": ('"1.5"', '"-1"', 4, ["link 'l1'", "'-1.0'", ">= 0"]),
    **{f"U4 '{x}'": ('"1.5"', f'"{x}"', 4, [f"'{x}'"]) for x in ("heavy", "1,5", "1kg", "1_0", "٣", "1e999", "")},
    "U4 no value": ('<mass value="1.5"/>', "<mass/>", 4, ["<mass> states no value"]),
    "U4 no mass": ('<mass value="1.5"/>', "", 4, ["<inertial> has no <mass>"]),
    "U4 no inertia": (f"<inertia {INERTIA2}/>", "", 6, ["link 'l2'", "<inertial> has no <inertia>"]),
    "U4 two masses": ('<mass value="1.5"/>', '<mass value="1"/><mass value="2"/>', 4, ["<mass> is stated twice"]),
    "U4 inertia text": ('ixx="0.1"', 'ixx="0.1m"', 5, ["inertia ixx '0.1m'"]),
    "U4 inertia missing": ('ixy="0" ', "", 5, ["<inertia> states no ixy"]),
    "U5 no inertial": (BODY2, '<link name="l2"/>', 10, ["joint 'j2'", "link 'l2'", "no mass"]),
    "U5 mass 0": (BODY2, re.sub(r'"[\d.]+"', '"0"', BODY2), 11, ["joint 'j2'", "no mass"]),
    "U5 mass 0, inertia": ('"2.5"', '"0"', 6, ["link 'l2'", "mass value '0'"]),
    "U6 negative": (INERTIA2, INERTIA2.replace('ixx="0.3"', 'ixx="-0.3"'), 7, ["not positive definite", "-0.3"]),
    "U6 indefinite": (INERTIA2, INERTIA2.replace('ixy="0"', 'ixy="0.4"'), 7, ["not positive definite", "-0.1"]),
    "U7": (INERTIA2, INERTIA2.replace('ixx="0.3"', 'ixx="0.7"'), 7, ["a + b < c", "0.3, 0.3, 0.7"]),
    "U8 zero": ('"0 0 1"', '"0 0 0"', 10, ["joint 'j1'", "axis", "zero length"]),
    "U8 nan": ('"0 0 1"', '"0 0 nan"', 10, ["axis xyz '0 0 nan' is not 3 finite numbers"]),
    "U8 two": ('"0 0 1"', '"0 1"', 10, ["axis xyz '0 1' is not 3 finite numbers"]),
    "U8 no xyz": ('xyz="0 0 1"', "", 10, ["<axis> states no xyz"]),
    "U8 origin": ('rpy="0 0 0"', 'rpy="0 0 inf"', 9, ["joint 'j1'", "origin rpy '0 0 inf'"]),
    "U8 inertial origin": ('"0.5 0 0"', '"0.5 0"', 4, ["link 'l1'", "origin xyz '0.5 0'"]),
    "U10 swapped": ('lower="-1"', 'lower="3"', 10, ["joint 'j1'", "limit lower 3 > upper 2"]),
    "U10 empty range": ('lower="-1"', 'lower="2"', 10, ["limit lower 2 = upper 2"]),
    "U10 nan": ('lower="-1"', 'lower="nan"', 10, ["limit lower 'nan'"]),
    "U10 none": (LIMIT1, "", 9, ["joint 'j1'", "revolute joint without <limit>"]),
    "U10 no lower": (
        'lower="-1" upper="2"',
        'upper="-1"',
        10,
        ["limit lower 0 > upper -1 (lower left out, which URDF reads as 0)", "j1"],
    ),
    "U10 no range": (
        'lower="-1" upper="2" ',
        "",
        10,
        ["limit lower 0 = upper 0 (lower and upper left out, which URDF reads as 0)", "zero_limits='unlimited'"],
    ),
    "U10 far": ('upper="2"', 'upper="1e308"', 10, ["limit upper 1e+308 is beyond ±1e+06"]),
    "U10 no effort": ('effort="10" ', "", 10, ["<limit> states no effort"]),
    "U10 no velocity": (' velocity="3"', "", 10, ["<limit> states no velocity"]),
    "U10 twice": (LIMIT1, LIMIT1 + LIMIT1, 10, ["<limit> is stated twice"]),
    "U11 zero": ('effort="10"', 'effort="0"', 10, ["limit effort '0' is not > 0"]),
    "U11 negative": ('effort="10"', 'effort="-10"', 10, ["limit effort '-10' is not > 0"]),
    "U11 velocity": ('velocity="3"', 'velocity="0"', 10, ["limit velocity '0' is not > 0"]),
    "damping": (LIMIT1, LIMIT1 + '<dynamics damping="-1"/>', 10, ["dynamics damping '-1.0'", ">= 0"]),
    "U12 joint": ('name="j2"', 'name="j1"', 11, ["the name 'j1' is used twice (lines 9 and 11)"]),
    "U12 link": ('name="tool"', 'name="l1"', 8, ["the name 'l1' is used twice (lines 4 and 8)"]),
    "U13 parent": ('parent link="l1"', 'parent link="nope"', 11, ["joint 'j2'", "parent link 'nope' is not defined"]),
    "U13 child": ('child link="tool"', 'child link="nope"', 13, ["child link 'nope' is not defined"]),
    "U13 no parent": ('<parent link="base"/>', "", 9, ["<joint> has no <parent>"]),
    "U14 orphan": (TOOL, TOOL + '<link name="lost"/>', 8, ["not a tree", "'base', 'lost'"]),
    "U14 cycle": ('parent link="base"', 'parent link="tool"', 9, ["not a tree", "'j1', 'j2', 'flange'", "cycle"]),
    "U14 self": ('parent link="l2"', 'parent link="tool"', 13, ["not a tree", "'flange'", "cycle"]),
    "U14 two parents": ('child link="tool"', 'child link="l1"', 13, ["not a tree", "also the child of joint 'j1'"]),
    "U15 floating": ('"prismatic"', '"floating"', 11, ["type 'floating' is not supported", "lock=['j2']"]),
    "U15 planar": ('"prismatic"', '"planar"', 11, ["type 'planar'"]),
    "U15 unknown": ('"prismatic"', '"hinge"', 11, ["type 'hinge'"]),
    "U15 none": (' type="prismatic"', "", 11, ["<joint> states no type"]),
    "U18 property": ('"1.5"', '"${m}"', 4, ["'${m}'", "xacro"]),
    "U18 undeclared": (TOOL, "<nope:macro/>", 8, ["not well-formed XML"]),
    "U20 XInclude": (
        TOOL,
        '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="/etc/passwd"/>',
        8,
        ["<xinclude:include>"],
    ),
    "U24 long": ('name="tool"', f'name="{"x" * 129}"', 8, ["longer than 128", "rename the link"]),
    "U24 bidi": ('name="tool"', 'name="a\u202eb"', 8, ["unprintable", "a\N{REPLACEMENT CHARACTER}b"]),
    "U24 empty": ('name="tool"', 'name=""', 8, ["empty"]),
    "U24 robot": ('name="arm"', f'name="{"x" * 10**6}"', 2, ["longer than 128", "rename the robot"]),
    "reserved": ('name="j1"', 'name="universe"', 9, ["reserved"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusal_names_file_line_element_value_and_remedy(case, tmp_path):
    old, new, line, words = REFUSED[case]
    message = refusal(write(tmp_path, mutated(old, new)))
    assert f"arm.urdf:{line}: " in message
    assert [word for word in words if word not in message] == []
    assert len(message) < 600


def test_the_unmutated_arm_is_accepted_as_stated(tmp_path):
    urdf = read_urdf(write(tmp_path, ARM))
    j1, j2 = urdf.joints
    assert (j1.name, j1.prismatic, j1.continuous) == ("j1", False, False)
    assert (j1.lower, j1.upper, j1.effort, j1.velocity, j1.damping, j1.friction) == (-1, 2, 10, 3, 0, 0)
    assert (j2.name, j2.prismatic, j2.effort) == ("j2", True, 20)


def test_u1_what_is_no_file(tmp_path, monkeypatch):
    with pytest.raises(RobotNotFound, match="no such file"):
        read_urdf(tmp_path / "arm.urdf")
    with pytest.raises(RobotNotFound, match="it is a directory"):
        read_urdf(tmp_path)
    path = write(tmp_path, ARM)

    def closed(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", closed)
    assert "Permission denied" in refusal(path)


@pytest.mark.parametrize("text", ["", "{}", "\x01\x02", ARM[:400], "robot", "<robot><link></robot>"])
def test_u2_what_is_no_xml(text, tmp_path):
    assert re.search(r"arm\.urdf:\d+: not well-formed XML: .*line \d+, column \d+", refusal(write(tmp_path, text)))


def test_u3_another_format(tmp_path):
    message = refusal(write(tmp_path, "<sdf/>"))
    assert "root element is <sdf>" in message
    assert "a URDF <robot> or an MJCF <mujoco> is needed" in message


def test_u9_a_long_axis_is_normalised_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match=r"arm\.urdf:10: joint 'j1': axis xyz '0.0 3.0 4.0' is not a unit vector"):
        urdf = read_urdf(write(tmp_path, mutated('"0 0 1"', '"0 3 4"')))
    assert b'xyz="0.0 0.6 0.8"' in urdf.without_geometry()
    read_urdf(write(tmp_path, mutated('"0 0 1"', '"0 0 0.99999999"')))  # rounding is silent


def test_u11_zero_limits_read_as_unlimited(tmp_path):
    text = mutated(LIMIT1, '<limit lower="0" upper="0" effort="0" velocity="0"/>')
    joint = read_urdf(write(tmp_path, text), UrdfOptions(zero_limits="unlimited")).joints[0]
    assert (joint.lower, joint.upper, joint.effort, joint.velocity) == (-np.inf, np.inf, np.inf, np.inf)
    assert load_robot(write(tmp_path, text), zero_limits="unlimited").effort_limit.tolist() == [np.inf, 20.0]
    for zero in ('lower="0" upper="0" effort="1"', 'lower="-1" upper="1" effort="0"'):
        message = refusal(write(tmp_path, mutated(LIMIT1, f'<limit {zero} velocity="1"/>')))
        assert "or zero_limits='unlimited' if 0 means no limit" in message
    negative = write(tmp_path, mutated('effort="10"', 'effort="-1"'))
    assert "or zero_limits='unlimited' if -1 means no limit" in refusal(negative)
    assert load_robot(negative, zero_limits="unlimited").effort_limit.tolist() == [np.inf, 20.0]
    with pytest.raises(ArgumentError, match="zero_limits is 'none'; give 'refuse' or 'unlimited'"):
        load_robot("two_link", zero_limits="none")


def test_an_arm_without_a_name_takes_that_of_its_file(tmp_path):
    named, unnamed = mutated('name="arm"', 'name="lone"'), mutated(' name="arm"', "")
    urdf = read_urdf(write(tmp_path, unnamed, "lone.urdf"))
    assert urdf.name == "lone"
    assert urdf.xml == read_urdf(write(tmp_path, named)).xml


@pytest.mark.parametrize("limit", ["", '<limit effort="7" velocity="5"/>', LIMIT1])
def test_u16_a_continuous_joint_is_an_unbounded_revolute_one(limit, tmp_path):
    robot = load_robot(write(tmp_path, mutated(LIMIT1, limit).replace("revolute", "continuous")))
    assert robot.continuous.tolist() == [True, False]
    assert robot.model.nq == robot.model.nv == 2
    assert (robot.lower[0], robot.upper[0]) == (-np.inf, np.inf)
    assert robot.effort_limit[0] == {"": np.inf, LIMIT1: 10}.get(limit, 7)
    z1 = robot.difference(np.array([3.0, 0.4]), np.array([-3.0, 0.1]))
    np.testing.assert_allclose(z1, [6.0 - 2 * np.pi, 0.3], atol=1e-15)


def test_u15_u17_locked_joints_are_fixed_whatever_they_were(tmp_path):
    text = mutated('"prismatic"', '"floating"').replace('<axis xyz="1 0 0"/>', '<axis xyz="0 0 0"/><mimic joint="j1"/>')
    path = write(tmp_path, text)
    urdf = read_urdf(path, UrdfOptions(lock={"j2": 0.0}))
    assert [joint.name for joint in urdf.joints] == ["j1"]
    assert b"mimic" not in urdf.xml
    message = refusal(path, UrdfOptions(lock={"j3": 0.0}))
    assert "no joint 'j3' for lock" in message
    assert "j1, j2, flange" in message


def test_u18_nothing_moves(tmp_path):
    assert "0 movable joints" in refusal(write(tmp_path, '<robot name="r"><link name="a"/></robot>'))
    assert "0 movable joints" in refusal(write(tmp_path, ARM), UrdfOptions(lock={"j1": 0.0, "j2": 0.0}))


def chain(count, kind):
    links = "".join(
        f'<link name="l{i}"/><joint name="j{i}" type="{kind}"><parent link="l{i + 1}"/><child link="l{i}"/></joint>'
        for i in range(count)
    )
    return f'<robot name="chain">{links}<link name="l{count}"/></robot>'


def test_u19_too_large(tmp_path):
    assert "65 moving joints (limit 64)" in refusal(write(tmp_path, chain(65, "continuous")))
    fixed = chain(1000, "fixed").replace('"fixed"', '"continuous"', 1)
    assert "1001 links (limit 1000)" in refusal(write(tmp_path, fixed))
    assert "too large" in refusal(write(tmp_path, b" " * (MAX_BYTES + 1)))
    assert "too deep" in refusal(write(tmp_path, "<robot>" + "<a>" * 100_000))


@pytest.mark.parametrize(
    "doctype",
    [
        "<!DOCTYPE robot>",
        '<!DOCTYPE robot SYSTEM "http://example.com/robot.dtd">',
        '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;">]>',
    ],
)
def test_u20_no_dtd_no_entities(doctype, tmp_path):
    message = refusal(write(tmp_path, mutated('<robot name="arm"', f'{doctype}\n<robot name="arm"')))
    assert "arm.urdf:2: DTD and entities are not allowed" in message


def test_u21_only_utf8(tmp_path):
    assert "not UTF-8 at byte 0" in refusal(write(tmp_path, ARM.encode("utf-16")))
    assert "NUL at byte 1" in refusal(write(tmp_path, ARM.encode("utf-16-le")))
    assert "NUL at byte 30" in refusal(write(tmp_path, ARM.encode()[:30] + b"\0" + ARM.encode()[30:]))
    assert "not UTF-8 at byte 5" in refusal(write(tmp_path, b"<?xml\xff"))
    relabelled = ARM.replace('version="1.0"', 'version="1.0" encoding="latin-1"').replace("tool", "Ärm")
    assert "Ärm" in read_urdf(write(tmp_path, relabelled)).xml.decode().replace("&#196;", "Ä")


def test_a_default_namespace_is_no_obstacle(tmp_path):
    spaced = read_urdf(write(tmp_path, mutated('<robot name="arm"', '<robot xmlns="http://example.com" name="arm"')))
    assert spaced.without_geometry() == read_urdf(write(tmp_path, ARM)).without_geometry()


def test_what_engines_read_is_what_was_checked(tmp_path):
    """Pinocchio silently drops the body of a mass ' 1.5 '; the checked bytes state 1.5."""
    text = mutated('"1.5"', '" +1.5 "').replace('"0.5 0 0"', '" 5e-1   0\t0 "')
    inertia = load_robot(write(tmp_path, text)).model.inertias[1]
    assert inertia.mass == 1.5
    np.testing.assert_array_equal(inertia.lever, [0.5, 0, 0])


def test_links_without_inertia_are_part_of_the_body_they_are_fixed_to(tmp_path):
    """A massless flange that a joint moves is fine when a massive tool is fixed to it."""
    body = BODY2.replace('name="l2"', 'name="tool"')
    text = ARM.replace(BODY2, '<link name="l2"/>').replace(TOOL, body)
    assert load_robot(write(tmp_path, text)).model.inertias[2].mass == 2.5


def test_point_masses_and_rods_are_bodies_as_long_as_the_arm_has_inertia(tmp_path):
    zero = re.sub(r'\b(i[xyz]{2})="[\d.]+"', r'\1="0"', ARM)
    load_robot(write(tmp_path, zero))  # two point masses off the first axis
    load_robot(write(tmp_path, zero.replace('ixy="0"', 'ixy="1e-35"')))  # a rounding error of a point mass
    rod = re.sub(r'ixx="0.3"', 'ixx="0"', ARM)
    load_robot(write(tmp_path, rod))
    on_axis = zero.replace('"0.5 0 0"', '"0 0 0.5"').replace('<origin xyz="1 0 0"/>', "").replace('"1 0 0"', '"0 0 1"')
    with pytest.raises(RobotError, match=r"arm\.urdf: joint 'j1': moves no inertia \(0 kg·m² about its axis\)"):
        load_robot(write(tmp_path, on_axis))


def test_two_joints_on_one_axis_leave_a_singular_arm(tmp_path):
    massless = 'ixx="1e-30" ixy="0" ixz="0" iyy="1e-30" iyz="0" izz="1e-30"'
    text = ARM.replace('"1 0 0"', '"0 0 1"').replace("prismatic", "revolute").replace('"0.5 0 0"', '"0 0 0"')
    text = re.sub(r'ixx="0.1".*?izz="0.2"', massless, text)
    with pytest.raises(RobotError, match=r"joint 'j\d': M\(q\)"):
        load_robot(write(tmp_path, text))


def test_without_geometry_is_the_dynamics_alone(tmp_path):
    drawn = mutated(TOOL, '<link name="tool"><visual><nonsense/></visual><collision/></link>')
    drawn = drawn.replace("<link", '<material name="m"/>\n<!-- a comment --><link', 1)
    urdf, plain = read_urdf(write(tmp_path, drawn)), read_urdf(write(tmp_path, ARM))
    assert b"nonsense" in urdf.xml
    assert urdf.without_geometry() == plain.without_geometry()
    load_robot(write(tmp_path, drawn))  # a broken drawing does not stop the dynamics


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_mujoco_reads_the_same_arm_from_the_same_bytes(name):
    robot = load_robot(name)
    model = mujoco.MjModel.from_xml_string(robot.urdf.without_geometry().decode())
    assert model.nv == model.nq == robot.nv
    masses = [model.body_mass[model.jnt_bodyid[model.joint(joint).id]] for joint in robot.joint_names]
    np.testing.assert_allclose(masses, [inertia.mass for inertia in robot.model.inertias[1:]], rtol=1e-12)


def test_space_before_the_declaration_is_passed_over(tmp_path):
    late = read_urdf(write(tmp_path, "\n\n" + ARM))
    assert late.without_geometry() == read_urdf(write(tmp_path, ARM)).without_geometry()
    assert "arm.urdf:6:" in refusal(write(tmp_path, "\n\n" + mutated('"1.5"', '"heavy"')))
