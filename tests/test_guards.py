"""What `simulate` refuses before it starts, joint stops, and what a run says that it left out."""

import numpy as np
import pytest
from commands import summary

import nbs_pin as nbs
from nbs_pin import cli


@pytest.fixture(scope="module")
def ur5():
    return nbs.load_robot("ur5")


@pytest.fixture(scope="module")
def law(ur5):
    return nbs.NeuralBackstepping.for_robot(ur5)


def simulated(robot, law, motion=None, **options):
    return nbs.simulate(nbs.MujocoPlant(robot), law, motion or nbs.Sinusoid.for_robot(robot), 0.05, 0.001, **options)


def faults(robot):
    """Motions and starts of an arm, and what is wrong with them."""
    heavy = robot.with_effort_limit(1.0)
    home = nbs.Sinusoid.for_robot(robot)(0.0).q
    fast = nbs.MinimumJerk([home, home + 0.5], [0.0, 0.05])
    return {
        "degrees": (robot, {"motion": nbs.Hold(np.full(6, 90.0))}, "position 90 rad.*are these degrees"),
        "range": (robot, {"motion": nbs.Hold([*home[:5], 6.5])}, r"'wrist_3_joint' at t = 0 s, outside \[-6.28"),
        "velocity": (robot, {"motion": fast}, "needs the velocity .* slow it down"),
        "effort": (heavy, {}, "needs the torque .* raise the limit"),
        "start": (robot, {"q0": [*home[:5], 45.0]}, "start 45 rad of joint 'wrist_3_joint' .*degrees.*check=False"),
        "one of many starts": (robot, {"q0": [home, [*home[:5], 6.5]]}, "start 6.5 rad of joint 'wrist_3_joint'"),
    }


@pytest.mark.parametrize("fault", ["degrees", "range", "velocity", "effort", "start", "one of many starts"])
def test_what_the_arm_cannot_do_is_refused_unless_asked_for(ur5, law, fault):
    robot, options, said = faults(ur5)[fault]
    with pytest.raises(nbs.ArgumentError, match=said):
        simulated(robot, law, **options)
    streamed = options.get("motion", nbs.Sinusoid.for_robot(robot))
    if fault != "one of many starts":
        with pytest.raises(nbs.ArgumentError, match=said):
            nbs.stream(nbs.MujocoPlant(robot), law, streamed, 0.05, 0.001, q0=options.get("q0"))
    if fault == "effort":
        assert np.abs(simulated(robot, law, check=False).tau).max() <= 1.0


def test_a_law_of_another_arm_is_refused(ur5, law, tmp_path):
    """Another arm is a mistake; another mass, load or friction is what a law may not know."""
    for other, said in (
        ("ur10", "joint 'shoulder_lift_joint' is of another"),
        ("talos_left_arm", "its joints are arm_left"),
    ):
        lock = {"lock": ["arm_left_7_joint"]} if other == "talos_left_arm" else {}
        wrong = nbs.PD.for_robot(nbs.load_robot(other, **lock))
        with pytest.raises(nbs.ArgumentError, match=f"the law is for {other} and the plant is ur5: {said}"):
            simulated(ur5, wrong)
    turned = nbs.load_robot("two_link").urdf.path.read_text().replace('xyz="0 -1 0"', 'xyz="0 1 0"', 1)
    (tmp_path / "two_link.urdf").write_text(turned)
    with pytest.raises(nbs.ArgumentError, match="joint 'joint1' is of another"):
        simulated(nbs.load_robot("two_link"), nbs.PD.for_robot(nbs.load_robot(tmp_path / "two_link.urdf")))
    simulated(ur5.with_payload("tool0", 2.0).with_armature(0.1).with_friction(0.5), law)
    simulated(nbs.load_robot("ur5", base_rpy=[0.5, 0.0, 1.0], base_xyz=[0.0, 0.0, 1.0]), law)
    simulated(ur5, law.compile())


def test_effort_limits_are_those_of_the_call(ur5, law):
    with pytest.raises(nbs.ArgumentError, match="needs the torque"):
        simulated(ur5, law, effort_limit=0.5)
    simulated(ur5.with_effort_limit(0.5), law, effort_limit=np.inf)


def test_joint_stops_hold_the_arm_in_its_range():
    """Without effort limits a constant torque drives two_link through its stops, or against them."""
    robot = nbs.load_robot("two_link", limits={"*": {"lower": -0.5, "upper": 0.5}})
    law = nbs.PD.for_robot(robot)
    push = {"disturbance": lambda t, q, v: np.full(2, 60.0), "check": False}
    free, held = (
        nbs.simulate(nbs.MujocoPlant(robot, joint_stops=stops), law, nbs.Hold([0.45, 0.45]), 1.0, 0.001, **push)
        for stops in ("drop", "keep")
    )
    assert free.q.max() > 0.6
    assert held.q.max() < 0.505
    inside = free.q[: np.argmax(free.q.max(axis=1) > 0.5)]
    np.testing.assert_allclose(held.q[: len(inside)], inside, atol=1e-9)
    with pytest.raises(nbs.ArgumentError, match="pinocchio has no joint stops; plant='mujoco' has"):
        nbs.DynamicsPlant.for_robot(robot, joint_stops="keep")


def test_the_summary_says_what_was_left_out(tmp_path):
    out = ["--duration", "0.1", "--out", str(tmp_path / "out"), "--force"]
    assert cli.main(["track", "xarm7", *out]) == 0
    friction, rotor = summary(tmp_path / "out")["figures"]["not_simulated"]
    assert friction == "joint friction, viscous up to 10 and Coulomb up to 1: --joint-friction keep"
    assert rotor.startswith("rotor inertia of joint1, joint2")
    assert cli.main(["track", "two_link", "--joint-stops", "keep", *out]) == 0
    assert summary(tmp_path / "out")["figures"]["not_simulated"] == []
