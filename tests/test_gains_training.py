"""What training changes: gains with a bound that no parameter value breaks, and packed weights with exact gradients."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.gain import Gain
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.controllers.potential import Potential
from nbs_pin.kernels.layout import LawCode
from nbs_pin.robots.robot import load_robot
from tests.laws import COMPILED
from tests.test_controllers import arguments, call
from tests.test_networks import randomise

LAWS = COMPILED | {
    "nbs_friction": lambda robot: NeuralBackstepping.for_robot(
        robot, friction=nbs.JointFriction(np.full(robot.nv, 0.3), np.linspace(1.0, 2.0, robot.nv))
    )
}
STEP = 1e-6


@pytest.fixture(params=LAWS)
def law(request):
    return LAWS[request.param]


@pytest.fixture(scope="module", params=["two_link", "panda", "kinova"])
def robot(request):
    return load_robot(request.param)


def slopes(function, module: torch.nn.Module, seed: int = 0) -> list[tuple[str, float, float]]:
    """Name of each parameter, a directional derivative by central differences, and the same from autograd.

    function: of `numpy`, a number computed in numpy (True) or in torch (False).
    """
    names, parameters = zip(*module.named_parameters(), strict=True)
    gradients = torch.autograd.grad(function(False), parameters)
    generator, found = torch.Generator().manual_seed(seed), []
    for name, parameter, gradient in zip(names, parameters, gradients, strict=True):
        direction = torch.randn(parameter.shape, generator=generator, dtype=torch.float64)
        ends, kept = [], parameter.detach().clone()
        for sign in (1.0, -1.0):
            with torch.no_grad():
                parameter.copy_(kept + sign * STEP * direction)
            ends.append(float(function(True)))
        with torch.no_grad():
            parameter.copy_(kept)
        found.append((name, (ends[0] - ends[1]) / (2.0 * STEP), float((gradient * direction).sum())))
    return found


# Gains.


def nominal(kind: str, n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    if kind == "vector":
        return np.exp(rng.normal(size=n))
    root = rng.normal(size=(n, n))
    matrix = root @ root.T + 0.01 * np.eye(n)
    return 0.5 * (matrix + matrix.T)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31 - 1),
    n=st.integers(1, 8),
    kind=st.sampled_from(["vector", "matrix"]),
    share=st.floats(0.0, 1.0, exclude_max=True),
    size=st.sampled_from([0.1, 1.0, 10.0]),
)
def test_a_gain_begins_at_its_nominal_and_stays_above_its_share(seed, n, kind, share, size):
    start = nominal(kind, n, seed)
    gain = Gain(start, least_share=share)
    np.testing.assert_array_equal(gain.numpy(), start)
    randomise(gain, seed, gain=size)
    value, excess = gain.numpy(), gain.numpy() - share * start
    np.testing.assert_allclose(gain.like(torch.zeros(n)).detach().numpy(), value, rtol=1e-14)
    if kind == "vector":
        assert (value > 0.0).all()
        assert (excess >= -1e-15 * start).all()
    else:
        np.testing.assert_array_equal(value, value.T)
        assert np.linalg.eigvalsh(excess)[0] >= -1e-13 * np.abs(value).max()


def test_a_gain_is_the_equation_and_comes_in_the_kind_asked_for():
    start, s = nominal("matrix", 3, 0), np.array([-0.3, 0.0, 0.7])
    gain, diagonal = Gain(start, least_share=0.3), Gain(np.diag(start), least_share=0.3)
    with torch.no_grad():
        gain.change.copy_(torch.as_tensor(s))
        diagonal.change.copy_(torch.as_tensor(s))
    e = np.diag(np.exp(s))
    np.testing.assert_allclose(gain.numpy(), 0.3 * start + 0.7 * e @ start @ e, rtol=1e-14)
    np.testing.assert_allclose(diagonal.numpy(), np.diag(gain.numpy()), rtol=1e-14)
    assert isinstance(gain.like(np.zeros(3)), np.ndarray)
    assert gain.like(torch.zeros(3)).requires_grad


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Gain(np.array([1.0, 0.0]), name="the rate"), "the rate is .* give 2 positive numbers"),
        (lambda: Gain(np.diag([1.0, -1.0])), "the gain has the eigenvalue -1"),
        (
            lambda: Gain(np.ones(2), least_share=1.0),
            r"least_share of the gain is 1.0; give a finite number ≥ 0 and < 1",
        ),
        (lambda: Gain(np.ones(2), least_share=-0.1), r"is -0\.1; give a finite number ≥ 0 and < 1"),
        (lambda: Potential(np.eye(2), least_share=2.0), "Potential: least_share is 2.0"),
        (lambda: Damping(2, floor=np.eye(2), least_share=2.0), "Damping: least_share is 2.0"),
        (lambda: nbs.PD(nbs.AnalyticDynamics(), feedforward="gravity", kp=np.inf, kd=1.0), "kp is"),
    ],
)
def test_impossible_gains_are_refused(make, words):
    with pytest.raises(ArgumentError, match=words):
        make()


@pytest.mark.parametrize("share", [0.0, 0.2, 0.9])
def test_the_certificates_constants_hold_for_every_parameter(robot, share):
    """S ⪰ φS₀, Λ ⪰ φΛ₀, D ⪰ φD₀ after any change of all parameters, and equality before it."""
    controller = NeuralBackstepping.for_robot(robot, least_share=share)
    gains = (controller.potential.stiffness, controller.damping.floor, controller.rate)
    start = [gain.numpy() for gain in gains]
    modulus = controller.potential.modulus
    randomise(controller, 3, gain=2.0)
    as_matrix = [np.diag(g) if g.ndim == 1 else g for g in start]
    z = np.random.default_rng(0).normal(size=(20, robot.nv))
    present = [gains[0].numpy(), controller.damping.matrix(z), np.diag(gains[2].numpy())]
    for now, before in zip(present, as_matrix, strict=True):
        assert np.linalg.eigvalsh(now - share * before).min() >= -1e-12 * np.abs(now).max()
    assert controller.potential.modulus >= share * modulus
    assert not np.allclose(gains[0].numpy(), start[0])


# Laws and their gains.


def test_every_gain_is_a_parameter(law, robot):
    controller = law(robot)
    gains = {name for name, module in controller.named_modules() if isinstance(module, Gain)}
    expected = {
        nbs.PID: {"gains.kp", "gains.ki", "gains.kd"},
        nbs.PD: {"gains.kp", "gains.kd"},
        nbs.ComputedTorque: {"gains.kp", "gains.kd"},
        nbs.SlotineLi: {"gains.rate", "gains.gain"},
        NeuralBackstepping: {"rate", "potential.stiffness", "damping.floor"},
    }[type(controller)]
    assert gains == expected - ({"damping.floor"} if law is LAWS["nbs-paper"] else set())
    assert all(p.dtype == torch.float64 and p.requires_grad for p in controller.parameters())


def test_the_torques_gradient_in_every_parameter(law, robot):
    """Against central differences of the numpy form, which knows nothing of autograd."""
    controller = law(robot)
    randomise(controller, 1, gain=0.3)
    states = arguments(robot.nv, (4,), seed=2)
    weights = np.random.default_rng(3).normal(size=(4, robot.nv))

    def functional(numpy: bool):
        kind = np.asarray if numpy else torch.as_tensor
        q, v, *desired = map(kind, states)
        memory, reference = controller.initial_memory(q), nbs.Reference(*desired)
        first, memory = controller.step(memory, q, v, reference, 0.01)
        second, _ = controller.step(memory, q, v, reference, 0.01)
        return ((first + second) * kind(weights)).sum()

    size = abs(float(functional(True)))
    for name, numeric, exact in slopes(functional, controller):
        assert abs(numeric - exact) <= 1e-6 * abs(exact) + 1e-8 * size, name


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_state_dict_holds_all_that_numbers_say(law, robot, share):
    """Gains with another nominal value and share take over both with the parameters."""
    controller, fresh = law(robot), law(robot)
    randomise(controller, 1, gain=0.3)
    for module in fresh.modules():
        if isinstance(module, Gain):
            module.nominal.mul_(2.0)
            module.least_share.fill_(share)
    fresh.load_state_dict(controller.state_dict())
    states = arguments(robot.nv)
    np.testing.assert_array_equal(call(fresh, *states), call(controller, *states))


# Packing.


def test_tensors_pack_to_the_same_numbers(law, robot):
    controller = law(robot)
    randomise(controller, 1, gain=0.5)
    arrays, tensors = controller.packed_law(), controller.packed_law(numpy=False)
    np.testing.assert_array_equal(tensors.layout, arrays.layout)
    assert arrays.layout.dtype == tensors.layout.dtype == np.int64
    assert tensors.weights.dtype == torch.float64
    weights = tensors.weights.detach().numpy()
    finite = np.isfinite(arrays.weights)
    assert np.abs(weights - arrays.weights)[finite].max() <= 1e-15 * np.abs(arrays.weights[finite]).max()
    np.testing.assert_array_equal(np.isfinite(weights), finite)


def test_packed_weights_have_the_gradient_of_every_parameter(law, robot):
    controller = law(robot)
    randomise(controller, 4, gain=0.5)
    start = controller.packed_law().weights
    functional = np.random.default_rng(5).normal(size=len(start))

    def value(numpy: bool):
        weights = controller.packed_law(numpy=numpy).weights
        return (weights * (functional if numpy else torch.as_tensor(functional))).sum()

    found = slopes(value, controller)
    assert all(exact != 0.0 for _, _, exact in found)
    for name, numeric, exact in found:
        assert abs(numeric - exact) <= 1e-6 * abs(exact) + 1e-8 * np.abs(start).max(), name


@pytest.mark.parametrize("widths", [(), (3,), (9, 17)])
@pytest.mark.parametrize("form", ["smooth", "paper"])
def test_networks_of_any_shape_pack_alike(form, widths):
    for nv in (1, 3):
        phi = Potential(np.eye(nv), form=form, widths=widths)
        damping = Damping(nv, widths=widths, **({"form": form} if form == "paper" else {"floor": np.eye(nv)}))
        for part in (phi, damping):
            randomise(part, 1)
            arrays, tensors = part.packed(), part.packed(numpy=False)
            np.testing.assert_array_equal(tensors.layout, arrays.layout)
            np.testing.assert_allclose(tensors.weights.detach().numpy(), arrays.weights, rtol=1e-14, atol=1e-15)


def test_a_packed_pid_is_its_rows():
    robot = load_robot("kinova")
    pid = nbs.PID.for_robot(robot, period=0.002)
    law = pid.packed_law()
    assert list(law.layout) == [LawCode.PID, robot.nv]
    rows = law.weights.reshape(6, -1)
    expected = [pid.kp, pid.ki, pid.kd, robot.effort_limit, np.full(robot.nv, 0.004), robot.continuous]
    np.testing.assert_array_equal(rows, np.array(expected, dtype=float))
