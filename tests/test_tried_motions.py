"""Certificates try motions of the loop as it runs: what one of them breaks is not PROVED."""

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.claims import Label
from nbs_pin.certificates import tried_motions
from nbs_pin.certificates.claims import Assumption, Role
from nbs_pin.certificates.tried_motions import MOTIONS, PERIODS, PLANT_STEPS, TriedMotions

SIMULATED = "in simulation"


def motion_of(robot, frequency=1.0):
    return nbs.Sinusoid.for_robot(robot, frequency=frequency)


def tried(law, robot, *, torque=1.0, period=1e-3, duration=0.5, start=None, friction=None, lookahead=None):
    none = nbs.JointFriction(np.zeros(robot.nv), np.zeros(robot.nv))
    box = torque if isinstance(torque, nbs.Admissible) else nbs.Admissible.of(np.full(robot.nv, torque), robot.nv)
    return TriedMotions.of(law, robot, friction or none, box, motion_of(robot), duration, period, start, lookahead)


@pytest.mark.parametrize("limit", [79.0, 1000.0])
def test_a_torque_that_is_cut_off_in_a_simulated_motion_ends_the_proof(limit):
    """Reference, disturbance and start together need 76.6 N·m; with the feedback on the way it is 81.7 N·m."""
    robot = nbs.load_robot("three_link")
    law = nbs.NeuralBackstepping.for_robot(robot, bandwidth=4.0, period=0.01)
    reference = motion_of(robot, 2.0)
    arm, given = robot.with_effort_limit(limit), {"reference": reference, "duration": 2.0, "period": 0.002}
    found = nbs.certify(law, np.full(3, 20.0), robot=arm, **given)
    cut = [x for x in found.conditions if x.checks is Assumption.EFFORT and not x.holds and x.role is Role.NECESSARY]
    assert [x.name for x in cut] == (list(found.void) if limit == 79.0 else [])
    assert all(SIMULATED in x.name for x in cut)
    assert found.label is (Label.EMPIRICAL if limit == 79.0 else Label.PROVED)


@pytest.mark.parametrize("radius", [None, 3.0])
def test_kernels_and_the_loop_of_simulate_agree(monkeypatch, radius):
    robot = nbs.load_robot("ur5")
    law = nbs.NeuralBackstepping.for_robot(robot)
    box = nbs.Admissible.of(np.full(6, 2.0) if radius is None else radius, 6)
    begin = motion_of(robot)(0.0)
    start = begin.q + 0.1, begin.v
    by_kernels = tried(law, robot, torque=box, start=start, duration=0.1)
    monkeypatch.setattr(tried_motions, "engine_for", lambda *_: "torch")
    by_simulate = tried(law, robot, torque=box, start=start, duration=0.1)
    np.testing.assert_allclose(by_simulate.errors, by_kernels.errors, rtol=1e-9)
    np.testing.assert_allclose(by_simulate.torque, by_kernels.torque, rtol=1e-9)


def test_friction_is_that_of_the_arm_and_moves_in_mujoco():
    """Friction of 10 N·m·s/rad on 1e-4 kg·m² is too stiff for explicit steps; fed forward, it leaves no error."""
    robot = nbs.load_robot("xarm7")
    friction = nbs.JointFriction.of(robot)
    fed, bare = (nbs.NeuralBackstepping.for_robot(robot, friction=f) for f in (friction, None))
    errors = [tried(law, robot, torque=0.01, friction=friction).errors.max() for law in (fed, bare)]
    assert errors[0] < 0.2 * errors[1]
    assert errors[1] < 1.0


def test_a_loop_that_diverges_breaks_every_bound():
    robot = nbs.load_robot("panda")
    law = nbs.NeuralBackstepping.for_robot(robot, bandwidth=20.0, period=1e-3)
    found = tried(law, robot, period=0.05, duration=2.0)
    assert np.isinf(found.errors).all()
    assert np.isinf(found.torque).all()
    assert [x.holds for x in found.conditions(robot, np.full(7, 1e6))] == [False, False]


def test_the_length_is_that_of_the_motion_up_to_a_number_of_periods():
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot)
    assert tried(law, robot, duration=0.0005) is None
    assert tried(law, robot, duration=0.3).duration == pytest.approx(0.3)
    assert tried(law, robot, duration=1e3).duration == pytest.approx(PERIODS * 1e-3)
    assert f"{MOTIONS} motions" in tried(law, robot, duration=0.1).conditions(robot, np.ones(2))[0].because


def test_a_payload_moves_with_the_arm():
    """The law of an arm held out straight is asked for what the payload weighs, on top of what the arm does."""
    robot = nbs.load_robot("ur5").with_effort_limit(100.0)
    law = nbs.NeuralBackstepping.for_robot(robot)
    reference, payload = nbs.Hold(np.zeros(6)), nbs.Payload(1.0)
    given = {"reference": reference, "period": 1e-3, "uncertainty": nbs.Uncertainty(payload=payload)}
    found = nbs.certify(law, np.zeros(6), **given)
    (seen,) = [x for x in found.conditions if x.checks is Assumption.EFFORT and SIMULATED in x.name]
    arm, loaded = (abs(nbs.PinocchioDynamics(x).gravity(np.zeros(6))[1]) for x in (robot, payload.on(robot)))
    assert loaded > 1.05 * arm
    assert loaded < seen.right < 1.05 * loaded


POINTS = """<robot name="points"><link name="base"/>
{links}</robot>"""
LINK = """<link name="l{k}"><inertial><origin xyz="0 0 -0.5"/><mass value="1"/>
<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link>
<joint name="j{k}" type="revolute"><parent link="{parent}"/><child link="l{k}"/>
<origin xyz="0 0 {z}"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="100" velocity="10"/><dynamics damping="0.1"/></joint>"""


def test_an_arm_of_point_masses_with_friction_which_mujoco_refuses_is_tried_too(tmp_path):
    path = tmp_path / "points.urdf"
    links = "".join(LINK.format(k=k, parent="l0" if k else "base", z=-1.0 if k else 0.0) for k in range(2))
    path.write_text(POINTS.format(links=links))
    robot = nbs.load_robot(path)
    law = nbs.NeuralBackstepping.for_robot(robot)
    found = nbs.certify(law, [0.5, 0.5], reference=nbs.Hold([0.3, 0.2]), duration=0.2, period=1e-3)
    (seen,) = [x for x in found.conditions if x.checks is Assumption.TIME and SIMULATED in x.name]
    assert 0.0 < seen.right < seen.left


def test_a_look_ahead_is_that_of_the_loop_and_late_loops_are_not_simulated():
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot)
    errors = [tried(law, robot, torque=0.0, period=5e-3, lookahead=x).errors.max() for x in (None, 0.0, 5e-3)]
    assert errors[0] < 0.2 * min(errors[1:])
    found = nbs.certify(law, [1.0, 1.0], reference=motion_of(robot), period=1e-3, delay=1e-3)
    assert not [x for x in found.conditions if SIMULATED in x.name]


def test_joints_without_a_limit_are_not_blamed_for_a_motion_that_diverged():
    robot = nbs.load_robot("panda").with_effort_limit([np.inf] * 6 + [12.0])
    none = np.full(7, np.inf)
    _, cut = TriedMotions(MOTIONS, 1.0, none, none).conditions(robot, none)
    assert cut.name.startswith("effort limit of panda_joint7")
    assert not cut.holds


def test_plant_steps_are_limited_too():
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot, period=0.02)
    found = tried(law, robot, torque=0.0, period=0.02, duration=1e3)
    assert found.count == 1
    assert found.duration == pytest.approx(0.02 * (PLANT_STEPS // 20))


def test_an_unknown_payload_comes_on_top_of_a_known_one():
    robot = nbs.load_robot("ur5").with_payload("tool0", 3.0)
    law = nbs.NeuralBackstepping.for_robot(robot)
    payload = nbs.Payload(0.2, link="tool0")
    given = {"reference": motion_of(robot), "period": 1e-3, "uncertainty": nbs.Uncertainty(payload=payload)}
    found = nbs.certify(law, np.zeros(6), **given)
    weights = [sum(body.mass for body in arm.model.inertias) for arm in (robot, payload.on(robot))]
    assert weights[1] - weights[0] == pytest.approx(0.2)
    assert found.label is Label.PROVED, found.void
