"""The guard: what leaves it is always legal, what it holds and when it stops, and what it tells."""

import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.benchmarks import fault_trial, faults_ridden, faults_stopped
from nbs_pin.benchmarks.faults import MATRIX, judge
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.kernels import guarding as at

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

ROBOT = nbs.load_robot("two_link")
LAW = nbs.NeuralBackstepping.for_robot(ROBOT).compile()
MOTION = nbs.Sinusoid.for_robot(ROBOT)
PLANT = nbs.MujocoPlant(ROBOT)
H = 0.001


def begun(law=LAW, guard=None, start=None):
    guarded = nbs.Guarded(law, ROBOT, guard)
    q = MOTION(0.0).q if start is None else start
    guarded.begin(q, MOTION(guarded.lead))
    return guarded


def follow(guarded, count, first=0, q=None, v=None, spoil=lambda k, sample: sample):
    """So many periods in the loop; returns the state of the plant and the torques."""
    q, v = (MOTION(first * H).q, MOTION(first * H).v) if q is None else (q, v)
    torques = []
    for k in range(first, first + count):
        tau = guarded.step(spoil(k, nbs.Sample(k * H, q, v)), MOTION(k * H + guarded.lead))
        torques.append(tau)
        q, v = PLANT.step(q, v, tau, H)
    return q, v, np.array(torques)


@pytest.mark.parametrize("compensated", [False, True])
@pytest.mark.parametrize("name", ["two_link", "panda"])
def test_no_hostile_sample_makes_an_illegal_torque(name, compensated):
    from hostile_samples import campaign, run

    illegal, modes, codes = run(name, 20_000, seed=1, compensated=compensated, function=campaign.py_func)
    assert illegal == 0
    assert (modes > 0).all()
    assert (codes > 0).sum() >= 6  # reasons to stop


def test_what_the_guard_lets_pass_is_what_simulate_applies():
    rest = nbs.Hold([0.3, 0.2])
    guarded = nbs.Guarded(LAW, ROBOT)
    guarded.begin(rest(0.0).q, rest(0.0))
    q, v = rest(0.0).q, np.zeros(2)
    push = nbs.SinusoidalTorque([3.0, -2.0], 10.0)
    run = nbs.simulate(PLANT, LAW, rest, 0.3, H, disturbance=push)
    for k in range(300):
        assert np.allclose(q, run.q[k], rtol=0.0, atol=1e-12)
        tau = guarded.step(nbs.Sample(k * H, q, v), rest(0.0))
        q, v = PLANT.step(q, v, tau + push(k * H, q, v), H)
    assert guarded.mode is nbs.Mode.OK
    assert guarded.report is None


def test_a_bad_sample_is_held_the_twentieth_stops_and_only_begin_goes_on():
    guarded = begun()
    q, v, before = follow(guarded, 50)
    gone = np.full(2, np.nan)
    _, _, held = follow(guarded, 19, 50, q, v, lambda k, s: s._replace(q=gone))
    assert (held == before[-1]).all()
    assert guarded.mode is nbs.Mode.DEGRADED
    assert guarded.counters.held == 19
    guarded.step(nbs.Sample(0.069, gone, v), MOTION(0.069))
    assert guarded.mode is nbs.Mode.STOPPED
    assert guarded.report.code is nbs.Fault.NOT_FINITE
    assert len(guarded.report.samples) == 50
    assert guarded.report.t[-1] == 0.069
    for k in range(70, 200):  # good samples do not undo it
        guarded.step(nbs.Sample(k * H, MOTION(k * H).q, MOTION(k * H).v), MOTION(k * H))
    assert guarded.mode is nbs.Mode.STOPPED
    guarded.begin(MOTION(0.0).q, MOTION(0.0))
    follow(guarded, 30)
    assert guarded.mode is nbs.Mode.OK
    assert guarded.report is None


def test_after_a_hundred_good_samples_degraded_is_over():
    guarded = begun()
    q, v, _ = follow(guarded, 10, spoil=lambda k, s: s._replace(fresh=k != 5))
    assert guarded.mode is nbs.Mode.DEGRADED
    q, v, _ = follow(guarded, 95, 10, q, v)
    assert guarded.mode is nbs.Mode.DEGRADED
    follow(guarded, 1, 105, q, v)
    assert guarded.mode is nbs.Mode.OK


def test_the_safe_stop_brakes_the_arm_against_gravity_and_lets_go_when_the_state_is_lost():
    guarded = begun()
    q, v, _ = follow(guarded, 700)
    guarded.step(nbs.Sample(0.7, q, v), MOTION(0.7), stop=True)
    assert guarded.report.code is nbs.Fault.REQUESTED
    for k in range(701, 2700):
        tau = guarded.step(nbs.Sample(k * H, q, v), MOTION(k * H))
        q, v = PLANT.step(q, v, tau, H)
    assert np.abs(v).max() < 1e-3  # it rests, where it was braked
    assert np.allclose(tau, nbs.PinocchioDynamics(ROBOT).gravity(q), atol=1e-2)
    sent = [guarded.step(nbs.Sample(2.7, q, v, fresh=False), MOTION(2.7)) for _ in range(200)]
    assert np.allclose(sent[90], tau, atol=1e-2)  # gravity of the last position, for a while
    assert (sent[-1] == 0.0).all()
    assert (np.abs(np.diff(sent, axis=0)) <= guarded.guard.torque_rate * H).all()


def test_a_joint_that_runs_away_from_the_brake_goes_limp():
    guarded = begun()
    q, v, _ = follow(guarded, 200)
    guarded.step(nbs.Sample(0.2, q, v), MOTION(0.2), stop=True)
    for k in range(201, 600):
        tau = guarded.step(nbs.Sample(k * H, q, v), MOTION(k * H))
        q, v = PLANT.step(q, v, np.array([1.0, -1.0]) * tau - np.array([0.0, 5.0]), H)  # flipped, and pushed
    away = guarded.guard.vector(guarded.state, at.AWAY)
    assert away[1] >= at.LIMP
    assert tau[1] == 0.0


@pytest.mark.parametrize("bad", [1.0, 0.01, [0.5, -0.5, 0.5]])
def test_a_few_bad_readings_do_not_end_the_brake(bad):
    """One reading far off, one off by less than three times the velocity limit, and three that leap about."""
    off = dict(enumerate(np.atleast_1d(bad).tolist(), start=210))

    def braked(off):
        guarded, torques = begun(), []
        q, v, _ = follow(guarded, 200)
        for k in range(200, 1200):
            sample = nbs.Sample(k * H, q + off.get(k, 0.0), v)
            torques.append(guarded.step(sample, MOTION(k * H), stop=k == 200))
            q, v = PLANT.step(q, v, torques[-1], H)
        return guarded, v, np.array(torques)

    (_, slow, usual), (guarded, v, torques) = braked({}), braked(off)
    assert (guarded.guard.vector(guarded.state, at.AWAY) < at.LIMP).all()
    assert np.abs(v).max() < 1.05 * np.abs(slow).max()  # braked
    if np.abs(bad).max() > 0.1:  # and not moved by what no motion can be
        assert np.abs(torques - usual).max() < 1.0


def test_an_arm_is_braked_while_its_clock_stands():
    speeds = {}
    for clock in ("goes on", "stands", "stands, and so do readings"):
        guarded = begun()
        q, v, _ = follow(guarded, 700)
        shown = q, v
        for k in range(700, 1200):
            shown = shown if clock.endswith("readings") else (q, v)
            sample = nbs.Sample(k * H if clock == "goes on" else 0.699, *shown)
            q, v = PLANT.step(q, v, guarded.step(sample, MOTION(k * H), stop=clock == "goes on"), H)
        assert guarded.report.code.name == ("REQUESTED" if clock == "goes on" else "TIME")
        speeds[clock] = np.abs(v).max()
    assert speeds["stands"] == pytest.approx(speeds["goes on"], rel=0.02)
    assert speeds["stands"] < 0.2 * speeds["stands, and so do readings"]


def test_no_velocity_of_the_wrong_sign_enters_the_brake():
    guarded = begun()
    q, v, _ = follow(guarded, 300)
    k = 300
    while guarded.report is None:
        tau = guarded.step(nbs.Sample(k * H, q, -v), MOTION(k * H + guarded.lead))
        kept = guarded.guard.vector(guarded.state, at.V).copy()
        q, v = PLANT.step(q, v, tau, H)
        k += 1
    assert guarded.report.code is nbs.Fault.SIGN
    assert (kept == 0.0).all()


class Strange(MemorylessController):
    """A law that does something else from a call on."""

    def __init__(self, after, do):
        self.calls, self.after, self.do = 0, after, do

    @property
    def nv(self):
        return 2

    def torque(self, *state):
        self.calls += 1
        return self.do() if self.calls > self.after else LAW.torque(*state)


def test_a_law_that_raises_stops_the_arm_in_that_period_with_its_traceback():
    guarded = begun(Strange(60, lambda: 1 / 0))
    *_, torques = follow(guarded, 70)
    report = guarded.report
    assert report.code is nbs.Fault.LAW
    assert "ZeroDivisionError" in report.traceback
    assert "division by zero" in str(report)
    assert np.isfinite(torques).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e300])  # the last is larger than any torque
def test_a_law_without_numbers_is_held_and_stops_at_the_twentieth(value):
    guarded = begun(Strange(60, lambda: np.full(2, value)))
    *_, torques = follow(guarded, 100)
    assert guarded.report.code is nbs.Fault.OUTPUT
    assert np.isfinite(torques).all()
    assert guarded.counters.held >= 19


def test_a_torque_from_limit_to_limit_is_chatter():
    signs = iter(np.tile([1.0, -1.0], 1000))
    guarded = begun(Strange(60, lambda: np.full(2, 1e3 * next(signs))))
    follow(guarded, 200)
    assert guarded.report.code is nbs.Fault.CHATTER


def test_a_torque_from_outside_and_an_arm_with_a_fault_stop():
    guard = replace(nbs.Guard.for_robot(ROBOT), external_limit=np.array([4.0, 4.0]))
    guarded = begun(guard=guard)
    follow(guarded, 30, spoil=lambda k, s: s._replace(external=np.array([0.0, 3.9 if k < 10 else 4.1])))
    assert guarded.report.code is nbs.Fault.EXTERNAL
    assert guarded.report.time == pytest.approx(0.012)  # the third in a row
    guarded = begun()
    follow(guarded, 30, spoil=lambda k, s: s._replace(fault="reflex" if k == 20 else ""))
    assert guarded.report.code is nbs.Fault.ARM
    assert "reflex" in str(guarded.report)


def test_a_certificate_gives_the_errors_at_which_the_loop_has_diverged():
    certificate = nbs.certify(nbs.NeuralBackstepping.for_robot(ROBOT), [5.0, 5.0])
    guard = nbs.Guard.for_robot(ROBOT, certificate=certificate)
    assert np.array_equal(guard.error_limit, certificate.joint_errors)
    q, v = MOTION(0.0).q, MOTION(0.0).v
    for size, stops in ((1.0, False), (40.0, True)):  # admissible torques never stop it, much larger ones do
        guarded = begun(guard=guard)
        q, v = MOTION(0.0).q, MOTION(0.0).v
        for k in range(1500):
            tau = guarded.step(nbs.Sample(k * H, q, v), MOTION(k * H + guarded.lead))
            q, v = PLANT.step(q, v, tau + size * 5.0 * np.sign(np.sin(8.0 * k * H)) * np.ones(2), H)
        assert (guarded.report is not None) == stops
    assert guarded.report.code is nbs.Fault.DIVERGED


def test_one_thread_at_a_time():
    inside, leave = threading.Event(), threading.Event()

    def wait():
        inside.set()
        leave.wait(10.0)
        return np.zeros(2)

    guarded = begun(Strange(5, wait))
    q, v, _ = follow(guarded, 4)
    other = threading.Thread(target=lambda: follow(guarded, 3, 4, q, v))
    other.start()
    inside.wait(10.0)
    with pytest.raises(nbs.ArgumentError, match="another thread"):
        guarded.step(nbs.Sample(0.01, q, v), MOTION(0.01))
    leave.set()
    other.join()


def test_arguments_that_do_not_fit_are_refused_or_held():
    with pytest.raises(nbs.ArgumentError, match="2 joints, the guard 7 and two_link 2"):
        nbs.Guarded(LAW, ROBOT, nbs.Guard.for_robot(nbs.load_robot("panda")))
    with pytest.raises(nbs.ArgumentError, match="has not begun"):
        nbs.Guarded(LAW, ROBOT).step(nbs.Sample(0.0, np.zeros(2), np.zeros(2)), MOTION(0.0))
    with pytest.raises(nbs.ArgumentError, match="torque_rate"):
        nbs.Guard.for_robot(ROBOT, torque_rate=-1.0)
    guarded = begun()
    _, _, torques = follow(guarded, 3)
    short = guarded.step(nbs.Sample(0.003, np.zeros(1), np.zeros(5)), MOTION(0.003))  # no reading of this arm
    assert np.array_equal(short, torques[-1])


def test_readings_of_any_kind_are_taken_or_held():
    guarded = begun()
    taken = 0
    for k in range(60):
        q, v, aim = MOTION(k * H).q, MOTION(k * H).v, MOTION(k * H + guarded.lead)
        fixed = q.copy()
        fixed.flags.writeable = False
        good = [fixed, q.tolist(), tuple(q), np.repeat(q, 2)[::2], q[::-1].copy()[::-1]]
        bad = [q[None], q[:1], q[:, None], q[0], None, "q", [[0.0], [0.0, 1.0]], [None, 0.0]]
        kind = (good + bad)[k % 13]
        before = guarded.counters.held
        tau = guarded.step(nbs.Sample(k * H, kind, v), aim)
        assert guarded.counters.held - before == (k % 13 >= 5)
        taken += k % 13 < 5
        assert tau.shape == (2,)
        assert np.isfinite(tau).all()
    assert taken == 25
    assert guarded.mode is nbs.Mode.DEGRADED
    for spoilt in (nbs.Reference(aim.q[:1], aim.v, aim.a), nbs.Reference(aim.q, aim.v[None], aim.a)):
        held = guarded.counters.held
        guarded.step(nbs.Sample(0.06 + held * H, q, v), spoilt)
        assert guarded.counters.held == held + 1
    guarded.step(nbs.Sample(None, q, v), aim)
    assert guarded.counters.held == held + 2
    for _ in range(20):
        guarded.step(nbs.Sample(0.2, "nothing", v), aim)
    assert guarded.report.q.shape == (50, 2)


def test_what_a_law_returns_in_another_shape_is_held():
    for value in (np.zeros((1, 2)), np.zeros(3), None):
        guarded = begun(Strange(60, lambda value=value: value))
        follow(guarded, 100)
        assert guarded.report.code is nbs.Fault.OUTPUT


def test_a_reference_of_another_length_is_not_read():
    """A row of large numbers lies behind an empty view: a joint at rest must not look frozen for them."""
    guard, rest, behind = nbs.Guard.for_robot(ROBOT), np.array([0.3, 0.2]), np.full(4, 1e9)
    state, still = guard.begin(rest, rest, np.zeros(2)), np.zeros(2)
    for k in range(60):
        v_ref = {5: behind[:0], 6: np.full(2, np.nan)}.get(k, still)
        at.admit(guard.config, state, k * H, True, False, rest, still, rest, v_ref, still)
    assert state[at.HELD] == 2.0
    assert state[at.MODE] != at.STOPPED
    for k in range(60, 90):  # and one that is frozen is found
        at.admit(guard.config, state, k * H, True, False, rest, still, rest, np.ones(2), still)
    assert state[at.CODE] == at.FROZEN


def test_an_error_is_that_of_one_instant():
    """A law that looks far ahead of a fast motion is not off by what the motion does until then."""
    guard = replace(nbs.Guard.for_robot(ROBOT), error_limit=np.full(2, 0.01))
    guarded = nbs.Guarded(LAW, ROBOT, guard, lookahead=0.02)

    def at_speed(t):
        return nbs.Reference(np.array([0.0, t]), np.array([0.0, 1.0]), np.zeros(2))

    for first, stops in ((0.0, False), (0.012, True)):
        guarded.begin(at_speed(0.0).q, at_speed(guarded.lead))
        for k in range(60):
            q, v, _ = at_speed(k * H)
            q[1] += min(first, 0.001 * k)
            guarded.step(nbs.Sample(k * H, q, v), at_speed(k * H + guarded.lead))
        assert (guarded.report is not None) == stops
    assert guarded.report.code is nbs.Fault.DIVERGED


def test_an_arm_that_adds_gravity_takes_no_law_without_it():
    guard, model = nbs.Guard.for_robot(ROBOT, compensated=True), nbs.PinocchioDynamics(ROBOT)
    upright = min(([x, 0.0] for x in 0.5 * np.pi * np.arange(4)), key=lambda q: np.abs(model.gravity(q)).max())
    for law in (nbs.PID.for_robot(ROBOT), Strange(0, lambda: np.zeros(2))):
        guarded = nbs.Guarded(law, ROBOT, guard)
        with pytest.raises(nbs.ArgumentError, match="law with a model"):
            guarded.begin([0.3, 0.2], nbs.Hold([0.3, 0.2])(0.0))
        guarded.begin(upright, nbs.Hold(upright)(0.0))  # nothing to subtract here
        for k in range(150):
            aim = nbs.Hold(np.add(upright, [4e-3 * k, 0.0]))(0.0)
            guarded.step(nbs.Sample(k * H, aim.q, aim.v), aim)
        assert guarded.report.code is nbs.Fault.MODEL

    class Remembers(nbs.Controller):
        """A law with memory and a model."""

        nv = 2

        def initial_memory(self, q):
            return 0

        def step(self, memory, q, v, reference, period):
            return LAW.step(None, q, v, reference, period)[0], memory + 1

    aim = nbs.Hold([0.3, 0.2])(0.0)
    guarded = nbs.Guarded(Remembers(), ROBOT, guard)
    guarded.begin(aim.q, aim)
    assert np.abs(guarded.step(nbs.Sample(0.0, aim.q, aim.v), aim)).max() < 1e-9


SHORT = ["F9", "F14 rate, gains for 1 kHz", "F16 samples lost in a row", "F19", "F21 velocity", "F22", "F23", "F25"]


@pytest.mark.parametrize("at", [k for k, case in enumerate(MATRIX) if case.fault.startswith(tuple(SHORT))])
def test_rows_of_the_fault_matrix(at):
    assert judge(at, "two_link", 0).passed


class Unguarded(nbs.Guarded):
    """The law alone: whatever comes in is used, whatever comes out is sent."""

    def step(self, sample, aim, *, overrun=False, stop=False):
        if not np.isfinite(sample.q).all() or not sample.fresh:
            return self.tau
        return self._command(self._taken(sample, aim, False)[1], aim)


def fails(at, arm="two_link"):
    try:
        return not judge(at, arm, 0).passed
    except ZeroDivisionError:  # the law's, which a guard keeps
        return True


GUARDED = ["F10 2^-12 turn, 1 ms", "F16 20 ms", "F23", "F25", "F27"]


@pytest.mark.parametrize("name", GUARDED)
def test_rows_of_the_fault_matrix_fail_without_a_guard(name, monkeypatch):
    monkeypatch.setattr(fault_trial, "Guarded", Unguarded)
    fault, _, level = name.partition(" ")
    rows = [k for k, case in enumerate(MATRIX) if case.fault.split()[0] == fault and level in case.level]
    assert rows
    assert all(map(fails, rows))


def test_rows_that_need_no_guard_can_fail_too(monkeypatch):
    def row(fault, level):
        (found,) = (k for k, case in enumerate(MATRIX) if case.fault.startswith(fault) and case.level == level)
        return found

    monkeypatch.setattr(faults_ridden, "check_reference", lambda *_: None)  # nothing is refused before the start
    assert fails(row("F17", "5 %"))
    monkeypatch.setattr(faults_stopped, "simulate", lambda *_, **__: None)  # nothing diverges
    assert fails(row("F26", "torque 1e9 N·m at 0.1 s"))
    slow = nbs.Guard.for_robot
    monkeypatch.setattr(
        nbs.Guard,
        "for_robot",
        lambda robot, *a, torque_rate=None, **k: slow(robot, *a, torque_rate=torque_rate and 0.02 * torque_rate, **k),
    )
    assert fails(row("F18", "1000 N·m/s against none"))


def test_samples_of_any_kind_are_used_alike_and_kept_as_they_were():
    robot = nbs.load_robot("two_link")
    motion, law = nbs.Sinusoid.for_robot(robot), nbs.NeuralBackstepping.for_robot(robot)
    kinds = {
        "arrays": np.array,
        "lists": np.ndarray.tolist,
        "strided": lambda x: np.repeat(x, 2)[::2],
        "read-only": lambda x: np.frombuffer(x.tobytes()),
    }
    sent, shown = {}, {}
    for kind, made in kinds.items():
        guarded, start = nbs.Guarded(law, robot), motion(0.0)
        guarded.begin(start.q, motion(guarded.lead))
        for k in range(30):
            now, aim = motion(k * H), motion(k * H + guarded.lead)
            vectors = [made(np.array(x)) for x in (now.q, now.v, *aim)]
            sent[kind, k] = guarded.step(nbs.Sample(k * H, *vectors[:2]), nbs.Reference(*vectors[2:]))
            shown[kind, k] = guarded.seen
            if kind == "arrays":  # what a driver does with its arrays afterwards is not seen in the report
                for x in vectors:
                    x[:] = np.nan
        assert guarded.mode is nbs.Mode.OK
    for kind, k in sent:
        np.testing.assert_array_equal(sent[kind, k], sent["arrays", k])
        sample, aim, tau = shown[kind, k]
        for found, expected in zip(
            (sample.q, sample.v, *aim, tau), (*motion(k * H)[:2], *motion(k * H + 0.5 * H), sent[kind, k]), strict=True
        ):
            np.testing.assert_array_equal(found, expected)
        assert (sample.t, sample.fresh, sample.external, sample.fault) == (k * H, True, None, "")


@pytest.mark.parametrize("a_ref", [np.zeros(3), [0.0, np.nan], "none", np.zeros((2, 2))])
def test_a_reference_without_accelerations_of_every_joint_holds_the_torque(a_ref):
    robot = nbs.load_robot("two_link")
    guarded, aim = nbs.Guarded(nbs.NeuralBackstepping.for_robot(robot), robot), nbs.Hold([0.3, 0.2])(0.0)
    guarded.begin(aim.q, aim)
    tau = guarded.step(nbs.Sample(0.0, aim.q, aim.v), aim)
    held = guarded.step(nbs.Sample(H, aim.q, aim.v), aim._replace(a=a_ref))
    assert held.tolist() == tau.tolist()
    assert guarded.mode is nbs.Mode.DEGRADED
    assert guarded.counters.held == 1


class Remembering(MemorylessController):
    """A law that keeps the references that it was given."""

    def __init__(self, law):
        self.law, self.aims = law, []

    @property
    def nv(self):
        return self.law.nv

    def torque(self, q, v, q_ref, v_ref, a_ref):
        self.aims.append((q_ref, v_ref, a_ref))
        return self.law.torque(q, v, q_ref, v_ref, a_ref)


def test_neither_the_caller_nor_the_law_can_change_what_the_guard_has_seen():
    law = Remembering(LAW)
    guarded, aim = nbs.Guarded(law, ROBOT), nbs.Reference(*map(np.array, MOTION(0.0)))
    guarded.begin(aim.q, aim)
    law.aims.clear()
    tau = guarded.step(nbs.Sample(0.0, aim.q.copy(), aim.v.copy()), aim)
    sent = tau.copy()
    tau[:] = 99.0
    for x in aim:
        x[:] = 99.0
    np.testing.assert_array_equal(guarded.seen.tau, sent)
    for found, expected in zip(law.aims[0], MOTION(0.0), strict=True):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("sample", [nbs.Sample(10**400, [0.0, 0.0], [0.0, 0.0]), nbs.Sample(H, [10**400, 0], [0, 0])])
def test_a_number_beyond_every_float_is_held(sample):
    guarded, aim = begun(), MOTION(0.0)
    tau = guarded.step(nbs.Sample(0.0, aim.q, aim.v), aim)
    assert guarded.step(sample, aim).tolist() == tau.tolist()
    assert guarded.mode is nbs.Mode.DEGRADED
