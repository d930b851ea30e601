"""One contract for every tracking law, and the theorems of the neural one."""

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.base.arrays import matvec
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.gains import effective_inertia, gains_for_robot, largest_inertia
from nbs_pin.controllers.neural_backstepping import DAMPINGS, NeuralBackstepping
from nbs_pin.controllers.pid import PID, PIDMemory
from nbs_pin.controllers.potential import POTENTIALS, Potential
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.robots.robot import load_robot
from tests.laws import EVERY as LAWS
from tests.test_networks import randomise

ARMS = ["two_link", "panda", "kinova", str(Path(__file__).parent / "data" / "gantry.urdf")]


@pytest.fixture(params=LAWS)
def law(request):
    return LAWS[request.param]


@pytest.fixture(scope="module", params=ARMS)
def robot(request):
    return load_robot(request.param)


def arguments(nv: int, batch: tuple[int, ...] = (5,), seed: int = 0) -> list[np.ndarray]:
    """q, v, q_ref, v_ref, a_ref at random."""
    return list(np.random.default_rng(seed).normal(size=(5, *batch, nv)))


def call(controller, q, v, q_ref, v_ref, a_ref):
    return controller.step(controller.initial_memory(q), q, v, Reference(q_ref, v_ref, a_ref), 0.001)[0]


def test_batch_is_the_stack_of_its_rows(law, robot):
    controller = law(robot)
    states = arguments(robot.nv, (2, 3))
    many = call(controller, *states)
    rows = [call(controller, *(x.reshape(6, -1)[i] for x in states)) for i in range(6)]
    assert many.shape == (2, 3, robot.nv)
    np.testing.assert_allclose(many.reshape(6, -1), rows, rtol=1e-12, atol=1e-10)


def test_whole_turns_of_a_continuous_joint_do_not_matter(law):
    robot = load_robot("kinova")
    controller = law(robot)
    q, v, q_ref, v_ref, a_ref = arguments(robot.nv)
    turned = q_ref + 2.0 * np.pi * robot.continuous * np.arange(-2, 3)[:, None]
    tau = call(controller, q, v, q_ref, v_ref, a_ref)
    np.testing.assert_allclose(call(controller, q, v, turned, v_ref, a_ref), tau, rtol=1e-9, atol=1e-9)


def test_a_loop_under_every_law_on_every_arm(law, robot):
    """Some periods, in which every call checks its shapes; test_closed_loops.py has longer ones."""
    start = nbs.Sinusoid.for_robot(robot, amplitude=0.2)
    run = nbs.simulate(nbs.DynamicsPlant(PinocchioDynamics(robot)), law(robot), start, 0.01, 0.001)
    assert np.isfinite(run.q).all()
    assert run.q.shape == run.tau_command.shape == (11, robot.nv)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
def test_copies_keep_what_was_learnt_and_go_their_own_way(law, robot, copied):
    controller = law(robot, friction=JointFriction(np.full(robot.nv, 0.3), np.linspace(1.0, 2.0, robot.nv)))
    randomise(controller, 1, gain=0.3)
    states = arguments(robot.nv)
    before = call(controller, *states)
    other = copied(controller)
    np.testing.assert_array_equal(call(other, *states), before)
    randomise(other, 2, gain=0.3)
    np.testing.assert_array_equal(call(controller, *states), before)
    assert np.abs(call(other, *states) - before).max() > 0.0


def test_torch_and_numpy_are_one_law(law, robot):
    controller = law(robot)
    states = arguments(robot.nv)
    tau = call(controller, *states)
    tensor = call(controller, *(torch.as_tensor(x) for x in states))
    assert isinstance(tensor, torch.Tensor)
    np.testing.assert_allclose(tensor.detach().numpy(), tau, rtol=1e-12, atol=1e-12 * np.abs(tau).max())


def test_the_other_laws_written_with_matrices(robot):
    """Slotine–Li, sliding mode, computed torque and both PD laws term by term, friction where each feeds it forward."""
    dynamics, n = PinocchioDynamics(robot), robot.nv
    friction = JointFriction(np.linspace(1.0, 2.0, n), np.linspace(0.5, 1.0, n), 0.3)
    first, second = np.linspace(3.0, 5.0, n), np.linspace(7.0, 9.0, n)
    q, v, q_ref, v_ref, a_ref = arguments(n)
    mass, coriolis, gravity = dynamics.mass_matrix(q), dynamics.coriolis_matrix(q, v), dynamics.gravity(q)
    z1, dz1 = robot.difference(q, q_ref), v - v_ref
    v_r, a_r = v_ref - first * z1, a_ref - first * dz1
    pd = -first * z1 - second * dz1 + friction.torque(v_ref)
    a = a_ref - second * dz1 - first * z1
    slotine_li = matvec(mass, a_r) + matvec(coriolis, v_r) + gravity - second * (v - v_r) + friction.torque(v_r)
    computed_torque = matvec(mass, a) + matvec(coriolis, v) + gravity + friction.torque(v_ref)
    gains = {"rate": first, "gain": second, "friction": friction}
    fed = {"kp": first, "kd": second, "friction": friction}
    expected = {
        nbs.SlotineLi(dynamics, **gains): slotine_li,
        nbs.SlidingMode(dynamics, **gains, switching=2.0, boundary=0.5): slotine_li - 2.0 * np.tanh((v - v_r) / 0.5),
        nbs.ComputedTorque(dynamics, **fed): computed_torque,
        nbs.PD(dynamics, feedforward="reference", **fed): matvec(mass, a_ref) + matvec(coriolis, v_ref) + gravity + pd,
        nbs.PD(dynamics, feedforward="gravity", **fed): gravity + pd,
    }
    for controller, tau in expected.items():
        for form in (controller, controller.compile()):
            ours = form.torque(q, v, q_ref, v_ref, a_ref)
            np.testing.assert_allclose(ours, tau, rtol=1e-11, atol=1e-11 * np.abs(tau).max())


def test_default_gains_of_the_other_laws_are_what_they_say():
    robot = load_robot("panda")
    dynamics = PinocchioDynamics(robot)
    gains = gains_for_robot(robot, dynamics, bandwidth=8.0, period=0.001)
    slotine_li, computed = nbs.SlotineLi.for_robot(robot), nbs.ComputedTorque.for_robot(robot)
    ceiling = 0.5 * effective_inertia(robot, dynamics) / 0.001
    np.testing.assert_allclose(slotine_li.rate, 8.0)
    np.testing.assert_allclose(slotine_li.gain, np.minimum(gains.stiffness / 8.0, ceiling))
    np.testing.assert_allclose(computed.kp, np.maximum(256.0, gains.stiffness / largest_inertia(robot, dynamics)))
    np.testing.assert_allclose(computed.kd**2, 4.0 * computed.kp)
    pd = nbs.PD.for_robot(robot)
    np.testing.assert_allclose(pd.kp, gains.stiffness)
    critical = 2.0 * np.sqrt(pd.kp * largest_inertia(robot, dynamics))
    np.testing.assert_allclose(pd.kd, np.minimum(critical, ceiling))


UNIT = {"kp": np.ones(1), "ki": np.ones(1), "kd": np.ones(1)}
STILL = Reference(*np.zeros((3, 1)))


def test_pid_filter_is_a_first_order_lag():
    """A step of velocity error reaches 1 − e⁻¹ of the derivative after the filter time."""
    pid = PID(**UNIT, effort_limit=np.inf, filter_time=0.1)
    memory = pid.initial_memory(np.zeros(1))
    for _ in range(1000):
        _, memory = pid.step(memory, np.zeros(1), np.ones(1), STILL, 0.0001)
    assert memory.derivative[0] == pytest.approx(1.0 - np.exp(-1.0), rel=1e-3)


def test_pid_integral_rests_while_saturated():
    pid = PID(**UNIT, effort_limit=np.array([0.5]))
    memory = pid.initial_memory(np.ones(1))
    for _ in range(100):
        _, memory = pid.step(memory, np.ones(1), np.zeros(1), STILL, 0.01)
    assert memory.integral[0] == 0.0
    _, free = pid.step(pid.initial_memory(np.ones(1)), np.full(1, 0.1), np.zeros(1), STILL, 0.01)
    assert free.integral[0] == pytest.approx(0.001)


def test_pid_integral_unwinds_while_saturated():
    """Saturated by a full integral, an error of the other sign still empties it."""
    pid = PID(**UNIT, effort_limit=np.array([0.5]))
    full = PIDMemory(np.array([3.0]), np.zeros(1))
    _, after = pid.step(full, np.array([-0.1]), np.zeros(1), STILL, 0.01)
    assert after.integral[0] == pytest.approx(3.0 - 0.001)


@pytest.mark.parametrize(("name", "bandwidth"), [("panda", 64.0), ("xarm7", 32.0)])
def test_a_bandwidth_beyond_the_effort_limits_warns(name, bandwidth):
    robot = load_robot(name)
    for law in (NeuralBackstepping, nbs.SlotineLi, nbs.ComputedTorque):
        with pytest.warns(UserWarning, match=r"times its effort limit from an error of 0\.3 rad"):
            law.for_robot(robot, bandwidth=bandwidth)


@pytest.mark.parametrize("kind", [NeuralBackstepping, nbs.SlotineLi, nbs.ComputedTorque, nbs.PD])
def test_friction_of_another_size_is_refused(kind):
    with pytest.raises(ArgumentError, match="the friction is for 1 joints"):
        kind.for_robot(load_robot("two_link"), friction=JointFriction(np.ones(1), np.ones(1)))


@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize("potential", POTENTIALS)
def test_torque_is_the_law_written_with_matrices(robot, potential, damping):
    """The two-RNEA, no-Hessian form against docs/theory.md §2 written out term by term."""
    controller = NeuralBackstepping.for_robot(robot, potential=potential, damping=damping, seed=2)
    q, v, q_ref, v_ref, a_ref = arguments(robot.nv)
    dynamics = PinocchioDynamics(robot)
    rate = controller.rate.numpy()
    z1, dz1 = robot.difference(q, q_ref), v - v_ref
    gradient = controller.potential.terms(z1, dz1)[1]
    columns = [controller.potential.terms(z1, np.broadcast_to(e, z1.shape))[2] for e in np.eye(robot.nv)]
    hessian = np.stack(columns, axis=-1)
    phi, dphi = v_ref - rate * gradient, a_ref - rate * matvec(hessian, dz1)
    z2 = v - phi
    mass = dynamics.mass_matrix(q)
    matrix = controller.inertial_rate * mass + controller.damping.matrix(z2)
    tau = matvec(mass, dphi) + matvec(dynamics.coriolis_matrix(q, v), phi) + dynamics.gravity(q)
    tau = tau - gradient - matvec(matrix, z2)
    ours = controller.torque(q, v, q_ref, v_ref, a_ref)
    np.testing.assert_allclose(ours, tau, rtol=1e-11, atol=1e-11 * np.abs(tau).max())


@settings(max_examples=12, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    damping=st.sampled_from(DAMPINGS),
    potential=st.sampled_from(POTENTIALS),
    name=st.sampled_from(["three_link", "panda"]),
)
def test_lyapunov_identity_along_simulated_motion(seed, damping, potential, name):
    """V̇ = −∇ΦᵀΛ∇Φ − z2ᵀ(ωM + D)z2 + z2ᵀτ_d for random weights, V̇ by differentiating V along the motion."""
    robot = load_robot(name)
    dynamics = PinocchioDynamics(robot)
    controller = NeuralBackstepping.for_robot(robot, dynamics, damping=damping, potential=potential)
    randomise(controller, seed)
    check_lyapunov_identity(controller, seed)


def check_lyapunov_identity(controller: NeuralBackstepping, seed: int) -> None:
    """V̇ = −dissipation + z2ᵀτ_d along a motion from a random start, to 1e-8 of its terms."""
    dynamics = controller.dynamics
    robot, rng = dynamics.robot, np.random.default_rng(seed)
    reference = nbs.Sinusoid(amplitude=rng.uniform(0.1, 1.0, robot.nv), frequency=rng.uniform(0.5, 3.0), offset=0.0)
    start = reference(0.0).q + rng.normal(size=robot.nv)
    anywhere = {"q0": start, "effort_limit": np.inf, "check": False}
    run = nbs.simulate(nbs.DynamicsPlant(dynamics), controller, reference, 0.002, 1e-4, **anywhere)
    rows = slice(0, None, 4)
    disturbance = rng.normal(size=run.q[rows].shape)
    q, v, q_ref, v_ref, a_ref = (x[rows] for x in (run.q, run.v, run.q_ref, run.v_ref, run.a_ref))
    tau = controller.torque(q, v, q_ref, v_ref, a_ref)
    acceleration = dynamics.forward_dynamics(q, v, tau + disturbance)
    tensors = [torch.as_tensor(x).requires_grad_() for x in (q, v, q_ref, v_ref)]
    gradients = torch.autograd.grad(controller.storage(*tensors).sum(), tensors)
    rates = (v, acceleration, v_ref, a_ref)
    parts = [(g.numpy() * rate).sum(-1) for g, rate in zip(gradients, rates, strict=True)]
    power = (controller.errors(q, v, q_ref, v_ref, a_ref).z2 * disturbance).sum(-1)
    dissipation = controller.dissipation(q, v, q_ref, v_ref)
    scale = np.abs(parts).max(axis=0) + dissipation
    assert (np.abs(sum(parts) - (power - dissipation)) <= 1e-8 * scale).all()


def test_the_paper_torque_jumps_and_the_smooth_one_does_not():
    """Crossing z1 = 0, where the paper's ∇²ψ is undefined, at speed (docs/theory.md §3)."""
    dynamics = nbs.AnalyticDynamics()
    smooth = NeuralBackstepping(dynamics, Potential(np.eye(2), seed=1), Damping(2, floor=np.eye(2)))
    zero, fast = np.zeros(2), np.array([5.0, -5.0])

    def jump(controller, distance: float) -> float:
        z = np.array([distance, -distance])
        after, before = (controller.torque(s * z, fast, zero, zero, zero) for s in (1.0, -1.0))
        return float(np.abs(after - before).max())

    paper = nbs.paper_controller(dynamics, seed=1)
    assert jump(paper, 1e-9) > 0.1
    assert jump(paper, 1e-9) == pytest.approx(jump(paper, 1e-11), rel=1e-3)  # a jump, not a steep slope
    assert jump(smooth, 1e-9) < 1e-6


def test_friction_fed_forward_at_the_reference_velocity_only_dissipates():
    """Monotone friction f: −z2ᵀ(f(v) − f(v_r)) ≤ 0, so V falls at least as fast as without it."""
    robot = load_robot("z1")
    friction, states = JointFriction.of(robot), arguments(robot.nv, (50,))
    with_it = NeuralBackstepping.for_robot(robot, friction=friction)
    without = NeuralBackstepping.for_robot(robot)
    e = with_it.errors(*states)
    fed = with_it.torque(*states) - without.torque(*states)
    np.testing.assert_allclose(fed, friction.torque(e.v_r), rtol=1e-9, atol=1e-9)
    assert (e.z2 * (fed - friction.torque(states[1]))).sum(-1).max() <= 0.0


def test_gains_scale_with_the_inertia_and_respect_the_effort():
    robot = load_robot("panda")
    dynamics = PinocchioDynamics(robot)
    gains = gains_for_robot(robot, dynamics, bandwidth=8.0, period=0.001)
    inertia = effective_inertia(robot, dynamics)
    assert (gains.stiffness * 0.3 <= robot.effort_limit + 1e-9).all()
    assert (gains.stiffness <= 1e4 * inertia + 1e-9).all()
    np.testing.assert_allclose(gains.rate * gains.stiffness, 8.0)
    np.testing.assert_allclose(gains.damping, 1.4 * np.sqrt(gains.stiffness * inertia))
    mass = dynamics.mass_matrix(np.random.default_rng(5).uniform(robot.lower, robot.upper, (500, 7)))
    assert (inertia <= 1.05 / np.diagonal(np.linalg.inv(mass), axis1=-2, axis2=-1)).all()


NETWORKS = Potential(np.eye(2)), Damping(2, form="paper")
UR5 = PinocchioDynamics(load_robot("ur5"))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda r, d: NeuralBackstepping.for_robot(r, bandwidth=-1.0), "bandwidth is -1.0; give a finite number > 0"),
        (lambda r, d: NeuralBackstepping.for_robot(r, bandwidth=900.0), "at most 500 rad/s"),
        (lambda r, d: NeuralBackstepping.for_robot(r, damping="none"), "give one of inertial, bounded, paper"),
        (lambda r, d: NeuralBackstepping.for_robot(r, potential="none"), "give one of paper, smooth"),
        (lambda r, d: NeuralBackstepping(d, Potential(np.eye(3)), Damping(2, floor=np.eye(2))), "2, 3 and 2 joints"),
        (lambda r, d: NeuralBackstepping(d, *NETWORKS, rate=np.zeros(2)), "rate Λ is"),
        (lambda r, d: NeuralBackstepping(d, *NETWORKS, inertial_rate=-1.0), "inertial_rate is -1.0"),
        (lambda r, d: NeuralBackstepping.for_robot(r, UR5), "the dynamics has 6 joints and two_link 2"),
        (lambda r, d: nbs.PD(d, feedforward="all", kp=1.0, kd=1.0), "give one of gravity, reference"),
        (lambda r, d: nbs.PD(d, feedforward="gravity", kp=np.array([1.0, -1.0]), kd=1.0), "kp is"),
        (lambda r, d: nbs.SlotineLi(d, rate=np.ones(3), gain=1.0), "rate is"),
        (lambda r, d: nbs.ComputedTorque(d, kp=np.nan, kd=1.0), "kp is nan"),
        (
            lambda r, d: PID(kp=np.ones(2), ki=1.0, kd=1.0, effort_limit=1.0, filter_time=-1.0),
            "filter_time is -1.0; give",
        ),
        (lambda r, d: nbs.paper_controller(d).torque(*[np.zeros(3)] * 5), r"q has shape \(3,\), expected \(.*, 2\)"),
    ],
)
def test_impossible_controllers_are_refused(make, words):
    robot = load_robot("two_link")
    with pytest.raises(ArgumentError, match=words):
        make(robot, PinocchioDynamics(robot))
