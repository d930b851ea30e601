"""Every law with a storage function: what it claims of V is true, and its certificate is kept."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import nbs_pin as nbs
from nbs_pin.base.claims import Label
from nbs_pin.base.exceptions import CertificateRefused
from nbs_pin.certificates.structure import check_structure
from nbs_pin.controllers.damping import Damping
from nbs_pin.controllers.lyapunov_law import LyapunovLaw
from nbs_pin.controllers.part_claims import CEILING
from nbs_pin.controllers.registry import LAWS, build_law

ROBOT = nbs.load_robot("three_link").with_effort_limit(1e3)
FRICTION = nbs.JointFriction(np.full(3, 0.4), np.full(3, 0.6))
CERTIFIED = [name for name in LAWS if isinstance(build_law(name, ROBOT), LyapunovLaw)]


def states(seed, count=20, size=0.5):
    q, z, v, v_ref, a_ref = np.random.default_rng(seed).normal(size=(5, count, ROBOT.nv))
    return q, v, q - size * z, v_ref, a_ref


def test_the_registry_has_laws_with_and_without_a_storage_function():
    assert {"nbs", "nbs-paper", "slotine-li", "sliding-mode"} == set(CERTIFIED)


@pytest.mark.parametrize("name", CERTIFIED)
@given(seed=st.integers(0, 2**31))
@settings(max_examples=10, deadline=None)
def test_v_falls_as_the_law_says(name, seed):
    """dV/dt along the closed loop, by central differences, is −dissipation, with Λ, D, ω and ζ the law's own."""
    law, (q, v, q_ref, v_ref, a_ref) = build_law(name, ROBOT, seed=seed % 97), states(seed)
    a = nbs.forward_dynamics(law.dynamics, q, v, law.torque(q, v, q_ref, v_ref, a_ref))
    h = 1e-6
    ahead, behind = (
        law.storage(q + s * (v + 0.5 * s * a), v + s * a, q_ref + s * (v_ref + 0.5 * s * a_ref), v_ref + s * a_ref)
        for s in (h, -h)
    )
    lost = law.dissipation(q, v, q_ref, v_ref)
    size = np.abs(lost) + law.storage(q, v, q_ref, v_ref)
    np.testing.assert_allclose((ahead - behind) / (2.0 * h), -lost, atol=1e-5 * size.max())


@pytest.mark.parametrize("name", CERTIFIED)
def test_the_constants_bound_what_they_are_constants_of(name):
    """Φ ≥ zᵀSz, D ⪰ D₀, ∇²Φ dz the derivative of ∇Φ, and v_r = v_d − Λ∇Φ."""
    law = build_law(name, ROBOT, friction=FRICTION)
    v = law.lyapunov()
    z, dz = np.random.default_rng(0).normal(size=(2, 50, ROBOT.nv))
    value, gradient, product = law.potential_terms(z, dz)
    assert (value >= np.einsum("bi,ij,bj->b", z, v.stiffness, z) * (1.0 - 1e-12)).all()
    h = 1e-6
    rate = (law.potential_terms(z + h * dz, dz)[1] - law.potential_terms(z - h * dz, dz)[1]) / (2.0 * h)
    np.testing.assert_allclose(rate, product, atol=1e-4 * np.abs(product).max())
    if name != "nbs-paper":  # whose D = TᵀT has no floor but a measured one
        assert np.linalg.eigvalsh(law.damping_matrix(z) - v.floor).min() > -1e-9
    np.testing.assert_allclose(law.damping_force(z), np.einsum("bij,bj->bi", law.damping_matrix(z), z))
    e = law.errors(z, dz, 0.0 * z, 0.0 * z, 0.0 * z)
    np.testing.assert_allclose(e.v_r, -v.rate * gradient, rtol=1e-12)
    assert any("friction" in claim.name for claim in v.claims)


@pytest.mark.parametrize("name", CERTIFIED)
@pytest.mark.parametrize("radius", [0.01, 0.5, 20.0, np.inf])
def test_the_share_of_the_damping_holds_all_its_values(name, radius):
    """D(z2) ⪯ (1 + n)D₀ while z2ᵀD₀z2 ≤ radius², D₀ of the law's own constants."""
    law = build_law(name, ROBOT)
    n, floor = law.damping_share(radius), law.lyapunov().floor
    z = np.linalg.solve(np.linalg.cholesky(floor).T, np.random.default_rng(0).normal(size=(3, 200))).T
    z *= min(radius, 1e4) * np.random.default_rng(1).uniform(0.0, 1.0, (200, 1)) / np.linalg.norm(z, axis=1)[:, None]
    if name == "nbs-paper":  # whose D has no floor for every weight
        assert n == np.inf
        return
    z[0] = 0.0
    assert np.linalg.eigvalsh(law.damping_matrix(z) - (1.0 + n) * floor).max() <= 1e-12 * (1.0 + n) * floor.max()
    assert n < {"nbs": 1.0 + 1e-6, "slotine-li": 1e-9, "sliding-mode": np.inf}[name]


def test_the_ceiling_is_a_claim_and_a_share_of_trained_gains():
    """As the floor sinks to a share φ of D₀, the ceiling b of the initial D₀ is b/φ of it."""
    law = build_law("nbs", ROBOT)
    claims = {claim.name: claim for claim in law.lyapunov().claims}
    assert claims[CEILING].label is Label.PROVED
    assert claims[CEILING].value == pytest.approx(1.0, rel=1e-6)
    law.damping.floor.change.data.fill_(-50.0)
    claims = {claim.name: claim for claim in law.lyapunov().claims}
    assert claims[CEILING].value == pytest.approx(2.0, rel=1e-6)
    assert law.damping_share(0.1) < law.damping_share(np.inf) < 2.0
    free = nbs.NeuralBackstepping.for_robot(ROBOT, damping_ceiling=None)
    assert CEILING not in {claim.name for claim in free.lyapunov().claims}
    assert free.damping_share(np.inf) > free.damping_share(0.1)
    law.damping.ceiling.fill_(-1.0)
    with pytest.raises(CertificateRefused, match="ceiling of D is -1"):
        law.lyapunov()


class Unlimited(Damping):
    """A damping that forgets its ceiling."""

    def factor(self, x):
        return 10.0 * super().factor(x)


def test_a_damping_that_is_above_its_ceiling_is_refused_and_has_no_share():
    law = build_law("nbs", ROBOT)
    mild = law.damping
    law.damping = Unlimited(3, floor=mild.floor.nominal, scale=mild.scale, ceiling=1.0, seed=1)
    assert law.damping_share(1.0) == np.inf
    with pytest.raises(CertificateRefused, match="which its ceiling states"):
        law.lyapunov()


@pytest.mark.parametrize("friction", [None, FRICTION])
def test_slotine_and_lis_law_is_certified_and_keeps_its_word(friction):
    law = build_law("slotine-li", ROBOT, friction=friction)
    bound = nbs.certify(law, np.full(3, 5.0), friction=friction)
    assert bound.label is Label.PROVED
    worst = nbs.attack(law, np.full(3, 5.0), rounds=3, starts=2)
    assert 0.0 < worst.error <= bound.error <= 4.0 * worst.error
    assert (worst.joint_errors <= bound.joint_errors).all()
    kept = nbs.monitor(worst.run, bound)
    assert kept.is_kept


def test_one_joint_under_slotine_and_lis_law_has_the_exact_worst_case():
    """The loop is (s + λ)(Ms + K)/M: a constant torque is the worst, and errs by τ/(λK)."""
    robot = nbs.load_robot("double_pendulum", lock=["joint2"])
    law = nbs.SlotineLi.for_robot(robot)
    bound = nbs.certify(law, np.full(1, 0.1), friction=nbs.JointFriction(np.zeros(1), np.zeros(1)))
    assert bound.error == pytest.approx(0.1 / float(law.rate[0] * law.gain[0]), rel=1e-6)


@pytest.mark.parametrize("name", sorted(set(LAWS) - set(CERTIFIED)))
def test_a_law_without_a_storage_function_is_refused_in_one_sentence(name):
    said = r"has no Lyapunov function here; give a Neural\w+ or SlotineLi|call transient_bound for it"
    with pytest.raises(CertificateRefused, match=said):
        nbs.certify(build_law(name, ROBOT), 1.0)


class Weaker(nbs.SlotineLi):
    """Claims all of K and feeds half of it back."""

    def torque(self, q, v, q_ref, v_ref, a_ref):
        e = self.errors(q, v, q_ref, v_ref, a_ref)
        return super().torque(q, v, q_ref, v_ref, a_ref) + 0.5 * self.gain * e.z2


class Stronger(nbs.SlotineLi):
    """Feeds more back than it claims, which only samples can tell."""

    def torque(self, q, v, q_ref, v_ref, a_ref):
        e = self.errors(q, v, q_ref, v_ref, a_ref)
        return super().torque(q, v, q_ref, v_ref, a_ref) - 0.5 * self.gain * e.z2


def test_what_a_subclass_claims_is_held_against_its_torque():
    with pytest.raises(CertificateRefused, match="V falls more slowly"):
        check_structure(Weaker.for_robot(ROBOT))
    labels = {claim.label for claim in check_structure(Stronger.for_robot(ROBOT)).claims}
    assert labels == {Label.PROVED, Label.EMPIRICAL}


def test_gains_edited_after_the_law_was_made_are_read_as_they_stand():
    law = build_law("slotine-li", ROBOT)
    law.gains.named("gain").nominal[1] = -1.0
    with pytest.raises(CertificateRefused, match="K has the eigenvalue -1"):
        nbs.certify(law, 1.0)
