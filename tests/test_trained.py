"""A trained controller, and one whose parameters are absurd, have every property of the one they began as."""

import copy
import functools
import pickle

import numpy as np
import pytest

from nbs_pin.controllers.gain import Gain
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import Sinusoid
from nbs_pin.robots.robot import load_robot
from nbs_pin.simulation.dynamics_plant import DynamicsPlant
from nbs_pin.simulation.simulate import simulate
from nbs_pin.training.train import train
from tests.test_closed_loops import check_storage_falls
from tests.test_compiled import assert_one_law
from tests.test_controllers import arguments, check_lyapunov_identity
from tests.test_networks import check_floor, check_psi, check_strong_convexity, randomise


def untrained(name: str) -> NeuralBackstepping:
    return NeuralBackstepping.for_robot(load_robot(name), period=0.005)


@functools.cache
def trained(name: str) -> NeuralBackstepping:
    """After 20 epochs, long enough to change every parameter."""
    law = untrained(name)
    plant, reference = DynamicsPlant(law.dynamics), Sinusoid.for_robot(law.dynamics.robot)
    settings = dict(
        starts=6,
        held_out=0,
        start_error=0.3,
        duration=0.4,
        period=0.005,
        optimiser="adam-backtracking",
        learning_rate=0.02,
    )
    result = train(law, plant, [reference], epochs=20, **settings)
    assert result.history[result.best_epoch] < 0.9 * result.history[0]
    return result.controller


def absurd(name: str) -> NeuralBackstepping:
    """Parameters of any sign and many times too large: torques of 10⁵ N·m from an error of 1 rad."""
    law = untrained(name)
    randomise(law, seed=7, gain=1.5)
    return law


@pytest.fixture(scope="module", params=["two_link", "panda"])
def name(request):
    return request.param


@pytest.fixture(scope="module", params=[trained, absurd])
def law(request, name):
    return request.param(name)


def test_every_parameter_is_another_one(law, name):
    before = dict(untrained(name).named_parameters())
    for key, parameter in law.named_parameters():
        assert not (parameter == before[key]).any() or key.endswith("b3")  # ∇Φ and ∇²Φ know nothing of the last bias


def test_gains_keep_their_share(law):
    gains = [module for module in law.modules() if isinstance(module, Gain)]
    assert len(gains) == 3
    for gain in gains:
        excess = gain.numpy() - 0.5 * gain.nominal.numpy()
        least = excess.min() if excess.ndim == 1 else np.linalg.eigvalsh(excess).min()
        assert least >= 0.0


@pytest.mark.parametrize("seed", range(5))
def test_the_potential_is_strongly_convex_and_zero_at_zero_alone(law, seed):
    check_psi(law.potential, seed)
    check_strong_convexity(law.potential, seed)


@pytest.mark.parametrize("seed", range(5))
def test_the_damping_is_above_its_floor(law, seed):
    check_floor(law.damping, seed)


@pytest.mark.parametrize("seed", range(5))
def test_the_storage_falls_at_the_rate_it_says(law, seed):
    check_lyapunov_identity(law, seed)


def test_the_storage_of_a_held_arm_never_rises():
    check_storage_falls(trained("two_link"))


@pytest.mark.parametrize("size", [1e-3, 1.0, 10.0])
def test_compiled_numpy_and_torch_are_one_law(law, size):
    assert_one_law(law, *(size * x for x in arguments(law.nv, (50,))))


def test_on_the_reference_the_torque_is_the_inverse_dynamics(law):
    q, v, _, _, a = arguments(law.nv, (50,))
    expected = PinocchioDynamics(law.dynamics.robot).reference_torque(q, v, v, a)
    np.testing.assert_allclose(law.torque(q, v, q, v, a), expected, rtol=1e-10, atol=1e-9)
    assert np.abs(law.storage(q, v, q, v)).max() <= 1e-9
    assert law.storage(q, v, q + 1e-3, v).min() > 0.0


def test_the_arm_stays_on_the_reference(name):
    law = trained(name)  # absurd gains chatter at this period; the theorem is of continuous time
    reference = Sinusoid.for_robot(law.dynamics.robot, amplitude=0.2)
    run = simulate(DynamicsPlant(law.dynamics), law, reference, 0.5, 0.005)
    assert np.abs(run.q - run.q_ref).max() < 1e-3


def test_copies_are_the_same(law):
    states = arguments(law.nv, (5,))
    for twin in (pickle.loads(pickle.dumps(law)), copy.deepcopy(law)):
        np.testing.assert_array_equal(twin.torque(*states), law.torque(*states))
