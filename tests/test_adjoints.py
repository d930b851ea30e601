"""Adjoints are the gradients of what they name: against torch's autograd, and differences for the PID."""

from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import pytest
import torch

from nbs_pin.kernels.convex import subtract_tangent
from nbs_pin.kernels.convex_adjoint import pull_back, room_for_potential, taped
from nbs_pin.kernels.damping import damping_adjoint, damping_force, room_for_damping
from nbs_pin.kernels.law_adjoints import adjoint_workspace, law_adjoint, pid_adjoint
from nbs_pin.kernels.laws import law_signals, law_workspace, pid
from nbs_pin.kernels.layout import (
    DAMPING_LAYOUT,
    DAMPING_WEIGHTS,
    FRICTION,
    JOINTS,
    LAW,
    LAYERS,
    PER_LAYER,
    POTENTIAL_LAYOUT,
    POTENTIAL_WEIGHTS,
    ActivationCode,
    DampingCode,
    LawCode,
    Packed,
    pack_damping,
    pack_law,
    pack_potential,
    workspace,
)
from nbs_pin.kernels.records import Dual, Memory, Signals, State, Target

SIZES = [(1, ()), (1, (5,)), (2, (4, 3)), (7, (32, 32, 32)), (7, (11,))]
ACTIVATIONS = {"smooth": (ActivationCode.SQUAREPLUS, 0.7), "paper": (ActivationCode.SMOOTHED_RELU, 0.5)}
LAWS = [code for code in LawCode if code is not LawCode.PID]


# Random parts, and the same parts written out in torch on the same flat weights.


def random_potential(n: int, widths: tuple[int, ...], form: str, seed: int = 0) -> Packed:
    rng = np.random.default_rng(seed)
    layers = [
        (rng.uniform(0.0, 1.0, (size, before)) / before if before else None, rng.normal(size=(size, n)), None)
        for before, size in pairwise((0, *widths, 1))
    ]
    if form == "smooth":
        layers = [(wy, wx, rng.normal(size=len(wx))) for wy, wx, _ in layers]
    packed = pack_potential(layers, ACTIVATIONS[form], rng.uniform(0.5, 2.0, n), rng.normal(size=(n, n)))
    return packed if form == "paper" else subtract_tangent(packed)


def random_damping(n: int, widths: tuple[int, ...], form: str, seed: int = 0) -> Packed:
    rng = np.random.default_rng(seed)
    networks = [
        [(rng.normal(size=(b, a)) / np.sqrt(a), rng.normal(size=b)) for a, b in pairwise((n, *widths, outputs))]
        for outputs in (n, n * (n - 1) // 2)
    ]
    code, ceiling = (DampingCode.PAPER, None) if form == "paper" else (DampingCode.BOUNDED, rng.uniform(0.3, 3.0))
    return pack_damping(tuple(networks), code, 0.3, rng.uniform(0.5, 2.0, n), rng.normal(size=(n, n)), ceiling)


def random_law(law: int, n: int, form: str, *, friction: bool, seed: int = 0) -> Packed:
    rng = np.random.default_rng(seed)
    parts = {}
    if law == LawCode.BACKSTEPPING:
        parts = {"potential": random_potential(n, (6, 5), form, seed), "damping": random_damping(n, (5,), form, seed)}
        parts["inertial_rate"] = 1.5
    gains = tuple(rng.uniform(0.5, 2.0, (2, n)))
    continuous = (np.arange(n) % 2).astype(float)
    fed = (*rng.uniform(0.1, 1.0, (2, n)), 0.8) if friction else None
    return pack_law(law, gains, continuous, fed, **parts)


def layers_of(layout: np.ndarray, weights: torch.Tensor, first: int, depth: int) -> list[torch.Tensor]:
    table = layout[LAYERS + PER_LAYER * first :][: PER_LAYER * depth].reshape(depth, PER_LAYER).tolist()
    return [weights[offset : offset + size * length].reshape(size, length) for size, length, offset in table]


def sigma(code: int, parameter: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
    if code == ActivationCode.SQUAREPLUS:
        return 0.5 * (a + (a * a + parameter).sqrt())
    s = (a / parameter).clip(0.0, 1.0)
    return s * (a - 0.5 * parameter * s)


def torch_potential(layout: np.ndarray, weights: torch.Tensor, z: torch.Tensor, dz: torch.Tensor):
    """∇Φ and ∇²Φ ż, by differentiating f itself."""
    n, depth, code = layout[:3].tolist()
    scale, tangent, double_s = weights[2 : 2 + n], weights[2 + n : 2 + 2 * n], weights[2 + 2 * n :][: n * n]
    x, y = scale * z, z[:0]
    for matrix in layers_of(layout, weights, 0, depth):
        u = torch.cat([x, torch.ones(1, dtype=z.dtype), y])
        y = sigma(code, weights[0], matrix[:, : len(u)] @ u)
    (slope,) = torch.autograd.grad(y[0], x, create_graph=True)
    (product,) = torch.autograd.grad(slope @ (scale * dz), x, create_graph=True)
    s = double_s.reshape(n, n)
    return scale * (slope - tangent) + s @ z, scale * product + s @ dz


def torch_damping(layout: np.ndarray, weights: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
    """D(z) z."""
    n, depth, form = layout[:3].tolist()
    scale, floor = weights[2 : 2 + n], weights[2 + n :][: n * n].reshape(n, n)
    outputs = []
    for first in (0, depth):
        h = scale * z
        for k, matrix in enumerate(layers_of(layout, weights, first, depth)):
            h = (torch.tanh(h) if k else h) @ matrix[:, : len(h)].T + matrix[:, len(h)]
        outputs.append(h)
    diagonal = outputs[0].clip(0.0) + weights[0] if form == DampingCode.PAPER else outputs[0]
    below = torch.zeros(n, n, dtype=z.dtype)
    below[*np.tril_indices(n, -1)] = outputs[1]
    t = torch.diag(diagonal) + below
    share = 1.0 / (1.0 + (t * t).sum() * weights[1])
    return floor @ z + share * scale * (t.T @ (t @ (scale * z)))


def part(law: Packed, weights: torch.Tensor, in_layout: int, in_weights: int) -> tuple[np.ndarray, torch.Tensor]:
    """The potential or the damping of a law."""
    return law.layout[law.layout[in_layout] :], weights[law.layout[in_weights] :]


def without_adjoint(law: Packed) -> list[int]:
    """Weights that get no cotangent: which joints wrap, σ's parameter, f(0), m, and the ceiling."""
    potential, damping = law.layout[POTENTIAL_WEIGHTS], law.layout[DAMPING_WEIGHTS]
    own = list(range(law.layout[JOINTS]))
    return [*own, potential, potential + 1, damping, damping + 1] if law.layout[LAW] == LawCode.BACKSTEPPING else own


def torch_law(law: Packed, weights: torch.Tensor, q, v, q_ref, v_ref, a_ref):
    """v_r, a_r and feedback."""
    code, n = law.layout[:2].tolist()
    wraps, first, second, viscous, coulomb = weights[: 5 * n].reshape(5, n)
    turns = torch.ceil((q - q_ref - np.pi) / (2.0 * np.pi))
    z1, dz1 = q - q_ref - 2.0 * np.pi * wraps * turns, v - v_ref
    if code == LawCode.BACKSTEPPING:
        gradient, product = torch_potential(*part(law, weights, POTENTIAL_LAYOUT, POTENTIAL_WEIGHTS), z1, dz1)
        v_r = v_ref - first * gradient
        a_r = a_ref - first * product - weights[5 * n + 1] * (v - v_r)
        damped = torch_damping(*part(law, weights, DAMPING_LAYOUT, DAMPING_WEIGHTS), v - v_r)
        feedback = -gradient - damped
    elif code == LawCode.SLOTINE_LI:
        v_r, a_r = v_ref - first * z1, a_ref - first * dz1
        feedback = -second * (v - v_r)
    elif code == LawCode.COMPUTED_TORQUE:
        v_r, a_r, feedback = v + 0.0, a_ref - second * dz1 - first * z1, 0.0 * q
    else:
        feedback = -first * z1 - second * dz1
        v_r, a_r = (0.0 * v_ref, 0.0 * a_ref) if code == LawCode.PD_GRAVITY else (v_ref, a_ref)
    if law.layout[FRICTION]:
        speed = v_r if code in (LawCode.BACKSTEPPING, LawCode.SLOTINE_LI) else v_ref
        feedback = feedback + viscous * speed + coulomb * torch.tanh(speed / weights[5 * n])
    return v_r, a_r, feedback


# What is compared.


@contextmanager
def scratch(size: int):
    """Scratch space full of NaN, so that a kernel that reads before it writes is seen, as is one that needs more."""
    room = np.full(size + 100, np.nan)
    yield room[:size]
    assert np.isnan(room[size:]).all()


def leaves(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.tensor(x, requires_grad=True) for x in arrays]


def gradients(total: torch.Tensor, inputs: list[torch.Tensor]) -> list[np.ndarray]:
    found = torch.autograd.grad(total, inputs, allow_unused=True, materialize_grads=True)
    return [x.numpy() for x in found]


def assert_close(found: np.ndarray, expected: np.ndarray, tolerance: float = 1e-10) -> None:
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= tolerance * max(np.abs(expected).max(), 1e-3)


@pytest.mark.parametrize(("n", "widths"), SIZES)
@pytest.mark.parametrize("form", ACTIVATIONS)
@pytest.mark.parametrize("seed", [0, 1])
def test_potential_adjoint_is_the_gradient(n, widths, form, seed):
    part = random_potential(n, widths, form, seed)
    z, dz, gradient_bar, product_bar = np.random.default_rng(seed).normal(size=(4, n))
    z_bar, dz_bar, weights_bar = np.zeros(n), np.zeros(n), np.zeros_like(part.weights)
    with scratch(room_for_potential(part)) as room:
        taped(Dual(z, dz), part, room, Dual(*np.empty((2, n))))
        pull_back(Dual(z, dz), Dual(gradient_bar, product_bar), part, room, Dual(z_bar, dz_bar), weights_bar)

    inputs = leaves(z, dz, part.weights)
    gradient, product = torch_potential(part.layout, inputs[2], *inputs[:2])
    total = gradient @ torch.tensor(gradient_bar) + product @ torch.tensor(product_bar)
    expected = gradients(total, inputs)
    expected[2][:2] = 0.0  # the activation's parameter and f(0)
    for found, wanted in zip((z_bar, dz_bar, weights_bar), expected, strict=True):
        assert_close(found, wanted)


@pytest.mark.parametrize("seed", range(3))
def test_damping_adjoint_is_what_finite_differences_say(seed):
    """Of the kernel of the force itself, under a ceiling, by z and by each weight that has a cotangent."""
    part = random_damping(3, (5, 4), "bounded", seed)
    z, force_bar = np.random.default_rng(seed).normal(size=(2, 3))
    z_bar, weights_bar, h = np.zeros(3), np.zeros_like(part.weights), 1e-6
    with scratch(room_for_damping(part)) as room:
        damping_adjoint(z, force_bar, part, room, z_bar, weights_bar)

    def power(at: np.ndarray) -> float:
        force = np.empty(3)
        with scratch(workspace(part)) as room:
            damping_force(at[:3].copy(), Packed(part.layout, at[3:].copy()), room, force)
        return float(force @ force_bar)

    at, steps = np.concatenate([z, part.weights]), h * np.eye(3 + len(part.weights))
    expected = np.array([power(at + step) - power(at - step) for step in steps]) / (2.0 * h)
    padding = part.weights == 0.0
    found = np.concatenate([z_bar, np.where(padding, 0.0, weights_bar)])
    expected[3:][padding] = 0.0
    expected[3:5] = 0.0  # m and the ceiling
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize(("n", "widths"), SIZES)
@pytest.mark.parametrize("form", ["bounded", "paper"])
@pytest.mark.parametrize("seed", [0, 1])
def test_damping_adjoint_is_the_gradient(n, widths, form, seed):
    part = random_damping(n, widths, form, seed)
    z, force_bar = np.random.default_rng(seed).normal(size=(2, n))
    z_bar, weights_bar = np.zeros(n), np.zeros_like(part.weights)
    with scratch(room_for_damping(part)) as room:
        damping_adjoint(z, force_bar, part, room, z_bar, weights_bar)

    inputs = leaves(z, part.weights)
    expected = gradients(torch_damping(part.layout, inputs[1], inputs[0]) @ torch.tensor(force_bar), inputs)
    expected[1][:2] = 0.0  # m and the ceiling
    assert_close(z_bar, expected[0])
    assert_close(weights_bar, expected[1])


def states(n: int, seed: int) -> list[np.ndarray]:
    """q, v, q_ref, v_ref, a_ref, errors beyond half a turn among them."""
    return list(np.random.default_rng(seed).normal(size=(5, n)) * [[8.0], [1.0], [1.0], [1.0], [1.0]])


def adjoint_of(law: Packed, given: list[np.ndarray], bars: np.ndarray) -> list[np.ndarray]:
    """By q, v and the weights: what is added to 0.5, while what is given is only read."""
    found = [np.full_like(x, 0.5) for x in (given[0], given[1], law.weights)]
    (q, v, *target), law_bar = given, Packed(law.layout, found[2])
    before = [x.copy() for x in (*given, bars, *law)]
    with scratch(adjoint_workspace(law)) as room:
        law_adjoint(State(q, v), Target(*target), law, room, Signals(*bars), State(*found[:2]), law_bar)
    for x, y in zip(before, (*given, bars, *law), strict=True):
        np.testing.assert_array_equal(x, y)
    return [x - 0.5 for x in found]


@pytest.mark.parametrize(("n", "widths"), [*SIZES, (12, (3,)), (2, (41, 2)), (9, (2, 50))])
def test_adjoints_stay_within_their_scratch_space(n, widths):
    one, parts = np.ones(n), (random_potential(n, widths, "smooth"), random_damping(n, widths, "paper"))
    law = pack_law(LawCode.BACKSTEPPING, (one, one), None, (one, one, 0.1), 1.0, *parts)
    assert all(np.isfinite(x).all() for x in adjoint_of(law, states(n, seed=0), np.ones((3, n))))


@pytest.mark.parametrize("n", [1, 2, 7])
@pytest.mark.parametrize("form", ACTIVATIONS)
@pytest.mark.parametrize("law_code", LAWS)
@pytest.mark.parametrize("friction", [False, True])
def test_law_adjoint_is_the_gradient(n, form, law_code, friction):
    law = random_law(law_code, n, form, friction=friction, seed=n)
    given, bars = states(n, seed=n), np.random.default_rng(7).normal(size=(3, n))
    inputs = leaves(given[0], given[1], law.weights)
    signals = torch_law(law, inputs[2], *inputs[:2], *(torch.tensor(x) for x in given[2:]))
    kernel = np.empty((3, n))
    with scratch(law_workspace(law)) as work:
        assert law_signals(*given, *law, work, kernel)
    for x, y in zip(signals, kernel, strict=True):
        assert_close(x.detach().numpy(), y, 1e-12)

    expected = gradients(sum(x @ torch.tensor(bar) for x, bar in zip(signals, bars, strict=True)), inputs)
    expected[2][without_adjoint(law)] = 0.0
    for found, wanted in zip(adjoint_of(law, given, bars), expected, strict=True):
        assert_close(found, wanted)


def pid_bars(given: list[np.ndarray], period: float, gains: np.ndarray, bars: np.ndarray, found: list) -> None:
    """Adds to integral, derivative, q, v and gains in found; given: the first four and the reference."""
    integral, derivative, q, v, q_ref, v_ref = given
    pid_adjoint(
        Memory(integral, derivative), State(q, v), State(q_ref, v_ref), period, gains.ravel(),
        bars[0], Memory(bars[1], bars[2]), Memory(*found[:2]), State(*found[2:4]), found[4].reshape(-1),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("filter_time", [0.0, 0.03])
@pytest.mark.parametrize("rows", [1, 3])
def test_pid_adjoint_against_differences(seed, filter_time, rows):
    n, period, rng = 3, 0.01, np.random.default_rng(seed)
    gains = np.array([*rng.uniform(1.0, 5.0, (4, n)), np.full(n, filter_time), [0.0, 1.0, 0.0]])
    integral, derivative, q, v, q_ref, v_ref = given = list(rng.normal(size=(6, n * rows)))
    q *= 4.0
    bars = rng.normal(size=(3, n * rows))
    found = [np.full_like(x, 0.25) for x in (integral, derivative, q, v, gains)]
    pid_bars(given, period, gains, bars, found)

    directions = [rng.normal(size=x.shape) for x in found]
    directions[4][[3, 5]] = 0.0
    np.testing.assert_array_equal(found[4][[3, 5]], 0.25)

    def value(step: float) -> float:
        out = np.empty((3, n * rows))
        moved = [x + step * d for x, d in zip((*given[:4], gains), directions, strict=True)]
        assert pid(*moved[:4], q_ref, v_ref, period, moved[4].ravel(), out)
        return float((out * bars).sum())

    slope = (value(1e-6) - value(-1e-6)) / 2e-6
    total = sum(((x - 0.25) * d).sum() for x, d in zip(found, directions, strict=True))
    assert total == pytest.approx(slope, rel=1e-6)


def test_pid_adjoint_rests_where_the_integral_rests():
    one, gains = np.ones(1), np.array([[2.0], [3.0], [1.0], [0.5], [0.0], [0.0]])
    zero = np.zeros(1)
    found = [*np.zeros((4, 1)), np.zeros((6, 1))]
    bars = np.array([[0.0], [1.0], [0.0]])
    pid_bars([zero, zero, one, zero, zero, zero], 0.01, gains, bars, found)  # τ = −2, limit 0.5
    np.testing.assert_array_equal(np.concatenate([x.ravel() for x in found]), [1.0, *[0.0] * 9])
