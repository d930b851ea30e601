"""Arms whose bodies are known to a share, or that carry a payload: directions, bounds in every pose, simulations."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import nbs_pin as nbs
from nbs_pin.certificates.attack import worst_of
from nbs_pin.certificates.body_bounds import BodyBounds
from nbs_pin.certificates.body_motion import _nearby, hessian_at_zero
from nbs_pin.certificates.body_rates import BodyRates
from nbs_pin.certificates.body_regressor import BodyRegressor
from nbs_pin.certificates.body_response import Response, instants
from nbs_pin.certificates.constants import constants_of
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.controllers.gains import Gains, effective_inertia
from nbs_pin.dynamics.pseudo_inertia import pseudo_inertia
from nbs_pin.dynamics.rigid_tree import RigidTree

SHARE = 0.05


def varied(robot: nbs.Robot, rng: np.random.Generator, share: float = SHARE, corner: bool = True) -> nbs.Robot:
    """The arm with every body drawn from the box, at a corner or anywhere inside, consistent or not."""
    model = robot.model.copy()
    for i in range(1, model.njoints):
        body = model.inertias[i]
        s = rng.choice([-1.0, 1.0], 10) if corner else rng.uniform(-1.0, 1.0, 10)
        inertia, upper = np.zeros((3, 3)), np.triu_indices(3)
        inertia[upper] = np.array(body.inertia)[upper] * (1.0 + share * s[4:])
        inertia = inertia + np.triu(inertia, 1).T
        model.inertias[i] = pin.Inertia(body.mass * (1.0 + share * s[0]), body.lever * (1.0 + share * s[1:4]), inertia)
    return replace(robot, model=model)


def loaded(robot: nbs.Robot, rng: np.random.Generator, payload: nbs.Payload) -> nbs.Robot:
    """The arm with a few point masses in the ball of a payload, on its last joint."""
    model, mass = robot.model.copy(), payload.mass * rng.uniform(0.0, 1.0)
    frame = max(
        (f for f in model.frames if f.parentJoint == robot.nv), key=lambda f: np.linalg.norm(f.placement.translation)
    )
    for share in rng.dirichlet(np.ones(4)):
        off = rng.standard_normal(3)
        off *= payload.radius * rng.uniform() ** (1.0 / 3.0) / np.linalg.norm(off)
        model.inertias[robot.nv] += pin.Inertia(mass * share, frame.placement.translation + off, np.zeros((3, 3)))
    return replace(robot, model=model)


def shares(robot: nbs.Robot, arm: nbs.Robot, errors: nbs.Uncertainty) -> list[float]:
    """Per body, the least largest |s_g| that reproduces its difference, by linear programming."""
    from scipy.optimize import linprog

    found = errors.errors(robot, robot.model)
    least = []
    for i in range(robot.nv):
        body = [pin.Inertia(model.inertias[i + 1]).toDynamicParameters() for model in (robot.model, arm.model)]
        wanted = pseudo_inertia(np.array(body[1])) - pseudo_inertia(np.array(body[0]))
        columns = found.pseudo[found.body == i].reshape(-1, 16).T
        if not columns.size:
            least.append(0.0 if np.allclose(wanted, 0.0, atol=1e-12) else np.inf)
            continue
        size, g = np.abs(columns).max(axis=1).clip(1e-12), columns.shape[1]
        sides = np.hstack([columns / size[:, None], np.zeros((16, 1))])
        box = np.vstack([np.hstack([sign * np.eye(g), -np.ones((g, 1))]) for sign in (1.0, -1.0)])
        solved = linprog(
            np.append(np.zeros(g), 1.0),
            box,
            np.zeros(2 * g),
            sides,
            wanted.reshape(16) / size,
            [(None, None)] * (g + 1),
        )
        assert solved.success, solved.message
        least.append(float(solved.x[-1]))
    return least


@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_every_arm_of_the_box_is_a_sum_of_the_directions(name):
    robot, rng = nbs.load_robot(name), np.random.default_rng(0)
    known, ball = nbs.Uncertainty(inertia=SHARE), nbs.Payload(1.5, radius=0.08)
    for corner in (True, False):
        assert max(shares(robot, varied(robot, rng, corner=corner), known)) <= 1.0 + 1e-6
    for _ in range(4):
        assert max(shares(robot, loaded(robot, rng, ball), nbs.Uncertainty(payload=ball))) <= 1.0 + 1e-6


@pytest.mark.parametrize("what", ["bodies", "payload"])
def test_errors_of_m_c_and_g_stay_within_their_bounds_in_random_poses(what):
    robot, rng = nbs.load_robot("panda"), np.random.default_rng(1)
    ball = nbs.Payload(0.5, radius=0.05)
    known = nbs.Uncertainty(inertia=SHARE) if what == "bodies" else nbs.Uncertainty(payload=ball)
    constants = constants_of(nbs.NeuralBackstepping.for_robot(robot))
    b = BodyBounds.of(robot, RigidTree.of(robot), known.errors(robot, robot.model), constants)
    root, rate = np.linalg.inv(np.linalg.cholesky(b.floor)), np.sqrt(constants.rate)
    beta, model = b.shortfall(17.0, 2.0), nbs.PinocchioDynamics(robot)
    for _ in range(20):
        arm = nbs.PinocchioDynamics(varied(robot, rng) if what == "bodies" else loaded(robot, rng, ball))
        q, x, y = rng.uniform(-3.0, 3.0, (3, 7))
        true, mass = arm.mass_matrix(q), model.mass_matrix(q)
        error = mass - true
        assert np.linalg.norm(root @ error @ root.T, 2) <= b.whole[0]
        assert np.linalg.norm(rate[:, None] * error * rate, 2) <= b.whole[1]
        assert (np.abs(arm.gravity(q) - model.gravity(q)) <= b.weight).all()
        assert np.linalg.eigvalsh(2.0 * true + beta * b.floor - 17.0 * (true - mass))[0] >= -1e-9
        assert 1.0 / b.nu <= np.linalg.eigvalsh(root @ true @ root.T)[0]
        assert 1.0 / b.kappa >= np.linalg.eigvalsh(root @ true @ root.T)[-1]
        sizes = [np.sqrt(z @ b.floor @ z) for z in (x, y)]
        for k, e in enumerate(np.eye(7)):
            turned = arm.coriolis_matrix(q, e) - model.coriolis_matrix(q, e)
            slope = x @ (turned + turned.T) @ y  # ∂_k xᵀΔMy
            assert abs(slope) <= b.degree[k] * b.damped[k] * sizes[0] * sizes[1] + 1e-9


def test_the_regressor_gives_the_differences_of_two_arms_and_the_slope_of_their_torque():
    robot, rng = nbs.load_robot("ur5"), np.random.default_rng(2)
    heavier = robot.model.copy()
    for i in range(1, heavier.njoints):
        heavier.inertias[i] = pin.Inertia(
            1.1 * heavier.inertias[i].mass, heavier.inertias[i].lever, heavier.inertias[i].inertia
        )
    other, model = nbs.PinocchioDynamics(replace(robot, model=heavier)), nbs.PinocchioDynamics(robot)
    errors = nbs.Uncertainty(inertia=0.1).errors(robot, robot.model)
    first = np.array([np.flatnonzero(errors.body == i)[0] for i in range(6)])  # the mass of each body
    q, v, a = rng.uniform(-1.0, 1.0, (3, 6))
    torque, slope, mass, coriolis = BodyRegressor(robot, robot.model, errors).at(q, v, a)
    assert mass[first].sum(axis=0) == pytest.approx(other.mass_matrix(q) - model.mass_matrix(q), abs=1e-10)
    assert coriolis[first].sum(axis=0) == pytest.approx(
        other.coriolis_matrix(q, v) - model.coriolis_matrix(q, v), abs=1e-10
    )

    def whole(x: np.ndarray) -> np.ndarray:
        return nbs.inverse_dynamics(other, x, v, a) - nbs.inverse_dynamics(model, x, v, a)

    assert torque[:, first].sum(axis=1) == pytest.approx(whole(q), abs=1e-10)
    steps = 1e-6 * np.eye(6)
    differences = np.array([(whole(q + e) - whole(q - e)) / 2e-6 for e in steps]).T
    assert slope[first].sum(axis=0) == pytest.approx(differences, abs=1e-7)


@pytest.mark.parametrize("kind", ["nbs", "slotine-li"])
def test_the_hessian_of_the_potential_stays_between_its_bounds(kind):
    robot, rng = nbs.load_robot("panda"), np.random.default_rng(3)
    law = (nbs.NeuralBackstepping if kind == "nbs" else nbs.SlotineLi).for_robot(robot)
    widths = 1.0 / np.sqrt(np.diag(law.lyapunov().stiffness))
    for level in (1e-3, 0.1, 2.0):
        low, high = law.stiffness_range(np.sqrt(level) * widths)
        for _ in range(20):
            z = rng.standard_normal(7)
            z *= np.sqrt(level) * widths / np.linalg.norm(z)
            hessian = law.potential_terms(np.repeat(z[None], 7, axis=0), np.eye(7))[2]
            assert np.linalg.eigvalsh(high - hessian)[0] >= -1e-9
            assert np.linalg.eigvalsh(hessian - low)[0] >= -1e-9


def test_extra_damping_is_within_its_slope():
    law, rng = nbs.NeuralBackstepping.for_robot(nbs.load_robot("panda")), np.random.default_rng(4)
    floor, slope = law.lyapunov().floor, law.damping_slope()
    for _ in range(50):
        z, x = rng.standard_normal((2, 7)) * rng.uniform(0.01, 3.0)
        extra = x @ (law.damping_matrix(z) - floor) @ x
        assert 0.0 <= extra <= slope**2 * (z @ floor @ z) * (x @ floor @ x)


def test_the_response_is_the_error_of_an_arm_of_other_masses_up_to_second_order():
    """z1 − ξ and V' of simulated arms, against z1 itself and the bound of V'."""
    robot, rng, share = nbs.load_robot("ur5"), np.random.default_rng(7), 0.05
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    known = nbs.Uncertainty(inertia=share)
    errors, c, t = known.errors(robot, robot.model), constants_of(law), instants(1.0)
    q, v, a = (np.asarray(x) for x in reference(t))
    torque = np.array([BodyRegressor(robot, robot.model, errors).at(*row)[0] for row in zip(q, v, a, strict=True)])
    mass = law.dynamics.mass_matrix(q)
    own, hessian = c.omega * mass + c.floor + law.dynamics.coriolis_matrix(q, v), hessian_at_zero(law)
    response = Response.of(t, mass, own, torque, hessian, c)
    bound = nbs.certify(law, np.zeros(6), reference=reference, duration=1.0, uncertainty=known).bodies.storage
    for _ in range(3):
        s, model = np.zeros(len(errors.body)), robot.model.copy()
        for i in range(6):
            sign, body = rng.choice([-1.0, 1.0]), model.inertias[i + 1]
            s[np.flatnonzero(errors.body == i)[0]] = sign  # the model less the true mass
            model.inertias[i + 1] = pin.Inertia(body.mass * (1.0 - share * sign), body.lever, body.inertia)
        arm = nbs.PinocchioDynamics(replace(robot, model=model))
        run = nbs.simulate(nbs.DynamicsPlant(arm), law, reference, 1.0, 0.0005)
        f, eta = (np.array([np.interp(run.t, t, x) for x in (y @ s).T]).T for y in (response.f, response.eta))
        now, xi = law.errors(run.q, run.v, run.q_ref, run.v_ref, run.a_ref), np.linalg.solve(hessian, f.T).T
        for _ in range(4):
            xi = xi - np.linalg.solve(hessian, (law.potential_terms(xi, xi)[1] - f).T).T
        e1, e2 = now.z1 - xi, now.z2 - eta
        kinetic = 0.5 * np.einsum("ti,tij,tj->t", e2, arm.mass_matrix(run.q), e2)
        storage = now.value - law.potential_terms(xi, xi)[0] - (f * e1).sum(axis=1) + kinetic
        assert np.abs(e1).max() < 0.02 * np.abs(now.z1).max()
        assert storage.max() <= bound


@pytest.mark.parametrize(("name", "torque"), [("two_link", 0.0), ("ur5", 0.0), ("ur5", 0.2)])
def test_simulated_arms_of_the_box_stay_within_the_bound(name, torque):
    robot, rng = nbs.load_robot(name), np.random.default_rng(5)
    law, reference, n = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot), robot.nv
    known = nbs.Uncertainty(inertia=SHARE)
    found = nbs.certify(law, np.full(n, torque), reference=reference, duration=3.0, uncertainty=known)
    assert str(found.label) == "PROVED"
    waves = torque * np.sign(
        np.sin(np.arange(3000)[:, None] * 0.001 * rng.uniform(1.0, 30.0, n) + rng.uniform(0.0, 6.0, n))
    )
    worst = 0.0
    for k in range(8):
        arm = varied(robot, rng) if k else varied(robot, np.random.default_rng(0), 0.0)
        peaks = worst_of(law, waves[None], reference, plant_dynamics=nbs.PinocchioDynamics(arm))
        assert (peaks.joint_errors[0] <= found.joint_errors).all()
        worst = max(worst, float(peaks.error[0]))
    assert worst <= found.error <= (3.0 if torque == 0.0 else 8.0) * worst


def test_two_kilograms_that_nobody_tells_are_proved_for_an_arm_with_its_rotors():
    bare = nbs.load_robot("panda")
    robot, payload = bare.with_armature(nbs.load_robot("fr3").armature), nbs.Payload(2.0)
    inertia = effective_inertia(robot, nbs.PinocchioDynamics(robot))
    gains = Gains(6.0, 12000.0 * inertia, 1200.0 * inertia)
    reference, given = nbs.Sinusoid.for_robot(robot), {"duration": 3.0, "uncertainty": nbs.Uncertainty(payload=payload)}
    law = nbs.NeuralBackstepping.for_robot(robot, gains=gains, damping_ceiling=0.05)
    found = nbs.certify(law, 0.0, reference=reference, **given)
    assert str(found.label) == "PROVED"
    worst = 0.0
    for mass in (1.0, 2.0):
        arm = nbs.PinocchioDynamics(nbs.Payload(mass).on(robot))
        peaks = worst_of(law, np.zeros((1, 12000, 7)), reference, period=0.00025, plant_dynamics=arm)
        assert (peaks.joint_errors[0] <= found.joint_errors).all()
        worst = max(worst, float(peaks.error[0]))
    assert worst <= found.error <= 5.0 * worst
    with pytest.raises(
        nbs.CertificateRefused, match="panda states no rotor inertia: if its motors have any, armature=… may allow more"
    ):
        nbs.certify(nbs.NeuralBackstepping.for_robot(bare), 0.0, reference=reference, **given)


def test_a_start_beside_the_reference_and_a_payload_stay_within_their_bounds():
    robot, rng = nbs.load_robot("ur5"), np.random.default_rng(6)
    law, reference, ball = (
        nbs.NeuralBackstepping.for_robot(robot),
        nbs.Sinusoid.for_robot(robot),
        nbs.Payload(0.3, 0.05),
    )
    q0 = reference(np.zeros(1)).q[0] + 0.002
    v0 = reference(np.zeros(1)).v[0]
    arguments = {"reference": reference, "duration": 2.0, "uncertainty": nbs.Uncertainty(payload=ball)}
    still, found = (nbs.certify(law, np.zeros(6), **arguments, **more) for more in ({}, {"q0": q0, "v0": v0}))
    assert found.error > still.error
    for _ in range(4):
        plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(loaded(robot, rng, ball)))
        run = nbs.simulate(plant, law, reference, 2.0, 0.001, q0=q0, v0=v0)
        assert (np.abs(robot.difference(run.q, run.q_ref)) <= found.joint_errors).all()


def test_friction_known_to_a_share_costs_what_its_worst_case_does():
    robot = nbs.load_robot("ur5")
    law, friction = nbs.NeuralBackstepping.for_robot(robot), nbs.JointFriction(np.full(6, 0.5), np.full(6, 1.0))
    arguments = {"reference": nbs.Sinusoid.for_robot(robot), "friction": friction}
    exact = nbs.certify(law, np.ones(6), **arguments)
    known = nbs.certify(law, np.ones(6), **arguments, uncertainty=nbs.Uncertainty(viscous=0.2, coulomb=0.1))
    worst = nbs.JointFriction(np.full(6, 0.6), np.full(6, 1.1))
    assert exact.error < known.error
    assert known.friction.gap.viscous == pytest.approx(worst.viscous)
    assert known.friction.gap.coulomb == pytest.approx(worst.coulomb)
    assert known.friction.gap.damping == pytest.approx(np.full(6, 0.4))


def test_what_cannot_be_bounded_is_refused_in_one_sentence():
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    with pytest.raises(nbs.ArgumentError, match="give the reference too"):
        nbs.certify(law, [1.0, 1.0], uncertainty=nbs.Uncertainty(inertia=0.01))
    heavy = nbs.Uncertainty(payload=nbs.Payload(20.0))
    with pytest.raises(nbs.CertificateRefused, match="state smaller shares"):
        nbs.certify(law, [0.0, 0.0], reference=reference, duration=1.0, uncertainty=heavy)
    for wrong in ({"inertia": 1.0}, {"viscous": -0.1}):
        with pytest.raises(nbs.ArgumentError, match=r"give a (share|finite number ≥ 0 and < 1)"):
            nbs.Uncertainty(**wrong)
    with pytest.raises(nbs.ArgumentError, match="no moving link"):
        nbs.certify(
            law, [0.0, 0.0], reference=reference, uncertainty=nbs.Uncertainty(payload=nbs.Payload(1.0, link="moon"))
        )
    run = nbs.simulate(nbs.DynamicsPlant(law.dynamics), law, reference, 0.1, 0.001)
    found = nbs.certify(law, [0.0, 0.0], reference=reference, duration=1.0, uncertainty=nbs.Uncertainty(inertia=0.01))
    with pytest.raises(nbs.ArgumentError, match="needs exact bodies"):
        nbs.monitor(run, found)


def test_shares_that_may_leave_no_positive_inertia_are_refused():
    """V' needs M ≻ 0 of every arm admitted, and so does a bound of z1 by V'."""
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot, bandwidth=1.0), nbs.Sinusoid.for_robot(robot)
    for payload in (None, nbs.Payload(0.01)):
        wide = nbs.Uncertainty(inertia=0.4, payload=payload)
        with pytest.raises(nbs.CertificateRefused, match="not shown to be positive definite"):
            nbs.certify(law, np.zeros(2), reference=reference, duration=1.0, uncertainty=wide)


def test_between_instants_accelerations_may_change_by_all_that_separates_two_of_them():
    """Of a motion whose acceleration jumps, the nearest instant may be on the other side of the jump."""
    robot = nbs.load_robot("two_link")
    law, rng = nbs.NeuralBackstepping.for_robot(robot), np.random.default_rng(0)
    constants = constants_of(law)
    bounds = BodyBounds.of(robot, RigidTree.of(robot), nbs.Uncertainty(0.05).errors(robot, robot.model), constants)
    t = np.linspace(0.0, 10.0, 2001)
    a = np.repeat(rng.uniform(-2.0, 2.0, (21, 2)), 100, axis=0)[: len(t)]
    rates = BodyRates.of(bounds, constants, SampledMotion(t, 0.0 * a, 0.0 * a, a))
    jumps = np.diff(a, axis=0)
    assert rates.off[2] >= np.sqrt(np.einsum("ti,ij,tj->t", jumps, constants.floor, jumps)).max()


def test_bounds_reach_to_the_neighbours_of_an_instant():
    found = _nearby(np.array([1.0, 5.0, 2.0, 0.0, 3.0]))
    assert found.tolist() == [5.0, 5.0, 5.0, 3.0, 3.0]


def test_a_load_that_moves_nothing_leaves_no_error():
    """A point on the axis of the first joint: no torque of the arm changes with it."""
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot)
    payload = nbs.Uncertainty(payload=nbs.Payload(0.3, link="link1"))
    found = nbs.certify(law, [0.0, 0.0], reference=nbs.Sinusoid.for_robot(robot), uncertainty=payload)
    assert (found.joint_errors < 1e-6).all()
