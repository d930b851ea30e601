"""Files as they are found: an arm, or a sentence whose remedy can be typed where it is printed."""

import itertools
import re
import shlex
import warnings

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh

from nbs_pin.base.doors import BLANK, at_the_shell, option
from nbs_pin.base.exceptions import ArgumentError, RobotError
from nbs_pin.cli import main, parse
from nbs_pin.robots.bodies import nearest_body
from nbs_pin.robots.packages import Packages
from nbs_pin.robots.robot import load_robot
from nbs_pin.robots.visuals import link_visuals
from tests.test_urdf import write


def link(name, mass=1.0, inertia=(0.02, 0.03, 0.04), extra=""):
    xx, yy, zz = inertia
    return (
        f'<link name="{name}"><inertial><origin xyz="0.02 0.01 0.15"/><mass value="{mass}"/><inertia ixx="{xx}" '
        f'iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>{extra}</link>\n'
    )


def joint(name, parent, child, kind="revolute", extra="", limit='lower="-2" upper="2" effort="50" velocity="3"'):
    stated = "" if kind == "fixed" else f'<axis xyz="0 1 0"/><limit {limit}/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0.1 0.3" rpy="0.1 0.2 0.3"/>{stated}{extra}</joint>\n'
    )


def robot(*parts, base='<link name="base"/>\n'):
    return f'<robot name="arm">\n{base}{"".join(parts)}</robot>\n'


ARM = (link("a"), joint("shoulder", "base", "a"), link("b"), joint("elbow", "a", "b"))
GRIPPER = (
    *ARM,
    link("left", 0.1, (1e-4, 1e-4, 1e-4)),
    joint("finger", "b", "left", "prismatic", limit='lower="0" upper="0.04" effort="20" velocity="1"'),
    link("right", 0.1, (1e-4, 1e-4, 1e-4)),
    joint("follower", "b", "right", "prismatic", '<mimic joint="finger" multiplier="-1" offset="0.01"/>'),
    link("tip", 0.1, (1e-4, 1e-4, 1e-4)),
    joint("tip_joint", "right", "tip", "revolute", '<mimic joint="follower" multiplier="2"/>'),
)


def loaded(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_robot(path, **options)


def typed(path, text=""):
    """The arm as `nbs-pin track FILE` with the options in `text` loads it."""
    with at_the_shell():
        return loaded(path, **parse(["track", str(path), *shlex.split(text)]).arm.given())


REMEDIES = {
    "effort 0": ("".join(ARM).replace('effort="50"', 'effort="0"', 1), "--limits shoulder.effort=…", "9"),
    "effort 0, unlimited": ("".join(ARM).replace('effort="50"', 'effort="0"'), "--zero-limits unlimited", ""),
    "effort -1 everywhere": ("".join(ARM).replace('effort="50"', 'effort="-1"'), "--zero-limits unlimited", ""),
    "no limit": (re.sub(r"<limit.*?/>", "", "".join(ARM)), "--zero-limits unlimited", ""),
    "equal": (
        "".join(ARM) + link("c") + joint("hand", "b", "c", limit='lower="1" upper="1" effort="1" velocity="1"'),
        "--lock hand=1",
        "",
    ),
    "mass 0": ("".join(ARM) + link("c", mass=0) + joint("hand", "b", "c", "fixed"), "--repair", ""),
    "two without mass": (
        "".join(ARM) + '<link name="c"/><link name="d"/>' + joint("hand", "b", "c") + joint("tool", "b", "d"),
        "--lock hand,tool",
        "",
    ),
    "velocity -1": ("".join(ARM).replace('velocity="3"', 'velocity="-1"', 1), "--limits shoulder.velocity=…", "2"),
    "no range": ("".join(ARM).replace('lower="-2" upper="2"', ""), "--zero-limits unlimited", ""),
    "no inertia": ("".join(ARM).replace('izz="0.04"', 'izz="0.9"', 1), "--repair", ""),
    "no mass": (
        "".join((*ARM[1:], '<link name="a"><visual><geometry><box size="1 1 1"/></geometry></visual></link>')),
        "--inertia-from shapes",
        "",
    ),
    "floating": ("".join(ARM) + link("c") + joint("base_joint", "b", "c", "floating"), "--lock base_joint", ""),
    "still": (
        "".join(ARM).replace('"0.02 0.01 0.15"', '"0 0.15 0"').replace('yy="0.03"', 'yy="0"').replace("0.04", "0.02"),
        "--lock elbow",
        None,
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REMEDIES)
def test_the_shell_takes_the_remedy_that_it_prints(case, tmp_path):
    text, remedy, value = REMEDIES[case]
    path = write(tmp_path, robot(text))
    with pytest.raises(RobotError) as caught:
        typed(path)
    assert f"{remedy}" in str(caught.value)
    if value is not None:
        assert typed(path, remedy.replace("…", value)).nv == 2
    with pytest.raises(RobotError) as caught:
        loaded(path)
    assert "--" not in str(caught.value)
    name = remedy.split()[0].removeprefix("--").replace("-", "_")
    assert f"{name}=" in str(caught.value)


def test_what_a_message_names_is_written_as_its_reader_types_it():
    assert option("lock", ["a", "b"]) == "lock=['a', 'b']"
    with at_the_shell():
        assert option("lock", ["a", "b"]) == "--lock a,b"
        assert option("lock", {"a": 0.02, "b": 0.0}) == "--lock a=0.02,b"
        assert option("limits", {"a": {"effort": 5, "lower": -1}}) == "--limits a.effort=5,a.lower=-1"
        assert option("xacro_args", {"x": "1", "y": "VALUE"}) == "--arg x:=1 --arg y:=VALUE"
        assert option("repair", True) == "--repair"
        assert option("package_dirs", "…") == "--package-dir …"
    assert option("repair", True) == "repair=True"


def test_joints_that_mimic_are_locked_where_the_others_stand_at_zero(tmp_path):
    path = write(tmp_path, robot(*GRIPPER))
    with pytest.warns(
        UserWarning, match=r"arm\.urdf:\d+: .*'follower' \(of 'finger', at 0\.01\), 'tip_joint' .*at 0\.02\)"
    ):
        arm = load_robot(path)
    assert arm.joint_names == ("shoulder", "elbow", "finger")
    by_hand = re.sub(r"<mimic.*?/>", "", path.read_text())
    whole = loaded(write(tmp_path, by_hand, "whole.urdf"))
    at = dict(zip(whole.joint_names, (0.3, -0.4, 0.02, 0.01, 0.02), strict=False))
    places = {"follower": 0.01, "tip_joint": 0.02}
    q = np.array([{**at, **places}[name] for name in whole.joint_names])
    _same_inertia(arm, np.array([at[name] for name in arm.joint_names]), whole, q)
    again = loaded(path, lock=["finger"])
    assert again.joint_names == ("shoulder", "elbow")


def _same_inertia(part, q_part, whole, q_whole):
    """M and G of an arm with locked joints are those of the whole arm at that place, for the joints that move."""
    rows = [whole.joint_names.index(name) for name in part.joint_names]
    full = pin.crba(whole.model, whole.model.createData(), q_whole)
    mass = pin.crba(part.model, part.model.createData(), q_part)
    np.testing.assert_allclose(mass, full[np.ix_(rows, rows)], rtol=1e-12, atol=1e-14)
    gravity = pin.computeGeneralizedGravity(whole.model, whole.model.createData(), q_whole)[rows]
    own = pin.computeGeneralizedGravity(part.model, part.model.createData(), q_part)
    np.testing.assert_allclose(own, gravity, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", ["shoulder", "elbow", "finger"])
def test_a_joint_locked_somewhere_is_the_arm_held_there(name, tmp_path):
    path = write(tmp_path, re.sub(r"<mimic.*?/>", "", robot(*GRIPPER)))
    whole, places = loaded(path), {name: 0.017, "follower": -0.3}
    part = loaded(path, lock=places)
    rng = np.random.default_rng(0)
    for q in rng.uniform(-1.0, 1.0, (5, part.nv)):
        at = {**dict(zip(part.joint_names, q, strict=True)), **places}
        _same_inertia(part, q, whole, np.array([at[name] for name in whole.joint_names]))
    again = loaded(part.source, **part.options)
    assert again.sha256 == part.sha256 != whole.sha256


def test_limits_from_outside_leave_the_description_alone(tmp_path):
    path = write(tmp_path, robot(*ARM))
    plain = load_robot(path)
    given = load_robot(path, limits={"*": {"effort": 7.0, "velocity": None}, "elbow": {"effort": np.inf}})
    assert given.effort_limit.tolist() == [7.0, np.inf]
    assert given.velocity_limit.tolist() == [np.inf, np.inf]
    assert given.sha256 == plain.sha256
    assert load_robot(path, **given.options).effort_limit.tolist() == [7.0, np.inf]
    shorter = load_robot(path, limits={"elbow": {"lower": -0.5, "upper": 0.25}})
    assert (shorter.lower[1], shorter.upper[1]) == (-0.5, 0.25)
    assert shorter.sha256 != plain.sha256
    for wrong in (
        {"elbow": {"effort": 0.0}},
        {"elbow": {"strength": 1.0}},
        {"elbow": 3.0},
        [1.0],
        {"elbow": {"lower": np.nan}},
    ):
        with pytest.raises(ArgumentError, match=r"limits is .*give for instance"):
            load_robot(path, limits=wrong)
    with pytest.raises(RobotError, match="no joint 'wrist' for limits; the joints are shoulder, elbow"):
        load_robot(path, limits={"wrist": {"effort": 1.0}})


def test_a_lower_limit_that_is_left_out_is_named(tmp_path):
    path = write(tmp_path, robot(*ARM).replace('lower="-2" ', "", 1))
    with pytest.warns(UserWarning, match=r"states no lower, which URDF reads as 0.*limits=\{'shoulder': \{'lower'"):
        assert load_robot(path).lower.tolist() == [0.0, -2.0]


def test_limits_that_exporters_write_for_none_are_none(tmp_path):
    for size in ("1e16", "3.4e38", "1e9"):
        path = write(tmp_path, robot(*ARM).replace('lower="-2" upper="2"', f'lower="-{size}" upper="{size}"', 1))
        arm = load_robot(path)
        assert (arm.lower[0], arm.upper[0]) == (-np.inf, np.inf)
        assert not arm.continuous[0]


def test_the_nearest_body_is_one_and_none_is_nearer():
    rng = np.random.default_rng(3)
    for _ in range(40):
        stated = rng.normal(size=(3, 3))
        stated = stated + stated.T + 2.0 * rng.uniform(-1, 1) * np.eye(3)
        body = nearest_body(stated)
        moments = np.linalg.eigvalsh(body)
        assert moments[0] >= 0.0
        assert moments[0] + moments[1] >= moments[2] - 1e-12
        np.testing.assert_allclose(nearest_body(body), body, atol=1e-12)
        second = _second(stated)
        distance = np.linalg.norm(_second(body) - second)
        for _ in range(20):
            root = rng.normal(size=(3, 3))
            assert np.linalg.norm(rng.exponential() * root @ root.T - second) >= distance * (1 - 1e-4)
    real = np.diag([0.1, 0.2, 0.25])
    np.testing.assert_allclose(nearest_body(real), real, rtol=1e-15)


def _second(inertia):
    return 0.5 * np.trace(inertia) * np.eye(3) - inertia


def test_an_inertia_that_is_repaired_is_named_with_its_numbers(tmp_path):
    path = write(tmp_path, robot(*ARM).replace('izz="0.04"', 'izz="0.9"', 1))
    with pytest.raises(RobotError, match=r'nearest body has <inertia ixx="[\d.]+" ixy'):
        load_robot(path)
    with pytest.warns(UserWarning, match=r"arm\.urdf:\d+: link 'a': not a physical body.*taken as <inertia"):
        arm = load_robot(path, repair=True)
    stated = arm.model.inertias[1].inertia
    np.testing.assert_allclose(stated, nearest_body(np.diag([0.02, 0.03, 0.9])), rtol=1e-5)
    mujoco.MjModel.from_xml_string(arm.urdf.without_geometry().decode())
    assert loaded(path, **arm.options).sha256 == arm.sha256


def test_what_is_welded_to_the_world_is_not_judged(tmp_path):
    base = link("base", inertia=(0.01, 0.01, 0.5)) + joint("plate_joint", "base", "plate", "fixed")
    text = robot(*ARM, base=base + link("plate", inertia=(-1.0, 1.0, 1.0))).replace(
        'parent link="base"', 'parent link="plate"'
    )
    text = text.replace('<parent link="plate"/><child link="plate"/>', '<parent link="base"/><child link="plate"/>')
    arm, plain = load_robot(write(tmp_path, text)), load_robot(write(tmp_path, robot(*ARM), "plain.urdf"))
    np.testing.assert_array_equal(
        *(pin.crba(a.model, a.model.createData(), np.array([0.1, 0.2])) for a in (arm, plain))
    )
    mujoco.MjModel.from_xml_string(arm.urdf.without_geometry().decode())
    with pytest.raises(RobotError, match="link 'a'"):
        load_robot(write(tmp_path, text.replace('iyy="0.03"', 'iyy="-3"')))


SHAPES = (
    '<collision><origin xyz="0.1 0 0.2" rpy="0.3 0 0.1"/><geometry><box size="0.1 0.2 0.3"/></geometry></collision>',
    '<collision><geometry><cylinder radius="0.05" length="0.4"/></geometry></collision>'
    '<collision><origin xyz="0 0 0.5"/><geometry><sphere radius="0.1"/></geometry></collision>',
)


def test_shapes_are_filled_as_mujoco_fills_them(tmp_path):
    massless = [f'<link name="{name}">{shape}</link>' for name, shape in zip("ab", SHAPES, strict=True)]
    path = write(tmp_path, robot(massless[0], ARM[1], massless[1], ARM[3]))
    with pytest.warns(UserWarning, match=r"links 'a', 'b' are guessed from their shapes, filled with 1000 kg/m³"):
        arm = load_robot(path, inertia_from="shapes")
    model = mujoco.MjModel.from_xml_string(path.read_text())
    masses = [model.body(name).mass[0] for name in "ab"]
    np.testing.assert_allclose(
        [body.mass for body in arm.model.inertias[1:]], masses, rtol=2e-3
    )  # round shapes: facets
    data, full = mujoco.MjData(model), np.zeros((2, 2))
    data.qpos[:] = q = [0.3, -0.7]
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    np.testing.assert_allclose(pin.crba(arm.model, arm.model.createData(), np.array(q)), full, rtol=3e-3)
    stated = load_robot(write(tmp_path, robot(*ARM), "stated.urdf"), inertia_from="shapes")
    assert stated.sha256 == load_robot(stated.source).sha256


def test_a_mesh_without_a_volume_counts_as_its_hull(tmp_path):
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    trimesh.Trimesh(box.vertices, box.faces[2:]).export(tmp_path / "open.stl")
    shape = '<visual><geometry><mesh filename="open.stl" scale="1 1 2"/></geometry></visual>'
    path = write(tmp_path, robot(f'<link name="a">{shape}</link>', ARM[1], *ARM[2:]))
    assert loaded(path, inertia_from="shapes").model.inertias[1].mass == pytest.approx(16.0)
    path.write_text(path.read_text().replace("open.stl", "gone.stl"))
    with pytest.raises(RobotError, match=r"inertia cannot be guessed: mesh 'gone.stl' was not found"):
        loaded(path, inertia_from="shapes")


def test_wheels_on_a_fixed_base_are_named(tmp_path):
    path = write(tmp_path, robot(*ARM, link("left_wheel"), joint("drive", "base", "left_wheel", "continuous")))
    with pytest.warns(UserWarning, match=r"joints 'drive' look like wheels.*lock=\['drive'\]"):
        load_robot(path)


XMLNS = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
BODY = (
    f'<robot {XMLNS}>\n<xacro:macro name="body" params="name mass">\n<link name="${{name}}"><inertial>\n'
    '<mass value="${mass}"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>\n'
    "</xacro:macro></robot>\n"
)
TOP = (
    f'<robot name="two" {XMLNS}>\n<xacro:include filename="$(find pieces)/body.xacro"/>\n'
    '<link name="base"/>\n<xacro:body name="a" mass="$(arg mass)"/>\n'
    '<joint name="j" type="continuous"><parent link="base"/><child link="a"/></joint>\n</robot>\n'
)


def package(folder, name, **files):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "package.xml").write_text(f"<package><name>{name}</name></package>")
    for file, text in files.items():
        path = folder / file.replace("__", ".")
        path.write_bytes(text) if isinstance(text, bytes) else path.write_text(text)
    return folder


def test_arguments_of_xacro_are_named_and_taken(tmp_path):
    package(tmp_path / "pieces", "pieces", body__xacro=BODY)
    path = package(tmp_path / "top", "top", arm__xacro=TOP) / "arm.xacro"
    with pytest.raises(
        RobotError, match=r"xacro needs the argument 'mass'; give a value: xacro_args=\{'mass': 'VALUE'\}"
    ):
        load_robot(path)
    with at_the_shell(), pytest.raises(RobotError, match="give a value: --arg mass:=VALUE"):
        load_robot(path)
    assert typed(path, "--arg mass:=2.5").model.inertias[1].mass == 2.5
    arm = load_robot(path, xacro_args={"mass": 3})
    assert load_robot(path, **arm.options).sha256 == arm.sha256
    with pytest.raises(RobotError, match=r"body\.xacro:4: link 'a': mass value '-1\.0'"):
        load_robot(path, xacro_args={"mass": -1})


def test_a_xacro_file_is_one_by_its_content_and_macros_alone_are_no_arm(tmp_path):
    path = write(tmp_path, TOP.replace("$(find pieces)/", "").replace("$(arg mass)", "2"), "arm.urdf")
    (tmp_path / "body.xacro").write_text(BODY)
    assert load_robot(path).model.inertias[1].mass == 2.0
    with pytest.raises(RobotError, match=r"0 movable joints.*macros"):
        load_robot(tmp_path / "body.xacro")


@pytest.mark.parametrize("where", ["beside", "renamed", "workspace", "given", "ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"])
def test_packages_are_found_for_xacro_and_meshes_alike(where, tmp_path, monkeypatch):
    places = {
        "beside": "src/pieces", "renamed": "src/pieces-main", "workspace": "src/repository/nested/pieces",
        "given": "elsewhere/pieces", "ROS_PACKAGE_PATH": "elsewhere/deep/pieces",
        "AMENT_PREFIX_PATH": "opt/share/pieces",
    }  # fmt: skip
    stl = trimesh.creation.box((1, 1, 1)).export(file_type="stl")
    package(tmp_path / places[where], "pieces", body__xacro=BODY, box__stl=stl)
    mesh = '<link name="base"><visual><geometry><mesh filename="package://pieces/box.stl"/></geometry></visual></link>'
    text = TOP.replace('<link name="base"/>', f'<xacro:arg name="mass" default="1"/>{mesh}')
    path = package(tmp_path / "src/other/top", "top", arm__xacro=text) / "arm.xacro"
    options = {}
    if where == "given":
        options = {"package_dirs": [tmp_path / "elsewhere"]}
    elif where == "ROS_PACKAGE_PATH":
        monkeypatch.setenv(where, f"/nowhere:{tmp_path / 'elsewhere'}")
    elif where == "AMENT_PREFIX_PATH":
        monkeypatch.setenv(where, str(tmp_path / "opt"))
    if where in ("given", "ROS_PACKAGE_PATH"):
        assert Packages(path, options.get("package_dirs", ())).find("pieces") is not None
    arm = load_robot(path, **options)
    assert {visual.link for visual in link_visuals(arm)} >= {"base"}
    again = load_robot(arm.source, **arm.options)
    assert again.sha256 == arm.sha256


def test_a_folder_without_a_name_is_taken_for_the_package_of_its_file(tmp_path):
    folder = tmp_path / "src" / "repository" / "copied" / "urdf"
    folder.mkdir(parents=True)
    (folder / "body.xacro").write_text(BODY)
    path = write(
        folder, TOP.replace("$(find pieces)/", "$(find pieces)/urdf/").replace("$(arg mass)", "2"), "arm.xacro"
    )
    with pytest.warns(
        UserWarning, match="package 'pieces' was not found and is taken to be .*copied, which has no pack"
    ):
        assert load_robot(path).nv == 1
    (folder / "body.xacro").unlink()
    with pytest.raises(RobotError, match=r"package 'pieces' was not found.*package_dirs=…"):
        load_robot(path)


def test_an_argument_whose_value_leads_nowhere_is_named(tmp_path):
    text = TOP.replace("$(find pieces)/body.xacro", "config/$(arg kind)/body.xacro")
    declared = '<xacro:arg name="kind" default="ur5x"/><xacro:arg name="other" default="1"/><xacro:include'
    path = write(
        tmp_path, text.replace("<xacro:include", declared).replace('name="two"', 'name="$(arg kind)"'), "arm.xacro"
    )
    with pytest.raises(RobotError, match=r"No such file.*argument kind = 'ur5x': set it by xacro_args=…"):
        load_robot(path)
    (tmp_path / "config" / "ur5e").mkdir(parents=True)
    (tmp_path / "config" / "ur5e" / "body.xacro").write_text(BODY)
    assert load_robot(path, xacro_args={"kind": "ur5e", "mass": 1}).name == "ur5e"


def test_a_missing_package_is_named_with_the_option_for_it(tmp_path):
    path = package(tmp_path / "src" / "repository" / "nested" / "top", "top", arm__xacro=TOP) / "arm.xacro"
    for _ in range(2):
        with pytest.raises(RobotError, match=r"package 'pieces' was not found .* package_dirs=…"):
            load_robot(path)
        loaded(package(tmp_path / "elsewhere" / "pieces", "pieces", body__xacro=BODY).parents[1] / path,
               package_dirs=[tmp_path / "elsewhere"], xacro_args={"mass": 1})  # fmt: skip
    with at_the_shell(), pytest.raises(RobotError, match=r"--package-dir …"):
        load_robot(path)
    with pytest.warns(UserWarning, match="package_dirs names .*nowhere, which is no folder"):
        load_robot("two_link", package_dirs=[tmp_path / "nowhere"])


def test_a_package_that_only_meshes_need_does_not_stop_the_arm(tmp_path):
    mesh = '<visual><geometry><mesh filename="file://$(find gone)/m/x.stl"/></geometry></visual>'
    text = robot(
        *(link(name, extra=mesh) if part.startswith("<link") else part for name, part in zip("axbx", ARM, strict=True))
    )
    path = write(tmp_path, text.replace("<robot", f"<robot {XMLNS}"), "arm.xacro")
    arm = load_robot(path)
    with pytest.warns(UserWarning, match="links 'a', 'b' are drawn as capsules") as caught:
        link_visuals(arm)
    assert len(caught) == 1


def test_options_of_the_wrong_type_are_refused_in_one_sentence():
    wrong = {
        "lock": [3, [1], {"joint1": np.nan}, {"joint1": "x"}], "repair": [1, "yes"], "inertia_from": ["mesh", 3],
        "xacro_args": [3, "a:=b", {1: 2}], "package_dirs": [3, [3]], "limits": [3, "x"], "zero_limits": ["x", 3],
    }  # fmt: skip
    for name, value in itertools.chain.from_iterable(((k, v) for v in values) for k, values in wrong.items()):
        with pytest.raises(ArgumentError, match=f"{name} is"):
            load_robot("two_link", **{name: value})


def test_a_name_is_one_word_of_the_shell():
    with at_the_shell():
        assert option("lock", ["left finger", "b"]) == "--lock 'left finger,b'"
        assert option("lock", ["a;rm -rf x"]) == "--lock 'a;rm -rf x'"
        assert option("lock", ["-a"]) == "--lock=-a"
        assert option("limits", {"*": {"effort": 5.0}}) == "--limits '*.effort=5.0'"
        assert option("limits", {"a": {"effort": "…"}}) == "--limits a.effort=…"
    assert option("limits", {"a": {"effort": BLANK}}) == "limits={'a': {'effort': …}}"


def test_options_may_be_repeated_and_add_up(tmp_path):
    path = write(tmp_path, robot(*ARM, link("c"), joint("hand", "b", "c")))
    arm = typed(path, "--lock hand=0.1 --limits shoulder.effort=1 --lock elbow --limits shoulder.velocity=2")
    assert arm.joint_names == ("shoulder",)
    assert (arm.effort_limit[0], arm.velocity_limit[0]) == (1.0, 2.0)


def test_remedies_name_everything_and_keep_what_was_given(tmp_path):
    text = robot(*ARM, link("c"), joint("fb", "b", "c", "floating"), link("d"), joint("pl", "b", "d", "planar"))
    with at_the_shell(), pytest.raises(RobotError, match=r"--lock fb,pl"):
        loaded(write(tmp_path, text))
    text = robot(*ARM).replace('effort="50"', 'effort="0"').replace('velocity="3"', 'velocity="-1"', 1)
    path = write(tmp_path, text)
    with pytest.raises(RobotError) as caught:
        typed(path, "--limits elbow.upper=1 --lock elbow")
    assert "--limits elbow.upper=1.0,shoulder.effort=…,shoulder.velocity=…" in str(caught.value)
    with pytest.raises(RobotError, match=r"--limits shoulder\.effort=…,shoulder\.velocity=…,elbow\.effort=…"):
        typed(path)


def test_shapes_fill_links_that_state_no_mass_at_all(tmp_path):
    zero = '<inertial><mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'
    path = write(tmp_path, robot(f'<link name="a">{zero}{SHAPES[0]}</link>', ARM[1], *ARM[2:]))
    assert loaded(path, inertia_from="shapes").model.inertias[1].mass == pytest.approx(6.0)
    for size in ("0 1 1", "-1 1 1", "1e200 1 1"):
        path = write(
            tmp_path,
            robot(f'<link name="a">{SHAPES[0]}</link>', *ARM[1:]).replace('size="0.1 0.2 0.3"', f'size="{size}"'),
        )
        with pytest.raises(RobotError, match=r"size .* encloses no volume"):
            loaded(path, inertia_from="shapes")
    box = trimesh.creation.box((0.2, 0.2, 0.2))
    shape = '<visual><geometry><mesh filename="part.stl"/></geometry></visual>'
    path = write(tmp_path, robot(f'<link name="a">{shape}</link>', *ARM[1:]))
    trimesh.Trimesh(box.vertices, box.faces[:, ::-1]).export(tmp_path / "part.stl")
    assert loaded(path, inertia_from="shapes").model.inertias[1].mass == pytest.approx(8.0)
    trimesh.Trimesh(box.vertices * [1, 1, 0], box.faces).export(tmp_path / "part.stl")
    with pytest.raises(RobotError, match="flat or too large"):
        loaded(path, inertia_from="shapes")


@pytest.mark.parametrize("seed", range(6))
def test_the_inertia_that_is_printed_is_accepted_as_it_is_printed(seed, tmp_path):
    rng, refused = np.random.default_rng(seed), 0
    for _ in range(25):
        stated = rng.normal(size=(3, 3)) + 2.0 * np.eye(3)
        stated = 0.5 * (stated + stated.T)
        keys = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        written = " ".join(f'{key}="{x:.8f}"' for key, x in zip(keys, stated[np.triu_indices(3)], strict=True))
        text = re.sub(r"<inertia ixx.*?/>", f"<inertia {written}/>", robot(*ARM), count=1)
        try:
            load_robot(write(tmp_path, text))
        except RobotError as error:
            refused += 1
            nearest = re.search(r"<inertia [^/]*/>", str(error))
            arm = load_robot(write(tmp_path, text.replace(f"<inertia {written}/>", nearest.group())))
            assert loaded(write(tmp_path, text), repair=True).sha256 == arm.sha256
            mujoco.MjModel.from_xml_string(arm.urdf.without_geometry().decode())
    assert refused > 5


@pytest.mark.parametrize("turn", [0.0, 1.0, -0.7])
@pytest.mark.parametrize("small", [1e-9, 1e-11, 1e-13])
def test_a_wrist_of_dummies_is_singular_wherever_it_aligns(small, turn, tmp_path):
    dummy = (small * 1e-3,) * 3
    text = robot(
        link("a", small, dummy).replace('xyz="0.02 0.01 0.15"', ""), joint("z1", "base", "a"),
        link("b", small, dummy).replace('xyz="0.02 0.01 0.15"', ""), joint("y", "a", "b"),
        link("c", 2.0), joint("z2", "b", "c"),
    )  # fmt: skip
    text = text.replace('<origin xyz="0 0.1 0.3" rpy="0.1 0.2 0.3"/>', "")
    for name in ("z1", "z2"):
        head, tail = text.split(f'<joint name="{name}"')
        text = f'{head}<joint name="{name}"' + tail.replace("0 1 0", "0 0 1", 1)
    head, tail = text.split('<joint name="y"')
    text = f'{head}<joint name="y"' + tail.replace("<axis", f'<origin xyz="0 0 0" rpy="0 {turn} 0"/><axis', 1)
    with pytest.raises(RobotError, match=r"joint 'z\d': M\(q\) is not finite and positive definite"):
        load_robot(write(tmp_path, text))


def test_mimic_joints_stand_where_their_leaders_can(tmp_path):
    leader = joint("finger", "b", "left", "prismatic", limit='lower="0.02" upper="0.08" effort="20" velocity="1"')
    parts = (*GRIPPER[:5], leader, *GRIPPER[6:])
    with pytest.warns(UserWarning, match=r"'follower' \(of 'finger', at -0\.01\)"):
        load_robot(write(tmp_path, robot(*parts)))
    with pytest.raises(RobotError, match="mimics joint 'nope', which is not defined"):
        load_robot(write(tmp_path, robot(*parts).replace('<mimic joint="finger"', '<mimic joint="nope"')))
    circle = robot(*parts).replace('<mimic joint="finger"', '<mimic joint="tip_joint"')
    with pytest.warns(UserWarning, match="'tip_joint'"):
        load_robot(write(tmp_path, circle))


def test_a_place_to_lock_is_within_reach_and_named_outside_the_range(tmp_path):
    path = write(tmp_path, robot(*ARM))
    with pytest.warns(UserWarning, match=r"locked at 2\.5, outside its range of \[-2, 2\]"):
        load_robot(path, lock={"elbow": 2.5})
    with pytest.raises(RobotError, match=r"locked at 1e\+200; lock it within"):
        load_robot(path, lock={"elbow": 1e200})


def test_arguments_that_no_file_takes_are_refused(tmp_path):
    (tmp_path / "body.xacro").write_text(BODY)
    path = write(tmp_path, TOP.replace("$(find pieces)/", ""), "arm.xacro")
    with pytest.raises(RobotError, match="takes no argument 'mas'; give 'mass'"):
        load_robot(path, xacro_args={"mass": 1, "mas": 2})
    with pytest.raises(RobotError, match="nothing of xacro"):
        load_robot(write(tmp_path, robot(*ARM)), xacro_args={"mass": 1})


def test_folders_that_are_no_package_stay_closed(tmp_path):
    secret = tmp_path / "a" / "b" / "c" / "secret"
    secret.mkdir(parents=True)
    trimesh.creation.box((1, 1, 1)).export(secret / "s.stl")
    shape = '<visual><geometry><mesh filename="package://{}/s.stl"/></geometry></visual>'
    own = tmp_path / "a" / "b" / "c" / "arm"
    own.mkdir()
    (own / "link").symlink_to(secret)
    for name in ("secret", "link"):
        arm = load_robot(write(own, robot(link("a", extra=shape.format(name)), *ARM[1:]), f"{name}.urdf"))
        with pytest.warns(UserWarning, match=f"package '{name}' was not found|leaves the robot's folder"):
            link_visuals(arm)


def test_arm_options_without_an_arm_are_refused(tmp_path, capsys):
    for command in (["replay", "run.npz", "--lock", "a"], ["certify", "m.nbs", "--gravity", "1"]):
        assert main(command) == 2
        assert "was given, but no arm is loaded here" in capsys.readouterr().err
    assert main(["track", "two_link", "--effort-limit", "5", "--limits", "*.effort=3"]) == 2
    assert "choose one" in capsys.readouterr().err


def test_an_arm_that_is_singular_in_a_one_sided_range_is_refused(tmp_path):
    """A point mass on the first axis at q2 = −π/2 − 2π, which only a search below the upper limit meets."""
    point = 'ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"'
    text = (
        '<robot name="arm"><link name="base"/><link name="a"><inertial><mass value="0.001"/>'
        f'<inertia {point}/></inertial></link><link name="c"><inertial><origin xyz="1 0 0"/><mass value="1"/>'
        f'<inertia {point}/></inertial></link><joint name="j1" type="continuous"><parent link="base"/><child link="a"/>'
        '<axis xyz="0 0 1"/></joint><joint name="j2" type="revolute"><parent link="a"/><child link="c"/>'
        '<axis xyz="0 1 0"/><limit lower="-20" upper="20" effort="5" velocity="1"/></joint></robot>'
    )
    path = write(tmp_path, text)
    with pytest.raises(RobotError, match=r"M\(q\) is not finite and positive definite") as caught:
        load_robot(path, limits={"j2": {"lower": None, "upper": -4.0}})
    q2 = float(re.search(r"at q = \[\S+ (\S+)\]", str(caught.value))[1])
    assert -4.0 - 2.0 * np.pi <= q2 <= -4.0
    narrow = load_robot(path, limits={"j2": {"lower": -1.0, "upper": 1.0}})
    assert narrow.upper[1] == 1.0


def test_the_remedy_for_a_still_joint_keeps_what_is_locked(tmp_path):
    still = (
        "".join(ARM).replace('"0.02 0.01 0.15"', '"0 0.15 0"').replace('yy="0.03"', 'yy="0"').replace("0.04", "0.02")
    )
    path = write(tmp_path, robot(still, link("c"), joint("hand", "a", "c")))
    with at_the_shell(), pytest.raises(RobotError, match=r"--lock hand,elbow"):
        load_robot(path, lock=["hand"])
