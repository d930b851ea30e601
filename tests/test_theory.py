"""What docs/theory.md says of the paper and of the bounds, recomputed: counterexamples exactly, bounds simulated."""

import numpy as np
import pytest
import torch

from nbs_pin.base.arrays import matvec
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping, paper_controller
from nbs_pin.controllers.potential import POTENTIALS, Potential
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.motions.disturbances import SquareWave
from nbs_pin.motions.references import Hold, Sinusoid
from nbs_pin.robots.robot import load_robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.simulate import simulate
from tests.test_networks import randomise


class UnitInertia(DynamicsProvider):
    """One joint, M = 1, C = G = 0."""

    nv = 1

    def mass_matrix(self, q):
        return np.ones((*q.shape, 1))

    def coriolis_matrix(self, q, v):
        return np.zeros((*q.shape, 1))

    def gravity(self, q):
        return np.zeros(q.shape)

    def potential_energy(self, q):
        return np.zeros(q.shape[:-1])


def linear_law(dynamics: DynamicsProvider, s: float, d: float) -> NeuralBackstepping:
    """Φ = s‖z‖², D = dI: the networks at zero."""
    eye = np.eye(dynamics.nv)
    controller = NeuralBackstepping(dynamics, Potential(s * eye), Damping(dynamics.nv, floor=d * eye))
    with torch.no_grad():
        for parameter in controller.parameters():
            parameter.zero_()
    return controller


def inertia_slope(q: np.ndarray) -> np.ndarray:
    """∂M_ij/∂q_k of the paper's arm, indices [i, j, k]."""
    return torch.autograd.functional.jacobian(AnalyticDynamics().mass_matrix, torch.as_tensor(q)).numpy()


def test_the_papers_coriolis_matrix_fails_on_its_own_arm_however_it_is_read():
    """At β₂ = π/2: N − ½Nᵀ loses the skew symmetry, ½Ṁ loses the force; ½(Ṁ + N − Nᵀ) keeps both."""
    q, v, x = np.array([0.3, np.pi / 2]), np.array([1.0, 0.0]), np.array([0.0, 1.0])
    slope = inertia_slope(q)
    mass_rate, n = slope @ v, np.einsum("ikj,k->ij", slope, v)
    christoffel = AnalyticDynamics().coriolis_matrix(q, v)
    np.testing.assert_allclose(christoffel, 0.5 * (mass_rate + n - n.T), atol=1e-15)
    assert x @ (mass_rate - 2.0 * christoffel) @ x == pytest.approx(0.0, abs=1e-15)
    read, literal = n - 0.5 * n.T, mass_rate - 0.5 * mass_rate.T
    np.testing.assert_allclose(read @ v, christoffel @ v, atol=1e-15)
    assert x @ (mass_rate - 2.0 * read) @ x == pytest.approx(1.0)
    np.testing.assert_allclose(christoffel @ v, [0.0, 1.0], atol=1e-15)
    np.testing.assert_allclose(literal @ v, [0.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("potential", POTENTIALS)
def test_theorem_1_is_exponential(potential):
    """V(t) ≤ V(0) e^(−2ωt) for the inertial damping, whatever the weights, with a moving reference."""
    robot = load_robot("three_link")
    dynamics = PinocchioDynamics(robot)
    omega = 3.0
    controller = NeuralBackstepping.for_robot(robot, dynamics, potential=potential, bandwidth=omega)
    randomise(controller, seed=7, gain=0.5)
    reference = Sinusoid(amplitude=np.full(3, 0.5), frequency=2.0)
    starts = np.random.default_rng(2).uniform(-1.0, 1.0, (6, 3))
    run = simulate(
        DynamicsPlant(dynamics), controller, reference, 0.4, 5e-4, q0=starts, effort_limit=np.inf, lookahead=0.0
    )
    storage = controller.storage(run.q, run.v, run.q_ref, run.v_ref)
    bound = storage[0] * np.exp(-2.0 * omega * run.t)[:, None]
    assert (storage <= 1.001 * bound).all()


def test_theorems_2_and_3_are_false_and_the_true_bound_holds():
    """M = 1, S = ¼, D = ½, τ_d = ±1: the error leaves the printed set, and comes to its worst case in closed form."""
    controller = linear_law(UnitInertia(), 0.25, 0.5)
    half_period = np.sqrt(2.0) * np.pi
    wave = SquareWave(1.0, frequency=np.pi / half_period, phase=1e-6)
    h = half_period / 200
    run = simulate(DynamicsPlant(UnitInertia()), controller, Hold([0.0]), 1400 * h, h, plant_step=h, disturbance=wave)
    worst = (run.q[1000:] ** 2).max()
    assert worst == pytest.approx(16 / 9 / np.tanh(np.pi / np.sqrt(8)) ** 2, rel=1e-2)
    gradient = controller.errors(run.q, run.v, run.q_ref, run.v_ref, run.a_ref).gradient
    assert (gradient[1000:] ** 2).max() > 1.3 * 0.5  # Theorem 2 prints ½d
    assert worst > 1.3 * 2.0  # Theorem 3 prints d/(2α²) with α = ½
    assert worst < 8.0  # ρ = κ = ½, Δ = 2d, V∞ = 2d, ‖z1‖² ≤ V∞/S


@pytest.mark.parametrize("potential", POTENTIALS)
def test_the_inertial_bound_holds_for_any_weights(potential):
    """limsup z1ᵀS z1 ≤ V∞ = Δ/(8ω), and each |z1_i| ≤ √(2V∞/K_i), under square waves of 1 to 30 rad/s."""
    robot = load_robot("three_link")
    dynamics = PinocchioDynamics(robot)
    omega, h = 4.0, 0.004
    controller = NeuralBackstepping.for_robot(robot, dynamics, potential=potential, bandwidth=omega, period=h)
    randomise(controller, seed=3, gain=0.3)
    amplitude, frequencies = np.array([10.0, 5.0, 2.0]), np.array([1.0, 4.0, 30.0])
    delta = amplitude @ np.linalg.solve(controller.damping.floor.numpy(), amplitude)
    stiffness = controller.potential.stiffness.numpy()

    def square_waves(t, q, v):
        return amplitude * np.sign(np.sin(frequencies[:, None] * t + np.arange(3.0)))

    start = np.tile([0.5, -0.4, 0.3], (3, 1))
    run = simulate(
        DynamicsPlant(dynamics), controller, Hold(start[0]), 3.0, h, q0=start, plant_step=h,
        disturbance=square_waves, effort_limit=np.inf,
    )  # fmt: skip
    z1 = (run.q - run.q_ref)[250:]
    ultimate = delta / (8.0 * omega)
    assert np.einsum("tbi,ij,tbj->tb", z1, stiffness, z1).max() <= ultimate
    worst, bound = np.abs(z1).max(axis=(0, 1)), np.sqrt(ultimate * np.diagonal(np.linalg.inv(stiffness)))
    assert (worst <= bound).all()
    assert (worst >= 0.02 * bound).all()  # the waves do push


def test_the_papers_regulariser_is_zero_over_its_whole_sweep():
    """S = I gives ∇²Φ(0) ⪰ 2I, so relu(λ_max(αI − ∇²Φ(0))) = 0 for every α in [0, 2]."""
    for seed in range(5):
        potential = paper_controller(AnalyticDynamics(), m=1.0, seed=seed).potential
        for side in (-1e-9, 0.0, 1e-9):  # one-sided values too: the Hessian jumps at 0
            z = np.full((2, 2), side)
            hessian = potential.terms(z, np.eye(2))[2]
            assert np.linalg.eigvalsh(2.0 * np.eye(2) - hessian).max() <= 1e-12


def test_paper_damping_is_below_one_half_from_an_off_diagonal_of_0_71_on():
    """T = [[1, 0], [c, 1]]: λ + 1/λ = 2 + c², so λ_min < ½ exactly when |c| > 1/√2, which tanh reaches."""
    for c, below in ((0.70, False), (0.71, True)):
        t = np.array([[1.0, 0.0], [c, 1.0]])
        assert (np.linalg.eigvalsh(t.T @ t)[0] < 0.5) == below


def test_the_law_solves_the_error_equation_of_the_paper():
    """M ż2 + C z2 = −∇Φ − D z2 + τ_d and ż1 = z2 − Λ∇Φ: the two lines from which V̇ follows."""
    robot = load_robot("three_link")
    dynamics = PinocchioDynamics(robot)
    controller = NeuralBackstepping.for_robot(robot, dynamics, seed=4)
    q, v, q_ref, v_ref, a_ref, tau_d = np.random.default_rng(0).normal(size=(6, 5, 3))
    e = controller.errors(q, v, q_ref, v_ref, a_ref)
    mass, coriolis = dynamics.mass_matrix(q), dynamics.coriolis_matrix(q, v)
    dv = dynamics.forward_dynamics(q, v, controller.torque(q, v, q_ref, v_ref, a_ref) + tau_d)
    damping = matvec(controller.inertial_rate * mass + controller.damping.matrix(e.z2), e.z2)
    left = matvec(mass, dv - e.a_r) + matvec(coriolis, e.z2)
    np.testing.assert_allclose(left, -e.gradient - damping + tau_d, rtol=1e-9, atol=1e-9 * np.abs(left).max())
    np.testing.assert_allclose(v - v_ref, e.z2 - controller.rate.numpy() * e.gradient, rtol=1e-12, atol=1e-9)
