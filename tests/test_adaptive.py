"""Laws that adapt: identities of their proof, their kernel against the law as it is written, and what they learn."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import ROW_ARRAYS, Reference
from nbs_pin.controllers.adapting_model import Duals
from nbs_pin.controllers.bearable import Bearable
from nbs_pin.controllers.excitation import _WEIGHTS, _row, _to_values
from nbs_pin.controllers.gains import effective_inertia, sample_configurations
from nbs_pin.controllers.matrix_logistic import logistic_and_cut
from nbs_pin.controllers.passive_outputs import damping_of, output_of
from nbs_pin.controllers.unknowns import ADAPTS, UPPER, Carrier, model_body
from nbs_pin.controllers.update_rates import UsualMotions
from nbs_pin.dynamics.body_fields import body_fields
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.dynamics.rigid_tree import RigidTree
from nbs_pin.kernels.symmetric4 import FARTHEST
from nbs_pin.kernels.tree_layout import ARMATURE, BASE, BODY
from nbs_pin.robots.places import tool_frame
from nbs_pin.simulation import loop

ARMS = ["two_link", "panda", str(Path(__file__).parent / "data" / "gantry.urdf")]
KINDS = [["load"], ["links"], ["friction", "rotors", "offsets"], list(ADAPTS)]


@pytest.fixture(scope="module", params=ARMS)
def robot(request):
    return nbs.load_robot(request.param)


def law_for(robot, adapts, **settings):
    return nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), adapts, **settings)


def stirred(law, batch, seed=0):
    """A memory with estimates away from the first ones, and errors of earlier instants."""
    rng, zero = np.random.default_rng(seed), np.zeros((*batch, law.nv))
    memory = law.initial_memory(zero)
    duals = memory.duals + rng.normal(size=memory.duals.shape)
    return memory._replace(duals=duals, output=rng.normal(size=zero.shape), before=rng.normal(size=zero.shape))


def fields_of(robot, q, v, w, a):
    tree = pack_model(robot.model)
    return body_fields(RigidTree.of(tree), -tree.weights[:BASE], q, v, w, a)


def test_torques_are_linear_in_bodies(robot):
    """The torque of 4×4 fields is Pinocchio's M a + C(q, v) w + G, and its power at μ is Σ tr(L P)."""
    tree, n = pack_model(robot.model), robot.nv
    q, v, w, a, mu = np.random.default_rng(1).normal(size=(5, 4, n))
    fields, bodies = fields_of(robot, q, v, w, a), [model_body(tree, i) for i in range(n)]
    armature = tree.weights[BASE:].reshape(n, BODY)[:, ARMATURE]
    tau = fields.torque(bodies)
    expected = nbs.PinocchioDynamics(robot).reference_torque(q, v, w, a)
    np.testing.assert_allclose(tau + armature * a, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    powers = zip(fields.velocities(mu), fields.accelerations, bodies, strict=True)
    power = sum(np.einsum("kij,kil,jl->k", u, x, p) for u, x, p in powers)
    np.testing.assert_allclose(power, (tau * mu).sum(axis=-1), rtol=1e-12, atol=1e-12 * np.abs(power).max())


@pytest.mark.parametrize("adapts", KINDS, ids="+".join)
def test_the_kernel_is_the_law(robot, adapts):
    law = law_for(robot, adapts, leak=0.3)
    compiled, rng = law.compile(), np.random.default_rng(2)
    assert compiled is not law
    ours = theirs = stirred(law, (2, 3))
    for _ in range(3):
        q, v, *aim = 0.1 * rng.normal(size=(5, 2, 3, law.nv))
        tau, ours = law.step(ours, q, v, Reference(*aim), 0.001)
        found, theirs = compiled.step(theirs, q, v, Reference(*aim), 0.001)
        np.testing.assert_allclose(found, tau, rtol=0.0, atol=1e-12 * np.abs(tau).max())
        for x, y in zip(theirs, ours, strict=True):
            np.testing.assert_allclose(x, y, rtol=0.0, atol=1e-11 * np.abs(y).max())


OTHERS = {
    "SlotineLi": nbs.SlotineLi.for_robot,
    "PD+": nbs.PD.for_robot,
    "PD": lambda robot: nbs.PD.for_robot(robot, feedforward="gravity"),
    "ComputedTorque": nbs.ComputedTorque.for_robot,
}


@pytest.mark.parametrize("name", OTHERS)
def test_the_kernel_is_the_law_with_integral_action(robot, name):
    law = nbs.AdaptiveLaw(OTHERS[name](robot), ["offsets"])
    compiled, rng = law.compile(), np.random.default_rng(2)
    ours = theirs = stirred(law, (2,))
    for _ in range(3):
        q, v, *aim = 0.1 * rng.normal(size=(5, 2, law.nv))
        tau, ours = law.step(ours, q, v, Reference(*aim), 0.001)
        found, theirs = compiled.step(theirs, q, v, Reference(*aim), 0.001)
        np.testing.assert_allclose(found, tau, rtol=0.0, atol=1e-12 * np.abs(tau).max())
        for x, y in zip(theirs, ours, strict=True):
            np.testing.assert_allclose(x, y, rtol=0.0, atol=1e-10 * np.abs(y).max())


@pytest.mark.parametrize("name", ["NeuralBackstepping", *OTHERS])
def test_integral_action_leaves_no_steady_error(name):
    """Constant torques on every joint: without it the error stays, with it every law ends within 1e-6 rad."""
    robot, torque = nbs.load_robot("two_link"), np.array([5.0, -5.0])
    inner = OTHERS.get(name, nbs.NeuralBackstepping.for_robot)(robot)
    plant, errors = nbs.DynamicsPlant.for_robot(robot), []
    for law in (inner, nbs.AdaptiveLaw(inner, ["offsets"])):
        run = nbs.simulate(plant, law, nbs.Hold([0.3, 0.2]), 10.0, 0.001, disturbance=nbs.ConstantTorque(torque))
        errors.append(np.abs(run.q - run.q_ref)[-100:].max())
    assert errors[0] > 1e-3
    assert errors[1] < 1e-6


@pytest.mark.parametrize("adapts", KINDS, ids="+".join)
def test_at_the_start_the_law_is_the_one_it_is_about(robot, adapts):
    law = law_for(robot, adapts)
    q, v, *aim = np.random.default_rng(3).normal(size=(5, law.nv))
    tau = law.law.torque(q, v, *aim)
    found, _ = law.step(law.initial_memory(q), q, v, Reference(*aim), 0.001)
    spare = 1e-3 if robot.name.startswith("two") else 1e-9  # a point mass is not inside the cone: it begins near it
    np.testing.assert_allclose(found, tau, rtol=0.0, atol=spare * np.abs(tau).max())


@pytest.mark.parametrize("adapts", KINDS, ids="+".join)
def test_the_divergence_pays_for_the_wrong_estimates(robot, adapts):
    """d/dt Σ d/γ = −z2ᵀ(τ(estimates) − τ(truth)): what the wrong model adds to V̇, the divergence takes away."""
    law, rng = law_for(robot, adapts), np.random.default_rng(4)
    memory, truth = stirred(law, ()), stirred(law, (), seed=5)
    q, v, v_r, a_r, z2 = rng.normal(size=(5, law.nv))
    now, true = (law._now(m.duals, q, v, v_r, a_r) for m in (memory, truth))
    power = float(z2 @ (now.torque() - true.torque()))

    def divergence(duals):
        count, total = len(law.unknowns.bodies), 0.0
        mine, other = Duals.of(duals, count), Duals.of(truth.duals, count)
        (x, _), (y, _) = logistic_and_cut(mine.bodies), logistic_and_cut(other.bodies)
        for k in range(count):
            total += _bregman(np.linalg.eigvalsh(mine.bodies[k]), np.linalg.eigvalsh(other.bodies[k])) / law.rates[k]
            total += np.trace((other.bodies[k] - mine.bodies[k]) @ y[k]) / law.rates[k]
            assert np.linalg.eigvalsh(x[k])[0] > 0.0
        for a, b, rate in zip(mine.numbers, other.numbers, law.rates[count:], strict=True):
            total += (np.logaddexp(0.0, a) - np.logaddexp(0.0, b) + (b - a) / (1.0 + np.exp(-b))) / rate
        return total

    h = 1e-7
    ahead, behind = (now.moved(sign * z2, law.rates, 0.0, h) for sign in (1.0, -1.0))
    rate = (divergence(ahead) - divergence(behind)) / (2.0 * h)
    assert rate == pytest.approx(-power, rel=1e-5, abs=1e-6 * (1.0 + abs(power)))


def _bregman(mine, other):
    return np.logaddexp(0.0, mine).sum() - np.logaddexp(0.0, other).sum()


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 3.0))
def test_no_step_leaves_the_cone_and_its_cost_is_bounded(seed, size):
    """However large a step, estimates stay within their bounds; it costs at most ‖step‖²/8 of divergence."""
    rng = np.random.default_rng(seed)
    q, step = (x + x.T for x in rng.normal(size=(2, 4, 4)) * 10.0**size)
    (x, cut), (y, _) = logistic_and_cut(q), logistic_and_cut(q + step)
    for estimate in (x, y):
        values = np.linalg.eigvalsh(estimate)
        assert values[0] > 0.0
        assert values[-1] < 1.0
    small = step / np.linalg.norm(step)
    if np.abs(np.linalg.eigvalsh(q)).max() < 0.9 * FARTHEST:
        cost = _bregman(np.linalg.eigvalsh(q + small), np.linalg.eigvalsh(q)) - np.trace(small @ x)
        assert -1e-12 <= cost <= 0.125 + 1e-12
        np.testing.assert_allclose(cut, q, rtol=0.0, atol=1e-12 * np.abs(q).max())


def test_the_logistic_function_can_be_differentiated_where_eigenvalues_are_equal():
    q = torch.diag(torch.tensor([1.0, 1.0, 1.0, -2.0], dtype=torch.float64))[None].requires_grad_()
    weight = torch.from_numpy(np.random.default_rng(6).normal(size=(1, 4, 4)))

    def value(dual):
        x, _ = logistic_and_cut(0.5 * (dual + dual.transpose(-1, -2)))
        return (x * weight).sum()

    assert torch.autograd.gradcheck(value, (q,), eps=1e-6, atol=1e-7)


def test_gradients_pass_through_steps(robot):
    """∂/∂(start) of torques after three steps, by torch against differences of the numpy law."""
    law, n = law_for(robot, ["load", "friction", "rotors"]), robot.nv
    rng = np.random.default_rng(7)
    states, weight, direction = 0.1 * rng.normal(size=(3, 5, n)), rng.normal(size=n), rng.normal(size=n)

    def cost(q0):
        memory, total = law.initial_memory(q0), 0.0
        for q, v, *aim in states:
            given = [torch.as_tensor(x) for x in aim] if isinstance(q0, torch.Tensor) else aim
            q, v = (torch.as_tensor(x) for x in (q, v)) if isinstance(q0, torch.Tensor) else (q, v)
            tau, memory = law.step(memory, q0 + q, v, Reference(*given), 0.001)
            total = total + (tau * (torch.as_tensor(weight) if isinstance(q0, torch.Tensor) else weight)).sum()
        return total

    start = torch.zeros(n, dtype=torch.float64, requires_grad=True)
    cost(start).backward()
    h = 1e-6
    slope = (cost(h * direction) - cost(-h * direction)) / (2.0 * h)
    assert float(start.grad @ torch.as_tensor(direction)) == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("leak", [0.0, 2.0])
def test_gradients_pass_to_rates_and_leak(robot, leak):
    """∂/∂s of torques after four steps, by torch against differences of the numpy law."""
    law, n = law_for(robot, ["load", "friction", "rotors"], leak=leak), robot.nv
    rng = np.random.default_rng(8)
    states, weight = 0.02 * rng.normal(size=(4, 5, n)), rng.normal(size=n)
    direction = rng.normal(size=law.speed.change.shape)

    def cost(kind):
        memory, total = law.initial_memory(kind(np.zeros(n))), 0.0
        for q, v, *aim in states:
            tau, memory = law.step(memory, kind(q), kind(v), Reference(*map(kind, aim)), 0.001)
            assert (abs(tau) <= kind(robot.effort_limit)).all()  # else the estimates wait
            total = total + (tau * kind(weight)).sum()
        return total

    cost(torch.as_tensor).backward()
    h, found = 1e-5, law.speed.change.grad.numpy() @ direction
    values = []
    for sign in (1.0, -1.0):
        law.speed.change.data[:] = torch.as_tensor(sign * h * direction)
        values.append(float(cost(np.asarray)))
    assert found == pytest.approx((values[0] - values[1]) / (2.0 * h), rel=1e-5, abs=1e-10)
    assert (float(law.speed.change.grad[-1]) != 0.0) == (leak > 0.0)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 30.0))
def test_no_rates_make_a_step_cost_all_of_the_damping_that_there_was(seed, size):
    law = law_for(nbs.load_robot("two_link"), ["load", "friction", "rotors"], gain=0.4, leak=0.5)
    first, leak, motions = law.rates, law.leak, UsualMotions.of(law.law, law.output, law.unknowns, *law._tree)
    law.speed.change.data[:] = torch.as_tensor(np.random.default_rng(seed).normal(scale=size, size=len(first) + 1))
    assert (law.rates >= 0.0).all()
    assert (law.rates <= first / 0.4 * (1.0 + 1e-12)).all()
    assert law.period * motions.cost(law.rates) <= 1.0 + 1e-9
    assert law.step_cost() == pytest.approx(law.period * motions.cost(law.rates))
    law.law.damping.floor.change.data[:] = -50.0  # half of D₀: the same rates cost more of what is left
    assert law.step_cost() > law.period * motions.cost(law.rates)
    assert law.leak == pytest.approx(leak * np.exp(float(law.speed.change.detach()[-1])))


@pytest.mark.parametrize("gains", [True, False])
def test_training_on_a_loaded_arm_chooses_rates(gains):
    robot = nbs.load_robot("two_link")
    law = law_for(robot, ["load"], load_mass=1.0, period=0.01, gain=0.2, leak=0.5)
    rates, leak = law.rates, law.leak
    plant = nbs.DynamicsPlant.for_robot(robot.with_payload("tip", 0.8))
    training = nbs.train(
        law, plant, [nbs.Sinusoid.for_robot(robot)], starts=2, duration=0.5, period=0.01, epochs=6, gains=gains
    )
    after = training.controller
    assert training.history[training.best_epoch] < training.history[0]
    assert (after.rates != rates).all() == gains
    assert (after.leak != leak) == gains
    np.testing.assert_array_equal(law.rates, rates)
    assert any((a != b).any() for a, b in zip(after.law.parameters(), law.law.parameters(), strict=True))


def test_estimates_wait_while_a_torque_is_cut_off():
    robot = nbs.load_robot("two_link")
    for adapting in (law_for(robot, list(ADAPTS)), law_for(robot, list(ADAPTS)).compile()):
        memory = stirred(adapting if isinstance(adapting, nbs.AdaptiveLaw) else law_for(robot, list(ADAPTS)), ())
        still = np.zeros(2)
        for error, moves in ((1e-3, True), (3.0, False)):
            _, after = adapting.step(memory, still, still, Reference(np.full(2, error), still, still), 0.001)
            assert bool((after.duals != memory.duals).any()) is moves


def test_a_reading_that_is_no_number_does_not_stay_in_the_memory():
    robot = nbs.load_robot("two_link")
    written = law_for(robot, list(ADAPTS))
    for law in (written, written.compile()):
        memory, zero = stirred(written, ()), np.zeros(2)
        aim = Reference(np.full(2, 1e-3), zero, zero)
        for k in range(6):
            v = np.full(2, np.nan) if k == 1 else zero
            tau, memory = law.step(memory, zero, v, aim, 0.001)
            assert np.isfinite(tau).all() == (k != 1)
            assert np.isfinite(memory.duals).all()


@pytest.mark.parametrize("name", ["panda", "ur5", "xarm7"])
def test_an_unknown_load_is_found(name):
    """2 kg that the law does not know: the error falls below a twentieth of the fixed law's, the mass is right."""
    robot = nbs.load_robot(name)
    plant = nbs.MujocoPlant(robot.with_payload(tool_frame(robot), 2.0))
    fixed, law = nbs.NeuralBackstepping.for_robot(robot), nbs.AdaptiveLaw.for_robot(robot)
    reference, errors = nbs.Sinusoid.for_robot(robot), []
    for one in (fixed, law):
        run = nbs.simulate(plant, one, reference, 12.0, 0.001, check=False)
        errors.append(np.abs(run.q - run.q_ref)[run.t > 9.0].max())
    assert errors[1] < 0.05 * errors[0] or errors[1] < 3e-3
    assert float(law.estimate(run.estimates[-1]).load_mass) == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("name", ["panda", "xarm7"])
def test_no_largest_estimate_is_more_than_the_sampled_law_bears(name):
    """h g λ_max(M⁻¹ΔM) ≤ ½ with the largest load and with each largest rotor, M of Pinocchio; g = 2ω and ψ''."""
    robot = nbs.load_robot(name)
    law, q = nbs.AdaptiveLaw.for_robot(robot), sample_configurations(robot, 200)
    mass, radii = 2.0 * law.load_mass, np.array([law.load_across, law.load_across, law.load_radius])
    second = mass * np.diag(radii**2)  # of KKᵀ less the link, in the frame of the tool, whose z is the last axis
    heaviest = robot.with_payload(tool_frame(robot), mass, inertia=np.trace(second) * np.eye(3) - second)
    own, loaded = (nbs.PinocchioDynamics(arm).mass_matrix(q) for arm in (robot, heaviest))
    heavier = np.linalg.eigvals(np.linalg.solve(own, loaded)).real.max() - 1.0
    bears = Bearable(law.law, pack_model(robot.model), 0.001)
    carrier = Carrier.of(robot, None)
    of_load = bears.heavier(carrier.joint, carrier.largest(law.load_mass, law.load_radius, law.load_across))
    assert of_load == pytest.approx(heavier, rel=1e-9)
    assert 16.0 <= 0.5 / (0.001 * bears.limit) <= 20.0
    assert of_load == pytest.approx(bears.limit) if name == "xarm7" else of_load <= bears.limit
    assert (law.load_across < 0.02) == (name == "xarm7")
    assert (law.largest_rotor <= bears.limit * effective_inertia(robot, law.law.dynamics) * (1.0 + 1e-9)).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_loads_in_their_ellipsoid_are_below_the_largest_body(seed):
    rng, carrier = np.random.default_rng(seed), Carrier.of(nbs.load_robot("panda"), "panda_link7")
    x = rng.normal(size=(5, 3))
    axis = carrier.place[2, :3]  # of the joint, in the frame of the load
    along = x @ axis[:, None] * axis
    size = np.linalg.norm(along / 0.1 + (x - along) / 0.02, axis=1)
    w = np.hstack([x * (rng.uniform(size=5) / size)[:, None], np.ones((5, 1))]) @ carrier.place.T
    load = w.T * (3.0 * rng.dirichlet(np.ones(5))) @ w
    assert np.linalg.eigvalsh(carrier.largest(3.0, 0.1, 0.02) - load)[0] >= -1e-12


def test_a_light_wrist_is_not_driven_into_its_torque_limits():
    """5 N·m on every joint of an arm whose last inertia is 1.3e-4 kg·m²: no torque is cut off for long."""
    robot = nbs.load_robot("xarm7")
    fixed, law = nbs.NeuralBackstepping.for_robot(robot), nbs.AdaptiveLaw.for_robot(robot)
    rates, errors = np.linspace(0.5, 2.5, 7), []
    for one in (fixed, law):
        run = nbs.simulate(
            nbs.MujocoPlant(robot), one, nbs.Sinusoid.for_robot(robot), 8.0, 0.001, check=False,
            disturbance=lambda t, q, v: 5.0 * np.where(np.sin(rates * t) >= 0.0, 1.0, -1.0),
        )  # fmt: skip
        errors.append(np.sqrt(np.square(run.q - run.q_ref)[run.t > 4.0].mean(axis=0)).max())
    assert errors[1] <= 0.25 * errors[0]
    assert (np.abs(run.tau_command) > run.effort_limit).any(axis=1).mean() < 0.01


def test_loads_and_rotors_that_the_sampled_law_may_not_bear_warn():
    inner = nbs.NeuralBackstepping.for_robot(nbs.load_robot("xarm7"))
    with pytest.warns(UserWarning, match=r"a load of 2 kg within 0\.1 m, 0\.1 m across, may be taken for .* armature="):
        law = nbs.AdaptiveLaw(inner, load_mass=2.0, load_across=0.1)
    assert (law.load_mass, law.load_radius, law.load_across) == (2.0, 0.1, 0.1)
    with pytest.warns(UserWarning, match=r"a rotor of 0\.1 kg·m² at 'joint7' is .* armature="):
        nbs.AdaptiveLaw(inner, ["rotors"], largest_rotor=0.1)


UNUSED = {"frame": "panda_link7", "load_mass": 1.0, "load_radius": 0.1, "load_across": 0.1, "largest_rotor": 0.1,
          "links": ["panda_joint7"]}  # fmt: skip


@pytest.mark.parametrize("name", UNUSED)
def test_bounds_of_what_does_not_adapt_are_refused(name):
    inner = nbs.NeuralBackstepping.for_robot(nbs.load_robot("panda"))
    with pytest.raises(ArgumentError, match=f"{name} was given with adapts=.*leave {name} out"):
        nbs.AdaptiveLaw(inner, ["friction"], **{name: UNUSED[name]})
    with pytest.raises(ArgumentError, match="largest_rotor has 3 numbers, expected one or 7"):
        nbs.AdaptiveLaw(inner, ["rotors"], largest_rotor=[0.1, 0.1, 0.1])


def test_estimates_make_a_model_whose_torque_is_that_of_the_law(robot):
    law = law_for(robot, list(ADAPTS[:-1]))
    numbers = 10 * len(law.unknowns.bodies)
    memory = stirred(law, ())
    memory.duals[numbers:] = np.maximum(memory.duals, law.unknowns.start)[numbers:]  # no friction below zero
    q, v, v_r, a_r = np.random.default_rng(8).normal(size=(4, robot.nv))
    model = law.estimate(memory).dynamics()
    tau = law.law.dynamics.reference_torque(q, v, v_r, a_r) + law._now(memory.duals, q, v, v_r, a_r).torque()
    found = model.reference_torque(q, v, v_r, a_r) + model.friction.torque(v_r)
    np.testing.assert_allclose(found, tau, rtol=0.0, atol=1e-9 * np.abs(tau).max())


@pytest.mark.parametrize("adapts", KINDS, ids="+".join)
def test_what_a_motion_shows_is_the_slope_of_the_torque(robot, adapts):
    """Y of the shares against differences of the law's torque, and changes of values against those of shares."""
    law, rng = law_for(robot, adapts), np.random.default_rng(11)
    memory = stirred(law, ())
    q, v, v_r, a_r = rng.normal(size=(4, 1, robot.nv))
    direction, h = rng.normal(size=memory.duals.size), 1e-5

    def at(step):
        duals = memory.duals + step * direction
        now = law._now(duals[None], q, v, v_r, a_r)
        x = np.concatenate([(now.shares.bodies[0][:, *UPPER] * _WEIGHTS).ravel(), now.shares.numbers[0]])
        return now, x, now.torque()[0], law.estimate(memory._replace(duals=duals)).values

    (now, more, up, high), (_, less, down, low) = at(h), at(-h)
    rows = np.concatenate([_row(now, unit[None]) for unit in np.eye(robot.nv)])
    np.testing.assert_allclose(rows @ (more - less), up - down, rtol=1e-5, atol=1e-9 * np.abs(up).max())
    np.testing.assert_allclose(_to_values(law.unknowns) @ (more - less), high - low, rtol=1e-5, atol=1e-11)


@pytest.mark.parametrize("at_rest", [False, True])
def test_an_estimate_says_how_far_it_may_be_off(at_rest):
    """The truth is within three deviations; an arm at rest shows neither rotors nor viscous friction."""
    robot = nbs.load_robot("panda")
    law = nbs.AdaptiveLaw.for_robot(robot)
    plant, moving = nbs.MujocoPlant(robot.with_payload(tool_frame(robot), 2.0)), nbs.Sinusoid.for_robot(robot)
    run = nbs.simulate(plant, law, nbs.Hold(moving.offset) if at_rest else moving, 10.0, 0.001, check=False)
    found, truth = law.estimate(run), np.zeros(31)
    truth[0] = 2.0
    np.testing.assert_array_equal(found.values, run.estimates[-1])
    assert (np.abs(found.values - truth) <= 3.0 * found.deviation).all()
    rotors = np.array(["rotor" in name for name in found.names])
    assert (found.deviation[rotors] > 0.99 * law.largest_rotor).all() == at_rest
    hidden = " ".join(found.unexcited)
    names = [name.rpartition(" [")[0] for name in found.names if "rotor" in name or "viscous" in name]
    assert all(name in hidden for name in names) == at_rest
    assert ("directions not excited" in repr(found)) == at_rest
    assert "may be off by" in found._repr_html_()


def test_only_one_motion_of_the_law_says_what_it_has_shown():
    robot = nbs.load_robot("two_link")
    law, plant, still = law_for(robot, ["load"]), nbs.DynamicsPlant.for_robot(robot), nbs.Hold([0.1, 0.2])
    runs = [
        nbs.simulate(plant, one, still, 0.01, 0.001, q0=q0) for one, q0 in ((law.law, None), (law, np.zeros((2, 2))))
    ]
    for run in runs:
        with pytest.raises(ArgumentError, match=r"expected one motion of this law, q of shape \(rows, 2\)"):
            law.estimate(run)


def test_damping_pays_for_the_mass_in_the_output_of_pd():
    """ż1ᵀ(K_d − εM)ż1 + εz1ᵀK_p z1 ≥ sᵀΔs for s = ż1 + εz1, with equality where the left is least."""
    robot = nbs.load_robot("panda")
    law, rng = nbs.PD.for_robot(robot), np.random.default_rng(12)
    output, mass = output_of(law), law.dynamics.mass_matrix(rng.uniform(-1.0, 1.0, (5, 7)))
    rate, damping = output.rate[0], damping_of(law, output, mass)
    paid, z1, dz1 = np.diag(law.kd) - rate * mass, *rng.normal(size=(2, 5, 7))
    dz1[0] = np.linalg.solve(paid[0], damping[0] @ dz1[0])
    z1[0] = damping[0] @ np.linalg.solve(damping[0], paid[0] @ dz1[0]) / law.kp
    s = dz1 + rate * z1
    taken = np.einsum("pi,pij,pj->p", dz1, paid, dz1) + rate * (z1**2 * law.kp).sum(axis=1)
    kept = np.einsum("pi,pij,pj->p", s, damping, s)
    assert (taken >= kept * (1.0 - 1e-12)).all()
    assert taken[0] == pytest.approx(kept[0])
    with pytest.raises(ArgumentError, match=r"output_rate of 1e\+03 1/s is more than the damping k_d of this PD"):
        nbs.AdaptiveLaw(law, ["offsets"], output_rate=np.full(7, 1e3))


def test_the_cost_of_a_step_is_the_gain_unless_the_rates_are_others():
    law = law_for(nbs.load_robot("panda"), ["load", "friction", "rotors"], gain=0.3)
    assert law.step_cost() == pytest.approx(0.3)
    assert law_for(law.robot, law.adapts, rates=2.0 * law.rates).step_cost() == pytest.approx(0.6)


@pytest.mark.parametrize("name", ["PD", "ComputedTorque"])
def test_the_cost_of_a_step_is_refused_where_training_left_too_little_damping(name):
    inner = OTHERS[name](nbs.load_robot("two_link"))
    law = nbs.AdaptiveLaw(inner, ["offsets"])
    assert law.step_cost() > 0.0
    inner.gains.named("kd").change.data[:] = -3.0  # k_d is e^-6 of what it was, and output_rate follows from that
    with pytest.raises(ArgumentError, match=f"is more than the damping k_d of this {name} pays for in every pose"):
        law.step_cost()
    assert nbs.AdaptiveLaw(inner, ["offsets"]).step_cost() > 0.0  # what the sentence says to do


def test_estimates_count_in_the_size_of_a_run(monkeypatch):
    law = law_for(nbs.load_robot("two_link"), ["load", "links"])
    monkeypatch.setattr(loop, "MOST_RECORDED", 101 * (2 * len(ROW_ARRAYS) + 19))
    plant, still = nbs.DynamicsPlant.for_robot(law.robot), nbs.Hold([0.1, 0.2])
    nbs.simulate(plant, law.law, still, 0.1, 0.001)
    with pytest.raises(ArgumentError, match="have more than"):
        nbs.simulate(plant, law, still, 0.1, 0.001)


def test_files_keep_rates_of_a_law_that_was_trained_first(tmp_path, robot):
    inner = nbs.NeuralBackstepping.for_robot(robot)
    with torch.no_grad():
        for parameter in inner.parameters():
            parameter += 0.01
    law = nbs.AdaptiveLaw(inner, ["load", "rotors"], load_mass=1.5, load_radius=0.2, leak=0.1)
    law.speed.change.data[:] = torch.linspace(-1.0, 1.0, len(law.rates) + 1)
    nbs.save(law, tmp_path / "law.nbs")
    again = nbs.load(tmp_path / "law.nbs")
    np.testing.assert_array_equal(again.rates, law.rates)
    assert again.leak == law.leak != 0.1
    memory = stirred(law, ())
    q, v, *aim = 0.1 * np.random.default_rng(9).normal(size=(5, robot.nv))
    for one, other in ((law, again), (law.compile(), again.compile())):
        after, same = (x.step(memory, q, v, Reference(*aim), 0.001)[1] for x in (one, other))
        for x, y in zip(after, same, strict=True):
            np.testing.assert_array_equal(x, y)


def _step(law, memory, zero, period=0.001):
    return law.step(memory, zero, zero, Reference(zero, zero, zero), period)


REFUSED = {
    "period is 0.002 s, expected at most": lambda law, zero: _step(law, law.initial_memory(zero), zero, 0.002),
    "what initial_memory or step returned": lambda law, zero: _step(law, None, zero),
    "duals": lambda law, zero: _step(law, law.initial_memory(zero)._replace(duals=np.zeros(3)), zero),
}


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_calls_are_refused(case):
    robot = nbs.load_robot("two_link")
    law = law_for(robot, ["load"])
    for one in (law, law.compile()):
        with pytest.raises(ArgumentError, match=case):
            REFUSED[case](one, np.zeros(2))


def test_wrong_settings_are_refused():
    robot = nbs.load_robot("panda")
    inner = nbs.NeuralBackstepping.for_robot(robot)
    for wrong in (["mass"], [], ["load", "load"]):
        with pytest.raises(ArgumentError, match="adapts is"):
            nbs.AdaptiveLaw(inner, wrong)
    with pytest.raises(ArgumentError, match="no moving link 'nothing'"):
        nbs.AdaptiveLaw(inner, frame="nothing")
    with pytest.raises(ArgumentError, match="no joint 'nothing'"):
        nbs.AdaptiveLaw(inner, ["links"], links=["nothing"])
    with pytest.raises(ArgumentError, match=r"expected \['offsets'\]"):
        nbs.AdaptiveLaw(nbs.PD.for_robot(robot), ["load"])
    with pytest.raises(ArgumentError, match="gain is 1"):
        nbs.AdaptiveLaw(inner, gain=1.0)
    with pytest.raises(ArgumentError, match="cannot adapt a Foreign"):
        nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot, Foreign(robot)))


class Foreign(nbs.PinocchioDynamics):
    """A model whose equations may not be those of a rigid tree."""


@pytest.mark.parametrize("name", ["two_link", "panda", "xarm7"])
@pytest.mark.parametrize("adapts", [["load", "friction", "rotors"], ["offsets"], ["links", "offsets"]], ids="+".join)
def test_slow_motions_bear_the_delay_of_the_update(name, adapts):
    """M s̈ + Δ ṡ + I s(t − d) = 0 is stable for I d ≺ Δ: all but loads together stay below `gain` of it."""
    law = law_for(nbs.load_robot(name), adapts, gain=0.4)
    motions = UsualMotions.of(law.law, law.output, law.unknowns, *law._tree)
    delayed = [not body.is_load for body in law.unknowns.bodies] + [True] * len(law.unknowns.numbers)
    stiffness = np.einsum("k,skij->sij", law.rates[delayed], motions.slow[:, delayed]) / 4.0
    assert 0.0 < np.linalg.eigvalsh(stiffness).max() * 3.0 * law.period <= 0.4 * (1.0 + 1e-9)
