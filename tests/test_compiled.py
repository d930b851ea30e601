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
from hypothesis import given, settings, strategies as st

from nbs_pin.base.arrays import array_namespace
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.controllers.activations import Activation, SmoothedReLU, Squareplus
from nbs_pin.controllers.compiled import CompiledController
from nbs_pin.controllers.computed_torque import ComputedTorque
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.neural_backstepping import DAMPINGS, NeuralBackstepping, paper_controller
from nbs_pin.controllers.pd import PD
from nbs_pin.controllers.pid import PID
from nbs_pin.controllers.potential import POTENTIALS, Potential
from nbs_pin.controllers.slotine_li import SlotineLi
from nbs_pin.dynamics.analytic import AnalyticDynamics
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.kernels import jit, laws
from nbs_pin.kernels.convex import potential
from nbs_pin.kernels.damping import damping_force, tanh
from nbs_pin.kernels.jit import compile_for
from nbs_pin.kernels.laws import difference
from nbs_pin.kernels.layout import workspace
from nbs_pin.kernels.records import Dual
from nbs_pin.robots.robot import load_robot
from tests.laws import COMPILED
from tests.test_networks import randomise

LAWS = {name: make for name, make in COMPILED.items() if name != "pid"}
"""Laws without memory."""
ARMS = ["two_link", "panda", "kinova", "z1"]


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
    """Compiled, numpy and torch agree to 1e-12 of the torque's size."""
    tau = controller.torque(*given)
    compiled = controller.compile().torque(*given)
    tensor = controller.torque(*(torch.as_tensor(x) for x in given)).detach().numpy()
    size = np.abs(tau).max()
    assert np.abs(compiled - tau).max() <= 1e-12 * size
    assert np.abs(compiled - tensor).max() <= 1e-12 * size


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
def test_potential_kernel_is_the_potential(seed, nv, widths, form, activation, at_zero):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(nv, nv))
    s = root @ root.T + np.eye(nv)
    scale = rng.uniform(0.1, 5.0, nv)
    phi = Potential(0.5 * (s + s.T), form=form, widths=tuple(widths), activation=activation, scale=scale)
    randomise(phi, seed, gain=2.0)
    z, dz = rng.normal(size=(2, nv)) * [[0.0 if at_zero else 1.0], [1.0]]
    packed = phi.packed()
    gradient, product = np.empty((2, nv))
    value = potential(Dual(z, dz), packed, guarded(workspace(packed)), Dual(gradient, product))
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
    size=st.sampled_from([0.0, 1e-9, 1.0, 1e3]),
)
def test_damping_kernel_is_the_damping(seed, nv, widths, paper, size):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(nv, nv))
    floor = None if paper else root @ root.T + np.eye(nv)
    floor = None if floor is None else 0.5 * (floor + floor.T)
    options = {"form": "paper" if paper else "bounded", "floor": floor, "scale": rng.uniform(0.1, 5.0, nv)}
    damping = Damping(nv, widths=tuple(widths), **options)
    randomise(damping, seed)
    z = size * rng.normal(size=nv)
    packed, force = damping.packed(), np.empty(nv)
    damping_force(z, packed, guarded(workspace(packed)), force)
    expected = damping.force(z)
    assert np.abs(force - expected).max() <= 1e-12 * np.abs(expected).max()


def guarded(size: int) -> np.ndarray:
    """Scratch space full of NaN, so that a kernel that reads before it writes is seen."""
    return np.full(size, np.nan)


def test_tanh_is_tanh():
    x = np.concatenate([np.linspace(-25.0, 25.0, 20_001), np.geomspace(1e-300, 1e3, 2_000)])
    y = np.empty_like(x)
    tanh(x, y)
    np.testing.assert_allclose(y, np.tanh(x), rtol=2e-15, atol=0.0)
    tanh(np.array([np.nan, np.inf, -np.inf, 0.0]), y)
    np.testing.assert_array_equal(y[:4], [np.nan, 1.0, -1.0, 0.0])


def test_kernels_stay_within_their_scratch_space():
    """Numbers beyond the end are left alone: a scratch space too short would be overrun silently."""
    for nv in (1, 2, 7, 30):
        for part, run in (
            (
                Potential(np.eye(nv), widths=(3, 40)).packed(),
                lambda p, w, n: potential(Dual(*np.ones((2, n))), p, w, Dual(*np.ones((2, n)))),
            ),
            (Damping(nv, floor=np.eye(nv)).packed(), lambda p, w, n: damping_force(np.ones(n), p, w, np.ones(n))),
        ):
            room = np.full(workspace(part) + 64, np.nan)
            run(part, room[: workspace(part)], nv)
            assert np.isnan(room[workspace(part) :]).all()


# Whole laws.


@pytest.mark.parametrize("friction", [False, True])
def test_every_law_on_every_arm(law, robot, friction):
    controller = law(
        robot, friction=JointFriction(np.full(robot.nv, 0.3), np.full(robot.nv, 2.0)) if friction else None
    )
    for seed in range(5):
        assert_one_law(controller, *states(robot.nv, seed=seed))
    assert_one_law(controller, *states(robot.nv, (2, 3)))


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
    dynamics = AnalyticDynamics()
    return NeuralBackstepping(dynamics, phi, Damping(2, form="paper")), np.full(2, 0.25)


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


class Foreign(DynamicsProvider):
    """A provider from outside, of which only the protocol is known."""

    nv = 2

    def __init__(self):
        self.inner = AnalyticDynamics()

    def mass_matrix(self, q):
        return self.inner.mass_matrix(q)

    def coriolis_matrix(self, q, v):
        return self.inner.coriolis_matrix(q, v)

    def gravity(self, q):
        return self.inner.gravity(q)

    def potential_energy(self, q):
        return self.inner.potential_energy(q)


@pytest.mark.parametrize("provider", [AnalyticDynamics, Foreign])
def test_every_provider_compiles(provider):
    dynamics = provider()
    gains = {"kp": 3.0, "kd": 2.0}
    for controller in (
        paper_controller(dynamics),
        SlotineLi(dynamics, rate=2.0, gain=3.0),
        ComputedTorque(dynamics, **gains),
        PD(dynamics, feedforward="reference", **gains),
        PD(dynamics, feedforward="gravity", **gains),
    ):
        assert_one_law(controller, *states(2))
        assert_one_law(controller, *states(2, (4,)))


def test_batch_is_the_stack_of_its_rows_on_any_number_of_cores(law):
    robot = load_robot("panda")
    compiled = law(robot).compile()
    many = states(robot.nv, (2, 100))  # enough rows for two threads
    rows = [compiled.torque(*(x.reshape(200, -1)[i] for x in many)) for i in range(200)]
    np.testing.assert_array_equal(compiled.torque(*many).reshape(200, -1), rows)


def test_arguments_of_other_kinds_are_converted_and_of_other_shapes_broadcast(law):
    robot = load_robot("two_link")
    compiled = law(robot).compile()
    given = states(2)
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
    controller = law(load_robot("two_link"))
    given = states(2)
    given[argument][1] = value
    with np.errstate(all="ignore"):
        expected = np.isfinite(controller.torque(*given))
    np.testing.assert_array_equal(np.isfinite(controller.compile().torque(*given)), expected)


def test_wrong_shapes_and_tensors_are_refused(law):
    compiled = law(load_robot("two_link")).compile()
    given = states(2)
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
    controller = NeuralBackstepping.for_robot(load_robot("two_link"))
    given = states(2)
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


class Softplus(Activation):
    """A user's own activation."""

    def derivatives(self, x):
        xp = array_namespace(x)
        s = 1.0 / (1.0 + xp.exp(-x))
        return xp.log1p(xp.exp(x)), s, s * (1.0 - s)


def test_laws_without_a_compiled_form_are_their_own():
    class Own(MemorylessController):
        nv = 2

        def torque(self, q, v, q_ref, v_ref, a_ref):
            return -q

    own = Own()
    assert own.compile() is own
    phi = Potential(np.eye(2), activation=Softplus())
    controller = NeuralBackstepping(AnalyticDynamics(), phi, Damping(2, floor=np.eye(2)))
    assert controller.compile() is controller
    with pytest.raises(ArgumentError, match="no compiled form"):
        phi.packed()


class Doubled(NeuralBackstepping):
    def torque(self, *given):
        return 2.0 * super().torque(*given)


class DoubledPD(PD):
    def torque(self, *given):
        return 2.0 * super().torque(*given)


class Loaded(PinocchioDynamics):
    def reference_torque(self, q, v, v_r, a_r):
        return 1.0 + super().reference_torque(q, v, v_r, a_r)


class Shifted(AnalyticDynamics):
    def reference_torque(self, q, v, v_r, a_r):
        return 1.0 + super().reference_torque(q, v, v_r, a_r)

    def difference(self, q, q_ref):
        return 1.0 + super().difference(q, q_ref)


class Stiction(JointFriction):
    def torque(self, v):
        return 3.0 + super().torque(v)


class Leaky(SmoothedReLU):
    """A user's variation of an activation that has a kernel."""

    def derivatives(self, x):
        value, slope, bend = super().derivatives(x)
        return value + 0.3 * x, slope + 0.3, bend


def test_an_empty_batch_is_empty():
    robot = load_robot("two_link")
    empty = np.zeros((0, 2))
    for law in (NeuralBackstepping, SlotineLi, ComputedTorque, PD):
        assert law.for_robot(robot).compile().torque(*[empty] * 5).shape == (0, 2)


def test_what_a_subclass_overrides_is_not_lost():
    robot = load_robot("two_link")
    for controller in (
        Doubled.for_robot(robot),
        DoubledPD.for_robot(robot),
        SlotineLi.for_robot(robot, Loaded(robot)),
        NeuralBackstepping.for_robot(robot, Loaded(robot)),
        SlotineLi.for_robot(robot, friction=Stiction(np.ones(2), np.ones(2))),
        SlotineLi(Shifted(), rate=1.0, gain=1.0),
        paper_controller(Shifted()),
        NeuralBackstepping(AnalyticDynamics(), Potential(np.eye(2), activation=Leaky()), Damping(2, form="paper")),
    ):
        assert_one_law(controller, *states(2))


@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_pid_remembers_as_the_written_one_does(robot, batch):
    pid = PID.for_robot(robot)
    compiled = pid.compile()
    rng = np.random.default_rng(0)
    given = rng.normal(size=(5, *batch, robot.nv))
    memories = [c.initial_memory(given[0]) for c in (pid, compiled)]
    for _ in range(50):
        q, v, *reference = given + rng.normal(size=given.shape)
        results = [c.step(m, q, v, Reference(*reference), 0.01) for c, m in zip((pid, compiled), memories, strict=True)]
        (tau, left), (fast, right) = results
        np.testing.assert_allclose(fast, tau, rtol=1e-12, atol=1e-12 * np.abs(tau).max())
        np.testing.assert_allclose(right, left, rtol=1e-12, atol=1e-12 * np.abs(tau).max())
        memories = [left, right]
    assert np.abs(memories[0].integral).max() > 0.0
    copy = pickle.loads(pickle.dumps(compiled))
    step = memories[1], given[0], given[1], Reference(*given[2:]), 0.01
    np.testing.assert_array_equal(copy.step(*step)[0], compiled.step(*step)[0])


def test_pid_refuses_what_does_not_fit():
    compiled = PID.for_robot(load_robot("two_link")).compile()
    memory = compiled.initial_memory(np.zeros(2))
    still = Reference(*np.zeros((3, 2)))
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
    NeuralBackstepping.for_robot(load_robot("two_link")).compile()
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
