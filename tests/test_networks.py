"""Properties that hold for every weight: convexity of Φ with its modulus, D ⪰ D₀, and closed forms against autograd."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from jaxtyping import TypeCheckError

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.intervals import Interval
from nbs_pin.controllers.activations import SmoothedReLU, Squareplus
from nbs_pin.controllers.convex import FICNN
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.gains import largest_inertia
from nbs_pin.controllers.potential import POTENTIALS, Potential

seeds = st.integers(0, 2**31 - 1)
sizes = st.integers(1, 8)
any_weights = settings(max_examples=25, deadline=None, derandomize=True)


def randomise(module: torch.nn.Module, seed: int, gain: float = 1.0) -> None:
    """Normal weights of any sign, large enough to matter."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            scale = gain / max(1.0, parameter.shape[-1] ** 0.5)
            parameter.copy_(scale * torch.randn(parameter.shape, generator=generator, dtype=torch.float64))


def random_potential(form: str, nv: int, seed: int) -> Potential:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(nv, nv))
    stiffness = root @ root.T + 0.1 * np.eye(nv)
    stiffness = 0.5 * (stiffness + stiffness.T)
    potential = Potential(stiffness, form=form, widths=(16, 8), scale=rng.uniform(0.3, 3.0, nv))
    randomise(potential, seed, gain=2.0)
    return potential


def test_annotations_are_executed_here():
    """A session without them meets an AttributeError."""
    with pytest.raises(TypeCheckError):
        largest_inertia("panda", None)


@pytest.mark.parametrize("activation", [SmoothedReLU(0.3), Squareplus(0.7)])
def test_activation_derivatives_by_finite_differences(activation):
    x = np.linspace(-2.0, 2.0, 401) + 1e-4  # no sample within the stencil of a switch at 0 or d
    h = 2e-5
    value, slope, curvature = activation.derivatives(x)
    numeric_slope = (activation.derivatives(x + h)[0] - activation.derivatives(x - h)[0]) / (2 * h)
    numeric_curvature = (activation.derivatives(x + h)[1] - activation.derivatives(x - h)[1]) / (2 * h)
    np.testing.assert_allclose(slope, numeric_slope, atol=1e-9)
    np.testing.assert_allclose(curvature, numeric_curvature, atol=1e-6)
    assert (slope >= 0.0).all()
    assert (curvature >= 0.0).all()
    assert (np.diff(value) >= 0.0).all()


@pytest.mark.parametrize("activation", [SmoothedReLU(0.3), Squareplus(0.7)])
def test_the_range_of_a_curvature_holds_all_its_values(activation):
    low, size = np.random.default_rng(0).uniform([[-1.0], [0.0]], [[0.5], [0.6]], (2, 500))
    found = activation.curvature_range(Interval(low, low + size))
    values = activation.derivatives(low + np.linspace(0.0, 1.0, 101)[:, None] * size)[2]
    assert (found.low <= values.min(axis=0) + 1e-12).all()
    assert (values.max(axis=0) <= found.high + 1e-12).all()
    assert (found.high <= activation.derivatives(np.linspace(-2.0, 2.0, 4001))[2].max() + 1e-12).all()


def test_smoothed_relu_is_the_paper_one():
    d = 0.01
    x = np.array([-1.0, 0.0, 0.004, 0.01, 0.5])
    np.testing.assert_allclose(SmoothedReLU(d).derivatives(x)[0], [0.0, 0.0, 0.004**2 / (2 * d), d / 2, 0.5 - d / 2])


def test_the_paper_activation_jumps_in_its_second_derivative():
    """Why the paper's torque is discontinuous (docs/theory.md §3): σ'' leaps by 1/d at 0, squareplus' does not."""
    around = np.array([-1e-9, 1e-9])
    assert np.diff(SmoothedReLU(0.01).derivatives(around)[2])[0] == pytest.approx(100.0)
    assert abs(np.diff(Squareplus().derivatives(around)[2])[0]) < 1e-8


@any_weights
@given(seed=seeds, nv=sizes, form=st.sampled_from(POTENTIALS))
def test_closed_forms_are_the_derivatives(seed, nv, form):
    """∇Φ and ∇²Φ·dz in closed form against torch's own differentiation of Φ."""
    potential = random_potential(form, nv, seed)
    rng = np.random.default_rng(seed + 1)
    z = torch.as_tensor(rng.normal(size=(3, nv))).requires_grad_()
    dz = torch.as_tensor(rng.normal(size=(3, nv)))
    value, gradient, product = potential.terms(z, dz)
    (expected,) = torch.autograd.grad(value.sum(), z, create_graph=True)
    torch.testing.assert_close(gradient, expected, rtol=1e-12, atol=1e-12 * float(expected.detach().abs().max()))
    (curvature,) = torch.autograd.grad((expected * dz).sum(), z)
    torch.testing.assert_close(product, curvature, rtol=1e-10, atol=1e-10 * float(curvature.abs().max()))


@any_weights
@given(seed=seeds, nv=sizes, form=st.sampled_from(POTENTIALS), ceiling=st.sampled_from([None, 0.5]))
def test_numpy_and_torch_are_one_law(seed, nv, form, ceiling):
    potential = random_potential(form, nv, seed)
    damping = Damping(nv, floor=np.eye(nv), widths=(8, 8), ceiling=ceiling)
    randomise(damping, seed)
    z, dz = np.random.default_rng(seed).normal(size=(2, 4, nv))
    z[0] = 0.0
    tensors = torch.as_tensor(z), torch.as_tensor(dz)
    for ours, theirs in zip(potential.terms(z, dz), potential.terms(*tensors), strict=True):
        assert isinstance(ours, np.ndarray)
        np.testing.assert_allclose(ours, theirs.detach().numpy(), rtol=1e-12, atol=1e-12 * np.abs(ours).max())
    np.testing.assert_allclose(damping.force(z), damping.force(tensors[0]).detach().numpy(), rtol=1e-12, atol=1e-12)


@any_weights
@given(seed=seeds, nv=sizes, form=st.sampled_from(POTENTIALS))
def test_psi_is_zero_with_zero_gradient_at_zero_and_nowhere_negative(seed, nv, form):
    check_psi(random_potential(form, nv, seed), seed)


def check_psi(potential: Potential, seed: int) -> None:
    nv, zero = potential.nv, np.zeros(potential.nv)
    value, gradient, _ = potential.terms(zero, zero)
    z = 3.0 * np.random.default_rng(seed).normal(size=(200, nv))
    total, slope, _ = potential.terms(z, z)
    quadratic = np.einsum("bi,ij,bj->b", z, potential.stiffness.numpy(), z)
    scale = np.abs(slope).max()
    assert abs(value) <= 1e-12 * scale
    assert np.abs(gradient).max() <= 1e-12 * scale
    assert (total - quadratic).min() >= -1e-12 * np.abs(total).max()


@any_weights
@given(seed=seeds, nv=sizes, form=st.sampled_from(POTENTIALS))
def test_potential_is_strongly_convex_with_its_modulus(seed, nv, form):
    check_strong_convexity(random_potential(form, nv, seed), seed)


def check_strong_convexity(potential: Potential, seed: int) -> None:
    """⟨∇Φ(x) − ∇Φ(y), x − y⟩ ≥ (x − y)ᵀ2S(x − y) ≥ μ‖x − y‖² on random pairs, near and far."""
    nv = potential.nv
    x, y = np.random.default_rng(seed).normal(size=(2, 300, nv)) * np.geomspace(1e-3, 10.0, 300)[:, None]
    step = x - y
    monotone = ((potential.terms(x, x)[1] - potential.terms(y, y)[1]) * step).sum(-1)
    strong = 2.0 * np.einsum("bi,ij,bj->b", step, potential.stiffness.numpy(), step)
    slack = 1e-10 * np.abs(monotone).max()
    assert (monotone >= strong - slack).all()
    assert (strong >= potential.modulus * (step * step).sum(-1) - slack).all()


def random_damping(nv: int, seed: int, *, ceiling: float | None = None, gain: float = 3.0) -> Damping:
    """D₀ and R of any shape, gains within their shares, and weights of any sign."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(nv, nv))
    floor = root @ root.T + 0.05 * np.eye(nv)
    scale = rng.uniform(0.2, 5.0, nv)
    damping = Damping(nv, floor=0.5 * (floor + floor.T), widths=(8, 8), scale=scale, ceiling=ceiling)
    randomise(damping, seed, gain=gain)
    return damping


@any_weights
@given(seed=seeds, nv=sizes, ceiling=st.sampled_from([None, 0.1, 4.0]))
def test_bounded_damping_is_above_its_floor(seed, nv, ceiling):
    check_floor(random_damping(nv, seed, ceiling=ceiling), seed)


@settings(any_weights, max_examples=30)
@given(seed=seeds, nv=sizes, ceiling=st.floats(1e-3, 1e3), gain=st.sampled_from([0.3, 3.0, 30.0]))
def test_a_ceiling_is_above_the_damping_for_every_weight(seed, nv, ceiling, gain):
    """D ≺ D₀ + bR² and TᵀT ≺ b1; and the ceiling only scales T."""
    damping = random_damping(nv, seed, ceiling=ceiling, gain=gain)
    free = random_damping(nv, seed, gain=gain)
    z = np.random.default_rng(seed).normal(size=(60, nv)) * np.geomspace(1e-3, 1e3, 60)[:, None]
    r, matrix, floor = damping.scale.numpy(), damping.matrix(z), damping.floor.numpy()
    most = np.linalg.eigvalsh(floor + ceiling * np.diag(r**2) - matrix).min(axis=-1)
    assert (most >= -1e-12 * np.abs(matrix).max()).all()
    t, plain = damping.factor(r * z), free.factor(r * z)
    assert (t**2).sum(axis=(-2, -1)).max() < ceiling * (1.0 + 1e-12)
    share = np.sqrt(1.0 + (plain**2).sum(axis=(-2, -1), keepdims=True) / ceiling)
    np.testing.assert_allclose(t * share, plain, rtol=1e-12, atol=1e-12)


@any_weights
@given(
    seed=seeds,
    nv=sizes,
    ceiling=st.sampled_from([None, 0.5, 20.0]),
    gain=st.sampled_from([0.1, 1.0, 5.0]),
    radius=st.sampled_from([0.0, 1e-3, 0.3, 10.0, np.inf]),
)
def test_the_share_of_a_damping_holds_all_its_values(seed, nv, ceiling, gain, radius):
    """D ⪯ (1 + n)D₀ on the ellipsoid, its surface included, for D₀ and R of any shape."""
    damping = random_damping(nv, seed, ceiling=ceiling, gain=gain)
    floor, rng = damping.floor.numpy(), np.random.default_rng(seed)
    z = np.linalg.solve(np.linalg.cholesky(floor).T, rng.normal(size=(nv, 80)))
    z /= np.sqrt((z * (floor @ z)).sum(axis=0))
    z = (z * np.where(np.arange(80) % 2, 1.0, rng.uniform(0.0, 1.0, 80)) * min(radius, 1e6)).T
    n = damping.share(radius)
    lack = np.linalg.eigvalsh((1.0 + n) * floor - damping.matrix(z)).min(axis=-1)
    assert (lack >= -1e-12 * (1.0 + n) * np.abs(floor).max()).all()
    assert n <= damping.share(2.0 * radius) <= damping.share(np.inf) < np.inf
    if ceiling is not None:
        stretched = np.linalg.eigvals(np.linalg.solve(floor, np.diag(damping.scale.numpy() ** 2))).real.max()
        assert damping.share(np.inf) <= ceiling * stretched * (1.0 + 1e-6)


def test_the_share_of_networks_without_a_hidden_layer_is_that_of_a_matrix():
    """T is affine in Rz, so that without a ceiling there is no bound everywhere, and with one there is."""
    for ceiling, most in ((None, np.inf), (2.0, 2.0)):
        damping = Damping(2, floor=np.eye(2), widths=(), ceiling=ceiling)
        damping.diagonal.w0.data.copy_(torch.tensor([[3.0, 0.0], [0.0, 1.0]]))
        damping.lower.w0.data.zero_()
        square = (3.0 * 0.7) ** 2  # the largest ‖T‖_F² over ‖z‖ ≤ 0.7, at z = (0.7, 0)
        expected = square if ceiling is None else square / (1.0 + square / ceiling)
        assert damping.share(0.7) == pytest.approx(expected, rel=1e-6)
        assert damping.share(np.inf) == pytest.approx(most, rel=1e-6)
    assert Damping(2, form="paper").share(1.0) == np.inf


def test_without_a_ceiling_nothing_is_computed_otherwise():
    """A ceiling of None is the form of old files, to the last bit; one that is never felt is near it."""
    free, high = Damping(3, floor=np.eye(3)), Damping(3, floor=np.eye(3), ceiling=1e12)
    assert "ceiling" not in free.state_dict()
    z = np.random.default_rng(0).normal(size=(20, 3))
    x = free.factor(z)
    np.testing.assert_array_equal(free.matrix(z), np.eye(3) + np.swapaxes(x, -1, -2) @ x)
    np.testing.assert_allclose(high.force(z), free.force(z), rtol=1e-11)


def check_floor(damping: Damping, seed: int) -> None:
    """D is symmetric, D ⪰ D₀, and `force` is D(z) z."""
    z = 3.0 * np.random.default_rng(seed).normal(size=(50, damping.nv))
    matrix = damping.matrix(z)
    np.testing.assert_allclose(matrix, np.swapaxes(matrix, -1, -2), rtol=1e-13, atol=1e-13 * np.abs(matrix).max())
    excess = np.linalg.eigvalsh(matrix - damping.floor.numpy()).min(axis=-1)
    assert (excess >= -1e-12 * np.abs(matrix).max()).all()
    np.testing.assert_allclose(damping.force(z), (matrix @ z[..., None])[..., 0], rtol=1e-10, atol=1e-10)


def test_the_paper_bound_on_d_is_false():
    """T = [[1, 0], [1, 1]] has m = 1 and λ_min(TᵀT) = 0.382 < ½: 'm = 1 ensures D ⪰ ½I' fails (docs/theory.md §4)."""
    damping = Damping(2, form="paper", m=1.0)
    with torch.no_grad():
        for parameter in damping.parameters():
            parameter.zero_()
        damping.lower.b2.fill_(1.0)
    z = np.array([0.3, -0.2])
    np.testing.assert_allclose(damping.factor(z), [[1.0, 0.0], [1.0, 1.0]])
    smallest = np.linalg.eigvalsh(damping.matrix(z))[0]
    assert smallest == pytest.approx((3 - np.sqrt(5)) / 2)
    assert smallest < 0.5


def test_a_negative_weight_would_break_convexity():
    """The property test can fail: without the map to Wy ≥ 0 the same network is not convex."""
    network = FICNN(2, (8, 8), Squareplus(), biases=True, nonnegative=lambda w: w)
    randomise(network, 0, gain=3.0)
    x, y = np.random.default_rng(0).normal(size=(2, 500, 2))
    monotone = ((network.terms(x, x)[1] - network.terms(y, y)[1]) * (x - y)).sum(-1)
    assert monotone.min() < 0.0


def test_seed_makes_the_weights_and_nothing_else_does():
    torch.manual_seed(1)
    state = torch.random.get_rng_state()
    first, second, other = (Potential(np.eye(2), seed=s) for s in (3, 3, 4))
    assert torch.equal(state, torch.random.get_rng_state())
    z = np.array([0.4, -0.7])
    assert first.terms(z, z)[0] == second.terms(z, z)[0] != other.terms(z, z)[0]


def test_initial_weights_of_the_potential_are_those_of_the_theory():
    """U(−0.1, 0.2) (docs/theory.md §8)."""
    network = Potential(np.eye(4), widths=(40, 40), seed=1).network
    weights = np.concatenate([p.numpy(force=True).ravel() for p in network.parameters()])
    assert weights.min() == pytest.approx(-0.1, rel=0.05)
    assert weights.max() == pytest.approx(0.2, rel=0.05)


@given(
    seed=st.integers(0, 2**31),
    radius=st.floats(0.01, 3.0),
    scale=st.floats(0.1, 10.0),
    ceiling=st.sampled_from([None, 0.02, 1.0]),
)
@settings(max_examples=30, deadline=None)
def test_for_one_joint_the_range_of_damping_holds_all_its_values(seed, radius, scale, ceiling):
    damping = Damping(1, floor=np.array([[1.0]]), scale=np.array([scale]), ceiling=ceiling, seed=seed)
    z = np.linspace(-radius, radius, 501)[:, None]
    more, found = damping.matrix(z)[:, 0, 0] - 1.0, damping.excess(radius)
    assert found.low <= more.min() <= more.max() <= found.high
    assert more.max() <= damping.share(radius)
    plain = Damping(1, floor=np.array([[1.0]]), ceiling=ceiling, seed=seed).excess(scale * radius)
    assert found.high == pytest.approx(scale**2 * plain.high, rel=1e-9)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Potential(np.diag([1.0, -1.0])), "stiffness S has the eigenvalue -1"),
        (lambda: Potential(np.array([[1.0, 0.1], [0.0, 1.0]])), "not a finite symmetric matrix"),
        (lambda: Potential(np.eye(2) * np.nan), "not a finite symmetric matrix"),
        (lambda: Potential(np.eye(2), form="fancy"), "form 'fancy' is unknown; give one of paper, smooth"),
        (lambda: Potential(np.eye(2), scale=np.array([1.0, 0.0])), "give 2 positive numbers"),
        (lambda: Damping(2, form="fancy"), "give one of bounded, paper"),
        (lambda: Damping(2), "'bounded' needs one"),
        (lambda: Damping(2, form="paper", floor=np.eye(2)), "'paper' has none"),
        (lambda: Damping(2, floor=np.eye(2), ceiling=0.0), "ceiling is 0.0; give a finite number > 0"),
        (lambda: Damping(2, floor=np.eye(2), ceiling=np.inf), "ceiling is inf; give a finite number > 0"),
        (lambda: Damping(2, form="paper", ceiling=1.0), "'paper' was given ceiling 1.0"),
        (lambda: Damping(2, form="paper", m=0.0), "m is 0.0; give a finite number > 0"),
        (lambda: Damping(2, floor=np.zeros((2, 2))), "floor D₀ has the eigenvalue 0"),
        (lambda: SmoothedReLU(0.0), "d is 0.0; give a finite number > 0"),
        (lambda: Squareplus(-1.0), "b is -1.0; give a finite number > 0"),
    ],
)
def test_impossible_networks_are_refused(make, words):
    with pytest.raises(ArgumentError, match=words):
        make()
