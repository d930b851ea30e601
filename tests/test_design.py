"""Gains from the bound: what is proposed is certified, calm, inside the limits; what cannot be is refused with why."""

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.claims import Label
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.certify import certify
from nbs_pin.certificates.margins import sampled_control
from nbs_pin.certificates.propose import FAST, PERIODS, STIFF, propose

"""Without the annotations' own checks, as a user has it."""
WISHES = [("two_link", 0.02, 5.0), ("panda", 0.2, 1.0)]


@pytest.fixture(scope="module", params=WISHES, ids=lambda wish: wish[0])
def wished(request):
    """The arm, the error and the torque asked for, and the proposal."""
    name, error, torque = request.param
    robot = nbs.load_robot(name)
    bounds = np.full(robot.nv, torque)
    return robot, error, bounds, propose(robot, bounds, error)


def test_the_certificate_shows_the_wanted_error(wished):
    _, error, bounds, proposal = wished
    certificate = certify(proposal.controller, bounds, period=proposal.period)
    assert certificate.error <= error
    assert certificate.error <= proposal.error * (1.0 + 1e-6)
    assert certificate.label is Label.PROVED
    assert (certificate.joint_errors <= proposal.joint_errors * (1.0 + 1e-6)).all()
    assert proposal.error > 0.99 * error


def test_the_controller_has_the_gains_proposed(wished):
    _, _, _, proposal = wished
    controller, gains = proposal.controller, proposal.gains
    np.testing.assert_array_equal(controller.potential.stiffness.numpy(), np.diag(0.5 * gains.stiffness))
    np.testing.assert_array_equal(controller.damping.floor.numpy(), np.diag(gains.damping))
    np.testing.assert_array_equal(controller.rate.numpy(), gains.rate)
    assert controller.inertial_rate == gains.bandwidth


def test_the_margins_are_kept_and_by_no_longer_period(wished):
    robot, error, bounds, proposal = wished
    assert proposal.stiff <= STIFF
    assert proposal.fast <= FAST
    assert all(condition.holds for condition in sampled_control(proposal.controller, proposal.period)[1])
    assert (proposal.torque <= robot.effort_limit).all()
    assert proposal.share == pytest.approx((proposal.torque / robot.effort_limit).max())
    assert propose(robot, bounds, error, periods=(proposal.period,)).gains.bandwidth == proposal.gains.bandwidth
    longer = [period for period in PERIODS if period > proposal.period]
    if longer:
        with pytest.raises(ArgumentError, match="control period"):
            propose(robot, bounds, error, periods=longer)


def test_the_loop_is_calm_under_the_disturbance_and_within_the_error(wished):
    """Sampled at the proposed period, with the arm's own limits."""
    robot, error, bounds, proposal = wished
    wave = nbs.SquareWave(bounds * (-1.0) ** np.arange(robot.nv), proposal.gains.bandwidth)
    plant, reference = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot)), nbs.Sinusoid.for_robot(robot)
    run = nbs.simulate(plant, proposal.controller, reference, 1.0, proposal.period, disturbance=wave)
    assert np.linalg.norm(run.q - run.q_ref, axis=-1).max() <= error
    assert not (np.abs(run.tau_command) > robot.effort_limit).any()


def test_a_stiffer_wish_costs_a_faster_loop_and_the_same_torque():
    """Errors fall with the square of the speed of the loop; the stiffness at its bound does not change.

    The motion states no bound of its jerk, so that nothing of held torques is added to the bounds.
    """
    robot = nbs.load_robot("two_link").with_effort_limit(np.inf)
    smooth = nbs.Sinusoid.for_robot(robot)

    def motion(t):
        return smooth(t)

    soft, hard = (propose(robot, np.full(2, 5.0), error, reference=motion, periods=(1e-5,)) for error in (0.01, 0.0001))
    assert hard.gains.bandwidth == pytest.approx(10.0 * soft.gains.bandwidth, rel=1e-3)
    np.testing.assert_allclose(hard.gains.stiffness, 100.0 * soft.gains.stiffness, rtol=1e-3)
    np.testing.assert_allclose(hard.torque, soft.torque, rtol=1e-3)
    assert soft.share == 0.0


def test_errors_can_be_wished_for_each_joint_and_disturbances_be_balls():
    robot, wanted = nbs.load_robot("two_link"), np.array([0.004, 0.05])
    proposal = propose(robot, Admissible(radius=4.0), wanted)
    certificate = certify(proposal.controller, Admissible(radius=4.0))
    assert (certificate.joint_errors <= wanted).all()
    assert (proposal.joint_errors / wanted).max() > 0.99


@pytest.mark.parametrize(
    ("torque", "error", "options", "words"),
    [
        (90.0, 0.05, {}, "joint 'joint1' of two_link gives 100 N·m, and reference and disturbance alone take"),
        (60.0, 0.05, {}, "the torque limit of joint 'joint1' of two_link forbids it"),
        (5.0, 1e-6, {}, "a control period of 0.25 ms forbids it"),
        (5.0, 0.01, {"periods": (0.1,)}, "a control period of 100 ms forbids it: .* at most"),
        (5.0, -0.01, {}, "the wanted error is -0.01"),
        (5.0, [0.1, 0.1, 0.1], {}, "one number > 0, or 2"),
        (5.0, 0.01, {"periods": ()}, "periods is .*; give a list of 1 to 1000 control periods"),
        (5.0, 0.01, {"periods": (-1.0,)}, r"periods\[0\] is -1"),
        (5.0, 0.01, {"periods": 0.001}, "periods is 0.001; give a list"),
        (5.0, 0.01, {"periods": "fast"}, "periods is 'fast'; give a list"),
        (5.0, 0.01, {"reference": 3}, "reference is 3; give a motion"),
        (5.0, 0.01, {"reference": nbs.Hold(np.zeros(3))}, "the reference has 3 joints, the arm has 2"),
        (5.0, 0.01, {"duration": -1.0}, "duration is -1"),
        (5.0, 0.01, {"dynamics": 3}, "dynamics is 3; give a model"),
        (0.0, 0.01, {}, "does not determine the gains"),
    ],
)
def test_what_forbids_a_design_is_said(torque, error, options, words):
    robot = nbs.load_robot("two_link")
    with pytest.raises(ArgumentError, match=words):
        propose(robot, np.full(2, torque), error, **options)


@pytest.mark.parametrize("arm", ["two_link", None, 3])
def test_a_design_is_for_an_arm(arm):
    with pytest.raises(ArgumentError, match=r"robot is .*; give an arm, as load_robot returns it"):
        propose(arm, [1.0, 1.0], 0.1)


def test_a_design_is_not_for_a_controller_or_the_model_of_another_arm():
    robot = nbs.load_robot("two_link")
    with pytest.raises(ArgumentError, match="robot is a NeuralBackstepping; give an arm"):
        propose(nbs.NeuralBackstepping.for_robot(robot), [1.0, 1.0], 0.1)
    with pytest.raises(ArgumentError, match="of 7 joints, expected a model of the 2 joints"):
        propose(robot, [1.0, 1.0], 0.1, dynamics=nbs.PinocchioDynamics(nbs.load_robot("panda")))
