"""Compiled laws are the same laws: agreement with the numpy and torch forms, everywhere."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.activations import Activation, SmoothedReLU, Squareplus
from nbs_pin.controllers.compiled import CompiledController
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.neural_backstepping import DAMPINGS, NeuralBackstepping
from nbs_pin.controllers.potential import POTENTIALS, Potential
from nbs_pin.kernels import jit, laws
from nbs_pin.kernels.convex import potential
from nbs_pin.kernels.damping import damping_force, tanh
from nbs_pin.kernels.jit import compile_for
from nbs_pin.kernels.laws import difference
from nbs_pin.kernels.layout import workspace
from nbs_pin.kernels.records import Dual
from nbs_pin.robots.robot import load_robot
from tests.laws import COMPILED
from tests.test_adjoints import scratch
from tests.test_networks import randomise

LAWS = {name: make for name, make in COMPILED.items() if name != "pid"}
"""Laws without memory."""
ARMS = ["two_link", "panda", "kinova", "z1"]
TWO_LINK = load_robot("two_link")


@pytest.fixture(params=LAWS)
def law(request):
    return LAWS[request.param]


@pytest.fixture(scope="module", params=ARMS)
def robot(request):
    return load_robot(request.param)


def states(nv: int, batch: tuple[int, ...] = (), seed: int = 0, size: float = 1.0) -> list[np.ndarray]:
    """q, v, q_ref, v_ref, a_ref at random."""
    return list(size * np.random.default_rng(seed).normal(size=(5, *batch, nv)))


def assert_one_law(controller, *given):
    """Compiled, numpy and torch agree to 1e-12 of each torque's size."""
    tau = controller.torque(*given)
    compiled = controller.compile().torque(*given)
    tensor = controller.torque(*(torch.as_tensor(x) for x in given)).detach().numpy()
    bound = 1e-12 * np.abs(tau).max(axis=-1, keepdims=True)
    assert (np.abs(compiled - tau) <= bound).all()
    assert (np.abs(compiled - tensor) <= bound).all()


def positive_definite(rng: np.random.Generator, n: int) -> np.ndarray:
    root = rng.normal(size=(n, n))
    matrix = root @ root.T + np.eye(n)
    return 0.5 * (matrix + matrix.T)


# The networks, one kernel at a time.


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31 - 1),
    nv=st.integers(1, 31),
    widths=st.lists(st.integers(1, 40), max_size=4),
    form=st.sampled_from(POTENTIALS),
    activation=st.sampled_from([None, SmoothedReLU(0.5), Squareplus(0.1)]),
    at_zero=st.booleans(),
)
@example(seed=0, nv=7, widths=[], form="paper", activation=None, at_zero=False)  # the widest row fills its padding
def test_potential_kernel_is_the_potential(seed, nv, widths, form, activation, at_zero):
    rng = np.random.default_rng(seed)
    s, scale = positive_definite(rng, nv), rng.uniform(0.1, 5.0, nv)
    phi = Potential(s, form=form, widths=tuple(widths), activation=activation, scale=scale)
    randomise(phi, seed, gain=2.0)
    z, dz = rng.normal(size=(2, nv)) * [[0.0 if at_zero else 1.0], [1.0]]
    packed = phi.packed()
    gradient, product = np.empty((2, nv))
    with scratch(workspace(packed)) as work:
        value = potential(Dual(z, dz), packed, work, Dual(gradient, product))
    expected = phi.terms(z, dz)
    for x, y in zip((value, gradient, product), expected, strict=True):
        assert np.abs(x - y).max() <= 1e-12 * max(np.abs(y).max(), 1.0)
    if at_zero and (form == "smooth" or activation is None):
        np.testing.assert_array_equal([value, *gradient], 0.0)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31 - 1),
    nv=st.integers(1, 31),
    widths=st.lists(st.integers(1, 40), max_size=3),
    paper=st.booleans(),
    ceiling=st.sampled_from([None, 1e-3, 1.0, 30.0]),
    size=st.sampled_from([0.0, 1e-9, 1.0, 1e3]),
)
def test_damping_kernel_is_the_damping(seed, nv, widths, paper, ceiling, size):
    rng = np.random.default_rng(seed)
    floor, scale = positive_definite(rng, nv), rng.uniform(0.1, 5.0, nv)
    options = {"form": "paper"} if paper else {"floor": floor, "ceiling": ceiling}
    damping = Damping(nv, widths=tuple(widths), scale=scale, **options)
    randomise(damping, seed)
    z = size * rng.normal(size=nv)
    packed, force = damping.packed(), np.empty(nv)
    with scratch(workspace(packed)) as work:
        damping_force(z, packed, work, force)
    expected = damping.force(z)
    assert np.abs(force - expected).max() <= 1e-12 * np.abs(expected).max()


def test_tanh_is_tanh():
    x = np.concatenate([np.linspace(-25.0, 25.0, 20_001), np.geomspace(1e-300, 1e3, 2_000)])
    y = np.empty_like(x)
    tanh(x, y)
    np.testing.assert_allclose(y, np.tanh(x), rtol=2e-15, atol=0.0)
    tanh(np.array([np.nan, np.inf, -np.inf, 0.0]), y)
    np.testing.assert_array_equal(y[:4], [np.nan, 1.0, -1.0, 0.0])


# Whole laws.


@pytest.mark.parametrize("friction", [False, True])
def test_every_law_on_every_arm(law, robot, friction):
    fed = nbs.JointFriction(np.full(robot.nv, 0.3), np.full(robot.nv, 2.0)) if friction else None
    controller = law(robot, friction=fed)
    assert_one_law(controller, *states(robot.nv))
    assert_one_law(controller, *states(robot.nv, (2, 5)))


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31 - 1),
    potential=st.sampled_from(POTENTIALS),
    damping=st.sampled_from(DAMPINGS),
    name=st.sampled_from(ARMS),
    size=st.sampled_from([1e-3, 1.0, 10.0]),
    on_reference=st.booleans(),
)
def test_neural_backstepping_for_random_weights_and_states(seed, potential, damping, name, size, on_reference):
    controller = NeuralBackstepping.for_robot(load_robot(name), potential=potential, damping=damping)
    randomise(controller, seed)
    q, v, q_ref, v_ref, a_ref = states(controller.nv, seed=seed, size=size)
    assert_one_law(controller, q, v, q if on_reference else q_ref, v_ref, a_ref)


def switching_controller() -> tuple[NeuralBackstepping, np.ndarray]:
    """A paper controller whose pre-activations at z1 = (1, 1)/4 are exactly d, 0, −d, 2d and d/2, with that z1."""
    d = 0.25
    phi = Potential(np.eye(2), form="paper", widths=(5,), activation=SmoothedReLU(d))
    with torch.no_grad():
        rows = [[0.5, 0.5], [1.0, -1.0], [-0.5, -0.5], [1.0, 1.0], [0.25, 0.25]]
        phi.network.wx0.copy_(torch.tensor(rows))
        phi.network.wx1.copy_(torch.tensor([[0.5, 0.25]]))
        phi.network.wy1.copy_(torch.tensor([[1.0, 2.0, 0.5, 0.25, 1.0]]))
    return NeuralBackstepping(nbs.AnalyticDynamics(), phi, Damping(2, form="paper")), np.full(2, 0.25)


def test_the_points_where_the_papers_curvature_jumps_are_the_same():
    controller, z1 = switching_controller()
    _, v, q_ref, v_ref, a_ref = states(2)
    q_ref = np.round(q_ref * 64.0) / 64.0  # so that q − q_ref is z1 exactly
    weights = controller.potential.network.wx0.detach().numpy()
    assert set(weights @ z1) >= {0.0, 0.25}
    for z in (z1, 0.0 * z1, -z1, np.nextafter(z1, 1.0), np.nextafter(z1, 0.0)):
        assert_one_law(controller, q_ref + z, v, q_ref, v_ref, a_ref)
    jump = [controller.compile().torque(q_ref + s * z1, v, q_ref, v_ref, a_ref) for s in (1.0, 1.0 - 1e-12)]
    assert np.abs(jump[1] - jump[0]).max() > 1e-3  # it is a switch indeed


def test_wrap_is_the_robots_wrap_bit_by_bit():
    turns = np.pi * np.arange(-9, 10)
    q = np.concatenate([turns, np.nextafter(turns, 10.0), np.nextafter(turns, -10.0), np.linspace(-40.0, 40.0, 1001)])
    for q_ref in (0.0 * q, np.full_like(q, 0.3), 1e3 * q[::-1]):
        z1 = np.empty_like(q)
        difference(q, q_ref, np.ones_like(q), z1)
        turned = load_robot("kinova")
        columns = np.repeat(q[:, None], turned.nv, axis=1), np.repeat(q_ref[:, None], turned.nv, axis=1)
        np.testing.assert_array_equal(z1, turned.difference(*columns)[:, np.argmax(turned.continuous)])


class Foreign(nbs.DynamicsProvider):
    """A provider from outside, of which only the protocol is known."""

    nv, inner = 2, nbs.AnalyticDynamics()
    mass_matrix, coriolis_matrix = inner.mass_matrix, inner.coriolis_matrix
    gravity, potential_energy = inner.gravity, inner.potential_energy


@pytest.mark.parametrize("provider", [nbs.AnalyticDynamics, Foreign])
def test_every_provider_compiles(law, provider):
    dynamics = provider()
    paper = law is LAWS["nbs-paper"]  # by name it has no other model
    controller = nbs.paper_controller(dynamics) if paper else law(TWO_LINK, dynamics=dynamics)
    assert_one_law(controller, *states(2))
    assert_one_law(controller, *states(2, (4,)))


def test_batch_is_the_stack_of_its_rows_on_any_number_of_cores(law):
    robot = load_robot("panda")
    compiled = law(robot).compile()
    many = states(robot.nv, (2, 100))  # enough rows for two threads
    rows = [compiled.torque(*(x.reshape(200, -1)[i] for x in many)) for i in range(200)]
    np.testing.assert_array_equal(compiled.torque(*many).reshape(200, -1), rows)


def test_arguments_of_other_kinds_are_converted_and_of_other_shapes_broadcast(law):
    compiled, given = law(TWO_LINK).compile(), states(2)
    expected = compiled.torque(*given)
    strided = [np.repeat(x, 2)[::2] for x in given]
    frozen = [x.copy() for x in given]
    for x in frozen:
        x.flags.writeable = False
    for other in ([x.tolist() for x in given], strided, frozen, [given[0], given[1].tolist(), *frozen[2:]]):
        np.testing.assert_array_equal(compiled.torque(*other), expected)
    np.testing.assert_array_equal(compiled.torque(np.tile(given[0], (3, 1)), *given[1:]), np.tile(expected, (3, 1)))
    np.testing.assert_array_equal(
        compiled.torque(given[0], given[1], np.tile(given[2], (3, 1)), *given[3:])[2], expected
    )
    assert compiled.torque(*[np.zeros((0, 2))] * 5).shape == (0, 2)
    single = [x.astype(np.float32) for x in given]
    np.testing.assert_array_equal(compiled.torque(*single), compiled.torque(*(x.astype(float) for x in single)))


def test_results_are_the_callers_own(law):
    compiled = law(load_robot("panda")).compile()
    first = compiled.torque(*states(7, seed=1))
    kept = first.copy()
    compiled.torque(*states(7, seed=2))
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("argument", range(5))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_none_come_out_as_none(law, argument, value):
    controller, given = law(TWO_LINK), states(2)
    given[argument][1] = value
    with np.errstate(all="ignore"):
        expected = np.isfinite(controller.torque(*given))
    np.testing.assert_array_equal(np.isfinite(controller.compile().torque(*given)), expected)


def test_wrong_shapes_and_tensors_are_refused(law):
    compiled, given = law(TWO_LINK).compile(), states(2)
    with pytest.raises(ArgumentError, match="expected numpy arrays"):
        compiled.torque(*(torch.as_tensor(x) for x in given))
    with pytest.raises(ArgumentError, match="numpy and torch were mixed"):
        compiled.torque(given[0], torch.as_tensor(given[1]), *given[2:])
    for k in range(5):
        with pytest.raises(ArgumentError, match=r"has shape \(3,\), expected \(\.\.\., 2\)"):
            compiled.torque(*(np.zeros(3) if j == k else x for j, x in enumerate(given)))
    with pytest.raises(ArgumentError, match="do not broadcast"):
        compiled.torque(np.zeros((2, 2)), np.zeros((3, 2)), *given[2:])


# What a compiled controller is.


def test_a_compiled_controller_is_a_snapshot():
    controller, given = NeuralBackstepping.for_robot(TWO_LINK), states(2)
    compiled, before = controller.compile(), controller.torque(*given)
    randomise(controller, 1)
    np.testing.assert_allclose(compiled.torque(*given), before, rtol=1e-12)
    assert np.abs(controller.torque(*given) - before).max() > 1e-3


def test_compiled_controllers_pickle_and_compile_to_themselves(law, robot):
    compiled = law(robot).compile()
    assert isinstance(compiled, CompiledController)
    assert compiled.nv == robot.nv
    copy = pickle.loads(pickle.dumps(compiled))
    given = states(robot.nv)
    for other in (copy, compiled.compile()):  # each with scratch space of its own
        assert other is not compiled
        np.testing.assert_array_equal(other.torque(*given), compiled.torque(*given))


def altered(kind, *methods):
    """A user's own subclass, whose methods of these names give 1 more."""

    def one_more(method):
        return lambda self, *given: 1.0 + method(self, *given)

    return type("Altered", (kind,), {name: one_more(getattr(kind, name)) for name in methods})


class Own(nbs.MemorylessController):
    nv = 2

    def torque(self, q, v, q_ref, v_ref, a_ref):
        return -q


class OwnActivation(Activation):
    derivatives = Squareplus().derivatives


class Leaky(SmoothedReLU):
    """A user's variation of an activation that has a kernel."""

    def derivatives(self, x):
        value, slope, bend = super().derivatives(x)
        return value + 0.3 * x, slope + 0.3, bend


def test_laws_without_a_compiled_form_are_their_own_and_say_so():
    phi = Potential(np.eye(2), activation=OwnActivation())
    network = NeuralBackstepping(nbs.AnalyticDynamics(), phi, Damping(2, floor=np.eye(2)))
    for law in (Own(), altered(nbs.PID).for_robot(TWO_LINK), altered(nbs.PD).for_robot(TWO_LINK), network):
        assert law.compile() is law
        assert not law.packable
        with pytest.raises(ArgumentError, match=f"{type(law).__name__} has no compiled form"):
            law.packed_law()
    with pytest.raises(ArgumentError, match="no compiled form"):
        phi.packed()


def test_what_a_subclass_overrides_is_not_lost():
    loaded = altered(nbs.PinocchioDynamics, "reference_torque")(TWO_LINK)
    shifted = altered(nbs.AnalyticDynamics, "reference_torque", "difference")()
    stiction = altered(nbs.JointFriction, "torque")(np.ones(2), np.ones(2))
    leaky = Potential(np.eye(2), activation=Leaky())
    for controller in (
        altered(NeuralBackstepping, "torque").for_robot(TWO_LINK),
        altered(nbs.PD, "torque").for_robot(TWO_LINK),
        nbs.SlotineLi.for_robot(TWO_LINK, loaded),
        NeuralBackstepping.for_robot(TWO_LINK, loaded),
        nbs.SlotineLi.for_robot(TWO_LINK, friction=stiction),
        nbs.SlotineLi(shifted, rate=1.0, gain=1.0),
        nbs.paper_controller(shifted),
        NeuralBackstepping(nbs.AnalyticDynamics(), leaky, Damping(2, form="paper")),
    ):
        assert_one_law(controller, *states(2))


@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
@torch.no_grad()
def test_pid_is_one_law_in_numpy_torch_and_compiled(robot, batch):
    """Torque and memory, through saturation and its anti-windup."""
    pid, rng, saturated = nbs.PID.for_robot(robot), np.random.default_rng(0), []
    given = rng.normal(size=(5, *batch, robot.nv))
    forms = (pid, np.asarray), (compiled := pid.compile(), np.asarray), (pid, torch.as_tensor)
    memories = [law.initial_memory(kind(given[0])) for law, kind in forms]
    for _ in range(50):
        now, results = given + rng.normal(size=given.shape), []
        for (law, kind), memory in zip(forms, memories, strict=True):
            q, v, *reference = map(kind, now)
            results.append(law.step(memory, q, v, nbs.Reference(*reference), 0.01))
        (tau, memory), *others = results
        for other, remembered in others:
            for x, y in zip((other, *remembered), (tau, *memory), strict=True):
                np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12 * np.abs(tau).max())
        memories = [memory for _, memory in results]
        saturated.append(np.abs(tau) > robot.effort_limit)
    assert 0.05 < np.mean(saturated) < 0.95
    assert np.abs(memory.integral).max() > 0.0
    copy = pickle.loads(pickle.dumps(compiled))
    step = memories[1], given[0], given[1], nbs.Reference(*given[2:]), 0.01
    np.testing.assert_array_equal(copy.step(*step)[0], compiled.step(*step)[0])


def test_pid_refuses_what_does_not_fit():
    compiled = nbs.PID.for_robot(TWO_LINK).compile()
    memory = compiled.initial_memory(np.zeros(2))
    still = nbs.Reference(*np.zeros((3, 2)))
    with pytest.raises(ArgumentError, match=r"v has shape \(3,\)"):
        compiled.step(memory, np.zeros(2), np.zeros(3), still, 0.01)
    with pytest.raises(ArgumentError, match="numpy and torch were mixed"):
        compiled.step(memory, torch.zeros(2), torch.zeros(2), still, 0.01)
    np.testing.assert_array_equal(compiled.step(memory, [1, 0], [0, 0], still, 0.01)[0][1], 0.0)


# Machine code on disk.

machine_code = pytest.mark.skipif(jit.INTERPRETED, reason="NUMBA_DISABLE_JIT is set")

PROCESS = """
import numpy as np
from nbs_pin.controllers.slotine_li import SlotineLi
from nbs_pin.controllers.pid import PID
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.kernels import convex, laws
compiled = SlotineLi(AnalyticDynamics(), rate=1.0, gain=1.0).compile()
kernels = (laws.law_signals, laws.pid)
before = [(len(k.overloads), sum(k.stats.cache_misses.values())) for k in kernels]
for shape in ((2,), (3, 2), (300, 2)):
    compiled.torque(*np.ones((5, *shape)))
compiled.torque(*np.ones((5, 2)).tolist())
assert before == [(len(k.overloads), sum(k.stats.cache_misses.values())) for k in kernels]
print(*(sum(k.stats.cache_misses.values()) for k in kernels))
"""


def misses(folder: Path, package: Path) -> list[int]:
    """Cache misses of the two entry points in a new process; it also checks that no call compiles anything."""
    env = os.environ | {"PYTHONPATH": str(package), "PYTHONDONTWRITEBYTECODE": "1"}
    out = subprocess.run([sys.executable, "-c", PROCESS], env=env, cwd=folder, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    return [int(x) for x in out.stdout.split()]


@machine_code
def test_a_second_process_does_not_compile(tmp_path):
    """`compile_laws` ran in this process or an earlier one; a new process loads what it left."""
    NeuralBackstepping.for_robot(TWO_LINK).compile()
    assert misses(tmp_path, Path(__file__).parent.parent) == [0, 0]


@machine_code
def test_machine_code_is_stamped_with_the_whole_folder():
    """numba looks at one file only; a change in a callee or a constant must renew its callers too."""
    stamps = {laws.law_signals._cache._cache_file._source_stamp, potential._cache._cache_file._source_stamp}
    assert stamps == {jit._SOURCES}
    assert len(jit._SOURCES) == 64


@machine_code
def test_a_kernel_that_another_compiled_refuses_other_arguments_too():
    """Whatever was compiled before it in the process, the fast path meets a TypeError and converts."""
    inner = numba.njit(lambda x: x[0])
    outer = numba.njit(lambda x: 2.0 * inner(x))
    assert outer(np.ones(1)) == 2.0
    compile_for(inner, numba.float64(numba.float64[::1]))
    assert inner(np.ones(1)) == 1.0
    with pytest.raises(TypeError):
        inner(np.ones((1, 1)))


def test_an_interpreted_kernel_refuses_them_as_well(monkeypatch):
    monkeypatch.setattr(jit, "INTERPRETED", True)
    first = jit.kernel(lambda x: x[0])
    assert first([2.0]) == 2.0  # any kernel takes anything before it is compiled for a signature
    compile_for(first, numba.float64(numba.float64[::1]))
    assert first(np.ones(1)) == 1.0
    frozen = np.ones(1)
    frozen.flags.writeable = False
    for other in (np.ones((1, 1)), [1.0], np.ones(4)[::2], np.ones(1, dtype=np.float32), torch.ones(1), frozen, None):
        with pytest.raises(TypeError, match="takes"):
            first(other)
