"""The replay page: what is in the file, and what a browser makes of it."""

import json
import re
import struct
import warnings
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Run
from nbs_pin.reports.replay import replay
from nbs_pin.reports.scene import body_poses
from nbs_pin.reports.signals import MAX_ROWS, _rows
from nbs_pin.robots.meshes import MeshError, find_mesh, read_mesh
from nbs_pin.robots.packages import Packages
from nbs_pin.robots.robot import load_robot
from nbs_pin.robots.visuals import STEEL, Transmission, link_visuals, read_couplings, tips
from tests.browser import Browser, find_chromium

BARE = """<robot name="bare"><link name="base"/>
  <link name="a&lt;/script>"><inertial><origin xyz="0 0 .2"/><mass value="1"/>
    <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>{visual}</link>
  <link name="b/c"><inertial><origin xyz="0 0 .3"/><mass value="1"/>
    <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="&lt;/script>&lt;script>alert(1)&lt;/script>" type="revolute"><parent link="base"/>
    <child link="a&lt;/script>"/><axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint>
  <joint name="{{{{data}}}}" type="continuous"><parent link="a&lt;/script>"/><child link="b/c"/>
    <origin xyz=".1 0 .4"/><axis xyz="1 0 0"/><limit effort="9" velocity="9"/></joint>{more}</robot>"""


def bare_robot(folder, visual="", more=""):
    path = folder / "bare.urdf"
    path.write_text(BARE.format(visual=visual, more=more))
    return load_robot(path)


def moving_run(robot, *, duration=2.0, period=0.004, batch=(), t0=0.0):
    """A sinusoid with an error that dies out, as if it had been simulated."""
    t = t0 + np.arange(round(duration / period) + 1) * period
    shape = (len(t), *batch, robot.nv)
    clock = t.reshape(-1, *(1 for _ in shape[1:]))
    rate = np.linspace(1.0, 2.0, robot.nv)
    q_ref = np.broadcast_to(0.6 * np.sin(rate * clock) - 0.4, shape).copy()
    q = q_ref + 0.3 * np.exp(-clock)
    zero = np.zeros(shape)
    return Run(
        t=t, q=q, v=zero, tau=zero, tau_command=zero, disturbance=zero, q_ref=q_ref, v_ref=zero, a_ref=zero,
        effort_limit=robot.effort_limit, continuous=robot.continuous, joint_names=robot.joint_names, period=period,
        robot=robot.source, robot_sha256=robot.sha256, robot_options=robot.options,
        info={"controller": "</script>", "plant": "MuJoCo"},
    )  # fmt: skip


def link_pose(robot, q, link):
    """Pose of a link in the base frame by Pinocchio, 4 × 4."""
    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId(link, pin.FrameType.BODY)].homogeneous


def shown_pose(page, link, arm):
    pose = page.evaluate(f"replay.pose({json.dumps(link)}, {json.dumps(arm)})")
    return np.array(pose).reshape(4, 4).T


def tip_link(robot):
    return tips(robot)[-1].name


@pytest.fixture(scope="module")
def browser():
    if find_chromium() is None:
        pytest.skip("no Chromium: install it or set $CHROMIUM")
    with closing(Browser(800, 600)) as page:
        page.resize(800, 600)
        yield page


def save(run, folder, **options):
    return replay(run, folder / "replay.html", **options)


# --- in the browser


@pytest.mark.browser
@pytest.mark.parametrize("name", ["two_link", "panda", "bare"])
def test_links_are_where_the_run_says_at_any_time(name, browser, tmp_path):
    robot = bare_robot(tmp_path) if name == "bare" else load_robot(name)
    run = moving_run(robot)
    browser.open(save(run, tmp_path), "#t=0")
    links = {"two_link": "tip", "panda": tip_link(robot) if name == "panda" else "", "bare": "b/c"}
    for t in (0.0, 0.733, 1.5, 2.0):
        browser.evaluate(f"replay.seek({t})")
        for arm, history in (("actual", run.q), ("reference", run.q_ref)):
            q = np.array([np.interp(t, run.t, column) for column in history.T])
            expected, shown = link_pose(robot, q, links[name]), shown_pose(browser, links[name], arm)
            assert np.linalg.norm(shown[:3, 3] - expected[:3, 3]) < 1e-3
            np.testing.assert_allclose(shown[:3, :3], expected[:3, :3], atol=1e-3)
    gap = shown_pose(browser, links[name], "actual")[:3, 3]
    browser.evaluate("replay.seek(0)")
    assert np.linalg.norm(shown_pose(browser, links[name], "actual")[:3, 3] - gap) > 0.05  # it did move


@pytest.mark.browser
def test_pictures_differ_in_time_and_show_the_arm(browser, tmp_path):
    browser.open(save(moving_run(load_robot("two_link")), tmp_path), "#t=0")
    early = browser.screenshot()
    assert browser.screenshot() == early  # paused: nothing moves
    browser.evaluate("replay.seek(2)")
    assert browser.screenshot() != early
    browser.evaluate("document.getElementById('ghost').click(); replay.seek(0)")
    assert browser.screenshot() != early  # the ghost can be hidden


@pytest.mark.browser
def test_play_pause_and_scrub(browser, tmp_path):
    browser.open(save(moving_run(load_robot("two_link"), t0=1.0), tmp_path))
    assert browser.evaluate("replay.playing")
    moved = "new Promise(done => { const t = replay.time; setTimeout(() => done(replay.time - t), 300); })"
    assert abs(browser.evaluate(moved)) > 0.02
    browser.click("#play")
    assert not browser.evaluate("replay.playing")
    assert browser.evaluate(moved) == 0.0
    browser.evaluate("replay.seek(1.2)")  # wherever the pause fell, away from the middle
    before = shown_pose(browser, "tip", "actual")
    browser.click("#time")  # the middle of the slider
    assert browser.evaluate("replay.time") == pytest.approx(2.0, abs=0.02)
    assert np.abs(shown_pose(browser, "tip", "actual") - before).max() > 0.0
    assert browser.evaluate("document.getElementById('label').textContent").endswith("/ 3.00 s")
    browser.evaluate("replay.seek(99)")
    assert browser.evaluate("replay.time") == 3.0
    browser.evaluate(
        "const s = document.getElementById('speed'); s.value = '0.1'; s.onchange({target: s}); replay.seek(1)"
    )
    browser.click("#play")
    # Against the time of the frames that were drawn, as the page counts it: a loaded machine drops some.
    rate = "new Promise(done => { let t, last, drawn = 0; const frame = stamp => { "
    rate += "if (last === undefined) t = replay.time; else drawn += Math.min(.1, (stamp - last) / 1000); last = stamp; "
    rate += "drawn < .5 ? requestAnimationFrame(frame) : done((replay.time - t) / drawn); }; "
    rate += "requestAnimationFrame(frame); })"
    assert browser.evaluate(rate) == pytest.approx(0.1, rel=0.5)


@pytest.mark.browser
def test_names_are_shown_as_they_are_and_nothing_is_fetched_or_complained_about(browser, tmp_path):
    robot = bare_robot(tmp_path)
    browser.open(save(moving_run(robot), tmp_path), "#t=1")
    shown = browser.evaluate("[...document.querySelectorAll('#joints tr')].map(row => row.cells[0].textContent)")
    assert tuple(shown) == robot.joint_names == ("</script><script>alert(1)</script>", "{{data}}")
    assert "</script>" in browser.evaluate("document.getElementById('law').textContent")
    browser.screenshot()
    assert browser.requests() == []
    loud = [entry for entry in browser.complaints() if entry.get("entry", {}).get("level") != "warning"]
    assert loud == []
    with pytest.raises(RuntimeError, match="fetch"):  # the page's policy would stop it
        browser.evaluate("fetch('http://127.0.0.1:9/')")


@pytest.mark.browser
def test_readout_is_the_error_of_the_run(browser, tmp_path):
    robot = load_robot("two_link")
    run = moving_run(robot)
    browser.open(save(run, tmp_path), "#t=1")
    row = np.searchsorted(run.t, 1.0 - 1e-9)
    cells = browser.evaluate("[...document.querySelectorAll('#joints tr')].map(row => row.cells[3].textContent)")
    shown = [float(text) for text in cells]
    np.testing.assert_allclose(shown, (run.q - run.q_ref)[row], rtol=0.05)
    cells = browser.evaluate("[...document.querySelectorAll('#joints tr')].map(row => row.cells[4].textContent)")
    shown = [np.deg2rad(float(text.removesuffix("°"))) for text in cells]
    np.testing.assert_allclose(shown, (run.q - run.q_ref)[row], rtol=0.05)


def rectangle(page, selector):
    return page.evaluate(f"(box => [box.left, box.top, box.right, box.bottom])"
                         f"(document.querySelector('{selector}').getBoundingClientRect())")  # fmt: skip


@pytest.mark.browser
def test_charts_show_the_run_zoom_together_and_share_the_scale_of_the_slider(browser, tmp_path):
    run = moving_run(load_robot("two_link"))
    browser.open(save(run, tmp_path), "#t=1")
    browser.evaluate("document.querySelectorAll('.signals button')[2].click()")  # the position beside |error|
    data = browser.evaluate("replay.plots().map(plot => plot.data.map(row => [...row]))")
    error, position = (np.array(rows) for rows in data)
    np.testing.assert_allclose(error[1:], np.abs(run.q - run.q_ref).T, rtol=1e-5)
    np.testing.assert_allclose(position[1::2], run.q.T, atol=1e-6)
    np.testing.assert_allclose(position[2::2], run.q_ref.T, atol=1e-6)
    browser.evaluate("replay.plots()[1].setScale('x', {min: .5, max: 1.5})")
    assert browser.evaluate("replay.plots().map(plot => [plot.scales.x.min, plot.scales.x.max])") == [[0.5, 1.5]] * 2
    left, _, right, _ = rectangle(browser, ".u-over")
    begin, _, end, _ = rectangle(browser, "#time")
    assert (begin + 8, end - 8) == pytest.approx((left, right), abs=1.0)  # the thumb is 16 px wide
    assert browser.evaluate("[document.getElementById('time').min, document.getElementById('time').max]") == [
        "0.5",
        "1.5",
    ]
    browser.evaluate("replay.plots()[1].over.dispatchEvent(new MouseEvent('dblclick', {bubbles: true}))")
    assert browser.evaluate("replay.plots()[0].scales.x.max") == 2.0


@pytest.mark.browser
@pytest.mark.parametrize("size", [(390, 844), (844, 390)])
def test_on_a_phone_nothing_leaves_the_window_and_panels_leave_room_for_the_arm(size, browser, tmp_path):
    browser.resize(*size, dark=True)
    try:
        browser.open(save(moving_run(load_robot("two_link")), tmp_path), "#t=1")
        for opened in ("numbers", "charts"):
            for selector in ("#side", "#bar", "#speed", "#label", "#time", "#fold"):
                left, top, right, bottom = rectangle(browser, selector)
                assert 0 <= left <= right <= size[0], (selector, opened)
                assert 0 <= top <= bottom <= size[1], (selector, opened)
            side, bar = rectangle(browser, "#side"), rectangle(browser, "#bar")
            beside, between = size[0] - side[2], bar[1] - side[3]
            assert max(beside * bar[1], size[0] * between) > 0.2 * size[0] * size[1], opened
            browser.click("#fold" if opened == "numbers" else "#chartfold")
        assert browser.evaluate("getComputedStyle(document.body).color") != "rgb(29, 39, 51)"  # dark
    finally:
        browser.resize(800, 600)


@pytest.mark.browser
def test_a_video_is_recorded_in_the_kind_that_its_name_says(browser, tmp_path):
    browser.open(save(moving_run(load_robot("two_link"), duration=0.5), tmp_path), "#t=0")
    name, kind, head = browser.evaluate(
        "new Promise(done => { window.save = async (blob, name) => done([name, blob.type, "
        "String.fromCharCode(...new Uint8Array(await blob.arrayBuffer()).slice(0, 8))]); "
        "document.getElementById('video').click(); })"
    )
    assert (name, kind) in (("two_link.mp4", "video/mp4"), ("two_link.webm", "video/webm"))
    assert head[4:] == "ftyp" if kind == "video/mp4" else head.startswith("\x1aE\xdf\xa3")


@pytest.mark.browser
def test_without_webgl_the_page_says_so_and_keeps_charts_and_numbers(tmp_path):
    if find_chromium() is None:
        pytest.skip("no Chromium: install it or set $CHROMIUM")
    with closing(Browser(1280, 800, "--disable-3d-apis")) as page:
        page.resize(1280, 800)
        page.open(save(moving_run(load_robot("two_link")), tmp_path), "#t=1")
        assert "WebGL" in page.evaluate("document.getElementById('absent').innerText")
        assert page.evaluate("replay.plots().length") == 3
        assert page.evaluate("document.querySelector('#joints td:nth-child(4)').textContent") == "0.1104"
        assert [entry for entry in page.complaints() if entry.get("entry", {}).get("level") == "error"] == []


# --- the file


def test_page_is_self_contained_and_small(tmp_path):
    text = save(moving_run(load_robot("panda")), tmp_path).read_text()
    assert len(text) < 12e6
    text = re.sub(r'<script type="text/plain" id="licences">.*?</script>', "", text, count=1, flags=re.S)
    addresses = set(re.findall(r"https?://[^\s\"'<>)]+", text))
    assert addresses <= {"http://www.w3.org/1999/xhtml"}, addresses
    assert not re.search(r"<(script|img|iframe|link)[^>]+(src|href)=\"(?!data:)", text)
    assert "default-src 'none'" in text
    assert [entry.name for entry in tmp_path.iterdir()] == ["replay.html"]


def test_the_chosen_start_of_a_batch_is_shown(tmp_path):
    run = moving_run(load_robot("two_link"), batch=(2, 2))
    run.q[:, 1, 0] += 0.25
    pages = {start: save(run, tmp_path, start=start).read_text() for start in range(4)}
    error = {start: re.search(r'"error":"([^"]+)"', page)[1] for start, page in pages.items()}
    assert error[0] == error[1] == error[3] != error[2]
    with pytest.raises(ArgumentError, match="starts 0 to 3"):
        save(run, tmp_path, start=4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": ""}, "names no robot"),
        ({"robot_sha256": "0" * 64}, "not the arm that ran"),
        ({"robot": "three_link"}, "not the arm that ran"),
        ({"robot_options": {"gravity": 1.62}}, "not the arm that ran"),
        ({"robot_options": {"spin": 1}}, "options that this version does not know .spin"),
        ({"joint_names": ("a", "b")}, "moves joints a, b"),
        ({"q": np.full((501, 2), np.nan)}, "not finite"),
    ],
)
def test_runs_that_cannot_be_shown_are_refused_and_leave_the_file_alone(change, message, tmp_path):
    run = moving_run(load_robot("two_link"))
    page = save(run, tmp_path)
    before = page.read_bytes()
    with pytest.raises(ArgumentError, match=message):
        save(replace(run, **change), tmp_path)
    assert page.read_bytes() == before


@pytest.mark.parametrize("options", [{"gravity": 1.62}, {"gravity": [0.0, 3.0, -9.0]}, {"lock": ["wrist_3_joint"]}])
def test_an_arm_loaded_in_another_way_is_found_again(options, tmp_path):
    run = moving_run(load_robot("ur5", **options))
    run.save(tmp_path / "run.npz")
    assert save(Run.load(tmp_path / "run.npz"), tmp_path).is_file()


def test_an_arm_without_a_name_is_shown(tmp_path):
    path = tmp_path / "nameless.urdf"
    path.write_text(BARE.format(visual="", more="").replace(' name="bare"', ""))
    assert save(moving_run(load_robot(path)), tmp_path).is_file()


def test_a_given_robot_needs_no_name_in_the_run(tmp_path):
    robot = load_robot("two_link")
    run = replace(moving_run(robot), robot="", robot_sha256="")
    assert save(run, tmp_path, robot=robot).is_file()


def test_body_poses_are_pinocchios():
    robot = load_robot("ur5")
    q = np.random.default_rng(1).normal(size=(5, robot.nv))
    data = robot.model.createData()
    for row, poses in zip(q, body_poses(robot, q), strict=True):
        pin.forwardKinematics(robot.model, data, row)
        for placement, pose in zip(data.oMi, poses, strict=True):
            np.testing.assert_allclose(pin.XYZQUATToSE3(pose).homogeneous, placement.homogeneous, atol=1e-12)


def test_of_a_long_run_the_rows_of_largest_error_and_torque_are_kept():
    run = moving_run(load_robot("two_link"), duration=120.0)
    run.q[12345, 1] += 5.0
    run.tau_command[23456, 0] = 1e4
    rows = _rows(run, MAX_ROWS)
    assert {0, 12345, 23456, len(run.t) - 1} <= set(rows.tolist())
    assert len(rows) <= MAX_ROWS + 3
    assert np.diff(rows).max() <= 3 * len(run.t) / MAX_ROWS + 1


def test_every_branch_has_a_tip():
    with pytest.warns(UserWarning, match="no actuator"):
        arms = load_robot(Path(__file__).parent / "data" / "mjcf" / "two_arms.xml")
    found = tips(arms)
    assert len(found) == 2
    assert {tip.joint for tip in found} == set(range(1, arms.model.njoints)) - set(arms.model.parents)


# --- what is drawn


def volume(visual):
    a, b, c = (visual.vertices[visual.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def test_primitives_have_their_size_place_and_colour(tmp_path):
    visual = """<visual><origin xyz="1 2 3"/><geometry><box size="1 2 3"/></geometry><material name="m">
      <color rgba="1 0 0 .5"/></material></visual><visual><geometry><cylinder radius=".5" length="2"/></geometry>
      <material name="blue"/></visual><visual><geometry><sphere radius="1"/></geometry></visual>"""
    robot = bare_robot(tmp_path, visual, '<material name="blue"><color rgba="0 0 1 1"/></material>')
    box, cylinder, sphere = (visual for visual in link_visuals(robot) if visual.link == "a</script>")
    assert (box.color, cylinder.color) == ((1.0, 0.0, 0.0, 0.5), (0.0, 0.0, 1.0, 1.0))
    np.testing.assert_allclose(box.placement[:3, 3], [1.0, 2.0, 3.0])
    assert volume(box) == pytest.approx(6.0, rel=1e-9)
    assert volume(cylinder) == pytest.approx(np.pi / 2, rel=0.01)
    assert volume(sphere) == pytest.approx(4 / 3 * np.pi, rel=0.02)


def test_an_arm_without_visuals_gets_capsules_from_joint_to_joint(tmp_path):
    robot = bare_robot(tmp_path)
    rods = {visual.link: visual for visual in link_visuals(robot) if visual.color == STEEL}
    end, rod = np.array([0.1, 0.0, 0.4]), rods["a</script>"]
    along = rod.vertices @ end / np.linalg.norm(end)
    radius = np.linalg.norm(np.cross(rod.vertices, end), axis=1).max() / np.linalg.norm(end)
    assert 0.005 < radius < 0.1
    assert (along.min(), along.max()) == pytest.approx((-radius, np.linalg.norm(end) + radius), abs=0.1 * radius)
    assert rods["b/c"].vertices[:, 2].max() > 0.3  # the last one reaches its centre of mass


def test_a_drawn_arm_gets_no_capsules():
    robot = load_robot("panda")
    drawn = {visual.link for visual in link_visuals(robot)}
    assert "panda_link8" not in drawn
    assert {f"panda_link{k}" for k in range(8)} <= drawn


def test_mesh_colours_survive():
    colors = {visual.color for visual in link_visuals(load_robot("panda")) if visual.link == "panda_link6"}
    assert len(colors) > 3  # white, black, the status lights …


STL = b"""solid x
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid x
"""


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("gone.stl", None, "not found"),
        ("../outside.stl", STL, "leaves the robot's folder"),
        ("package://other/../../outside.stl", STL, "package 'other' was not found"),
        ("file:///etc/outside.stl", None, "leaves the robot's folder"),
        ("http://example.org/a.stl", None, "not a file on this machine"),
        ("package://file:///etc/a.stl", None, "not a file"),
        ("mesh.ply", STL, "unknown kind"),
        ("broken.dae", b"<COLLADA", "cannot be read"),
        ("lying.stl", bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(50), "mesh"),
        ("empty.stl", b"", "mesh"),
    ],
)
def test_meshes_that_cannot_be_trusted_are_named_and_replaced(name, content, message, tmp_path):
    folder = tmp_path / "robot"
    folder.mkdir()
    if content is not None:
        (tmp_path / "outside.stl" if "outside" in name else folder / name).write_bytes(content)
    robot = bare_robot(folder, f'<visual><geometry><mesh filename="{name}"/></geometry></visual>')
    with pytest.warns(UserWarning, match=message) as caught:
        visuals = link_visuals(robot)
    assert all("a</script>" in str(warning.message) for warning in caught)
    assert STEEL in {visual.color for visual in visuals if visual.link == "a</script>"}


def test_u22_meshes_stay_inside_their_roots(tmp_path):
    folder = tmp_path / "pkg"
    folder.mkdir()
    (tmp_path / "outside.stl").touch()
    (folder / "a.STL").touch()
    (folder / "link.stl").symlink_to(tmp_path / "outside.stl")
    packages = Packages(folder / "x.urdf")
    assert find_mesh("a.STL", packages) == find_mesh("package://pkg/a.STL", packages) == (folder / "a.STL").resolve()
    for uri in ("package://pkg/../outside.stl", "link.stl", f"{tmp_path}/outside.stl"):
        with pytest.raises(MeshError, match="leaves the robot's folder"):
            find_mesh(uri, packages)
    with pytest.raises(MeshError, match=r"package '\.\.' was not found"):
        find_mesh("package://../outside.stl", packages)


def test_meshes_are_scaled_and_found_where_they_may_be(tmp_path):
    (tmp_path / "pkg" / "urdf").mkdir(parents=True)
    (tmp_path / "pkg" / "package.xml").write_text("<package/>")
    (tmp_path / "pkg" / "a.stl").write_bytes(STL)
    packages = Packages(tmp_path / "pkg" / "urdf" / "x.urdf")
    for uri in ("../a.stl", "..\\a.stl", "package://pkg/a.stl", f"file://{tmp_path}/pkg/a.stl"):
        assert find_mesh(uri, packages) == (tmp_path / "pkg" / "a.stl").resolve()
    with pytest.raises(MeshError, match="package_dirs"):
        find_mesh("package://elsewhere/a.stl", Packages(tmp_path / "lone" / "x.urdf"))
    (part,) = read_mesh(tmp_path / "pkg" / "a.stl", np.array([2.0, 3.0, -1.0]))
    np.testing.assert_allclose(np.ptp(part.vertices, axis=0), [2.0, 3.0, 0.0])
    a, b, c = part.vertices[part.faces[0]]
    assert np.cross(b - a, c - a)[2] < 0.0  # mirrored: outside stays outside


def test_couplings_are_what_the_urdf_states(tmp_path):
    more = """<link name="f"/><joint name="g" type="fixed"><parent link="b/c"/><child link="f"/></joint>
      <transmission name="gear"><joint name="{{data}}"/><actuator name="m">
      <mechanicalReduction>100</mechanicalReduction></actuator></transmission>"""
    couplings = read_couplings(bare_robot(tmp_path, more=more))
    assert couplings.transmissions == (Transmission("gear", ("{{data}}",), 100.0),)
    assert couplings.mimics == ()
    talos = read_couplings(load_robot("talos_left_arm")).mimics
    assert all(mimic.source == "gripper_left_joint" and abs(mimic.multiplier) == 1.0 for mimic in talos)


def test_no_arm_of_the_catalogue_draws_with_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("default", DeprecationWarning)
        for name in ("two_link", "three_link", "ur3", "xarm7", "so100", "talos_left_arm", "double_pendulum"):
            robot = load_robot(name)
            for visual in link_visuals(robot):
                assert robot.model.existFrame(visual.link, pin.FrameType.BODY)
                assert visual.faces.max() < len(visual.vertices)
                assert np.abs(visual.vertices).max() < 2.0  # metres
