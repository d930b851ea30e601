"""The loop over arms: approach, simulated, UR (a double) and Franka arms (a server of its protocol), the live view."""

import functools
import inspect
import itertools
import json
import signal
import socket
import sys
import threading
import time
import types

import numpy as np
import psutil
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.benchmarks import faults
from nbs_pin.reports.live import LiveView
from tests.commands import printed_by, refusal

ROBOT = nbs.load_robot("two_link")
LAW = nbs.NeuralBackstepping.for_robot(ROBOT)
MOTION = nbs.Sinusoid.for_robot(ROBOT)
H = 0.001


def simulated(robot=ROBOT, q=None, **more):
    start = MOTION(0.0).q if q is None else q
    return nbs.PlantArm(nbs.MujocoPlant(robot), start, real_time=False, **more)


def test_an_approach_begins_with_the_arm_and_ends_in_the_motion_smoothly():
    q, v = np.array([-1.0, 0.7]), np.array([0.5, -0.2])
    led = nbs.Approach.from_state(MOTION, ROBOT, q, v)
    begin, T = led(0.0), led.length
    assert np.allclose([begin.q, begin.v], [q, v], atol=1e-12)
    assert np.allclose(begin.a, 0.0, atol=1e-9)
    t = np.linspace(0.0, T, 2001)
    along, h = led(t), t[1]
    assert np.allclose(np.gradient(along.q, h, axis=0)[1:-1], along.v[1:-1], atol=1e-4)
    assert np.allclose(np.gradient(along.v, h, axis=0)[1:-1], along.a[1:-1], atol=1e-2)
    for t in (T, T + 0.37):
        assert all(np.allclose(x, y, atol=1e-12) for x, y in zip(led(t), MOTION(t), strict=True))
    assert (np.abs(along.v - MOTION(np.linspace(0.0, T, 2001)).v) <= 0.5 * ROBOT.velocity_limit + 1e-3).all()


def test_the_loop_leads_the_arm_to_the_motion_and_along_it():
    driven = nbs.drive(simulated(q=[-0.5, 0.5]), LAW, ROBOT, MOTION, 2.0)
    assert driven.report is None
    assert len(driven.run.t) == 2000
    assert nbs.metrics.squared_error(driven.run).max() < 1e-8
    assert driven.times.missed == 0
    assert np.abs(driven.run.q_ref[-1] - MOTION(driven.run.t[-1]).q).max() < 1e-12


def test_what_a_watcher_raises_and_what_the_plant_raises_stop_the_arm_and_do_not_leave():
    def watch(seen):
        if seen.sample.t > 0.1:
            raise RuntimeError("the screen is gone")

    driven = nbs.drive(simulated(), LAW, ROBOT, MOTION, 1.0, watch=watch)
    assert driven.report.code is nbs.Fault.REQUESTED
    assert "the screen is gone" in driven.run.info["watcher"]
    assert driven.run.t[-1] > 0.5  # it was braked
    push = simulated(disturbance=lambda t, q, v: np.full(2, np.nan if t > 0.1 else 0.0))
    driven = nbs.drive(push, LAW, ROBOT, MOTION, 1.0)
    assert "SimulationDiverged" in driven.report.message


class Wrapped:
    """A simulated arm of whose members some are replaced; what is replaced takes the arm first."""

    def __init__(self, arm, **members):
        self.inner, self.members = arm, members

    def __getattr__(self, name):
        if name in self.members:
            return functools.partial(self.members[name], self.inner)
        return getattr(self.inner, name)


@pytest.mark.parametrize("place", ["law", "write", "read", "watch", "the last period"])
def test_ctrl_c_brakes_the_arm_wherever_it_comes(place):
    count, last = itertools.count(), 1990 if place == "the last period" else 300

    def interrupt(here):
        if here in place and next(count) == last:
            signal.raise_signal(signal.SIGINT)

    class Law(nbs.MemorylessController):
        nv = 2

        def torque(self, *state):
            interrupt("law")
            return LAW.torque(*state)

    def write(arm, tau):
        interrupt("write")
        arm.write(tau)
        speeds.append(np.abs(arm.read_v()).max())

    def read(arm):
        interrupt("read")
        return arm.read()

    speeds, plain = [], simulated()
    plain.read_v = lambda: plain._v
    arm = Wrapped(plain, write=write, read=read)
    before = signal.getsignal(signal.SIGINT)
    driven = nbs.drive(
        arm, Law(), ROBOT, MOTION, 2.0, watch=lambda seen: interrupt("watch" if place == "watch" else "the last period")
    )
    assert signal.getsignal(signal.SIGINT) is before
    assert driven.report.code is nbs.Fault.REQUESTED
    assert len(speeds) == pytest.approx(last + 500, abs=10)  # it was braked for half a second, even at the end
    assert speeds[-1] < 0.3 * max(speeds[last - 10 : last])


def test_ctrl_c_ends_an_arm_that_does_not_answer(monkeypatch):
    monkeypatch.setattr("nbs_pin.runtime.drive._STUCK", 0.0)
    stopped, plain = [], simulated()

    def read(arm):  # as a driver that waits for its arm
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)
        pytest.fail("the second Ctrl-C was not raised")

    before = signal.getsignal(signal.SIGINT)
    arm = Wrapped(plain, read=read, stop=lambda inner: stopped.append(inner))
    with pytest.raises(KeyboardInterrupt):
        nbs.drive(arm, LAW, ROBOT, MOTION, 2.0)
    assert stopped == [plain]
    assert signal.getsignal(signal.SIGINT) is before


def test_a_loop_in_another_thread_leaves_ctrl_c_alone():
    before, seen = signal.getsignal(signal.SIGINT), []
    work = threading.Thread(
        target=lambda: seen.append(
            nbs.drive(
                simulated(), LAW, ROBOT, MOTION, 0.1, watch=lambda _: handlers.add(signal.getsignal(signal.SIGINT))
            )
        )
    )
    handlers = set()
    work.start()
    work.join()
    assert seen[0].report is None
    assert handlers == {before}


@pytest.mark.parametrize(
    ("clock", "code"),
    [
        (lambda t: t + 5.0, "TIME"),
        (lambda t: t - 0.2, "TIME"),
        (lambda t: 0.3, "TIME"),
        (lambda t: np.nan, "NOT_FINITE"),
        (lambda t: np.inf, "NOT_FINITE"),
        (lambda t: 1e300, "NOT_FINITE"),
        (lambda t: 0.3 + 3.0 * (t - 0.3), "PERIOD"),
    ],
)
def test_the_guard_judges_the_clock_of_the_arm(clock, code):
    def read(arm):
        sample = arm.read()
        return sample._replace(t=clock(sample.t)) if sample.t > 0.3 + 0.5 * H else sample

    speeds = []
    arm = Wrapped(simulated(), read=read)
    driven = nbs.drive(arm, LAW, ROBOT, MOTION, 2.0, watch=lambda seen: speeds.append(np.abs(seen.sample.v).max()))
    assert driven.report.code.name == code
    assert len(speeds) - 300 == pytest.approx(500, abs=60)  # braked for half a second
    share = 0.6 if code == "PERIOD" else 0.3  # by a clock three times as fast velocities are a third
    assert speeds[-1] < share * speeds[300]
    assert (np.diff(driven.run.t) > 0.0).all()


def test_a_run_has_the_readings_that_are_numbers():
    def read(arm):
        sample = arm.read()
        odd = {5: np.full(2, np.nan), 6: np.zeros(3), 7: [None, "q"]}
        return sample._replace(q=odd.get(round(sample.t / H), sample.q))

    driven = nbs.drive(Wrapped(simulated(), read=read), LAW, ROBOT, MOTION, 0.2)
    assert driven.report is None
    assert driven.counters.held == 3
    assert len(driven.run.t) == 197
    assert np.isfinite(driven.run.q).all()


def test_the_torque_rate_is_that_of_the_driver():
    """Not that of an arm of some name."""
    panda = nbs.load_robot("panda")
    assert (nbs.Guard.for_robot(panda).torque_rate > 1000.0).any()
    with pytest.raises(nbs.ArgumentError, match="beyond the arm's 50"):
        nbs.drive(simulated(torque_rate=50.0), LAW, ROBOT, MOTION, 0.1, guard=nbs.Guard.for_robot(ROBOT))
    sent = []
    blow = simulated(torque_rate=50.0, disturbance=lambda t, q, v: 20.0 * (t > 0.1) * np.ones(2))
    nbs.drive(blow, LAW, ROBOT, MOTION, 0.2, watch=lambda seen: sent.append(seen.tau))
    steps = np.abs(np.diff(sent, axis=0))
    assert 0.9 * 50.0 * H < steps.max() <= 50.0 * H
    assert (nbs.FrankaArm.torque_rate, nbs.URArm.torque_rate) == (1000.0, None)


def test_an_arm_in_real_time_moves_on_without_torques():
    arm = nbs.PlantArm(nbs.MujocoPlant(ROBOT), [0.3, 0.2])
    arm.start()
    arm.write(nbs.PinocchioDynamics(ROBOT).gravity(np.array([0.3, 0.2])))
    began, last = time.perf_counter(), 0.0
    for _ in range(20):
        sample = arm.read()
        assert sample.t > last
        last = sample.t
    time.sleep(0.03)
    assert arm.read().t > last + 0.029  # it did not wait for the caller
    assert sample.t <= time.perf_counter() - began + 2 * H


@pytest.fixture
def ur(monkeypatch):
    """Modules with the classes of ur_rtde 1.6, around a simulated arm that adds gravity."""
    robot = nbs.load_robot("ur5")
    plant, model = nbs.MujocoPlant(robot), nbs.PinocchioDynamics(robot)
    state = {"q": nbs.Sinusoid.for_robot(robot)(0.0).q, "v": np.zeros(6), "tau": np.zeros(6), "t": 5.0, "stop": False}

    class RTDEControlInterface:
        def __init__(self, hostname, frequency=-1.0):
            assert (hostname, frequency) == ("arm", 500.0)

        def initPeriod(self):
            return None

        def waitPeriod(self, start):
            for _ in range(2):
                q = state["q"]
                state["q"], state["v"] = plant.step(q, state["v"], state["tau"] + model.gravity(q), 0.001)
            state["t"] += 0.002

        def directTorque(self, torque, viscous_scale, coulomb_scale):
            assert viscous_scale == coulomb_scale == [0.0] * 6
            state["tau"] = np.array(torque)
            return True

        def stopScript(self):
            state["tau"] = np.zeros(6)

    class RTDEReceiveInterface:
        def __init__(self, hostname, frequency=-1.0):
            assert (hostname, frequency) == ("arm", 500.0)

        def getActualQ(self):
            return state["q"].tolist()

        def getActualQd(self):
            return state["v"].tolist()

        def getTimestamp(self):
            return state["t"]

        def isConnected(self):
            return True

        def isEmergencyStopped(self):
            return False

        def isProtectiveStopped(self):
            return state["stop"]

    for name, kind in (("rtde_control", RTDEControlInterface), ("rtde_receive", RTDEReceiveInterface)):
        module = types.ModuleType(name)
        setattr(module, kind.__name__, kind)
        monkeypatch.setitem(sys.modules, name, module)
    return robot, state


def test_a_ur_arm_as_its_client_describes_it(ur):
    robot, state = ur
    law = nbs.NeuralBackstepping.for_robot(robot, period=0.002)
    driven = nbs.drive(nbs.URArm("arm"), law, robot, nbs.Sinusoid.for_robot(robot), 1.0)
    assert driven.report is None
    assert np.abs(nbs.metrics.error(driven.run)).max() < 1e-3

    def watch(seen):
        state["stop"] = seen.sample.t > 6.5

    driven = nbs.drive(nbs.URArm("arm"), law, robot, nbs.Sinusoid.for_robot(robot), 1.0, watch=watch)
    assert driven.report.code is nbs.Fault.ARM
    assert "protective stop" in driven.report.message


@pytest.mark.parametrize(
    ("place", "call", "said"),
    [("look", "getActualQ", "tells no state"), ("start", "initPeriod", "does not take control")],
)
def test_what_the_client_of_a_ur_arm_raises_before_it_moves_is_one_error(ur, monkeypatch, place, call, said):
    arm = nbs.URArm("arm")

    def lost(self):
        raise RuntimeError("read: end of file")

    client = sys.modules["rtde_receive"].RTDEReceiveInterface if place == "look" else type(arm._control)
    monkeypatch.setattr(client, call, lost)
    with pytest.raises(nbs.ArgumentError, match=f"{said} .read: end of file"):
        getattr(arm, place)()


def test_the_double_of_the_ur_arm_has_the_names_of_its_client(ur):
    double = {name: sys.modules[name] for name in ("rtde_control", "rtde_receive")}
    for name, kind in (("rtde_control", "RTDEControlInterface"), ("rtde_receive", "RTDEReceiveInterface")):
        del sys.modules[name]
        real = getattr(pytest.importorskip(name), kind)
        ours = getattr(double[name], kind)
        for method, _ in inspect.getmembers(ours, inspect.isfunction):
            assert hasattr(real, method)
        if hasattr(ours, "directTorque"):
            assert all(word in real.directTorque.__doc__ for word in ("torque", "viscous_scale", "coulomb_scale"))


def test_an_arm_that_does_not_answer_or_whose_client_is_missing_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "pylibfranka", None)
    with pytest.raises(nbs.MissingExtra, match=r"nbs-pin\[franka\]"):
        nbs.FrankaArm("127.0.0.1")
    monkeypatch.setitem(sys.modules, "rtde_control", None)
    with pytest.raises(nbs.MissingExtra, match=r"nbs-pin\[ur\]"):
        nbs.URArm("127.0.0.1")


@pytest.fixture(scope="module")
def franka():
    pytest.importorskip("pylibfranka")
    pytest.importorskip("franky_sim")
    from tests.franka_wire import simulated_arm

    robot = simulated_arm()
    return robot, nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot, amplitude=0.2)


def test_the_wire_carries_what_a_franka_arm_takes(franka):
    from tests.franka_wire import drive_with_fault, is_legal

    robot, _, motion = franka
    friction = nbs.JointFriction(viscous=np.full(7, 0.21), coulomb=[1.137] * 4 + [0.763, 0.44, 0.248])
    law = nbs.NeuralBackstepping.for_robot(robot, friction=friction)
    driven, story = drive_with_fault(robot, law, motion, "", duration=0.6)
    assert driven.report is None
    assert is_legal(story, robot)
    assert story["commands"] + driven.counters.late >= 600
    assert np.abs(nbs.metrics.error(driven.run)).max() < 5e-3
    run, model = driven.run, nbs.PinocchioDynamics(robot)
    gravity = np.abs(model.gravity(run.q)).max(axis=0)
    heavy = gravity > 5.0  # N·m
    assert heavy.sum() >= 2
    assert (np.array(story["largest"])[heavy] < 0.2 * gravity[heavy]).all()  # sent without it
    needed = model.reference_torque(run.q, run.v, run.v_ref, run.a_ref) + friction.torque(run.v_ref)
    assert np.abs(run.tau - needed)[50:].max() < 1.0  # and with it in the run, as the motion needs


@pytest.mark.parametrize("fault", ["drop 10", "late 10", "late 30", "deaf 40", "reflex", "close"])
def test_every_fault_on_the_wire_of_a_franka_arm_ends_in_a_recovery_or_a_stop(franka, fault):
    from tests.franka_wire import ENDS, drive_with_fault, is_legal

    robot, law, motion = franka
    driven, story = drive_with_fault(robot, law, motion, fault, duration=0.25)
    assert ("" if driven.report is None else driven.report.code.name) in ENDS[fault]
    assert is_legal(story, robot)
    if fault == "drop 10":
        lost = driven.counters.late  # ten, and what this machine loses by itself
        assert lost >= 10
        assert len(driven.run.t) == 250 - lost
        assert np.diff(driven.run.t).max() > 0.0105


def test_the_live_view_listens_on_this_machine_only():
    with LiveView(ROBOT) as view:
        assert view.url.startswith("http://127.0.0.1:")
        here = psutil.Process(view._server.pid)
        listening = [c for c in here.net_connections("inet") if c.status == psutil.CONN_LISTEN]
        assert listening
        assert all(c.laddr.ip == "127.0.0.1" for c in listening)
        view.show(np.array([0.3, 0.2]))
        port = int(view.url.split(":")[2].split("/")[0])
        socket.create_connection(("127.0.0.1", port), timeout=5.0).close()


def test_nbs_pin_run_writes_what_happened(tmp_path, monkeypatch):
    from nbs_pin.commands import run as command

    monkeypatch.setattr(command, "arm_at", lambda text, robot, motion, *_: simulated(robot, motion(0.0).q))
    text = printed_by("run", "two_link", "--duration", "0.3", "--certified", "5", "--out", tmp_path)
    assert "guard: OK" in text
    assert {path.name for path in tmp_path.iterdir()} == {"run.npz", "tracking.png", "replay.html", "summary.json"}
    assert len(nbs.Run.load(tmp_path / "run.npz").t) == 300


@pytest.mark.parametrize("tried", [1, 2, 3])
def test_ctrl_c_keeps_the_whole_rows_of_the_fault_matrix(tried, tmp_path, capsys, monkeypatch):
    def interrupted(function, tasks, *_):
        yield from (function(*task) for task in tasks[:tried])
        raise KeyboardInterrupt

    monkeypatch.setattr(faults, "on_all_cores", interrupted)
    arguments = ["faults", "--arms", "two_link", "--seeds", "2", "--only", "F22", "--out", str(tmp_path)]
    assert cli.main(arguments) == 130
    said = capsys.readouterr().out
    assert ("interrupted after 1 of 3 faults" in said) == (tried >= 2)
    kept = json.loads((tmp_path / "summary.json").read_text()) if tried >= 2 else None
    assert kept is None or (kept["interrupted"] and [len(row["passed"]) for row in kept["rows"]] == [2])
    assert (tmp_path / "summary.json").exists() == (tried >= 2)
    complete = {"interrupted": False}
    (tmp_path / "summary.json").write_text(json.dumps(complete))
    assert cli.main(arguments) == 130
    assert json.loads((tmp_path / "summary.json").read_text()) == complete
    assert ("complete rows of before" in capsys.readouterr().out) == (tried >= 2)


def test_nbs_pin_faults_prints_a_row_for_each_fault(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(faults, "on_all_cores", lambda function, tasks, *_: (function(*task) for task in tasks))
    text = printed_by("faults", "--arms", "two_link", "--seeds", "1", "--only", "F22", "--out", tmp_path)
    assert text.count("TIME at once") == 3
    assert text.count("F22 time") == 3  # at 80 columns
    assert "3 of 3 rows passed" in text
    assert "F99" in refusal(cli.main(["faults", "--only", "F99", "--out", str(tmp_path)]), capsys)
    assert "libfranka:HOST" in refusal(cli.main(["run", "panda", "--arm", "libfranka"]), capsys)
