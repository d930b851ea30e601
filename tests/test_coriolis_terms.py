"""Bounds of ∂M/∂q by the rates of links, and of Ṁ and C(q, v) for a velocity that is known by its norms."""

import numpy as np
import pinocchio as pin
import pytest

import nbs_pin as nbs
from nbs_pin.certificates.coriolis import CoriolisBounds
from nbs_pin.certificates.coriolis_terms import Norms, Velocity
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.inertia.derivatives import inertia_derivatives, link_derivatives, link_rates, rate_bound
from tests.test_inertia_bounds import masses
from tests.test_inertia_derivatives import over, slopes


def parallel_model(rng, n, branched):
    """Bodies on joints whose axes are parallel, opposite or in any direction to that of the parent."""
    model, parent = pin.Model(), 0
    for i in range(n):
        turn = pin.rpy.rpyToMatrix(rng.choice([0.0, np.pi]), 0.0, rng.uniform(-np.pi, np.pi))
        if rng.random() < 0.3:
            turn = turn @ pin.rpy.rpyToMatrix(*rng.uniform(-np.pi, np.pi, 3))
        place = pin.SE3(turn, rng.uniform(-0.5, 0.5, 3))
        parent = model.addJoint(parent, pin.JointModelRZ(), place, f"joint{i}")
        body = pin.Inertia.FromBox(float(rng.uniform(0.2, 3.0)), *rng.uniform(0.05, 0.3, 3))
        model.appendBodyToJoint(parent, body, pin.SE3(np.eye(3), rng.uniform(-0.3, 0.3, 3)))
        if branched and i == n - 2:
            parent -= 1
    return model


def christoffel(model, pose):
    """Γ with (C(q, v)z)_i = Σ Γ_ijk v_j z_k, by central differences of M."""
    d = np.array([slopes(model, pose[None], i)[0] for i in range(model.nv)])
    return 0.5 * (np.einsum("jik->ijk", d) + np.einsum("kij->ijk", d) - d), d


@pytest.mark.parametrize("seed", [0, 1, 3, 5])
def test_no_motion_of_a_random_tree_changes_its_inertia_faster_than_its_links_allow(seed):
    rng = np.random.default_rng(seed)
    model = parallel_model(rng, int(rng.integers(3, 6)), branched=seed % 2 == 1)
    packed, weight = pack_model(model), np.diag(rng.uniform(0.1, 3.0, model.nv))
    rates, poses = link_rates(packed), rng.uniform(-np.pi, np.pi, (150, model.nv))
    by_mass = link_derivatives(packed, inertia_derivatives(packed))
    by_weight = link_derivatives(packed, inertia_derivatives(packed, weight), weight)
    d, mass = np.array([slopes(model, poses, i) for i in range(model.nv)]), masses(model, poses)
    turns = [*np.linalg.inv(rates).T, *rng.standard_normal((20, model.nv))]  # one link at a time, and any motion
    for v in turns:
        change, speeds = np.tensordot(v, d, 1), np.abs(rates @ v)
        assert over(change, mass).max() <= by_mass @ speeds + 1e-6
        assert over(change, weight).max() <= by_weight @ speeds + 1e-6
    bound = rate_bound(packed, by_mass, rates=rates)
    for v in rng.standard_normal((20, model.nv)):
        energy = np.sqrt(np.einsum("i,kij,j->k", v, mass, v))
        assert by_mass @ np.abs(rates @ v) <= bound * energy.min() * (1.0 + 1e-9)


def test_rates_of_links_add_up_along_parallel_axes_with_their_signs():
    assert link_rates(nbs.load_robot("two_link")).tolist() == [[1.0, 0.0], [1.0, 1.0]]
    ur5 = link_rates(nbs.load_robot("ur5"))
    assert ur5[3].tolist() == [0.0, 1.0, 1.0, 1.0, 0.0, 0.0]
    assert np.array_equal(link_rates(nbs.load_robot("panda")), np.eye(7))


def test_the_rates_of_links_bound_the_change_of_ur5_at_half_of_what_joints_do():
    """The worst motion that an ascent from random poses finds changes M by 2.3/s for |v|_M = 1; joints give 11.6."""
    robot = nbs.load_robot("ur5")
    relative = inertia_derivatives(robot)
    bound = rate_bound(robot, link_derivatives(robot, relative), rates=link_rates(robot))
    assert 2.0 < bound < 0.6 * rate_bound(robot, relative)


@pytest.mark.parametrize("name", ["two_link", "ur5"])
def test_the_terms_of_any_velocity_are_within_their_bounds(name):
    robot, rng = nbs.load_robot(name), np.random.default_rng(0)
    k = nbs.certify(nbs.NeuralBackstepping.for_robot(robot), np.full(robot.nv, 5.0)).constants
    arm, reference = CoriolisBounds.of(robot, k), nbs.Sinusoid.for_robot(robot)
    motion = arm.motion(SampledMotion.of(reference, robot.nv, 10.0), k.floor, reference.largest_jerk)
    root, slowing = np.linalg.cholesky(k.floor), np.sqrt(np.linalg.eigvalsh(k.floor * k.rate).max())
    norms = Norms(1.0 / np.sqrt(k.kappa), np.sqrt(k.nu), slowing)
    for _ in range(300):
        q, v_d = rng.uniform(-np.pi, np.pi, robot.nv), reference(rng.uniform(0.0, 10.0)).v
        mass = masses(robot.model, q[None])[0]
        size = lambda b: np.sqrt(b @ mass @ b)  # noqa: B023, E731
        # The lightest motions of the pose are the fastest for their energy.
        z2 = np.linalg.eigh(mass)[1] @ (rng.standard_normal(robot.nv) * rng.choice([0.01, 1.0, 10.0], robot.nv))
        f = rng.standard_normal(robot.nv) * rng.choice([0.0, 1.0, 30.0])
        z1_rate = z2 - k.rate * f
        sizes = np.linalg.norm(root.T @ z1_rate), size(z1_rate), size(z2), np.sqrt(f @ (k.rate * f))
        velocity = Velocity(arm, motion, norms, *sizes)
        terms, (gamma, d) = velocity.coriolis(sizes[-1]), christoffel(robot.model, q)
        change = np.tensordot(v_d + z1_rate, d, 1)
        assert over(change[None], mass[None])[0] <= velocity.turn + 1e-6
        assert np.abs(v_d + z1_rate).sum() <= velocity.sum + 1e-9
        of_d, of_m = np.linalg.inv(root).T, np.linalg.inv(np.linalg.cholesky(mass)).T
        c, slow = (np.einsum("ijk,j->ik", gamma, v) for v in (v_d + z1_rate, v_d - k.rate * f))
        norm = lambda left, matrix, right: np.linalg.norm(left.T @ matrix @ right, 2)  # noqa: E731
        assert norm(of_d, c, of_d) <= min(terms.here, terms.by_speed) + 1e-6
        assert norm(of_d, c, of_m) <= terms.by_energy + 1e-6
        assert norm(of_d, slow, of_m) <= terms.slow + 1e-6
        assert norm(of_m, c, of_m) <= terms.form + 1e-6
        elsewhere, _ = christoffel(robot.model, rng.uniform(-np.pi, np.pi, robot.nv))
        assert norm(of_d, np.einsum("ijk,j->ik", elsewhere, v_d + z1_rate), of_d) <= terms.by_speed + 1e-6
