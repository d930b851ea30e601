"""Lagrangian networks: structure that holds for every parameter value, one formula against another, models in files."""

import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.chain import Chain
from nbs_pin.dynamics.cholesky import CholeskyNetwork
from nbs_pin.dynamics.features import JointFeatures
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.identified import IdentifiedDynamics
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.lagrangian_network import GeneralLagrangianNetwork, LagrangianNetwork
from nbs_pin.dynamics.picnn import PICNN
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.dynamics.registry import NETWORKS, make_network
from nbs_pin.dynamics.residual import ResidualDynamics, ResidualNetwork
from nbs_pin.dynamics.softplus_network import SoftplusNetwork, paper_spread, softplus
from nbs_pin.robots.robot import Robot

JOINTS = (False, True, False)
SCALES = {"inertia": (2.0, 0.3, 5.0), "energy": 7.0, "epsilon": 0.05}
QUADRATIC = ["cholesky", "homogenised", "residual"]
GENERAL = ["picnn", "unconstrained"]


def scrambled(network: LagrangianNetwork, spread: float = 0.2, seed: int = 0) -> LagrangianNetwork:
    """The network with parameters far from its start."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in network.parameters():
        parameter.data += spread * torch.randn(parameter.shape, dtype=torch.float64, generator=generator)
    return network


def make(name: str, spread: float = 0.2, seed: int = 0) -> LagrangianNetwork:
    if name == "chain":
        return scrambled(Chain((0, 1, 1), JOINTS, seed=seed), spread, seed)
    if name == "residual":
        return scrambled(ResidualNetwork(AnalyticDynamics(), seed=seed), spread, seed)
    return scrambled(make_network(name, JOINTS, seed, **SCALES), spread, seed)


def tensors(network: LagrangianNetwork, count: int, rows: int = 6, seed: int = 1) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(rows, network.nv, dtype=torch.float64, generator=generator) for _ in range(count)]


def close(ours: torch.Tensor, theirs: torch.Tensor, tolerance: float = 1e-12) -> bool:
    return bool((ours - theirs).abs().max() <= tolerance * max(1.0, float(theirs.detach().abs().max())))


class Exact(LagrangianNetwork):
    """The two-link arm, as a network without weights."""

    def __init__(self) -> None:
        super().__init__()
        self.nv, self.arm = 2, AnalyticDynamics()

    def mass_matrix(self, q):
        return self.arm.mass_matrix(q)

    def potential(self, q):
        return self.arm.potential_energy(q)


class ExactGeneral(GeneralLagrangianNetwork):
    """The same arm, known by its Lagrangian alone."""

    def __init__(self) -> None:
        super().__init__()
        self.nv, self.arm = 2, AnalyticDynamics()

    def lagrangian(self, q, v):
        return 0.5 * (v * (self.arm.mass_matrix(q) @ v[..., None])[..., 0]).sum(-1) - self.arm.potential_energy(q)


@pytest.mark.parametrize("network", [Exact(), ExactGeneral()], ids=["quadratic", "general"])
def test_the_equations_of_a_known_arm_come_out(network):
    ours, arm = LagrangianDynamics(network), AnalyticDynamics()
    q, v, w, a = (x.numpy() for x in tensors(network, 4))
    for name, arguments in (
        ("mass_matrix", (q,)), ("coriolis_matrix", (q, v)), ("gravity", (q,)), ("potential_energy", (q,)),
        ("reference_torque", (q, v, w, a)), ("reference_torque", (q, v, v, a)), ("forward_dynamics", (q, v, a)),
    ):  # fmt: skip
        np.testing.assert_allclose(getattr(ours, name)(*arguments), getattr(arm, name)(*arguments), atol=1e-12)


@pytest.mark.parametrize("name", QUADRATIC)
def test_a_written_out_torque_is_that_of_automatic_differentiation(name):
    network = make(name)
    q, v, w, a = tensors(network, 4)
    for arguments in ((q, v, w, a), (q, v, v, a)):
        assert close(network.torque(*arguments), LagrangianNetwork.torque(network, *arguments))
    assert close(network.torque(q, v, v.clone(), a), network.torque(q, v, v, a))
    assert close(network.mass_rates(q), LagrangianNetwork.mass_rates(network, q))
    assert close(network.gravity(q), LagrangianNetwork.gravity(network, q))
    assert close(network.kinetic(q, v), LagrangianNetwork.kinetic(network, q, v))


@pytest.mark.parametrize("name", GENERAL)
def test_a_general_torque_is_the_euler_lagrange_equation(name):
    """d/dt ∂L/∂v − ∂L/∂q along q + vt + ½at², all by finite differences of the Lagrangian."""
    network = make(name, 0.05)
    q, v, a = tensors(network, 3)
    h, unit = 1e-3, torch.eye(3, dtype=torch.float64)

    def slope(f):
        return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)

    def momentum(t):
        at, speed = q + t * v + 0.5 * t * t * a, v + t * a
        return torch.stack([slope(lambda s, e=e: network.lagrangian(at, speed + s * e)) for e in unit], dim=-1)

    in_q = torch.stack([slope(lambda s, e=e: network.lagrangian(q + s * e, v)) for e in unit], dim=-1)
    assert close(network.torque(q, v, v, a), slope(momentum) - in_q, 1e-7)
    assert close(network.acceleration(q, v, network.torque(q, v, v, a)), a, 1e-9)


@pytest.mark.parametrize("name", GENERAL)
def test_a_general_torque_is_linear_in_the_second_velocity_with_frozen_christoffel_symbols(name):
    network = make(name, 0.05)
    q, v, w, a = tensors(network, 4)
    frozen = torch.func.vmap(torch.func.jacrev(lambda x, s: network.inertia(x, s)))(q, v)  # (rows, i, j, k)
    along, turned = torch.einsum("bijk,bk->bij", frozen, v), torch.einsum("bikj,bk->bij", frozen, v)
    coriolis = 0.5 * (along + turned - turned.mT)
    expected = network.torque(q, v, v, a) + (coriolis @ (w - v)[..., None])[..., 0]
    assert close(network.torque(q, v, w, a), expected)
    assert close(network.torque(q, v, v.clone(), a), network.torque(q, v, v, a))


@pytest.mark.parametrize("name", GENERAL)
def test_ingredients_of_a_general_network_are_those_at_rest(name):
    model = LagrangianDynamics(make(name, 0.05))
    q, a = (x.numpy() for x in tensors(model.network, 2))
    rest = np.zeros_like(q)
    held = (model.mass_matrix(q) @ a[..., None])[..., 0] + model.gravity(q)
    np.testing.assert_allclose(model.reference_torque(q, rest, rest, a), held, atol=1e-11)
    with torch.no_grad():
        assert float(model.network.kinetic(torch.from_numpy(q), torch.from_numpy(rest)).abs().max()) == 0.0


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.0, 3.0))
@pytest.mark.parametrize("name", [*QUADRATIC, "picnn"])
def test_inertia_has_its_floor_for_every_parameter_value(name, seed, spread):
    network = make(name, spread, seed)
    q, v = tensors(network, 2, seed=seed)
    if name == "residual":
        floor = network.share * np.linalg.eigvalsh(network.nominal.mass_matrix(q.numpy()))[:, 0]
    else:
        floor = np.full(len(q), SCALES["epsilon"])
    for mass in (network.mass_matrix(q), network.inertia(q, 10.0 * v)):
        eigenvalues = np.linalg.eigvalsh(mass.numpy(force=True))
        assert (eigenvalues[:, 0] >= floor - 1e-13 * eigenvalues[:, -1]).all()


def test_the_gate_must_be_clipped_and_an_unconstrained_lagrangian_has_no_floor():
    """What the paper prints is not convex; what stands here is, in the same states and with the same parameters."""

    class AsPrinted(PICNN):
        def _gate(self, i, u):
            return self._linear("wyu", i, u, "by")

    lowest = {PICNN: 0.0, AsPrinted: 0.0}
    for seed in range(8):
        for kind in lowest:
            network = kind(4, 2, (16, 16, 16), torch.Generator().manual_seed(seed), smooth=False)
            generator = torch.Generator().manual_seed(100 + seed)
            u, x = (torch.randn(50, size, dtype=torch.float64, generator=generator) for size in (4, 2))
            hessian = torch.func.vmap(torch.func.hessian(lambda s, c, f=network: f(c, s)))(x, u)
            lowest[kind] = min(lowest[kind], float(torch.linalg.eigvalsh(hessian.detach()).min()))
    assert lowest[PICNN] > -1e-12
    assert lowest[AsPrinted] < -0.1
    free = make("unconstrained")
    assert float(torch.linalg.eigvalsh(free.mass_matrix(*tensors(free, 1, 50)).detach()).min()) < -0.1


def test_curvature_of_a_convex_network_is_its_second_derivative_at_zero():
    for smooth in (True, False):
        network = PICNN(4, 3, (8, 7, 6), torch.Generator().manual_seed(1), smooth=smooth)
        assert network.widths == (8, 7, 6)
        generator = torch.Generator().manual_seed(2)
        u, x = (torch.randn(5, size, dtype=torch.float64, generator=generator) for size in (4, 3))
        hessian = torch.func.vmap(torch.func.hessian(lambda s, c, f=network: f(c, s)))(torch.zeros_like(x), u)
        assert close(network.curvature(u, x), torch.einsum("bij,bi,bj->b", hessian, x, x))


def test_the_start_is_the_papers():
    sizes = (32, 32, 32, 1)
    expected = [2.2 / 32**0.5, 0.58 / 32**0.5, 2 * 0.58 / 32**0.5, 1.0]
    np.testing.assert_allclose([paper_spread(i, sizes) for i in range(4)], expected)
    network = SoftplusNetwork(4000, (32, 32, 32), torch.Generator().manual_seed(0))
    assert float(network.get_parameter("w0").detach().std()) == pytest.approx(expected[0], rel=0.01)
    assert float(network.get_parameter("w2").detach().std()) == pytest.approx(expected[2], rel=0.1)


def test_softplus_is_smooth_far_out_and_in_the_middle():
    x = torch.tensor([-800.0, -30.0, 0.0, 19.9, 20.1, 800.0], dtype=torch.float64)
    expected = np.maximum(x.numpy(), 0.0) + np.log1p(np.exp(-np.abs(x.numpy())))
    np.testing.assert_allclose(softplus(x).numpy(), expected, rtol=1e-15)
    slope = torch.sigmoid(x)
    first, second = (torch.func.jvp(f, (x,), (torch.ones_like(x),))[1] for f in
                     (softplus, torch.func.grad(lambda s: softplus(s).sum())))  # fmt: skip
    np.testing.assert_allclose(first.numpy(), slope.numpy(), atol=1e-15)
    np.testing.assert_allclose(second.numpy(), (slope * (1.0 - slope)).numpy(), atol=1e-15)


def test_features_turn_with_the_joints():
    features = JointFeatures((True, False, True, False))
    assert (features.nv, features.size) == (4, 6)
    q, dq = torch.randn(2, 5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x, dx = torch.func.jvp(features, (q,), (dq,))
    assert torch.equal(x, torch.stack([*(f(q[:, i]) for f in (torch.sin, torch.cos) for i in (1, 3)),
                                       q[:, 0], q[:, 2]], dim=-1))  # fmt: skip
    assert close(features.push(x, dq), dx)
    gradient = torch.randn(5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    assert close(features.pull(x, gradient), torch.func.vjp(features, q)[1](gradient)[0])
    turned = q + 2 * torch.pi * torch.tensor([0.0, 1.0, 0.0, -2.0], dtype=torch.float64)
    assert close(features(turned), x)


@pytest.mark.parametrize("joints", [JOINTS, (True,), (False,) * 7])
@pytest.mark.parametrize("widths", [(64, 64), (5,), (20, 3, 9)])
def test_machine_code_gives_the_torque_of_the_formulas(joints, widths):
    network = scrambled(CholeskyNetwork(joints, widths=widths, energy=3.0, epsilon=0.05, seed=3))
    model = LagrangianDynamics(network)
    states = [x.reshape(2, 70, -1) for x in tensors(network, 4, 140)]
    expected = network.torque(*states).numpy(force=True)
    for ours in (
        model.reference_torque(*(x.numpy() for x in states)),
        pickle.loads(pickle.dumps(model)).reference_torque(*(x.numpy() for x in states)),
        np.stack([model.reference_torque(*(x[0, i].numpy()[::1] for x in states)) for i in range(70)])[None],
    ):
        np.testing.assert_allclose(ours, expected[: len(ours)], atol=2e-14 * np.abs(expected).max())
    bad = [x[0, 0].numpy() for x in states]
    bad[0] = np.full_like(bad[0], np.nan)
    assert np.isnan(model.reference_torque(*bad)).all()


def test_a_seed_gives_one_network_and_leaves_the_global_generator_alone():
    state = torch.get_rng_state()
    for name in NETWORKS:
        one, same, other = (make_network(name, JOINTS, seed).state_dict() for seed in (0, 0, 1))
        assert all(torch.equal(one[k], same[k]) for k in one)
        assert not all(torch.equal(one[k], other[k]) for k in one)
    assert torch.equal(torch.get_rng_state(), state)


def test_an_untrained_residual_is_the_nominal_model():
    nominal = PinocchioDynamics(nbs.load_robot("panda"))
    ours = ResidualDynamics(ResidualNetwork(nominal))
    q, v, w, a = (x.numpy() for x in tensors(ours.network, 4))
    for name, arguments in (("mass_matrix", (q,)), ("gravity", (q,)), ("reference_torque", (q, v, w, a))):
        theirs = getattr(nominal, name)(*arguments)
        np.testing.assert_allclose(getattr(ours, name)(*arguments), theirs, atol=1e-13 * np.abs(theirs).max())
    assert ours.robot.sha256 == nominal.robot.sha256
    assert ours.nominal.nv == 7


def test_a_model_is_a_frozen_copy():
    network = make("cholesky")
    model = LagrangianDynamics(network)
    q = tensors(network, 1)[0].numpy()
    before = model.mass_matrix(q)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += 1.0
    np.testing.assert_array_equal(model.mass_matrix(q), before)
    assert all(p.requires_grad for p in network.parameters())
    law = nbs.SlotineLi(model, rate=1.0, gain=1.0)
    trainable = [name for name, p in law.named_parameters() if p.requires_grad]
    assert trainable
    assert not any(name.startswith("dynamics.") for name in trainable)


def test_other_weights_renew_the_machine_code():
    one, two = (LagrangianDynamics(make("cholesky", seed=seed)) for seed in (0, 1))
    states = [x.numpy() for x in tensors(one.network, 4)]
    assert np.abs(one.reference_torque(*states) - two.reference_torque(*states)).max() > 0.1
    one.load_state_dict(two.state_dict())
    np.testing.assert_array_equal(one.reference_torque(*states), two.reference_torque(*states))


def stored(name: str, robot: Robot) -> DynamicsProvider:
    """A model of every kind that files hold, with friction and a report."""
    more = JointFriction(np.array([0.1, 0.0, 0.3]), np.zeros(3)), {"history": np.array([2.0, 1.0]), "seed": 4}
    if name == "identified":
        parameters = np.array([inertia.toDynamicParameters() for inertia in robot.model.inertias[1:]])
        return IdentifiedDynamics(robot, 1.1 * parameters, more[0], report=more[1])
    if name == "residual":
        return ResidualDynamics(scrambled(ResidualNetwork(PinocchioDynamics(robot), share=0.1, widths=(8, 9))), *more)
    return LagrangianDynamics(make(name, 0.05), robot, *more)


class TestFiles:
    @pytest.mark.parametrize("name", [*NETWORKS, "chain", "residual", "identified"])
    def test_a_learned_model_comes_back_bit_for_bit(self, name, tmp_path):
        robot = nbs.load_robot("three_link")
        model, states = stored(name, robot), np.random.default_rng(0).normal(size=(4, 6, 3))
        nbs.save(model, tmp_path / "model.nbs", info={"samples": 10})
        for again in (nbs.load(tmp_path / "model.nbs"), nbs.load(tmp_path / "model.nbs", robot)):
            np.testing.assert_array_equal(again.reference_torque(*states), model.reference_torque(*states))
            np.testing.assert_array_equal(again.friction.viscous, model.friction.viscous)
            assert type(again) is type(model)
            assert again.robot.name == "three_link"
            assert again.report == {"history": [2.0, 1.0], "seed": 4}
            assert not again.reference_torque(*map(torch.from_numpy, states)).requires_grad
        assert again.robot is robot

    def test_a_law_with_a_learned_model_comes_back(self, tmp_path):
        robot = nbs.load_robot("three_link")
        model = LagrangianDynamics(make("cholesky"), robot)
        law = nbs.NeuralBackstepping.for_robot(robot, dynamics=model, bandwidth=2.0)
        nbs.save(law, tmp_path / "law.nbs")
        again = nbs.load(tmp_path / "law.nbs")
        state = [x.numpy() for x in tensors(model.network, 5)]
        np.testing.assert_array_equal(again.torque(*state), law.torque(*state))
        np.testing.assert_allclose(again.compile().torque(*state), law.torque(*state), rtol=1e-10, atol=1e-10)

    def test_a_file_of_another_arm_is_refused(self, tmp_path):
        nbs.save(LagrangianDynamics(make("cholesky"), nbs.load_robot("three_link")), tmp_path / "model.nbs")
        with pytest.raises(ArgumentError, match="is for the arm 'three_link'"):
            nbs.load(tmp_path / "model.nbs", nbs.load_robot("two_link"))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: make_network("mlp", JOINTS), "network 'mlp' is unknown; choose one of cholesky"),
        (lambda: CholeskyNetwork(()), "prismatic is empty"),
        (lambda: CholeskyNetwork(JOINTS, epsilon=0.0), "epsilon is 0.0; give a finite number > 0"),
        (lambda: CholeskyNetwork(JOINTS, energy=float("inf")), "energy is inf"),
        (lambda: CholeskyNetwork(JOINTS, inertia=(1.0, -1.0, 1.0)), "give 3 positive numbers"),
        (lambda: ResidualNetwork(AnalyticDynamics(), share=1.0), r"share is 1.0; give a number between 0 and 1"),
        (lambda: ResidualNetwork(AnalyticDynamics(), JOINTS), "prismatic has 3 values, expected 2"),
        (lambda: LagrangianDynamics(make("cholesky"), nbs.load_robot("two_link")),
         "the network is for 3 joints and two_link has 2"),
        (lambda: LagrangianDynamics(make("cholesky"), friction=JointFriction(np.zeros(2), np.zeros(2))),
         "the friction is for 2 joints, the arm has 3"),
        (lambda: LagrangianDynamics(make("cholesky").float()), "is torch.float32, expected float64"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_refused_in_one_sentence(build, message):
    with pytest.raises(ArgumentError, match=message):
        build()
