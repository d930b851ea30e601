"""The time loop: what acts when, what is recorded, and what stops it."""

import io
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError, SimulationDiverged
from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Reference
from nbs_pin.controllers.controller import Controller, MemorylessController
from nbs_pin.motions.disturbances import ConstantTorque, SinusoidalTorque, SquareWave, TorqueNoise
from nbs_pin.motions.references import Hold, Sinusoid
from nbs_pin.robots.robot import load_robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.mujoco_plant import MujocoPlant
from nbs_pin.simulation.simulate import simulate, stream

N = 2


class Masses(nbs.DynamicsProvider):
    """Unit masses without gravity: v̇ = τ, so that every run has a closed form."""

    nv = N

    def mass_matrix(self, q):
        return np.broadcast_to(np.eye(N), (*q.shape, N)).copy()

    def coriolis_matrix(self, q, v):
        return np.zeros((*q.shape, N))

    def gravity(self, q):
        return np.zeros(q.shape)

    def potential_energy(self, q):
        return np.zeros(q.shape[:-1])

    def forward_dynamics(self, q, v, tau):
        return tau


class Law(MemorylessController):
    """A torque written as a function of (q, v, reference)."""

    nv = N

    def __init__(self, law, nv=N):
        self.law, self.nv = law, nv

    def torque(self, q, v, q_ref, v_ref, a_ref):
        return self.law(q, v, Reference(q_ref, v_ref, a_ref))


class Counter(Controller):
    """τ = number of the call; remembers nothing but that number, which the loop keeps for it."""

    nv = N

    def initial_memory(self, q):
        return 0

    def step(self, memory, q, v, reference, period):
        return np.full(q.shape, float(memory)), memory + 1


PLANT = DynamicsPlant(Masses())
STILL = Hold([0.0, 0.0])
SILENT = Law(lambda q, v, ref: 0.0 * q)
MOVING = Sinusoid([1.0, 0.5], [2.0, 3.0])
PD = Law(lambda q, v, ref: ref.a - 20.0 * (v - ref.v) - 100.0 * (q - ref.q))


def test_the_torque_of_row_k_acts_from_t_k_to_t_k_plus_1():
    run = simulate(PLANT, Counter(), STILL, 0.4, 0.1)
    assert run.t.tolist() == [0.0, 0.1, 0.2, 0.30000000000000004, 0.4]
    np.testing.assert_array_equal(run.tau[:, 0], [0, 1, 2, 3, 4])
    np.testing.assert_allclose(np.diff(run.v[:, 0]), 0.1 * run.tau[:-1, 0], rtol=1e-12)
    np.testing.assert_allclose(np.diff(run.q[:, 0]), 0.1 * run.v[:-1, 0] + 0.005 * run.tau[:-1, 0], rtol=1e-12)


def test_times_do_not_drift():
    run = simulate(PLANT, SILENT, STILL, 1.0, 0.001)
    assert run.t.shape == (1001,)
    np.testing.assert_array_equal(run.t, np.arange(1001) * 0.001)


def test_the_controller_sees_the_state_and_reference_of_its_own_instant():
    seen = []
    law = Law(lambda q, v, ref: seen.append((q.copy(), v.copy(), *ref)) or -q)
    run = simulate(PLANT, law, MOVING, 0.5, 0.01, lookahead=0.0)
    recorded = zip(run.q, run.v, run.q_ref, run.v_ref, run.a_ref, strict=True)
    np.testing.assert_array_equal(seen, list(recorded))
    np.testing.assert_array_equal((run.q_ref, run.v_ref, run.a_ref), MOVING(run.t))


def test_looking_ahead_to_the_middle_of_the_hold_removes_its_lag():
    """A held torque acts half a period late; the law evaluated there tracks ten times better, and to second order."""
    late, timely = (simulate(PLANT, PD, MOVING, 2.0, 0.01, lookahead=lead) for lead in (0.0, None))
    finer = simulate(PLANT, PD, MOVING, 2.0, 0.005)
    error = [np.abs(run.q - run.q_ref)[run.t > 1.0].max() for run in (late, timely, finer)]
    assert error[1] < 0.1 * error[0]
    assert error[2] < 0.3 * error[1]


def test_the_start_is_the_references_or_the_one_given_at_rest():
    reference = Sinusoid([1.0, 0.5], [2.0, 3.0], 0.3)
    start = reference(0.0)
    for options, q, v in (
        ({}, start.q, start.v),
        ({"q0": [0.1, 0.2]}, [0.1, 0.2], [0.0, 0.0]),
        ({"q0": [0.1, 0.2], "v0": [1.0, 2.0]}, [0.1, 0.2], [1.0, 2.0]),
        ({"v0": [1.0, 2.0]}, start.q, [1.0, 2.0]),
    ):
        run = simulate(PLANT, SILENT, reference, 0.01, 0.01, **options)
        np.testing.assert_array_equal((run.q[0], run.v[0]), (q, v))


def test_many_starts_at_once_are_the_stack_of_single_starts():
    robot = load_robot("three_link")
    dynamics = nbs.PinocchioDynamics(robot)
    law = Law(lambda q, v, ref: dynamics.reference_torque(q, v, v, ref.a - 9.0 * (q - ref.q) - 6.0 * (v - ref.v)), 3)
    reference, q0 = Sinusoid(np.ones(3), 1.0), np.random.default_rng(0).normal(size=(2, 3, 3))
    for plant in (MujocoPlant(robot), DynamicsPlant(dynamics)):
        disturbance = SquareWave(1.0, 30.0)
        batch = simulate(plant, law, reference, 0.05, 0.01, q0=q0, disturbance=disturbance, effort_limit=50.0)
        alone = simulate(plant, law, reference, 0.05, 0.01, q0=q0[1, 2], disturbance=disturbance, effort_limit=50.0)
        assert batch.q.shape == (6, 2, 3, 3)
        for name in ("q", "v", "tau", "tau_command", "disturbance", "q_ref", "v_ref", "a_ref"):
            np.testing.assert_allclose(getattr(batch, name)[:, 1, 2], getattr(alone, name), rtol=0, atol=1e-12)


def test_effort_limits_clip_what_is_applied_and_keep_what_was_asked():
    for sign in (1.0, -1.0):
        asked = sign * np.array([10.0, -10.0])
        law = Law(lambda q, v, ref, asked=asked: asked)
        run = simulate(PLANT, law, STILL, 0.1, 0.1, effort_limit=[3.0, np.inf])
        np.testing.assert_array_equal(run.tau, sign * np.array([[3.0, -10.0]] * 2))
        np.testing.assert_array_equal(run.tau_command, [asked] * 2)
        np.testing.assert_allclose(run.v[1], sign * np.array([0.3, -1.0]), rtol=1e-12)
    np.testing.assert_array_equal(run.effort_limit, [3.0, np.inf])


def test_effort_limits_are_the_arms_unless_others_are_given():
    robot = load_robot("panda")
    law = Law(lambda q, v, ref: np.full(q.shape, 1e3), 7)
    hold = Hold(0.5 * (robot.lower + robot.upper))
    run = simulate(MujocoPlant(robot), law, hold, 0.002, 0.001)
    np.testing.assert_array_equal(run.tau[0], robot.effort_limit)
    assert (run.robot, run.robot_sha256, run.joint_names) == ("panda", robot.sha256, robot.joint_names)
    free = simulate(MujocoPlant(robot), law, hold, 0.002, 0.001, effort_limit=np.inf)
    np.testing.assert_array_equal(free.tau[0], 1e3)


def test_a_finer_plant_step_converges_to_the_closed_form_whatever_the_period():
    """Held torque on an oscillating disturbance: q(T) = T − sin T for v̇ = sin t from rest."""
    errors = []
    for plant_step in (0.01, 0.005):
        options = {"plant_step": plant_step, "disturbance": lambda t, q, v: np.full(q.shape, np.sin(t))}
        run = simulate(PLANT, SILENT, STILL, 1.0, 0.1, **options)
        errors.append(abs(run.q[-1, 0] - (1.0 - np.sin(1.0))))
        np.testing.assert_allclose(run.disturbance[:-1, 1], np.sin(run.t[:-1]), rtol=1e-12)
    assert errors[0] == pytest.approx(2.0 * errors[1], rel=0.05)
    assert errors[1] < 2e-3


def test_the_recorded_disturbance_is_the_one_that_acted():
    """A callable with a memory of its own is asked once per plant step, and what it said is what is written."""
    rng = np.random.default_rng(0)
    said = []
    run = simulate(PLANT, SILENT, STILL, 0.03, 0.01, plant_step=0.01, disturbance=lambda t, q, v: said.append(
        rng.normal(size=q.shape)) or said[-1])  # fmt: skip
    assert len(said) == 3
    np.testing.assert_array_equal(run.disturbance[:-1], said)
    np.testing.assert_array_equal(run.disturbance[-1], 0.0)
    np.testing.assert_allclose(np.diff(run.v, axis=0), 0.01 * np.array(said), rtol=1e-12)


@pytest.mark.parametrize("law", ["memoryless", "pid"])
def test_a_stream_is_the_run_in_pieces(law):
    """Block by block, the very numbers of one simulation, for laws with and without memory."""
    pid = nbs.PID(kp=np.full(2, 50.0), ki=np.full(2, 20.0), kd=np.full(2, 10.0), effort_limit=np.full(2, 5.0))
    controller = pid if law == "pid" else PD
    options = {"q0": np.ones((3, 2)), "disturbance": SquareWave(1.0, 9.0), "effort_limit": 5.0}
    whole = simulate(PLANT, controller, MOVING, 1.0, 0.01, **options)
    pieces = list(stream(PLANT, controller, MOVING, 1.0, 0.01, block=37, **options))
    assert [len(piece.t) - 1 for piece in pieces] == [37, 37, 26]
    for name in ("t", "q", "v", "tau", "tau_command", "disturbance", "q_ref"):
        joined = np.concatenate([*(getattr(piece, name)[:-1] for piece in pieces), getattr(pieces[-1], name)[-1:]])
        np.testing.assert_array_equal(joined, getattr(whole, name))
    with pytest.raises(ArgumentError, match="block is 0; give a whole number of periods"):
        next(stream(PLANT, controller, MOVING, 1.0, 0.01, block=0))


class Payload(MujocoPlant):
    """A plant of the user's own: the base class and a constant torque."""

    def step(self, q, v, tau, duration):
        return super().step(q, v, tau + 0.5, duration)


@pytest.mark.parametrize("law", ["nbs", "pid"])
def test_workers_share_the_starts(law):
    """Any number of processes gives the run of one: same plant, same noise for each start, same notes."""
    robot = load_robot("three_link")
    controller = nbs.NeuralBackstepping.for_robot(robot) if law == "nbs" else nbs.PID.for_robot(robot)
    plant, reference = Payload(robot), Sinusoid.for_robot(robot)
    plant.model.body_mass[:] *= 2.0
    rng = np.random.default_rng(0)
    options = {"q0": rng.normal(size=(5, 2, 3)), "v0": rng.normal(size=(2, 3)), "disturbance": TorqueNoise(1.0, 0.002)}
    alone = simulate(plant, controller, reference, 0.02, 0.001, **options)
    shared = simulate(plant, controller, reference, 0.02, 0.001, **options, workers=2)
    for name in ("q", "v", "tau", "tau_command", "disturbance", "q_ref", "a_ref"):
        np.testing.assert_allclose(getattr(shared, name), getattr(alone, name), rtol=1e-9, atol=1e-9)
    assert shared.info == alone.info
    assert np.ptp(alone.disturbance[:-1], axis=1).min() > 0.0


def test_a_stream_does_not_depend_on_what_its_reader_does_with_a_run():
    whole = simulate(PLANT, PD, MOVING, 0.2, 0.01, q0=np.ones(2))
    for run in stream(PLANT, PD, MOVING, 0.2, 0.01, q0=np.ones(2), block=5):
        last = run.q[-1].copy()
        run.q[:] = 1e6
    np.testing.assert_array_equal(last, whole.q[-1])


def test_a_stream_is_refused_before_it_begins():
    with pytest.raises(ArgumentError, match="duration is -1"):
        stream(PLANT, PD, STILL, -1.0, 0.01)


def test_threads_may_share_a_compiled_controller():
    """Each simulation takes scratch space of its own."""
    robot = load_robot("three_link")
    fast, reference = nbs.NeuralBackstepping.for_robot(robot).compile(), Sinusoid.for_robot(robot)

    def run(shift: float) -> np.ndarray:
        start = reference(0.0).q + shift
        return simulate(MujocoPlant(robot), fast, reference, 0.2, 0.001, q0=start).q

    shifts = [0.1, 0.2, 0.3]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(run, shifts))
    for shift, q in zip(shifts, together, strict=True):
        np.testing.assert_array_equal(q, run(shift))


def test_a_law_that_is_also_a_torch_module_is_simulated():
    """torch.nn.Module has a `compile` of its own, which is not a law's."""

    class Mine(torch.nn.Module, MemorylessController):
        nv = 2

        def torque(self, q, v, q_ref, v_ref, a_ref):
            return -q - v

    run = simulate(PLANT, Mine(), STILL, 0.1, 0.01, q0=np.ones(2))
    assert run.info["controller"] == "Mine"


def test_a_motion_is_not_asked_for_what_comes_after_its_end():
    """A reference that ends in motion: looking ahead of the last instant would see it stop dead."""
    t = np.linspace(0.0, 1.0, 101)
    run = simulate(PLANT, PD, nbs.Sampled(t, np.stack([t, t**2], axis=-1)), 1.0, 0.01)
    assert np.abs(np.diff(run.tau, axis=0)[-1]).max() < 0.1


def test_the_default_plant_step_is_the_longest_within_a_millisecond():
    for period, step in ((0.01, 0.001), (0.001, 0.001), (0.0025, 0.0025 / 3), (2e-4, 2e-4), (1 / 240, 1 / 1200)):
        run = simulate(PLANT, SILENT, STILL, period, period)
        assert run.info["plant_step"] == pytest.approx(step, rel=1e-9)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"duration": -1.0}, "duration is -1.0"),
        ({"duration": 0.0}, "duration is 0.0"),
        ({"duration": np.nan}, "duration is nan"),
        ({"duration": np.inf}, "duration is inf"),
        ({"duration": 0.105}, "10.5 times the period"),
        ({"duration": 0.001}, "0.1 times the period"),
        ({"period": 0.0}, "period is 0.0"),
        ({"period": np.nan}, "period is nan"),
        ({"plant_step": 0.003}, "times the plant_step"),
        ({"plant_step": 0.02}, "times the plant_step"),
        ({"plant_step": -0.001}, "plant_step is"),
        ({"lookahead": -0.1}, r"lookahead is -0\.1; give a finite number ≥ 0"),
        ({"q0": [1.0, 2.0, 3.0]}, "q0 has shape"),
        ({"q0": 1.0}, "q0 has shape"),
        ({"q0": np.zeros((0, 2))}, "q0 has shape"),
        ({"q0": [np.nan, 0.0]}, "q0 is"),
        ({"v0": [np.inf, 0.0]}, "v0 is"),
        ({"q0": np.zeros((2, 2)), "v0": np.zeros((3, 2))}, "do not broadcast"),
        ({"q0": np.zeros(2), "workers": 2}, r"q0 has shape \(2,\); give q0 of shape \(starts, \.\.\., nv\)"),
        ({"q0": np.zeros((4, 2)), "v0": np.zeros((3, 2)), "workers": 2}, "the starts do not broadcast"),
        ({"q0": np.zeros((4, 2)), "workers": 0}, "workers is 0; give a whole number"),
        ({"effort_limit": -1.0}, "effort_limit"),
        ({"effort_limit": [1.0, np.nan]}, "effort_limit"),
        ({"effort_limit": [1.0, 1.0, 1.0]}, "effort_limit"),
        ({"reference": Hold([0.0])}, "the reference has 1 joints, the arm has 2"),
        ({"reference": lambda t: Reference(np.zeros(2), np.zeros(2), np.zeros(2))}, "arrays of times"),
        ({"reference": lambda t: Reference(*np.full((3, *t.shape, 2), np.nan))}, "expected a finite number"),
        ({"controller": Law(lambda q, v, ref: q, nv=3)}, "3 joints and the plant 2"),
        ({"disturbance": lambda t, q, v: np.zeros(3)}, "the disturbance at t = 0 s has shape"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(options, reason):
    arguments = {"controller": SILENT, "reference": STILL, "duration": 0.1, "period": 0.01} | options
    with pytest.raises(ArgumentError, match=reason):
        simulate(PLANT, **arguments)


class Raw(Counter):
    """A controller from outside the package, whose torque nobody has checked."""

    def __init__(self, torque):
        self.torque = torque

    def step(self, memory, q, v, reference, period):
        return (0.0 * q if memory < 3 else self.torque), memory + 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_torque_that_is_not_finite_stops_the_run_before_any_clip(value):
    with pytest.raises(SimulationDiverged, match=r"Raw commanded the torque .* at t = 0\.03 s"):
        simulate(PLANT, Raw([0.0, value]), STILL, 0.1, 0.01, effort_limit=1.0)


@pytest.mark.parametrize("torque", [[1.0], 1.0, [[1.0, 1.0]], [1.0, 2.0, 3.0]])
def test_a_torque_of_another_shape_stops_the_run(torque):
    with pytest.raises(ArgumentError, match=r"Raw gave a torque of shape .* at t = 0\.03 s, expected \(2,\)"):
        simulate(PLANT, Raw(torque), STILL, 0.1, 0.01)


def test_a_disturbance_that_is_not_finite_stops_the_run():
    with pytest.raises(SimulationDiverged, match=r"after t = 0\.01 s: the disturbance at t = 0\.016 s"):
        simulate(PLANT, SILENT, STILL, 0.1, 0.01, disturbance=lambda t, q, v: np.full(N, np.nan if t > 0.015 else 0.0))


def test_an_unstable_loop_is_reported_with_its_time_and_no_warnings():
    wild = Law(lambda q, v, ref: 1e4 * q**3)
    plant = DynamicsPlant(Masses(), "euler")
    with pytest.raises(SimulationDiverged, match=r"Law commanded the torque .*inf.* at t = 0\.\d+ s"):
        simulate(plant, wild, STILL, 1.0, 0.01, q0=[1.0, 1.0], plant_step=0.01)


def test_a_diverging_mujoco_arm_is_reported_and_not_put_back_to_its_start(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot = load_robot("three_link")
    wild = Law(lambda q, v, ref: 1e5 * (v + 1.0), 3)
    with pytest.raises(SimulationDiverged, match=r"after t = .* s: MujocoPlant\(three_link"):
        simulate(MujocoPlant(robot), wild, Hold(np.zeros(3)), 1.0, 0.01, effort_limit=np.inf)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_errors_and_ctrl_c_of_a_controller_come_through(error):
    def fail(q, v, ref):
        raise error

    with pytest.raises(error):
        simulate(PLANT, Law(fail), STILL, 0.1, 0.01)


def test_a_run_says_what_was_simulated():
    run = simulate(PLANT, PD, STILL, 0.1, 0.01)
    plant = {"plant": "DynamicsPlant(Masses, rk4)", "plant_step": 0.001}
    assert run.info == {"controller": "Law", "lookahead": 0.005, **plant}


Q = np.zeros((4, 2))


def test_disturbances_are_what_they_say():
    np.testing.assert_array_equal(ConstantTorque([1.0, 2.0])(3.0, Q, Q), np.tile([1.0, 2.0], (4, 1)))
    np.testing.assert_allclose(SinusoidalTorque(2.0, [1.0, 3.0], 0.5)(0.7, Q, Q)[0], 2.0 * np.sin([1.2, 2.6]))
    wave = SquareWave([1.0, 2.0], np.pi)
    assert [wave(t, Q[0], Q[0]).tolist() for t in (0.0, 0.5, 1.5, 2.5)] == [[1, 2], [1, 2], [-1, -2], [1, 2]]


def test_noise_is_white_reproducible_and_constant_over_its_period():
    noise = TorqueNoise([0.5, 2.0], 0.01, seed=3)
    samples = np.array([noise(0.01 * k, Q, Q) for k in range(2000)]).reshape(-1, 4, 2)
    np.testing.assert_allclose(samples.std(axis=(0, 1)), [0.5, 2.0], rtol=0.05)
    assert np.abs(samples.mean(axis=(0, 1)) / [0.5, 2.0]).max() < 0.05
    assert abs(np.corrcoef(samples[:-1, 0, 0], samples[1:, 0, 0])[0, 1]) < 0.08
    np.testing.assert_array_equal(noise(0.57, Q, Q), samples[57])
    np.testing.assert_array_equal(noise(0.5799, Q, Q), samples[57])
    np.testing.assert_array_equal(TorqueNoise([0.5, 2.0], 0.01, seed=3)(0.57, Q, Q), samples[57])
    assert not np.allclose(TorqueNoise([0.5, 2.0], 0.01, seed=4)(0.57, Q, Q), samples[57])


@pytest.mark.parametrize(
    "make",
    [
        lambda: ConstantTorque(np.nan),
        lambda: SinusoidalTorque(1.0, np.inf),
        lambda: SquareWave([[1.0]], 1.0),
        lambda: TorqueNoise(1.0, 0.0),
        lambda: TorqueNoise(1.0, 0.01, -1),
    ],
)
def test_disturbances_that_make_no_sense_are_refused(make):
    with pytest.raises(ArgumentError):
        make()


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_shows_only_at_a_terminal_and_only_for_long_work(monkeypatch):
    clock = iter(range(1000))
    monkeypatch.setattr("nbs_pin.base.progress.time.perf_counter", lambda: 0.3 * next(clock))
    monkeypatch.setattr(sys, "stderr", quick := Terminal())
    assert list(tracked(range(5), "working")) == [0, 1, 2, 3, 4]
    assert "working" not in quick.getvalue()
    monkeypatch.setattr("nbs_pin.base.progress.time.perf_counter", lambda: float(next(clock)))
    assert list(tracked(range(5), "working", show=False)) == [0, 1, 2, 3, 4]
    assert quick.getvalue().count("working") == 0
    assert list(tracked(range(5), "working")) == [0, 1, 2, 3, 4]
    assert "working" in quick.getvalue()
    monkeypatch.setattr(sys, "stderr", pipe := io.StringIO())
    assert list(tracked(range(5), "working")) == [0, 1, 2, 3, 4]
    assert pipe.getvalue() == ""
