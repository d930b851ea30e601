"""One contract for every dynamics provider on every arm: the identities that control relies on."""

from pathlib import Path

import numpy as np
import pytest
import torch

from nbs_pin.base.arrays import matvec
from nbs_pin.base.exceptions import ArgumentError, CertificateRefused
from nbs_pin.dynamics import equations
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.chain import Chain
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.registry import make_network
from nbs_pin.dynamics.residual import ResidualDynamics, ResidualNetwork
from nbs_pin.robots.catalogue import ROBOT_NAMES
from nbs_pin.robots.robot import load_robot

GANTRY = str(Path(__file__).parent / "data" / "gantry.urdf")  # prismatic, revolute and continuous
LEARNED = ["chain", "cholesky", "homogenised", "residual"]
PROVIDERS = [*ROBOT_NAMES, GANTRY, "analytic", "analytic_uneven", *LEARNED]
ROWS = 8


@pytest.fixture(scope="module", params=PROVIDERS)
def dynamics(request) -> DynamicsProvider:
    return make(request.param)


def make(name: str) -> DynamicsProvider:
    if name == "analytic":
        return AnalyticDynamics()
    if name == "analytic_uneven":
        return AnalyticDynamics(masses=(0.7, 1.9), lengths=(0.4, 1.3), gravity=9.81)
    if name in LEARNED:
        return learned(name)
    return PinocchioDynamics(load_robot(name))


def learned(name: str) -> LagrangianDynamics:
    """A network far from its start, on joints that turn and slide."""
    if name == "residual":
        network = ResidualNetwork(PinocchioDynamics(load_robot(GANTRY)), seed=1)
    elif name == "chain":
        network = Chain((0, 1, 1), (False, True, False), seed=1)
    else:
        network = make_network(name, (False, True, False), 1, inertia=(2.0, 0.3, 5.0), energy=7.0, epsilon=0.1)
    generator = torch.Generator().manual_seed(2)
    for parameter in network.parameters():
        parameter.data += 0.1 * torch.randn(parameter.shape, dtype=torch.float64, generator=generator)
    return ResidualDynamics(network) if name == "residual" else LagrangianDynamics(network)


def states(dynamics: DynamicsProvider, count: int, *more: float, seed: int = 0) -> list[np.ndarray]:
    """Uniform configurations and normal vectors of the given scales, shape (ROWS, nv) each."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (ROWS, dynamics.nv))
    return [q, *(rng.normal(size=(ROWS, dynamics.nv)) for _ in range(count - 1))]


def relative(error: np.ndarray, scale: np.ndarray) -> float:
    return float(np.abs(error).max() / max(1e-30, np.abs(scale).max()))


def mass_rate(dynamics: DynamicsProvider, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Ṁ along v by fourth-order central differences."""
    h = 1e-3

    def m(s: float) -> np.ndarray:
        return dynamics.mass_matrix(q + s * v)

    return (8 * (m(h) - m(-h)) - (m(2 * h) - m(-2 * h))) / (12 * h)


def test_mass_matrix_is_symmetric_positive_definite(dynamics):
    (q,) = states(dynamics, 1)
    mass = dynamics.mass_matrix(q)
    assert relative(mass - np.swapaxes(mass, -1, -2), mass) < 1e-14
    assert np.linalg.eigvalsh(mass).min() > 0.0


def test_mass_rate_minus_twice_coriolis_is_skew(dynamics):
    q, v, x = states(dynamics, 3)
    rate, coriolis = mass_rate(dynamics, q, v), dynamics.coriolis_matrix(q, v)
    skew = rate - 2.0 * coriolis
    assert relative(skew + np.swapaxes(skew, -1, -2), coriolis) < 1e-8
    quadratic = np.einsum("bi,bij,bj->b", x, skew, x)  # x is not v
    assert np.abs(quadratic).max() < 1e-8 * np.abs(coriolis).max() * (x * x).sum(-1).max()


def test_coriolis_is_symmetric_in_its_velocities(dynamics):
    q, v, w = states(dynamics, 3)
    left, right = matvec(dynamics.coriolis_matrix(q, v), w), matvec(dynamics.coriolis_matrix(q, w), v)
    assert relative(left - right, left) < 1e-12


def test_coriolis_force_is_the_christoffel_one(dynamics):
    """C(q, v) v = Ṁ v − ½ ∂(vᵀMv)/∂q, the Euler–Lagrange equation by finite differences."""
    q, v = states(dynamics, 2)
    h = 1e-3

    def kinetic(shift: np.ndarray) -> np.ndarray:
        return equations.kinetic_energy(dynamics, q + shift, v)

    gradient = np.stack(
        [
            (8 * (kinetic(e) - kinetic(-e)) - (kinetic(2 * e) - kinetic(-2 * e))) / (12 * h)
            for e in h * np.eye(dynamics.nv)
        ],
        axis=-1,
    )
    lagrange = matvec(mass_rate(dynamics, q, v), v) - gradient
    force = matvec(dynamics.coriolis_matrix(q, v), v)
    assert relative(force - lagrange, force) < 1e-8


def test_gravity_is_the_gradient_of_the_potential(dynamics):
    (q,) = states(dynamics, 1)
    h = 1e-3
    columns = []
    for e in h * np.eye(dynamics.nv):
        v = [dynamics.potential_energy(q + s * e) for s in (1, -1, 2, -2)]
        columns.append((8 * (v[0] - v[1]) - (v[2] - v[3])) / (12 * h))
    gravity = dynamics.gravity(q)
    assert relative(gravity - np.stack(columns, axis=-1), gravity) < 1e-8


def test_reference_torque_equals_its_ingredients(dynamics):
    q, v, v_r, a_r = states(dynamics, 4)
    fast = equations.reference_torque(dynamics, q, v, v_r, a_r)
    plain = DynamicsProvider.reference_torque(dynamics, q, v, v_r, a_r)
    assert relative(fast - plain, plain) < 1e-13


def test_inverse_and_forward_dynamics_undo_each_other(dynamics):
    q, v, a = states(dynamics, 3)
    tau = equations.inverse_dynamics(dynamics, q, v, a)
    condition = np.linalg.cond(dynamics.mass_matrix(q)).max()
    for forward in (dynamics.forward_dynamics(q, v, tau), DynamicsProvider.forward_dynamics(dynamics, q, v, tau)):
        assert relative(forward - a, a) < 1e-15 * condition + 1e-12


def test_energy_changes_at_the_rate_of_the_power(dynamics):
    """dE/dt = vᵀτ, the time derivative by central differences along the motion's second-order expansion."""
    q, v, tau = states(dynamics, 3)
    a = equations.forward_dynamics(dynamics, q, v, tau)
    scale = 1.0 / max(1.0, np.abs(a).max())
    h = 1e-3 * scale

    def e(s: float) -> np.ndarray:
        return equations.energy(dynamics, q + s * v + 0.5 * s * s * a, v + s * a)

    rate = (8 * (e(h) - e(-h)) - (e(2 * h) - e(-2 * h))) / (12 * h)
    power = (v * tau).sum(-1)
    acceleration_power = np.abs(v * matvec(dynamics.mass_matrix(q), a)).max()
    assert np.abs(rate - power).max() < 1e-7 * max(acceleration_power, np.abs(power).max())


@pytest.mark.parametrize("quantity", ["mass_matrix", "coriolis_matrix", "gravity", "potential_energy"])
def test_batch_is_the_stack_of_its_rows(dynamics, quantity):
    arguments = states(dynamics, 2 if quantity == "coriolis_matrix" else 1)
    function = getattr(dynamics, quantity)
    batch = function(*(x.reshape(2, ROWS // 2, -1) for x in arguments))
    rows = np.stack([function(*row) for row in zip(*arguments, strict=True)])
    assert batch.shape == (2, ROWS // 2, *rows.shape[1:])
    # A product of matrices may sum in another order when there are more rows.
    bound = 1e-13 * np.abs(rows).max() if isinstance(dynamics, LagrangianDynamics) else 0.0
    np.testing.assert_allclose(batch.reshape(rows.shape), rows, rtol=0.0, atol=bound)


def test_torch_gives_the_numbers_of_numpy(dynamics):
    q, v, v_r, a_r = states(dynamics, 4)
    tensors = [torch.as_tensor(x) for x in (q, v, v_r, a_r)]
    for name, count in (("mass_matrix", 1), ("coriolis_matrix", 2), ("gravity", 1), ("potential_energy", 1),
                        ("reference_torque", 4), ("forward_dynamics", 3)):  # fmt: skip
        ours = getattr(dynamics, name)(*(q, v, v_r, a_r)[:count])
        theirs = getattr(dynamics, name)(*tensors[:count])
        assert isinstance(theirs, torch.Tensor)
        assert relative(theirs.numpy() - ours, ours) < 1e-13


@pytest.mark.parametrize(
    ("quantity", "count"),
    [("mass_matrix", 1), ("coriolis_matrix", 2), ("gravity", 1), ("potential_energy", 1), ("reference_torque", 4),
     ("forward_dynamics", 3)],
)  # fmt: skip
def test_gradients_against_finite_differences(dynamics, quantity, count):
    """⟨w, f⟩ differentiated along a random direction of every argument, against central differences."""
    function = getattr(dynamics, quantity)
    rng = np.random.default_rng(7)
    arguments = [x[:2] for x in states(dynamics, count, seed=3)]
    value = function(*arguments)
    weights = torch.as_tensor(rng.normal(size=value.shape))
    tensors = [torch.as_tensor(x).requires_grad_() for x in arguments]
    gradients = torch.autograd.grad((weights * function(*tensors)).sum(), tensors)
    for k, gradient in enumerate(gradients):
        along = rng.normal(size=arguments[k].shape)

        def shifted(h: float, k=k, along=along) -> np.ndarray:
            return function(*(x + h * along if i == k else x for i, x in enumerate(arguments)))

        h = 1e-3
        slope = (8 * (shifted(h) - shifted(-h)) - (shifted(2 * h) - shifted(-2 * h))) / (12 * h)
        numeric = float((weights.numpy() * slope).sum())
        assert abs(float((gradient.numpy() * along).sum()) - numeric) < 1e-7 * (
            np.abs(slope).sum() + np.abs(value).max()
        )


def test_a_second_derivative_is_refused():
    dynamics = PinocchioDynamics(load_robot("two_link"))
    q = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(dynamics.gravity(q).sum(), q, create_graph=True)
    with pytest.raises(RuntimeError, match="does not require grad"):
        gradient.sum().backward()


def test_closed_form_and_pinocchio_are_one_arm():
    robot = load_robot("two_link")
    ours, theirs = AnalyticDynamics(robot=robot), PinocchioDynamics(robot)
    q, v = states(ours, 2)
    for name, arguments in (("mass_matrix", (q,)), ("coriolis_matrix", (q, v)), ("gravity", (q,))):
        np.testing.assert_allclose(getattr(ours, name)(*arguments), getattr(theirs, name)(*arguments), atol=1e-11)
    constant = ours.potential_energy(q) - theirs.potential_energy(q)
    assert np.ptp(constant) < 1e-12


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((np.zeros(3), np.zeros(2), np.zeros(2)), r"q has shape \(3,\), expected \(\.\.\., 2\)"),
        ((np.zeros(2), torch.zeros(2), np.zeros(2)), "numpy and torch were mixed"),
        ((np.zeros((3, 2)), np.zeros((4, 2)), np.zeros(2)), "batch shapes do not broadcast"),
        ((torch.zeros(2),) * 3, r"q is a torch\.float32 tensor, expected float64; give q\.double\(\)"),
    ],
)
def test_wrong_arguments_are_refused_in_one_sentence(arguments, words):
    with pytest.raises(ArgumentError, match=words):
        equations.inverse_dynamics(AnalyticDynamics(), *arguments)


def test_lists_and_broadcasting_are_welcome():
    dynamics = AnalyticDynamics()
    many = equations.inverse_dynamics(dynamics, [[0.0, 0.1], [0.2, 0.3]], [1.0, 2.0], [0, 0])
    assert many.shape == (2, 2)
    np.testing.assert_array_equal(many[1], equations.inverse_dynamics(dynamics, [0.2, 0.3], [1.0, 2.0], [0.0, 0.0]))


def test_wrong_parameters_are_refused():
    with pytest.raises(ArgumentError, match="give a finite number > 0"):
        AnalyticDynamics(masses=(1.0, -1.0))


@pytest.mark.parametrize("masses", [(1.0, float("nan")), (float("inf"), 1.0)])
def test_masses_that_are_no_numbers_are_refused(masses):
    with pytest.raises(ArgumentError, match="give a finite number"):
        AnalyticDynamics(masses=masses)


def test_an_empty_batch_gives_an_empty_result():
    dynamics = PinocchioDynamics(load_robot("two_link"))
    assert dynamics.mass_matrix(np.zeros((0, 2))).shape == (0, 2, 2)
    assert dynamics.gravity(torch.zeros((0, 2), dtype=torch.float64)).shape == (0, 2)


def test_a_provider_called_directly_checks_its_arguments():
    dynamics = PinocchioDynamics(load_robot("ur5"))
    with pytest.raises(ArgumentError, match=r"q has shape \(5,\), expected \(\.\.\., 6\)"):
        dynamics.gravity(np.zeros(5))


def test_a_model_that_is_no_longer_its_arms_is_refused():
    robot = load_robot("panda")
    dynamics = PinocchioDynamics(robot)
    assert dynamics.structure_claims() is not None
    dynamics._model = robot.model.copy()
    dynamics._model.armature = np.full(robot.nv, 0.1)
    with pytest.raises(CertificateRefused, match="the model is no longer that of the arm panda"):
        dynamics.structure_claims()
