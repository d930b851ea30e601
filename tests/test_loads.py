"""Loads as disturbances: what a loaded arm really feels is inside them, and what they are called is true."""

import numpy as np
import pinocchio as pin
import pytest

import nbs_pin as nbs
from nbs_pin.base.claims import Label
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.loads import gravity_error, payload, total
from nbs_pin.robots.places import tool_frame

ARMS = ("two_link", "panda", "ur5", "kinova")


@pytest.fixture(scope="module", params=ARMS)
def robot(request):
    return nbs.load_robot(request.param)


def rail(limits='lower="-2" upper="3"'):
    """A slide that carries a turning link: the least tree with both kinds of joint."""
    link = (
        '<link name="{}"><inertial><origin xyz="{} 0 0"/><mass value="2"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
    return (
        f'<robot name="rail"><link name="base"/>{link.format("arm", 0.3)}{link.format("cart", 0.1)}'
        '<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="500" velocity="3"/></joint>'
        '<joint name="slide" type="prismatic"><parent link="arm"/><child link="cart"/><origin xyz="0.5 0 0"/>'
        f'<axis xyz="1 0 0"/><limit {limits} effort="500" velocity="3"/></joint></robot>'
    )


def loaded(robot, mass):
    """The arm with a point mass at its tool frame, built by another way than `payload`'s: a frame's Jacobian."""
    frame = robot.model.getFrameId(tool_frame(robot))
    data = robot.model.createData()

    def torque(q, v, a):
        pin.forwardKinematics(robot.model, data, q, v, a)
        pin.computeJointJacobians(robot.model, data, q)
        pin.updateFramePlacements(robot.model, data)
        around = pin.LOCAL_WORLD_ALIGNED
        jacobian = pin.getFrameJacobian(robot.model, data, frame, around)[:3]
        moved = pin.getFrameClassicalAcceleration(robot.model, data, frame, around).linear
        return jacobian.T @ (mass * (moved - robot.gravity_vector))

    return torque


def test_a_payload_takes_what_newton_says_along_the_reference(robot):
    reference = nbs.Sinusoid.for_robot(robot, 1.3)
    found = payload(robot, 0.7, reference, margin=1.0, duration=4.0)
    torque = loaded(robot, 0.7)
    wanted = np.array([np.abs(torque(*row)) for row in zip(*reference(np.linspace(0.0, 4.0, 2001)), strict=True)])
    np.testing.assert_allclose(found.box, wanted.max(axis=0), rtol=1e-9, atol=1e-9)
    assert found.label is Label.EMPIRICAL
    assert found.claims[0].value == found.box.max()


def test_margins_multiply(robot):
    reference = nbs.Sinusoid.for_robot(robot, 1.0)
    once, thrice = (payload(robot, 1.0, reference, margin=m).box for m in (1.0, 3.0))
    np.testing.assert_allclose(thrice, 3.0 * once)


def test_no_posture_and_no_direction_makes_a_gravity_error_larger_than_its_bound(robot):
    proved, rng, data = gravity_error(robot, 0.4), np.random.default_rng(1), robot.model.createData()
    model, worst = robot.model.copy(), np.zeros(robot.nv)
    for q in rng.uniform(-np.pi, np.pi, (2000, robot.nv)):
        direction = rng.standard_normal(3)
        model.gravity.linear = 0.4 * direction / np.linalg.norm(direction)
        worst = np.maximum(worst, np.abs(pin.computeGeneralizedGravity(model, data, q)))
    assert (worst <= proved.box).all()
    assert worst.max() > 0.4 * proved.box.max()
    assert proved.label is Label.PROVED


def test_along_a_reference_the_worst_direction_of_gravity_is_met_and_never_more_than_anywhere(robot):
    reference = nbs.Sinusoid.for_robot(robot, 1.0)
    found, everywhere = gravity_error(robot, 0.4, reference, margin=1.0), gravity_error(robot, 0.4)
    model, data, rng = robot.model.copy(), robot.model.createData(), np.random.default_rng(2)
    worst = np.zeros(robot.nv)
    for q in reference(np.linspace(0.0, 10.0, 201)).q:
        for direction in rng.standard_normal((20, 3)):
            model.gravity.linear = 0.4 * direction / np.linalg.norm(direction)
            worst = np.maximum(worst, np.abs(pin.computeGeneralizedGravity(model, data, q)))
    assert (worst <= found.box * (1.0 + 1e-9)).all()
    assert worst.max() > 0.8 * found.box.max()
    assert (gravity_error(robot, 0.4, reference, margin=50.0).box <= everywhere.box).all()


def test_a_slide_carries_its_whole_weight_and_lengthens_levers_by_its_travel(tmp_path):
    """The bodies of the arm and of the cart, 2 kg each, the cart's 0.6 m out and up to 3 m more."""
    path = tmp_path / "rail.urdf"
    path.write_text(rail())
    robot, g = nbs.load_robot(path), 9.81
    proved = gravity_error(robot, g)
    np.testing.assert_allclose(proved.box, [g * 2.0 * (0.3 + 0.6 + 3.0), g * 2.0], rtol=1e-6)
    model, data, worst = robot.model.copy(), robot.model.createData(), np.zeros(2)
    for axis in np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]):
        model.gravity.linear = g * axis
        for q in np.random.default_rng(0).uniform([-3.0, -2.0], [3.0, 3.0], (2000, 2)):
            worst = np.maximum(worst, np.abs(pin.computeGeneralizedGravity(model, data, q)))
    assert (worst <= proved.box).all()
    assert (worst > 0.95 * proved.box).all()


def test_a_slide_without_end_has_no_lever(tmp_path):
    path = tmp_path / "rail.urdf"
    path.write_text(rail('lower="0" upper="0"'))
    robot = nbs.load_robot(path, zero_limits="unlimited")
    with pytest.raises(ArgumentError, match="slides without end"):
        gravity_error(robot, 1.0)


def test_loads_add_up():
    robot = nbs.load_robot("two_link")
    one, other = gravity_error(robot, 1.0), gravity_error(robot, 2.0)
    np.testing.assert_allclose(total(one, other).box, 3.0 * one.box)
    np.testing.assert_allclose(total(one, Admissible(radius=2.0)).box, one.box + 2.0)
    assert total(Admissible(radius=2.0), Admissible(radius=3.0)).radius == 5.0


def test_a_sum_keeps_the_claims_of_its_parts_and_the_weakest_label():
    robot = nbs.load_robot("two_link")
    proved, load = gravity_error(robot, 1.0), payload(robot, 1.0, nbs.Sinusoid.for_robot(robot))
    given = Admissible(box=np.ones(2))
    assert total(given, proved).label is given.label is Label.PROVED
    assert total(given, proved, load).label is Label.EMPIRICAL
    assert total(proved, load).claims == (*proved.claims, *load.claims)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda r, ref: payload(r, 0.0, ref), "payload is 0"),
        (lambda r, ref: payload(r, 1.0, ref, frame="moon"), "no moving link 'moon'"),
        (lambda r, ref: payload(r, 1.0, ref, position=np.full(3, np.nan)), "three finite numbers"),
        (lambda r, ref: payload(r, 1.0, ref, margin=0.5), "margin is 0.5"),
        (lambda r, ref: payload(r, 1.0, nbs.Hold(np.zeros(3))), "the reference has 3 joints, the arm has 2"),
        (lambda r, ref: gravity_error(r, -1.0), "gravity error is -1"),
        (lambda r, ref: total(), "at least one"),
        (lambda r, ref: total(Admissible(box=np.ones(2)), Admissible(box=np.ones(3))), "same joints"),
    ],
)
def test_what_is_no_load_is_refused(call, words):
    robot = nbs.load_robot("two_link")
    with pytest.raises(ArgumentError, match=words):
        call(robot, nbs.Sinusoid.for_robot(robot, 1.0))
