"""Runs for other tools: what is written comes back bit by bit, also through readers that share no code with us."""

import dataclasses
import errno
import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.exports import SIGNALS
from nbs_pin.base.records import ROW_ARRAYS
from nbs_pin.reports.run_bags import Topic, write_bag
from tests.commands import printed_by, refusal, summary
from tests.test_cli import motion_in

rosbag2 = pytest.importorskip("rosbags.rosbag2")
mcap_ros2 = pytest.importorskip("mcap_ros2.reader")

GANTRY = """<robot name="gantry"><link name="base"/>
  <joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-2" upper="2" effort="200" velocity="3"/></joint>
  <link name="cart"><inertial><mass value="3"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="swing, or β" type="continuous"><parent link="cart"/><child link="bob"/><axis xyz="0 1 0"/>
    <limit effort="20" velocity="9"/></joint>
  <link name="bob"><inertial><origin xyz="0 0 -.4"/><mass value="1"/>
    <inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
KINDS = ("mcap", "csv")
STATES = {"position": "q", "velocity": "v", "effort": "tau"}


def simulated(robot, law=None, duration=0.3, **settings):
    law = nbs.NeuralBackstepping.for_robot(robot) if law is None else law
    motion = nbs.Sinusoid.for_robot(robot)
    settings = {"q0": motion(0.0).q + 0.1} | settings
    return nbs.simulate(nbs.MujocoPlant(robot), law, motion, duration, 0.001, **settings)


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "gantry.urdf"
    path.write_text(GANTRY)
    return {"gantry": nbs.load_robot(path)} | {name: nbs.load_robot(name) for name in ("two_link", "panda")}


@pytest.fixture(scope="module")
def runs(arms):
    """A run of each kind that there is."""
    two = arms["two_link"]
    adaptive = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(two), load_mass=0.5)
    batch = np.random.default_rng(0).uniform(-0.3, 0.3, (3, 2))
    return {
        "plain": simulated(two),
        "pushed": simulated(two, disturbance=nbs.SinusoidalTorque([2.0, 1.0], 9.0)),
        "saturated": simulated(two.with_effort_limit([30.0, 9.0])),
        "adaptive": simulated(two, adaptive),
        "sliding": simulated(arms["gantry"]),
        "late": dataclasses.replace(simulated(two), t=0.001 * np.arange(301) - 0.05),
        "uneven": dataclasses.replace(simulated(two), t=np.cumsum(np.full(301, 0.00123456789123))),
        "batch": simulated(two, q0=batch),
    }


ONE_START = ("plain", "pushed", "saturated", "adaptive", "sliding", "late", "uneven")


def same(run, again, *, but=()):
    for name in ("t", *ROW_ARRAYS, "estimates"):
        if name not in but:
            assert_array_equal(getattr(run, name), getattr(again, name), err_msg=name)
    assert (run.joint_names, run.slides.tolist()) == (again.joint_names, again.slides.tolist())


# There and back.


@pytest.mark.parametrize("name", ONE_START)
def test_a_run_comes_back_from_mcap_bit_by_bit(runs, name, tmp_path):
    run = runs[name]
    again = nbs.import_run(nbs.export_run(run, tmp_path / "new" / "run.mcap"))
    same(run, again, but=("a_ref",))
    for entry in dataclasses.fields(nbs.Run):
        if entry.name not in ("t", *ROW_ARRAYS, "estimates"):
            assert_array_equal(getattr(run, entry.name), getattr(again, entry.name), err_msg=entry.name)
    # a_ref is differentiated, to second order in the period
    gap = np.abs(again.a_ref - run.a_ref)[1:-1].max()
    assert gap < 1e-5 * np.abs(run.a_ref).max() or name in ("late", "uneven")
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("name", ONE_START)
def test_a_run_comes_back_from_csv_bit_by_bit(runs, arms, name, tmp_path):
    run, robot = runs[name], arms["gantry" if name == "sliding" else "two_link"]
    path = nbs.export_run(run, tmp_path / "run.csv")
    again = nbs.import_run(path, robot)
    same(run, again)
    assert again.period == pytest.approx(np.median(np.diff(run.t)), rel=1e-8)
    assert (again.robot, again.robot_sha256, again.robot_options) == (robot.source, robot.sha256, robot.options)
    assert_array_equal(again.continuous, run.continuous)
    assert again.info == ({"estimates": run.info["estimates"]} if name == "adaptive" else {})
    without = nbs.import_run(path)
    assert without.robot == ""
    assert np.isinf(without.effort_limit).all()


@pytest.mark.parametrize("kind", KINDS)
def test_one_start_of_a_batch_is_chosen(runs, kind, tmp_path):
    run = runs["batch"]
    for start in range(3):
        again = nbs.import_run(nbs.export_run(run, tmp_path / f"run.{kind}", start=start))
        for name in ("q", "v", "tau", "q_ref"):
            assert_array_equal(getattr(again, name), getattr(run, name)[:, start])
    with pytest.raises(ArgumentError, match="start=3 does not exist: the run has starts 0 to 2"):
        nbs.export_run(run, tmp_path / f"no.{kind}", start=3)
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_log_of_an_exported_run_is_that_of_the_run(arms, kind, tmp_path):
    run = simulated(arms["two_link"], duration=8.0)
    run.save(tmp_path / "run.npz")
    nbs.export_run(run, tmp_path / f"run.{kind}", signals=SIGNALS[:4])
    plain = nbs.load_log(tmp_path / "run.npz", lowpass=0)
    if kind == "csv":
        with pytest.warns(UserWarning, match=r"columns that are not read: qref_joint1 \[rad\]"):
            data = nbs.load_log(tmp_path / "run.csv", lowpass=0)
    else:
        data = nbs.load_log(tmp_path / "run.mcap", lowpass=0)
    for name in ("q", "v", "tau"):
        assert_array_equal(getattr(data, name), getattr(plain, name))
    np.testing.assert_allclose(data.t, plain.t, rtol=1e-15)
    np.testing.assert_allclose(data.a, plain.a, atol=1e-8)


def test_a_page_is_made_of_what_was_exported(runs, tmp_path):
    run = runs["pushed"]
    pages = [nbs.replay(run, tmp_path / "run.html")]
    for kind in KINDS:
        path = nbs.export_run(run, tmp_path / f"run.{kind}")
        pages.append(tmp_path / f"{kind}.html")
        printed_by("replay", path, "--robot", "two_link", "--out", pages[-1])
    assert motion_in(pages[0]) == motion_in(pages[1]) == motion_in(pages[2])


# As others read it.


def topics_of(path):
    """What an independent reader finds: times [ns] and messages of every topic."""
    found = {}
    for message in mcap_ros2.read_ros2_messages(str(path)):
        found.setdefault(message.channel.topic, []).append((message.log_time_ns, message.ros_msg))
    return found


def test_an_independent_reader_finds_every_number(runs, arms, tmp_path):
    run, robot = runs["pushed"], arms["two_link"]
    seen = nbs.monitor(run, nbs.certify(nbs.NeuralBackstepping.for_robot(robot), [5.0, 5.0]))
    signals = [name for name in SIGNALS if name != "estimates"]
    found = topics_of(nbs.export_run(run, tmp_path / "run.mcap", signals=signals, monitored=seen))
    external = nbs.MomentumObserver.for_robot(robot).observe(run).torque
    error = {"position": run.q - run.q_ref, "velocity": run.v - run.v_ref}
    expected = {
        "/joint_states": {part: getattr(run, name) for part, name in STATES.items()},
        "/reference": {"position": run.q_ref, "velocity": run.v_ref},
        "/command": {"effort": run.tau_command},
        "/error": error,
        "/disturbance": {"effort": run.disturbance},
        "/external_torque": {"effort": external},
        "/certificate": {"position": np.column_stack([seen.storage, seen.promise])},
    }
    assert found.keys() == expected.keys() | {"/run", "/robot_description"}
    for topic, parts in expected.items():
        names = ["V", "bound"] if topic == "/certificate" else list(run.joint_names)
        assert all(list(message.name) == names for _, message in found[topic])
        for part in STATES:
            numbers = np.array([getattr(message, part) for _, message in found[topic]])
            assert_array_equal(numbers, parts.get(part, np.zeros((len(run.t), 0))), err_msg=f"{topic} {part}")
        stamps = [(m.header.stamp.sec * 10**9 + m.header.stamp.nanosec, at) for at, m in found[topic]]
        assert stamps == [(k * 10**6, k * 10**6) for k in range(len(run.t))]
    ((_, description),) = found["/robot_description"]
    (tmp_path / "arm.urdf").write_text(description.data)
    again = nbs.load_robot(tmp_path / "arm.urdf")
    assert again.joint_names == robot.joint_names
    assert again.model.inertias[2].mass == robot.model.inertias[2].mass
    ((_, facts),) = found["/run"]
    assert json.loads(facts.data)["robot"] == "two_link"


def test_the_messages_are_those_of_the_library_that_defines_them(runs, tmp_path):
    """Made all at once, from the bytes of one."""
    typesys = pytest.importorskip("rosbags.typesys")
    from rosbags.highlevel import AnyReader

    run, store = runs["sliding"], typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    state, header, time = (
        store.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    nbs.export_run(run, tmp_path / "run.mcap")
    with AnyReader([tmp_path / "run.mcap"]) as reader:
        wanted = [c for c in reader.connections if c.topic == "/joint_states"]
        raw = [bytes(message) for _, _, message in reader.messages(connections=wanted)]
        (described,) = [c for c in reader.connections if c.topic == "/robot_description"]
        assert "TRANSIENT_LOCAL" in str(described.ext.offered_qos_profiles)
    for k, message in enumerate(raw):
        rows = (x[k] for x in (run.q, run.v, run.tau))
        made = state(header(time(0, k * 10**6), ""), list(run.joint_names), *rows)
        assert message == bytes(store.serialize_cdr(made, state.__msgtype__))


def test_what_the_law_learned_has_its_names(runs, tmp_path):
    run = runs["adaptive"]
    found = topics_of(nbs.export_run(run, tmp_path / "run.mcap"))
    assert list(found["/estimates"][0][1].name) == run.info["estimates"]
    assert_array_equal(np.array([m.position for _, m in found["/estimates"]]), run.estimates)
    header = nbs.export_run(run, tmp_path / "run.csv").read_text().splitlines()[0].split(",")
    assert [name.removeprefix("estimate_") for name in header if "estimate" in name] == run.info["estimates"]


@pytest.mark.parametrize(
    ("name", "more"),
    [("plain", set()), ("pushed", {"/disturbance"}), ("saturated", {"/command"}), ("adaptive", {"/estimates"})],
)
def test_what_says_nothing_is_left_out(runs, name, more, tmp_path):
    found = topics_of(nbs.export_run(runs[name], tmp_path / "run.mcap"))
    assert found.keys() == {"/joint_states", "/reference", "/run", "/robot_description"} | more


def test_columns_say_what_they_have_and_in_which_unit(runs, tmp_path):
    signals = ["states", "reference", "error", "external"]
    path = nbs.export_run(runs["sliding"], tmp_path / "run.csv", signals=signals)
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    assert table.shape == (301, 21 - 2)
    header = path.read_text(encoding="utf-8").splitlines()[0]
    assert header.startswith('t [s],q_rail [m],"q_swing, or β [rad]",v_rail [m/s],"v_swing, or β [rad/s]",tau_rail')
    assert 'aref_rail [m/s²],"aref_swing, or β [rad/s²]",qerror_rail [m]' in header
    assert header.endswith('external_rail [N],"external_swing, or β [N·m]"')


def test_how_much_ten_seconds_of_panda_take(arms, tmp_path):
    run = simulated(arms["panda"], duration=10.0, q0=None)
    sizes = {
        names: nbs.export_run(run, tmp_path / "run.mcap", signals=names).stat().st_size / 1e6
        for names in (("states",), None, ("states", "reference", "error"))
    }
    assert sizes["states",] < 2.0
    assert sizes[None] < 2.6
    assert sizes["states", "reference", "error"] < 3.7


# Refusals, and what stays when something goes wrong.


def test_what_cannot_be_exported_is_refused(runs, arms, tmp_path):
    run = runs["plain"]
    for path in ("run.rrd", "run", "run.npz"):
        with pytest.raises(ArgumentError, match=r"export_run: path is '.*'; give a file that ends in .mcap or .csv"):
            nbs.export_run(run, tmp_path / path)
    with pytest.raises(ArgumentError, match="signals\\[1\\] 'torque' is unknown; give one of states, reference"):
        nbs.export_run(run, tmp_path / "run.csv", signals=["states", "torque"])
    with pytest.raises(ArgumentError, match="no estimates, as its law does not adapt"):
        nbs.export_run(run, tmp_path / "run.csv", signals=["estimates"])
    with pytest.raises(ArgumentError, match="the run moves joints joint1, joint2 but panda has"):
        nbs.export_run(run, tmp_path / "run.csv", arms["panda"])
    late = dataclasses.replace(run, t=run.t + 3e9)
    fine = dataclasses.replace(run, t=1e-10 * np.arange(301), period=1e-10)
    for other in (late, fine):
        with pytest.raises(ArgumentError, match=r"messages have times up to 2147483648 s in whole nanosec.*\.csv"):
            nbs.export_run(other, tmp_path / "run.mcap")
        same(other, nbs.import_run(nbs.export_run(other, tmp_path / "run.csv")))
    (tmp_path / "run.csv").unlink()
    broken = dataclasses.replace(run, q=np.where(np.arange(301)[:, None] > 7, np.nan, run.q))
    with pytest.raises(ArgumentError, match=r"export_run: q has numbers that are not finite in row 8; .*head\(8\)"):
        nbs.export_run(broken, tmp_path / "run.csv")
    named = dataclasses.replace(run, joint_names=("a;b", "c"))
    with pytest.raises(ArgumentError, match=r"'q_a;b \[rad\]' would separate .* CSV file; export to .mcap"):
        nbs.export_run(named, tmp_path / "run.csv")
    seen = nbs.monitor(run, nbs.certify(nbs.NeuralBackstepping.for_robot(arms["two_link"]), [5.0, 5.0]))
    with pytest.raises(ArgumentError, match="monitored is of another run"):
        nbs.export_run(run.head(9), tmp_path / "run.csv", monitored=seen)
    with pytest.raises(ArgumentError, match="monitored is of another run"):
        nbs.export_run(runs["pushed"], tmp_path / "run.csv", monitored=seen)  # at the same times
    assert list(tmp_path.iterdir()) == []


def test_an_arm_that_is_gone_is_told_and_no_reason_to_stop(tmp_path):
    urdf = tmp_path / "arm.urdf"
    urdf.write_bytes(Path(nbs.load_robot("two_link").urdf.path).read_bytes())
    run = simulated(nbs.load_robot(urdf))
    urdf.unlink()
    with pytest.warns(UserWarning, match=r"run.mcap has no /robot_description: the run is of the arm .* not there"):
        nbs.export_run(run, tmp_path / "run.mcap")
    assert "/robot_description" not in topics_of(tmp_path / "run.mcap")
    nbs.export_run(run, tmp_path / "run.mcap", nbs.load_robot("two_link"))
    assert "/robot_description" in topics_of(tmp_path / "run.mcap")
    with pytest.raises(nbs.RobotNotFound, match=r"give it as robot=load_robot\(…\)"):
        nbs.export_run(run, tmp_path / "run.mcap", signals=["external"])


@pytest.mark.parametrize("stop", [KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")])
def test_what_is_stopped_leaves_the_file_before_it(runs, stop, tmp_path, monkeypatch):
    for kind in KINDS:
        nbs.export_run(runs["plain"], tmp_path / f"run.{kind}")
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    written = 0

    def write(*arguments):
        nonlocal written
        written += 1
        if written > 50:
            raise stop

    monkeypatch.setattr("rosbags.rosbag2.Writer.write", write)
    monkeypatch.setattr("os.fsync", lambda handle: (_ for _ in ()).throw(stop))
    for kind in KINDS:
        with pytest.raises(type(stop)):
            nbs.export_run(runs["pushed"], tmp_path / f"run.{kind}")
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_files_that_are_no_exported_run_are_refused(runs, arms, tmp_path):
    run = runs["plain"]
    whole = nbs.export_run(run, tmp_path / "whole.mcap").read_bytes()
    states = nbs.export_run(run, tmp_path / "states.mcap", signals=["states"])
    with pytest.raises(FileFormatError, match="no /reference of a run; export it with states and reference"):
        nbs.import_run(states)
    with pytest.raises(FileFormatError, match="no column qref_joint1; export the run with states and reference"):
        nbs.import_run(nbs.export_run(run, tmp_path / "states.csv", signals=["states"]))
    with pytest.raises(FileFormatError, match=r"joints joint1, joint2, and panda has .*; give the robot that ran"):
        nbs.import_run(tmp_path / "whole.mcap", arms["panda"])
    for name, content in {"cut": whole[:1000], "zeros": bytes(99), "changed": _changed(whole)}.items():
        (tmp_path / f"{name}.mcap").write_bytes(content)
        with pytest.raises(FileFormatError, match=rf"{name}.mcap: "):
            nbs.import_run(tmp_path / f"{name}.mcap")
    (tmp_path / "other.csv").write_text("t [s],x\n0,1\n1,1\n")
    with pytest.raises(FileFormatError, match=r"no columns q_JOINT"):
        nbs.import_run(tmp_path / "other.csv")
    with pytest.raises(FileFormatError, match="one row, which has no period"):
        nbs.import_run(nbs.export_run(run.head(1), tmp_path / "one.csv"))
    nbs.import_run(nbs.export_run(run.head(1), tmp_path / "one.mcap"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "nbs_pin run 99"}, "/run is not that of a 'nbs_pin run 1'"),
        ({"period": None}, "period is None"),
        ({"period": -1.0}, "period is -1.0"),
        ({"begins": "x"}, "begins is 'x'"),
        ({"effort_limit": [1.0]}, r"effort_limit has shape \(1,\)"),
        ({"effort_limit": "x"}, "effort_limit"),
        ({"continuous": None}, "continuous"),
        ({"robot_options": [1]}, "robot_options is"),
        ({"t": [1.0]}, r"t has shape \(1,\)"),
        ({"info": 1}, "info is 1"),
    ],
)
def test_what_else_a_run_has_is_checked(runs, change, words, tmp_path):
    path, run = tmp_path / "run.mcap", runs["plain"]
    states = Topic(run.joint_names, {part: getattr(run, name) for part, name in STATES.items()})
    topics = {"/joint_states": states, "/reference": states}
    stamps = np.arange(len(run.t)) * 10**6
    facts = {"begins": 0.0, "effort_limit": [None, 2.0], "continuous": [False, False], "prismatic": None}
    facts |= {"format": "nbs_pin run 1", "period": 0.001, "robot": "", "robot_sha256": "", "robot_options": {}}
    facts |= {"info": {}}
    write_bag(path, stamps, topics, {"/run": json.dumps(facts)})
    assert nbs.import_run(path).effort_limit.tolist() == [np.inf, 2.0]
    write_bag(path, stamps, topics, {"/run": json.dumps(facts | change)})
    with pytest.raises(FileFormatError, match=rf"run.mcap: .*{words}"):
        nbs.import_run(path)
    write_bag(path, stamps, topics, {"/run": json.dumps({name: x for name, x in facts.items() if name not in change})})
    if "t" not in change:
        with pytest.raises(FileFormatError, match="/run is not that of a"):
            nbs.import_run(path)


def _changed(whole):
    """The file with other bytes in the middle of a chunk."""
    at = len(whole) // 2
    return whole[:at] + struct.pack("<8Q", *range(8)) + whole[at + 64 :]


def test_of_several_topics_the_measured_one_is_read(tmp_path, runs):
    run = runs["plain"]
    path = nbs.export_run(run, tmp_path / "run.mcap", signals=["reference", "error", "command"])
    with pytest.raises(ArgumentError, match="joint states under /command, /error, /reference; choose one, as in colu"):
        nbs.load_log(path)


# At the shell.


def test_the_shell_writes_what_python_writes(tmp_path, capsys):
    folder = tmp_path / "run"
    printed_by("track", "two_link", "--duration", "0.5", "--out", folder)
    run = nbs.Run.load(folder / "run.npz")
    assert printed_by("export-run", folder) == f"{folder / 'run.mcap'}\n"
    same(run, nbs.import_run(folder / "run.mcap"), but=("a_ref",))
    chosen = ("--to", "csv", "--signals", "states,external", "--out", tmp_path / "x.csv")
    printed_by("export-run", folder / "run.npz", *chosen)
    header = (tmp_path / "x.csv").read_text().splitlines()[0]
    assert re.findall(r"(\w+)_joint1", header) == ["q", "v", "tau", "external"]
    options = ("--disturbance", "5", "--monitor", folder / "run.npz", "--out", tmp_path / "certificate")
    printed_by("certify", "two_link", *options)
    printed_by("export-run", folder, "--monitored", tmp_path / "certificate")
    found = topics_of(folder / "run.mcap")["/certificate"]
    assert found[0][1].position[0] == summary_of_monitor(tmp_path / "certificate")
    refused = {
        ("--to", "rrd"): "--to is 'rrd'; give mcap, csv.",
        ("--signals", "states,torque"): "--signals is 'torque'; give states, reference",
        ("--signals", "estimates"): "leave them out, as in --signals states,reference.",
        ("--start", "3"): "--start 3 does not exist: the run has starts 0 to 0.",
        ("--out", tmp_path / "y.csv"): "does not end in .mcap; rename it, or give another --to.",
        ("--out", tmp_path / "x.csv", "--to", "csv"): "exists; give another --out, or --force to replace it.",
        ("--monitored", tmp_path): f"--monitored: no such file '{tmp_path / 'monitor.csv'}'",
    }
    for more, words in refused.items():
        assert words in refusal(cli.main(["export-run", str(folder), *map(str, more)]), capsys)
    words = "is an exported file; give the run.npz that it was made of."
    assert words in refusal(cli.main(["export-run", str(folder / "run.mcap")]), capsys)
    words = "the run names no robot: give it as --robot ROBOT."
    printed_by("export-run", folder, "--to", "csv")
    assert words in refusal(cli.main(["replay", str(folder / "run.csv"), "--out", str(tmp_path / "z.html")]), capsys)
    assert summary(folder)["command"].startswith("nbs-pin track")


def summary_of_monitor(folder):
    """V of the first row, as `nbs-pin certify --monitor` wrote it."""
    return float((folder / "monitor.csv").read_text().splitlines()[1].split(",")[1])
