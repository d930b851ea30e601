"""What the kernels know: every code in every form of the law, NaN for what is unknown, scratch space, plain Python."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.controllers.activations import SmoothedReLU, Squareplus
from nbs_pin.controllers.compiled import CompiledController
from nbs_pin.controllers.damping import DAMPINGS, Damping
from nbs_pin.kernels.convex import activation, potential
from nbs_pin.kernels.damping import damping_adjoint, damping_force, room_for_damping
from nbs_pin.kernels.laws import law_signals
from nbs_pin.kernels.layout import (
    CODE,
    LAW,
    ActivationCode,
    DampingCode,
    IntegratorCode,
    JointCode,
    LawCode,
    Packed,
    known,
    pack_damping,
    pack_law,
    pack_potential,
    workspace,
)
from nbs_pin.kernels.records import Dual, Motion, State
from nbs_pin.kernels.rollouts import Course, Rollout, rollout, rollout_adjoint, rollout_workspace
from nbs_pin.kernels.tree_layout import PER_JOINT, TREE_JOINTS, Link, pack_tree, tree_workspace
from nbs_pin.kernels.trees import tree_acceleration, tree_torque
from nbs_pin.simulation.costs import squared_error
from nbs_pin.simulation.integrators import INTEGRATORS
from nbs_pin.simulation.rollout import motions, running_cost, scene_of
from tests.laws import COMPILED
from tests.test_adjoints import adjoint_of, random_damping, random_law, random_potential, scratch, states
from tests.test_training import arm, assert_engines_agree, law_for, problem

ACTIVATIONS = {ActivationCode.SMOOTHED_RELU: SmoothedReLU(0.5), ActivationCode.SQUAREPLUS: Squareplus(0.3)}
UNKNOWN = 99


def forged(part: Packed, at: int) -> Packed:
    """The same numbers under a code that no kernel knows."""
    layout = part.layout.copy()
    layout[at] = UNKNOWN
    return Packed(layout, part.weights)


# Every code: what is written = kernel = adjoint. A code without all three fails here; laws run in test_compiled.py and
# test_both_engines_are_one_loop_for_every_law.


@pytest.mark.parametrize("code", ActivationCode)
def test_every_activation_is_its_kernel(code):
    """Its value and three derivatives; potential and adjoint have no other."""
    written = ACTIVATIONS[code]
    assert written.kernel[0] == code
    x = torch.linspace(-2.0, 2.0, 40, dtype=torch.float64, requires_grad=True)  # not 0 nor 0.5, where σ'' jumps
    value, slope, bend = written.derivatives(x)
    (third,) = torch.autograd.grad(bend.sum() + 0.0 * x.sum(), x)
    expected = torch.stack([value, slope, bend, third]).detach().numpy().T
    found = np.array([activation(*written.kernel, a) for a in x.tolist()])
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(("code", "ceiling"), [*((code, None) for code in DampingCode), (DampingCode.BOUNDED, 0.4)])
def test_every_damping_is_its_kernel_and_its_adjoint(code, ceiling):
    form = code.name.lower()
    damping = Damping(3, form=form, floor=None if form == "paper" else np.eye(3), ceiling=ceiling, gain=0.8)
    part = damping.packed()
    assert part.layout[CODE] == code
    z, force_bar = np.random.default_rng(0).normal(size=(2, 3))
    force, z_bar, weights_bar = np.empty(3), np.zeros(3), np.zeros_like(part.weights)
    damping_force(z, part, np.empty(workspace(part)), force)
    np.testing.assert_allclose(force, damping.force(z), rtol=1e-12)
    damping_adjoint(z, force_bar, part, np.empty(room_for_damping(part)), z_bar, weights_bar)
    tensor, parameters = torch.tensor(z, requires_grad=True), list(damping.parameters())
    expected = torch.autograd.grad(damping.force(tensor) @ torch.tensor(force_bar), [tensor, *parameters])
    weights = damping.packed(numpy=False).weights
    through = torch.autograd.grad(weights, parameters, torch.tensor(weights_bar), allow_unused=True)
    for x, y in zip((torch.tensor(z_bar), *through), expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("code", IntegratorCode)
@pytest.mark.parametrize("substeps", [1, 3])
def test_every_integrator_is_its_kernel_and_its_adjoint(code, substeps):
    """With friction in the plant and in the law."""
    robot, friction = arm("two_link"), nbs.JointFriction(np.array([0.3, 0.2]), np.array([0.4, 0.0]), 0.5)
    batch = problem(robot, steps=5, integrator=code.name.lower(), substeps=substeps, friction=friction)
    assert_engines_agree(law_for(robot, friction=friction), batch, squared_error)


@pytest.mark.parametrize("code", JointCode)
def test_every_joint_has_its_kernel(code):
    """A unit mass a metre from its axis: it turns and slides against gravity, which is across the axis and along it."""
    slides = code is JointCode.PRISMATIC
    about, gravity = (np.zeros(3), [0.0, 0.0, -9.0]) if slides else (np.array([1.0, 0.0, 0.0]), [0.0, -9.0, 0.0])
    link = Link(0, slides, np.array([0.0, 0.0, 1.0]), np.eye(3), np.zeros(3), 1.0, about, np.zeros((3, 3)))
    tau, tree = np.empty(1), pack_tree([link], np.array(gravity))
    tree_torque(Motion(*np.array([[0.0], [3.0], [3.0], [2.0]])), tree, np.empty(tree_workspace(tree)), tau)
    np.testing.assert_allclose(tau, [11.0])


def test_names_and_codes_are_the_same_lists():
    assert {code.name.lower() for code in IntegratorCode} == set(INTEGRATORS)
    assert {code.name.lower() for code in DampingCode} == set(DAMPINGS)
    assert {law_for(arm("two_link"), name).packed_law().layout[LAW] for name in COMPILED} == set(LawCode)
    assert set(ACTIVATIONS) == set(ActivationCode)


# What no kernel knows.


def test_unknown_codes_are_not_packed():
    one = np.ones(2)
    layers = [(None, np.ones((1, 2)), None)]
    networks = tuple([[(np.ones((k, 2)), np.ones(k))] for k in (2, 1)])
    for pack, what in (
        (lambda: pack_law(UNKNOWN, (one, one), None, None), "the law '99'; give one of backstepping = 0"),
        (lambda: pack_potential(layers, (UNKNOWN, 0.1), one, np.eye(2)), "the activation '99'"),
        (lambda: pack_damping(networks, UNKNOWN, 0.1, one, np.eye(2)), "the form of a damping '99'"),
        (lambda: known("leapfrog", IntegratorCode, "integrator"), "the integrator 'leapfrog'; give one of euler = 0"),
        (lambda: pack_law(LawCode.PID, (one, one), None, None), "PID to pack_pid"),
        (lambda: pack_law(LawCode.BACKSTEPPING, (one, one), None, None), "with 0 networks"),
    ):
        with pytest.raises(ArgumentError, match=what):
            pack()
    pid = nbs.PID.for_robot(arm("two_link")).packed_law()
    for law, what in (
        (pid, "a PID was given"),
        (forged(random_law(LawCode.PD_GRAVITY, 2, "paper", friction=True), LAW), "99"),
    ):
        with pytest.raises(ArgumentError, match=what):
            CompiledController(law, nbs.AnalyticDynamics())


@pytest.mark.parametrize("friction", [False, True])
def test_an_unknown_law_gives_no_number(friction):
    for code in (LawCode.BACKSTEPPING, LawCode.SLOTINE_LI):
        law = forged(random_law(code, 2, "smooth", friction=friction), LAW)
        given, out = states(2, seed=0), np.zeros((3, 2))
        assert law_signals(*given, *law, np.zeros(1000), out)
        assert np.isnan(out).all()
        assert np.isnan(adjoint_of(law, given, np.ones((3, 2)))[:2]).all()


def test_unknown_parts_give_no_number():
    one, out = np.ones(2), np.zeros((2, 2))
    phi = forged(random_potential(2, (3,), "smooth"), CODE)
    assert np.isnan(potential(Dual(one, one), phi, np.empty(workspace(phi)), Dual(*out)))
    assert np.isnan(out).all()
    damping, force, z_bar = forged(random_damping(2, (3,), "bounded"), CODE), np.zeros(2), np.zeros(2)
    damping_force(one, damping, np.empty(workspace(damping)), force)
    damping_adjoint(one, one, damping, np.empty(room_for_damping(damping)), z_bar, np.zeros_like(damping.weights))
    assert np.isnan([force, z_bar]).all()
    tree = nbs.PinocchioDynamics(arm("two_link")).packed_tree()
    for joint in range(2):
        odd, tau, factor = forged(tree, TREE_JOINTS + PER_JOINT * joint + 1), np.zeros((2, 2)), np.zeros((2, 2))
        tree_torque(Motion(one, one, one, one), odd, np.empty(tree_workspace(tree)), tau[0])
        tree_acceleration(State(one, one), one, odd, np.empty(tree_workspace(tree)), factor, tau[1])
        assert np.isnan(tau).all()


def test_an_unknown_integrator_gives_no_number():
    motion, bars, _ = run_and_adjoint("slotine-li", "two_link", "euler", 1, code=UNKNOWN)
    assert np.isnan(motion.q[1:]).all()
    assert np.isnan(bars.q[0]).all()


# Scratch space.


def run_and_adjoint(name: str, arm_name: str, integrator: str, substeps: int, code: int | None = None):
    """A motion, its cotangents and the last number of the scratch space they used."""
    robot = arm(arm_name)
    steps, n, law = 2, robot.nv, law_for(robot, name)
    batch, packed = problem(robot, steps, 1, integrator=integrator, substeps=substeps), law.packed_law()
    scene = scene_of(law, batch.loop)
    scene = scene if code is None else scene._replace(integrator=code)
    shapes = ((steps + 1, n), (steps + 1, n), (steps, n), (steps + 1, 2, n))
    motion, bars = Rollout(*(np.zeros(s) for s in shapes)), Rollout(*(np.ones(s) for s in shapes))
    motion.q[0], motion.v[0], bars.memory[:] = batch.q0[0], batch.v0[0], 0.0
    course = Course(batch.aims[0], batch.leads, batch.tau_d[0])
    with scratch(rollout_workspace(packed, scene)) as room:
        rollout(course, scene, packed, room, motion)
    law_bar = Packed(packed.layout, np.zeros_like(packed.weights))
    with scratch(len(room)) as room:
        rollout_adjoint(course, scene, packed, room, motion, bars, np.empty((steps, n)), law_bar)
    return motion, bars, room[-1]


@pytest.mark.parametrize("name", COMPILED)
@pytest.mark.parametrize(("arm_name", "integrator", "substeps"), [("two_link", "euler", 1), ("panda", "rk4", 3)])
def test_rollouts_stay_within_their_scratch_space(name, arm_name, integrator, substeps):
    motion, bars, last = run_and_adjoint(name, arm_name, integrator, substeps)
    assert np.isfinite(motion.q).all()
    assert np.isfinite(bars.q).all()
    if not name.startswith("nbs"):  # whose networks leave room for rows that are padded
        assert np.isfinite(last)


# Kernels as Python.


def numbers() -> dict[str, np.ndarray]:
    """Torques of all laws, of a model beside a law's kernel, and of a tree; motions with their gradients."""
    robot, found = arm("two_link", 30.0), {}
    q, v, *reference = given = np.random.default_rng(0).normal(size=(5, 2))
    for name in COMPILED:
        law = law_for(robot, name).compile()
        found[name], _ = law.step(law.initial_memory(q), q, v, nbs.Reference(*reference), 0.01)
    compiled = CompiledController(law_for(robot).packed_law(), nbs.PinocchioDynamics(robot))
    many = given[:, None] * np.arange(1.0, 4.0)[:, None]
    found["rows"], found["lists"] = compiled.torque(*many), compiled.torque(*given.tolist())
    found["single precision"] = compiled.torque(*given.astype(np.float32))
    found["no number"] = np.isnan(compiled.torque(q, v, reference[0] * np.inf, *reference[1:]))
    for k in range(5):  # what does not fit is refused by as_vectors, not met by a kernel
        with pytest.raises(ArgumentError, match="has shape"):
            compiled.torque(*(np.zeros(3) if j == k else x for j, x in enumerate(given)))
    for name in ("nbs-paper", "pid"):
        law, batch = law_for(robot, name), problem(robot, steps=2, starts=1, substeps=2)
        motion = motions(law, batch, "kernels")
        running_cost(motion, batch, squared_error).sum().backward()
        found[f"motion of {name}"] = motion.q.detach().numpy()
        found[f"gradient of {name}"] = torch.cat([p.grad.ravel() for p in law.parameters()]).numpy()
    panda = nbs.PinocchioDynamics(nbs.load_robot("panda")).packed_tree()
    states, tau = np.random.default_rng(1).normal(size=(4, 7)), np.empty(7)
    tree_torque(Motion(*states), panda, np.empty(tree_workspace(panda)), tau)
    return found | {"panda": tau}


def test_interpreted_kernels_give_the_compiled_numbers(tmp_path):
    code = "import sys, numpy as np, numba; from tests.test_kernels import numbers; assert numba.config.DISABLE_JIT"
    root, path = Path(__file__).parent.parent, tmp_path / "numbers.npz"
    env = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(root)}
    command = [sys.executable, "-c", f"{code}; np.savez(sys.argv[1], **numbers())", str(path)]
    out = subprocess.run(command, env=env, cwd=root, capture_output=True, text=True)
    assert out.returncode == 0, out.stderr
    interpreted = np.load(path)
    for name, x in numbers().items():
        assert np.abs(1.0 * interpreted[name] - x).max() <= 1e-12 * max(np.abs(x).max(), 1e-3), name
