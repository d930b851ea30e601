"""The run of one kernel is the run of `simulate`, and what has no kernel says so."""

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.controllers.registry import build_law
from nbs_pin.simulation.fused import Fused

DISTURBANCES = {
    "none": None,
    "constant": nbs.ConstantTorque(1.0),
    "square": nbs.SquareWave([1.0, -2.0], 8.0),
    "sine": nbs.SinusoidalTorque(2.0, [8.0, 3.0], 0.3),
    "noise": nbs.TorqueNoise(0.5, 0.002, seed=2),
}


@pytest.fixture(scope="module")
def robot():
    return nbs.load_robot("two_link").with_effort_limit([60.0, 25.0])


def both(plant, law, motion, *where, **settings):
    fused = Fused.of(plant, law, motion, *where, **settings)
    return fused.run(), nbs.simulate(plant, law, motion, *where, **settings)


def assert_equal(ours, simulated):
    assert ours.info == simulated.info
    for name, values in simulated.signals.items():
        np.testing.assert_allclose(getattr(ours, name), values, rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("name", ["nbs", "nbs-paper", "slotine-li", "computed-torque", "pd-plus", "pd-gravity", "pid"])
def test_every_law_with_a_rollout_runs_as_in_simulate(robot, name):
    law, motion = build_law(name, robot, bandwidth=5.0, period=0.001), nbs.Sinusoid.for_robot(robot)
    plant = nbs.DynamicsPlant.for_robot(robot)
    q0 = motion(0.0).q + np.array([0.6, -0.4])
    ours, simulated = both(plant, law, motion, 0.3, 0.001, q0=q0, disturbance=DISTURBANCES["square"])
    assert_equal(ours, simulated)
    assert name == "nbs-paper" or (np.abs(simulated.tau_command) > simulated.effort_limit).any()  # they were at work


@pytest.mark.parametrize("disturbance", DISTURBANCES)
@pytest.mark.parametrize("integrator", ["rk4", "semi_implicit_euler", "euler"])
def test_disturbances_and_integrators_are_those_of_simulate(robot, disturbance, integrator):
    law, motion = nbs.PID.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    friction = nbs.JointFriction(np.full(2, 0.3), np.full(2, 0.2))
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot), integrator, friction)
    assert_equal(*both(plant, law, motion, 0.2, 0.001, disturbance=DISTURBANCES[disturbance], lookahead=0.0))


def test_plant_steps_within_a_period_hold_the_disturbance(robot):
    law, motion = nbs.PD.for_robot(robot, period=0.004), nbs.Sinusoid.for_robot(robot)
    plant = nbs.DynamicsPlant.for_robot(robot)
    assert_equal(*both(plant, law, motion, 0.2, 0.004, disturbance=DISTURBANCES["constant"]))
    assert Fused.of(plant, law, motion, 0.2, 0.004, disturbance=DISTURBANCES["sine"]) is None


def test_what_has_no_kernel_is_none(robot):
    motion, plant = nbs.Sinusoid.for_robot(robot), nbs.DynamicsPlant.for_robot(robot)
    assert Fused.of(plant, nbs.SlidingMode.for_robot(robot), motion, 0.1, 0.001) is None
    assert Fused.of(nbs.MujocoPlant(robot), nbs.PD.for_robot(robot), motion, 0.1, 0.001) is None
    assert Fused.of(plant, nbs.PD.for_robot(robot), motion, 0.1, 0.001, disturbance=lambda t, q, v: 0.0 * q) is None


def test_what_simulate_refuses_is_refused(robot):
    law, plant = nbs.PD.for_robot(robot), nbs.DynamicsPlant.for_robot(robot)
    with pytest.raises(nbs.ArgumentError, match="whole number"):
        Fused.of(plant, law, nbs.Hold([0.0, 0.0]), 0.1005, 0.001)
    with pytest.raises(nbs.ArgumentError, match="outside"):
        Fused.of(plant, law, nbs.Hold([0.0, 0.0]), 0.1, 0.001, q0=[99.0, 0.0])


def test_divergence_is_told_with_its_time(robot):
    law = nbs.PD.for_robot(robot)
    settings = {"q0": [1.0, 1.0], "effort_limit": np.inf, "disturbance": None}
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot), "euler")
    with pytest.raises(nbs.SimulationDiverged) as told:
        nbs.simulate(plant, law, nbs.Hold([0.0, 0.0]), 100.0, 0.5, plant_step=0.5, **settings)
    fused = Fused.of(plant, law, nbs.Hold([0.0, 0.0]), 100.0, 0.5, plant_step=0.5, **settings)
    with pytest.raises(nbs.SimulationDiverged, match="at t = ") as ours:
        fused.run()
    at = float(str(ours.value).split("t = ")[1].split(" s")[0])
    assert abs(at - float(str(told.value).split("t = ")[1].split(" s")[0])) <= 1.0
