"""Drives: friction, offsets and rotors beside the bodies, chosen by what data show and solved beside every model."""

import re
import warnings
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st
from numpy.testing import assert_allclose

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError, CertificateRefused, RobotError
from nbs_pin.identification.drive_choice import Wanted, terms_of_rest
from nbs_pin.identification.drive_terms import TERMS, DriveTerms
from nbs_pin.identification.fit_report import torque_errors, torque_nmse
from nbs_pin.identification.remainder import EFFECTS, next_try, remainder

UR5, TWO = nbs.load_robot("ur5"), nbs.load_robot("two_link")
REAL = nbs.Noise(encoder=2**-16, torque=0.2)


@cache
def drives():
    return nbs.DriveFriction(
        [8.0, 6.0, 0.0, 1.0, 0.0, 0.0],
        [5.0, 4.0, 3.0, 0.0, 0.0, 0.0],
        offset=[0.0, 0.0, 1.5, 0.0, 0.8, 0.0],
        stribeck=[6.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        stribeck_speed=0.2,
        load=[0.0, 0.15, 0.0, 0.0, 0.0, 0.0],
    )


@cache
def moved(robot, samples=600, seed=3, **options):
    return nbs.collect(robot, "excited", samples, seed, **options)


def driven(data, drives, rotors=0.0):
    """The same motions with the torques of an arm with these drives."""
    needed = data.tau + rotors * data.a
    return replace(data, tau=needed + drives.feedforward(data.v, needed))


@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6), st.lists(st.floats(-50.0, 50.0), min_size=6, max_size=6))
def test_friction_of_a_torque_is_what_that_torque_was_given_for_it(v, needed):
    v, needed = np.array(v), np.array(needed)
    fed = drives().feedforward(v, needed)
    assert_allclose(drives().torque(v, needed + fed), fed, atol=1e-10 + 1e-12 * np.abs(needed).max())
    bare = replace(drives(), load=np.zeros(6))
    assert_allclose(bare.torque(v), bare.feedforward(v, needed), atol=1e-12)
    both = drives().feedforward(torch.from_numpy(v), torch.from_numpy(needed))
    assert_allclose(both.numpy(), fed, atol=1e-12)


def test_factors_are_the_derivatives_of_friction():
    data, rng = moved(UR5).take(slice(60)), np.random.default_rng(0)
    names = TERMS[:-1]
    terms = replace(DriveTerms.of(6, *names, transition=0.05), stribeck_speed=rng.uniform(0.1, 0.4, 6))
    numbers = rng.uniform(0.1, 0.5, (len(names), 6))
    friction = terms.friction(numbers)
    total = np.einsum("kj,ksj->sj", numbers, terms.factors(data, data.tau))
    assert_allclose(friction.feedforward(data.v, data.tau), total, rtol=1e-12, atol=1e-12)
    again, same = DriveTerms.of_friction(friction)
    assert again.kinds == names
    assert_allclose(same, numbers)


@pytest.fixture(scope="module")
def noisy():
    """Motions of ur5 with these drives, rotors and noise, and fresh ones without noise."""
    data = moved(UR5, 1_500, noise=REAL, duration=3.0)
    return driven(data, drives(), 0.4), driven(moved(UR5), drives(), 0.4)


def test_each_joint_gets_the_terms_that_it_has(noisy):
    data, fresh = noisy
    model = nbs.identify(data, UR5)
    found = model.friction
    assert_allclose(found.offset, drives().offset, atol=0.15)
    assert (found.stribeck[1:] < 0.05).all()  # of 0.2 N·m of noise
    assert found.stribeck[0] > 3.0
    assert_allclose(found.load, drives().load, atol=0.04)
    assert (found.asymmetry == 0.0).all()
    assert_allclose(found.viscous, drives().viscous, atol=0.5)
    plain = nbs.identify(data, UR5, friction=True, offset=False)
    ours, theirs = (torque_nmse(m, fresh, m.friction) for m in (model, plain))
    assert ours < 0.3 * theirs
    assert ours < 2e-3


@pytest.mark.parametrize("robot", [TWO, UR5], ids=["two_link", "ur5"])
def test_drives_that_are_not_there_are_not_found(robot):
    clean = nbs.identify(moved(robot), robot)
    assert clean.friction is None
    assert not clean.rotor_inertia.any()
    found = nbs.identify(moved(robot, noise=REAL), robot).friction
    most = 0.02 * np.abs(moved(robot).tau).max(axis=0) + 0.1 * REAL.torque
    assert found is None or (np.abs(found.torque(np.ones(robot.nv))) < most).all()


def test_spikes_cost_little_and_are_counted(noisy):
    data, fresh = noisy
    rng = np.random.default_rng(1)
    hit = rng.random(data.tau.shape) < 0.002
    spiked = replace(data, tau=data.tau + 500.0 * hit * rng.choice([-1.0, 1.0], hit.shape))
    clean, found = (nbs.identify(x, UR5, friction=True) for x in (data, spiked))
    assert found.report.outliers >= 0.9 * hit.sum()
    assert torque_nmse(found, fresh, found.friction) < 1.1 * torque_nmse(clean, fresh, clean.friction)


def test_a_network_is_never_worse_than_the_arm_with_friction(noisy):
    """An arm that is wrong by half in its masses; blocks held out that resemble the others little."""
    data, _ = noisy
    train, test = data.split(0.3, 1)
    nominal = nbs.PinocchioDynamics(UR5)
    left = train.tau - nominal.reference_torque(train.q, train.v, train.v, train.a)
    terms, numbers = terms_of_rest(Wanted(rotor_inertia=False), train, left)
    start = torque_nmse(nominal, test, terms.friction(numbers))
    for iterations in (1, 3):
        model = nbs.fit(train, "residual", robot=UR5, held_out=test, iterations=iterations, widths=(4,))
        assert model.report.test_nmse <= 1.02 * start
        assert model.report.held_out[0] >= min(model.report.held_out)


def test_a_network_that_learns_nothing_says_so():
    data = moved(TWO, 200, noise=nbs.Noise(torque=1.0))
    told = nbs.fit(data, "residual", robot=TWO, widths=(4,), iterations=3).report
    assert (told.stopped == "no better than the start") == (min(told.held_out) == told.held_out[0])


@pytest.mark.parametrize(
    ("effect", "argument", "change"),
    [
        ("constant", "offset", lambda data: 0.0 * data.v + 3.0),
        ("v", "friction", lambda data: 4.0 * data.v),
        ("sign v", "friction", lambda data: 3.0 * np.tanh(data.v / 0.01)),
        ("a", "rotor_inertia", lambda data: 0.5 * data.a),
    ],
)
def test_what_is_left_out_is_named(effect, argument, change):
    data, nominal = moved(TWO), nbs.PinocchioDynamics(TWO)
    found = remainder(nominal, replace(data, tau=data.tau + change(data) * [0.0, 1.0]), None)
    gains = dict(zip(EFFECTS, found.gains, strict=True))
    assert max(gains, key=gains.get) == effect
    assert gains[effect] == pytest.approx(1.0, abs=1e-9)
    said = next_try(found, TWO.joint_names, {argument: False})
    assert "joint2" in said
    assert "joint1" not in said
    assert f"leave out {argument}=False" in said
    assert "which was learned" in next_try(found, TWO.joint_names, {argument: None})


def test_a_delay_is_named_with_its_time_and_direction():
    """Half a row, so that no shift fits exactly, in noise; late torques must be moved earlier, and early ones later."""
    data, rng = moved(TWO), np.random.default_rng(0)
    nominal = nbs.PinocchioDynamics(TWO)
    step = float(np.median(np.diff(data.t)[np.diff(data.trajectory) == 0]))
    for rows, said in ((2.5, "earlier"), (-2.5, "later")):
        parts = []
        for k in np.unique(data.trajectory):
            t, tau = data.t[data.trajectory == k], data.tau[data.trajectory == k]
            parts.append(np.column_stack([np.interp(t - rows * step, t, y) for y in tau.T]))
        tau = np.concatenate(parts)
        late = replace(data, tau=tau + 0.02 * tau.std(axis=0) * rng.standard_normal(tau.shape))
        told = next_try(remainder(nominal, late, None), TWO.joint_names, {})
        assert f"{2 * step:.3g} s {said}" in told or f"{3 * step:.3g} s {said}" in told
    assert next_try(remainder(nominal, data, None), TWO.joint_names, {}) == ""


def test_laws_feed_drives_forward_and_plants_have_them():
    drives = nbs.DriveFriction([0.5, 0.2], [1.0, 0.5], 0.1, offset=[0.3, -0.2], stribeck=[0.4, 0.0], load=[0.1, 0.05])
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(TWO), friction=drives)
    motion = nbs.Sinusoid.for_robot(TWO)
    worst = []
    for friction in (drives, nbs.JointFriction(drives.viscous, drives.coulomb, 0.1)):
        law = nbs.NeuralBackstepping.for_robot(TWO, friction=friction)
        assert law.compile() is law or type(friction) is nbs.JointFriction
        run = nbs.simulate(plant, law, motion, duration=1.0, period=0.002)
        worst.append(np.abs(run.q - run.q_ref)[250:].max())
    assert worst[0] < 0.01 * worst[1]
    law = nbs.NeuralBackstepping.for_robot(TWO, friction=drives)
    with pytest.raises(CertificateRefused, match="viscous and Coulomb friction"):
        nbs.certify(law, 1.0, robot=TWO)
    with pytest.raises(ArgumentError, match="viscous and Coulomb friction only"):
        nbs.MujocoPlant(TWO, joint_friction=drives)


def test_a_model_with_drives_is_stored_whole(tmp_path, noisy):
    model = nbs.identify(noisy[0], UR5)
    nbs.save(model, tmp_path / "model.nbs")
    again = nbs.load(tmp_path / "model.nbs")
    fresh = noisy[1]
    assert_allclose(torque_errors(again, fresh, again.friction), torque_errors(model, fresh, model.friction))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"offset": [1.0]}, "offset of the friction"),
        ({"load": 1.0}, "shares below 1"),
        ({"stribeck": -0.1}, "stribeck of the friction"),
        ({"stribeck_speed": 0.0}, "speeds > 0"),
        ({"asymmetry": np.nan}, "asymmetry"),
    ],
)
def test_what_no_drive_has_is_refused(change, words):
    with pytest.raises(ArgumentError, match=words):
        nbs.DriveFriction([0.1, 0.1], [0.2, 0.1], **change)


SPECK = '<mass value="1e-9"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>'


@pytest.mark.parametrize("inertial", ["", f"<inertial>{SPECK}</inertial>"], ids=["none", "rounded"])
def test_bodies_are_learned_where_the_file_has_geometry_alone(tmp_path, inertial):
    xml = TWO.urdf.xml.decode()
    bare = re.sub(r"<inertial>.*?</inertial>", inertial, xml, flags=re.DOTALL)
    assert bare != xml
    path = tmp_path / "two_link.urdf"
    path.write_text(bare)
    with pytest.raises(RobotError, match=r"or learn all bodies from a log \(inertia_from='links'\)"):
        nbs.load_robot(path)
    with pytest.warns(UserWarning, match="balls of 1 kg"):
        robot = nbs.load_robot(path, inertia_from="links", gravity=9.8)
    data = replace(moved(TWO), about={})
    model = nbs.fit(data, "identified", robot=robot)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (20, 2))
    assert_allclose(model.mass_matrix(q), nbs.PinocchioDynamics(TWO).mass_matrix(q), atol=1e-8)
    assert model.report.details["stated_mass_kg"] is None
    with pytest.raises(ArgumentError, match="only the geometry was taken"):
        nbs.fit(data, "residual", robot=robot)
    again = nbs.load_robot(model.write_urdf(tmp_path / "learned.urdf"), gravity=9.8)
    assert_allclose(nbs.PinocchioDynamics(again).mass_matrix(q), model.mass_matrix(q), atol=1e-8)


WRIST = np.eye(6)
WRIST[5, 4] = 1.0


ROTORS = np.array([1.0, 1.0, 0.5, 0.3, 0.2, 0.15])


@cache
def gears():
    return nbs.DriveFriction([8.0, 7.0, 5.0, 2.0, 1.5, 1.0], [6.0, 5.0, 4.0, 2.0, 1.5, 1.2], offset=0.1, coupling=WRIST)


@cache
def wrists():
    """Noisy motions of ur5, of which motor 6 turns q5 + q6, and the same without coupling; fresh ones of both."""
    alone = replace(gears(), coupling=None)

    def made(data):
        joined = driven(data, gears())
        joined = replace(joined, tau=joined.tau + data.a @ (WRIST.T * ROTORS @ WRIST))
        return joined, driven(data, alone, ROTORS)

    return made(moved(UR5, 1_500, noise=REAL, duration=3.0)), made(moved(UR5))


@pytest.fixture(scope="module")
def wrist():
    return wrists()


@pytest.mark.parametrize("at_motors", [False, True], ids=["torques of joints", "torques of motors"])
def test_a_coupled_wrist_is_found_and_is_as_good_as_an_uncoupled_one(wrist, at_motors):
    (joined, alone), (fresh, fresh_alone) = wrist
    data = replace(joined, tau=joined.tau @ np.linalg.inv(WRIST)) if at_motors else joined
    said = "torques of the log are those of the motors" if at_motors else "torques of the log are those of the joints"
    with pytest.warns(UserWarning, match=f"motor of wrist_3_joint also turns .* with wrist_2_joint, and the {said}"):
        model = nbs.identify(data, UR5)
    assert_allclose(model.coupling, WRIST, atol=0.01)
    assert_allclose(model.motor_inertia, ROTORS, atol=0.1)
    usual = nbs.identify(alone, UR5)
    ours, theirs = torque_nmse(model, fresh, model.friction), torque_nmse(usual, fresh_alone, usual.friction)
    assert ours < 1.2 * theirs
    given = nbs.fit(data, "identified", robot=UR5, coupling=WRIST, held_out=0.0)
    assert torque_nmse(given, fresh, given.friction) < 1.2 * theirs


@pytest.mark.parametrize("entries", [((4, 3), (5, 4)), ((1, 0), (5, 4))], ids=["one joint in both", "apart"])
def test_two_couplings_are_found(entries):
    """Of two that share a joint the first alone leaves much of the torque."""
    matrix = np.eye(6)
    for at in entries:
        matrix[at] = 1.0
    data = driven(moved(UR5, 1_500, noise=REAL, duration=3.0), replace(gears(), coupling=matrix))
    data = replace(data, tau=data.tau + data.a @ (matrix.T * ROTORS @ matrix))
    with pytest.warns(UserWarning, match="also turns .* and the motor of .* also turns"):
        model = nbs.identify(data, UR5)
    assert_allclose(model.coupling, matrix, atol=0.01)


def test_the_warning_of_a_coupling_is_told_of_the_line_that_asks(wrist):
    (joined, _), _ = wrist
    for ask in (nbs.identify, lambda data, robot: nbs.fit(data, "identified", robot=robot, held_out=0.0)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            ask(joined, UR5)
        assert any("also turns" in str(warning.message) for warning in caught)
        assert {warning.filename for warning in caught} == {__file__}


def test_a_wrist_without_coupling_has_none(wrist):
    (_, alone), _ = wrist
    assert type(nbs.identify(alone, UR5)) is nbs.IdentifiedDynamics


def test_coupled_dynamics_are_those_of_an_arm(tmp_path):
    own = np.stack([body.toDynamicParameters() for body in list(TWO.model.inertias)[1:]])
    model = nbs.CoupledDynamics(TWO, own, [[1.0, 0.0], [0.5, 1.0]], motor_inertia=[0.3, 0.7])
    rng = np.random.default_rng(0)
    q, v, a = rng.normal(size=(3, 5, 2))
    tau = nbs.inverse_dynamics(model, q, v, a)
    needed = (model.mass_matrix(q) @ a[..., None] + model.coriolis_matrix(q, v) @ v[..., None])[..., 0]
    assert_allclose(tau, needed + model.gravity(q))
    assert_allclose(model.forward_dynamics(q, v, tau), a)
    arguments = [torch.tensor(x[0], requires_grad=True) for x in (q, v, tau)]
    assert torch.autograd.gradcheck(model.forward_dynamics, arguments, atol=1e-6)
    assert torch.autograd.gradcheck(lambda *x: model.reference_torque(x[0], x[1], x[1], x[2]), arguments, atol=1e-6)
    nbs.save(model, tmp_path / "model.nbs")
    assert_allclose(nbs.load(tmp_path / "model.nbs").mass_matrix(q), model.mass_matrix(q))
    with pytest.raises(ArgumentError, match="no coupled drives"):
        model.write_urdf(tmp_path / "model.urdf")
    with pytest.raises(ArgumentError, match="invertible 2×2"):
        nbs.CoupledDynamics(TWO, own, [[1.0, 1.0], [1.0, 1.0]])


def test_parameters_are_as_uncertain_as_said():
    """z-scores of the identifiable numbers over independent noise are of one."""
    clean, rng = moved(TWO), np.random.default_rng(4)
    clean = replace(clean, tau=clean.tau + nbs.JointFriction([2.0, 1.0], [1.0, 0.5]).torque(clean.v))
    found, said = [], []
    for _ in range(30):
        model = nbs.identify(
            replace(clean, tau=clean.tau + 0.3 * rng.standard_normal(clean.tau.shape)), TWO, friction=True
        )
        found.append([model.parameters[1, 1], *model.friction.viscous, *model.friction.coulomb])
        deviations, drives = model.report.parameter_deviations, model.report.drive_deviations
        said.append([deviations[1, 1], *drives["viscous"], *drives["coulomb"]])
    ratio = np.std(found, axis=0) / np.mean(said, axis=0)
    assert (ratio > 0.6).all()
    assert (ratio < 1.5).all()


def test_a_joint_without_torque_is_no_fault():
    data = moved(TWO)
    model = nbs.fit(replace(data, tau=data.tau * [1.0, 0.0]), "identified", robot=TWO, held_out=0.0)
    assert np.isfinite(model.parameters).all()


def test_the_load_of_friction_includes_the_rotors():
    data = moved(TWO)
    needed = data.tau + data.a * [2.0, 3.0]
    drives = nbs.DriveFriction([0.0, 0.0], [0.5, 0.5], load=[0.2, 0.1])
    model = nbs.identify(replace(data, tau=needed + drives.feedforward(data.v, needed)), TWO)
    assert_allclose(model.friction.load, drives.load, atol=0.01)
    assert model.report.train_nmse < 1e-5


@pytest.mark.parametrize(
    "wrong",
    [
        lambda data: data.tau * [1.0, 1.0, 1.0, 3.0, 1.0, 1.0],
        lambda data: data.tau[:, [0, 1, 2, 4, 3, 5]],
        lambda data: data.tau + 300.0 * (np.arange(len(data))[:, None] % 250 == 7),
    ],
    ids=["scale", "swap", "spikes"],
)
def test_faults_of_a_log_are_no_coupled_drives(wrist, wrong):
    (_, alone), _ = wrist
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = nbs.identify(replace(alone, tau=wrong(alone)), UR5)
    assert type(model) is nbs.IdentifiedDynamics


def test_torque_that_is_a_constant_and_noise_is_not_learned():
    data, rng = moved(TWO), np.random.default_rng(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report = nbs.fit(replace(data, tau=5.0 + rng.standard_normal(data.tau.shape)), "identified", robot=TWO).report
    assert report.test_nmse >= 1.0
    assert report.stopped == "no better than a constant torque"


def test_identified_arms_come_out_as_mjcf_too(tmp_path):
    own = np.stack([body.toDynamicParameters() for body in list(TWO.model.inertias)[1:]])
    friction = nbs.JointFriction([0.5, 0.2], [1.0, 0.3])
    model = nbs.IdentifiedDynamics(TWO, own, friction, [0.4, 0.1])
    arm = nbs.load_robot(model.write_urdf(tmp_path / "arm.urdf"), gravity=9.8)
    path = nbs.MujocoPlant(arm, joint_friction="keep").write_mjcf(tmp_path / "arm.xml")
    theirs = mujoco.MjModel.from_xml_path(str(path))
    assert_allclose(theirs.dof_damping, friction.viscous)
    assert_allclose(theirs.dof_frictionloss, friction.coulomb)
    assert_allclose(theirs.actuator_ctrlrange[:, 1], TWO.effort_limit)
    data, mass = mujoco.MjData(theirs), np.zeros((2, 2))
    data.qpos[:] = q = np.array([0.4, -0.7])
    mujoco.mj_forward(theirs, data)
    for unit, column in zip(np.eye(2), mass, strict=True):
        mujoco.mj_mulM(theirs, data, column, unit)
    assert_allclose(mass, model.mass_matrix(q), rtol=1e-5)
    again = nbs.load_robot(path)
    assert_allclose(again.armature, [0.4, 0.1])
    assert_allclose(nbs.PinocchioDynamics(again).gravity(q), model.gravity(q), rtol=1e-5)


def test_friction_that_pushes_is_not_proposed():
    """What is left has the sign of a motor that helps: no friction would explain it."""
    data = moved(TWO)
    found = remainder(nbs.PinocchioDynamics(TWO), replace(data, tau=data.tau - 4.0 * data.v), None)
    assert found.explained[EFFECTS.index("v")].max() == 0.0
    assert "friction" not in next_try(found, TWO.joint_names, {"friction": False})
