"""The bound of the loop with held torques: its inequality over single holds, adversaries, what it does not cover."""

import math
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import nbs_pin as nbs
from nbs_pin.base.claims import Label
from nbs_pin.base.records import Reference
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.coriolis import CoriolisBounds
from nbs_pin.certificates.hold import hold_of, rows_in_g
from nbs_pin.certificates.sampled_law import Curvature, Fed, SampledLaw
from nbs_pin.certificates.sampled_loop import _ENLARGED, _add_fed, _excess, _Form, _limit, kept_level
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.controllers.gains import Gains, effective_inertia

SUBSTEPS = 30


LAWS = {
    "nbs": lambda robot, w, **more: nbs.NeuralBackstepping.for_robot(robot, bandwidth=w, seed=3, **more),
    "bounded": lambda robot, _, **more: nbs.NeuralBackstepping.for_robot(robot, damping="bounded", seed=3, **more),
    "slotine-li": lambda robot, w, **more: nbs.SlotineLi.for_robot(robot, bandwidth=w, **more),
}


def loop_of(name, h, lead, *, bandwidth=8.0, torque=5.0, viscous=0.0, coulomb=0.0, fed=0.0, law="nbs"):
    """A sampled loop, its certificate in continuous time and the law, for an arm with friction, a share of it fed."""
    robot = nbs.load_robot(name)
    reference, friction = nbs.Sinusoid.for_robot(robot), nbs.JointFriction.of(robot)
    if viscous or coulomb:
        friction = nbs.JointFriction(np.full(robot.nv, viscous), np.full(robot.nv, coulomb))
    feed = nbs.JointFriction(fed * friction.viscous, fed * friction.coulomb) if fed else None
    law = LAWS[law](robot, bandwidth, friction=feed)
    given = {"reference": reference, "friction": friction}
    certificate = nbs.certify(law, np.full(robot.nv, torque), **given)
    constants = certificate.constants
    arm = CoriolisBounds.of(robot, constants)
    motion = arm.motion(SampledMotion.of(reference, robot.nv, 10.0), constants.floor, reference.largest_jerk)
    comparison, gap = certificate.comparison, certificate.friction.gap
    numbers = comparison.t, comparison.alpha, gap.arm.viscous
    more = {"fed": Fed.of(feed, constants, comparison.power), "unfed": np.abs(gap.viscous)}
    return SampledLaw(law, constants, arm, motion, *numbers, h, lead, **more), certificate, reference


class OneHold:
    """A hold that begins at a random state of the level, integrated in small steps under a disturbance that jumps."""

    def __init__(self, loop, reference, level, torque, rng, rubbing, slow=0.0):
        law, k, n, h = loop.law, loop.constants, loop.law.nv, loop.h
        self.rubbing = rubbing
        t = float(rng.uniform(0.0, 8.0))
        if slow:  # where friction changes its sign: a joint and its reference turn round
            turns = np.linspace(0.0, 8.0, 8001)
            t = float(turns[np.abs(reference(turns).v).min(axis=1).argmin()] + slow * rng.standard_normal())
        now, held = (Reference(*(x[0] for x in reference(np.array([s])))) for s in (t, t + loop.lead))
        share = rng.uniform()
        z1 = np.linalg.solve(np.linalg.cholesky(k.stiffness).T, rng.standard_normal(n))
        while law.potential_terms(z1, z1)[0] > share * level:
            z1 = 0.95 * z1
        z1 = min(slow, 1.0) * z1 if slow else z1
        rest = level - float(law.potential_terms(z1, z1)[0])
        q = now.q + z1
        moving = law.dynamics.mass_matrix(q) - 0.5 * h * (k.floor - np.diag(loop.friction))
        direction = rng.standard_normal(n)
        direction *= math.sqrt(2.0 * rest) / np.linalg.norm(direction)
        z2 = np.linalg.solve(np.linalg.cholesky(moving).T, direction)
        v = z2 + law.errors(q, 0.0 * q, now.q, now.v, now.a).v_r
        if slow:
            v_r = v - z2
            v = np.where(np.abs(v_r) < 0.1, 0.0, v_r) + 10.0 ** rng.uniform(-5.0, -1.0) * rng.standard_normal(n)
        seen = q + loop.lead * v + 0.5 * loop.lead**2 * now.a, v + loop.lead * now.a
        self.tau, self.seen = law.torque(*seen, *held), law.errors(*seen, *held)
        jumps = np.sign(rng.standard_normal((SUBSTEPS, n)))
        if rng.uniform() < 0.5:
            jumps = jumps[0] * np.sign(np.arange(SUBSTEPS) - rng.uniform(0, SUBSTEPS))[:, None]
        self.push, self.loop = torque * np.vstack([jumps, jumps[-1:]]), loop
        states = [(q, v)]
        for push in self.push[:-1]:
            states.append(self._step(*states[-1], push, h / SUBSTEPS))
        self.q, self.v = (np.array(x) for x in zip(*states, strict=True))
        self.desired = reference(t + h / SUBSTEPS * np.arange(SUBSTEPS + 1))
        self.errors = law.errors(self.q, self.v, *self.desired)
        self.mass = law.dynamics.mass_matrix(self.q)

    def acceleration(self, q, v, push):
        return self.loop.law.dynamics.forward_dynamics(q, v, self.tau + push - self.rubbing.torque(v))

    def _step(self, q, v, push, h):
        a = self.acceleration(q, v, push)
        middle = v + 0.5 * h * a
        b = self.acceleration(q + 0.5 * h * v, middle, push)
        later = v + 0.5 * h * b
        c = self.acceleration(q + 0.5 * h * middle, later, push)
        last = v + h * c
        d = self.acceleration(q + h * later, last, push)
        return q + h / 6.0 * (v + 2.0 * middle + 2.0 * later + last), v + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)

    def mean(self, x):
        """Mean over the hold by the trapezoid rule."""
        return (x.sum(axis=0) - 0.5 * (x[0] + x[-1])) / SUBSTEPS

    def suprema(self):
        k, e = self.loop.constants, self.errors
        speed = lambda x: np.sqrt(np.einsum("ki,ij,kj->k", x, k.floor, x)).max()  # noqa: E731
        torque = lambda x: np.sqrt(np.einsum("ki,ij,kj->k", x, np.linalg.inv(k.floor), x)).max()  # noqa: E731
        energy = lambda x: np.sqrt(np.einsum("ki,kij,kj->k", x, self.mass, x)).max()  # noqa: E731
        rate = self.v - self.desired.v
        a = np.array([self.acceleration(*x) for x in zip(self.q, self.v, self.push, strict=True)])
        force = np.einsum("kij,kj->ki", self.mass, a - e.a_r)
        loss = np.sqrt((e.gradient**2 * k.rate).sum(axis=1)).max()
        found = torque(e.gradient), loss, speed(e.z2), energy(e.z2), speed(rate), energy(rate), torque(force)
        return np.array([*found, speed(a - e.a_r), energy(a - e.a_r)])

    def g(self):
        k, e = self.loop.constants, self.errors
        y = 0.5 * (e.z2[0] + e.z2[-1])
        lost = self.mean((e.gradient**2 * k.rate).sum(axis=1))
        law = self.loop.law
        extra = law.damping_force(self.seen.z2) - (k.floor - np.diag(self.loop.friction)) @ self.seen.z2
        squares = lost, y @ k.floor @ y, k.omega * y @ self.mean(self.mass) @ y, self.seen.z2 @ extra, 1.0
        return np.sqrt(np.maximum(squares, 0.0)), y

    def storage(self, i):
        z2, own = self.errors.z2[i], self.loop.constants.floor - np.diag(self.loop.friction)
        return float(self.errors.value[i] + 0.5 * z2 @ (self.mass[i] - 0.5 * self.loop.h * own) @ z2)


@pytest.mark.parametrize(
    ("name", "h", "share", "settings"),
    [
        ("two_link", 1e-3, 0.5, {}),
        ("two_link", 1e-3, 0.0, {"bandwidth": 20.0}),
        ("two_link", 5e-4, 0.5, {"viscous": 0.3}),
        ("ur5", 2.5e-4, 0.5, {}),
        ("ur5", 5e-4, 0.5, {"torque": 1.0}),
        ("two_link", 3e-4, 0.5, {"law": "slotine-li"}),
        ("two_link", 3e-4, 1.0, {"law": "bounded"}),
        ("two_link", 1e-3, 0.5, {"viscous": 0.3, "coulomb": 2.0, "fed": 1.0}),
        ("two_link", 5e-4, 0.0, {"viscous": 0.5, "coulomb": 1.0, "fed": 0.6}),
        ("two_link", 3e-4, 0.5, {"viscous": 0.2, "coulomb": 1.0, "fed": 1.5, "law": "slotine-li"}),
        ("ur5", 2.5e-4, 0.5, {"viscous": 0.5, "coulomb": 0.5, "fed": 1.0}),
    ],
)
def test_every_quantity_of_a_hold_and_the_change_of_storage_are_within_their_bounds(name, h, share, settings):
    """The inequality of docs/certificates.md §13, term by term, on holds from random states of the level."""
    loop, certificate, reference = loop_of(name, h, share * h, **settings)
    level = kept_level(loop, certificate.storage).level
    assert level < 3.0 * certificate.storage
    hold = next(x for x in (hold_of(loop, level, more * level) for more in _ENLARGED) if x is not None)
    rows = rows_in_g(hold)
    excess, spread, ends = _excess(hold, rows)
    rng, torque = np.random.default_rng(0), settings.get("torque", 5.0)
    for _ in range(40):
        one = OneHold(loop, reference, level, torque, rng, certificate.friction.gap.arm)
        (g, y), suprema = one.g(), one.suprema()
        assert (suprema <= np.array(rows) @ g * (1.0 + 1e-6)).all()
        assert (suprema <= np.array([float(x) for x in hold.sups])).all()
        change = (one.storage(-1) - one.storage(0)) / h
        allowed = -g[:4] @ g[:4] + loop.t * math.hypot(g[1], spread @ g) + g @ excess @ g
        assert change <= allowed + 1e-9
        mean = one.mean(one.errors.value) + 0.5 * y @ one.mean(one.mass) @ y
        assert 0.5 * (one.storage(0) + one.storage(-1)) - mean <= g @ ends @ g + 1e-9
        assert one.storage(-1) <= level


@pytest.mark.parametrize(("h", "share"), [(1e-3, 0.5), (1e-3, 0.0), (3e-4, 1.0)])
def test_friction_that_is_held_while_the_joint_turns_round_supplies_no_more_than_is_counted(h, share):
    """ȳᵀ⟨f̂(φ̂) − f(v) + b z2⟩ of an arm whose friction changes its sign faster than what is fed forward."""
    settings = {"viscous": 0.3, "coulomb": 2.0, "fed": 1.0, "torque": 0.3}
    loop, certificate, reference = loop_of("two_link", h, share * h, **settings)
    level = kept_level(loop, certificate.storage).level
    hold = next(x for e in _ENLARGED if (x := hold_of(loop, level, e * level)) is not None)
    rows, counted = rows_in_g(hold), _Form()
    _add_fed(hold, rows, np.zeros(5), counted)
    rng, nearest = np.random.default_rng(1), 0.0
    friction = replace(certificate.friction.gap.arm, transition=1e-3)
    for k in range(400):
        one = OneHold(loop, reference, level, 0.3, rng, friction, slow=10.0 ** rng.uniform(-4.0, -1.0))
        if one.storage(0) > level:
            continue
        g, y = one.g()
        forces = loop.law.friction.torque(one.seen.v_r) - friction.torque(one.v) + friction.viscous * one.errors.z2
        supplied = y @ one.mean(forces)
        allowed = g @ counted.matrix @ g
        assert supplied <= allowed, k
        nearest = max(nearest, supplied / allowed)
    assert nearest > 0.02


def test_the_worst_motions_of_a_held_loop_stay_below_its_bound():
    robot, box = nbs.load_robot("two_link"), np.full(2, 5.0)
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    for period in (0.001, 0.0005):
        certificate = nbs.certify(law, box, reference=reference, period=period)
        found = nbs.attack(law, box, reference=reference, period=period, duration=1.0, rounds=3)
        assert certificate.held.is_proved
        assert certificate.label is Label.PROVED
        assert found.error <= certificate.error <= 1.6 * found.error
        assert (found.joint_errors <= certificate.joint_errors).all()


def test_friction_that_is_fed_forward_is_part_of_the_proof_and_costs_less_than_if_it_were_not():
    robot, box = nbs.load_robot("two_link"), np.full(2, 2.0)
    reference, friction = nbs.Sinusoid.for_robot(robot), nbs.JointFriction(np.full(2, 0.3), np.full(2, 3.0))
    given = {"reference": reference, "period": 5e-4}
    law = nbs.NeuralBackstepping.for_robot(robot, friction=friction)
    certificate = nbs.certify(law, box, friction=friction, **given)
    assert certificate.held.is_proved
    assert certificate.label is Label.PROVED
    found = nbs.attack(law, box, duration=1.0, rounds=3, **given)
    assert found.error <= certificate.error <= 2.5 * found.error
    without = nbs.certify(nbs.NeuralBackstepping.for_robot(robot), box, friction=friction, **given)
    assert without.held.is_proved
    assert certificate.error < 0.75 * without.error


@pytest.mark.parametrize("law", LAWS)
def test_the_shorter_the_period_the_nearer_is_the_bound_of_continuous_time(law):
    loop, certificate, _ = loop_of("two_link", 1e-3, 5e-4, law=law)
    levels = [kept_level(replace(loop, h=h, lead=0.5 * h), certificate.storage).level for h in (1e-3, 3e-4, 1e-4, 1e-6)]
    assert levels == sorted(levels, reverse=True)
    assert certificate.storage <= levels[-1] <= 1.01 * certificate.storage
    hold = hold_of(replace(loop, h=1e-6, lead=0.0), 1.02 * certificate.storage, 1.2 * certificate.storage)
    assert _limit(hold) >= 0.999 * certificate.storage  # nothing is lost on the way, with and without ω


def test_continuous_time_is_checked_where_the_held_torque_is_proved_and_in_part_where_not():
    robot = nbs.load_robot("ur5")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    for period, checked in ((2e-4, "checked"), (1e-3, "checked in part")):
        certificate = nbs.certify(law, np.full(6, 5.0), reference=reference, period=period)
        assert dict(certificate.assumptions)[Assumption.TIME] == checked
    held = certificate.held
    assert 1e-4 < held.longest < 1e-3
    assert "nothing is proved at 1 ms" in held.line.because
    again = nbs.certify(law, np.full(6, 5.0), reference=reference, period=0.99 * held.longest)
    assert again.held.is_proved
    assert again.error > certificate.error


@pytest.mark.parametrize("torque", [0.0, 1e-3])
def test_what_a_hold_alone_does_to_a_reference_is_bounded(torque):
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    certificate = nbs.certify(law, np.full(2, torque), reference=reference, period=1e-3)
    assert certificate.held.is_proved
    assert certificate.label is Label.PROVED
    assert 0.0 < certificate.error < 1e-4
    run = nbs.simulate(nbs.DynamicsPlant.for_robot(robot), law, reference, 1.0, 1e-3)
    assert 0.0 < np.linalg.norm(run.q - run.q_ref, axis=-1).max() <= certificate.error


def with_damping(robot, rate):
    """A law with D₀ of that many effective inertias a second, K = 10 D₀/s and a weak network in Φ."""
    inertia = effective_inertia(robot, nbs.PinocchioDynamics(robot))
    gains = Gains(6.0, 10.0 * rate * inertia, rate * inertia)
    law = nbs.NeuralBackstepping.for_robot(robot, gains=gains, damping_ceiling=0.05)
    for weights in law.potential.network.parameters():
        weights.data *= 0.3
    return law


def test_the_rotors_of_an_arm_of_seven_joints_are_what_a_proof_at_1_khz_needs():
    bare = nbs.load_robot("panda")
    robot = bare.with_armature(nbs.load_robot("fr3").armature)
    reference, box = nbs.Sinusoid.for_robot(robot), np.full(7, 5.0)
    given = {"reference": reference, "period": 1e-3, "duration": 1.0}
    law = with_damping(robot, 200.0)
    certificate = nbs.certify(law, box, **given)
    assert certificate.label is Label.PROVED
    assert certificate.held.is_proved
    assert certificate.unproved_hold == ""
    found = nbs.attack(law, box, rounds=3, **given)
    assert found.error <= certificate.error <= 2.0 * found.error
    without = nbs.certify(nbs.NeuralBackstepping.for_robot(bare), box, **given)
    assert not without.held.is_proved
    assert "panda states no rotor inertia: if its motors have any, armature=… may allow more" in without.unproved_hold


@pytest.mark.parametrize(("torque", "factor"), [(1.0, 1.3), (2.0, 1.42)])
def test_gains_that_suit_a_period_have_a_proof_at_it(torque, factor):
    """ur5 at 1 kHz: less damping per inertia than a proof for larger disturbances needs, and a weak network in Φ."""
    robot = nbs.load_robot("ur5")
    law, box = with_damping(robot, 100.0), np.full(6, torque)
    certificate = nbs.certify(law, box, reference=nbs.Sinusoid.for_robot(robot), period=1e-3)
    assert certificate.held.is_proved
    assert certificate.error <= factor * nbs.certify(law, box).error


def test_a_start_far_away_is_in_the_level_that_is_proved_or_nothing_is():
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    given = {"reference": reference, "period": 0.001}
    begin = reference(np.zeros(1)).q[0]
    near = nbs.certify(law, np.full(2, 5.0), q0=begin + 0.01, v0=reference(np.zeros(1)).v[0], **given)
    assert near.held.is_proved
    assert near.overshoot[0] >= near.error
    far = nbs.certify(law, np.full(2, 5.0), q0=begin + 1.5, **given)
    assert not far.held.is_proved


def test_the_hessian_is_bounded_on_the_whole_ellipsoid_of_a_coupled_stiffness():
    """Where S is not diagonal, Σ (z_i/radii_i)² ≤ 1 must contain z1ᵀSz1 ≤ Φ."""
    loop, certificate, _ = loop_of("two_link", 1e-3, 5e-4)
    stiffness = loop.constants.stiffness.copy()
    stiffness[0, 1] = stiffness[1, 0] = 0.9 * np.sqrt(stiffness[0, 0] * stiffness[1, 1])
    coupled = replace(loop, constants=replace(loop.constants, stiffness=stiffness))
    radii = []
    watched = replace(coupled, law=_Radii(loop.law, radii))
    Curvature.of(watched, certificate.storage)
    z1 = np.random.default_rng(0).standard_normal((2000, 2)) @ np.linalg.inv(np.linalg.cholesky(stiffness))
    z1 *= np.sqrt(certificate.storage / np.einsum("ki,ij,kj->k", z1, stiffness, z1))[:, None]
    assert (((z1 / radii[0]) ** 2).sum(axis=1) <= 1.0 + 1e-9).all()


class _Radii:
    """A law that notes the radii it is asked about."""

    def __init__(self, law, radii):
        self.law, self.radii = law, radii

    def stiffness_range(self, radii):
        self.radii.append(radii)
        return self.law.stiffness_range(radii)

    def stiffness_rate(self, radii, weights):
        return self.law.stiffness_rate(radii, weights)


def test_a_reference_without_a_bound_of_its_jerk_is_not_covered():
    """The acceleration may jump between two samples, by which nothing would tell."""
    robot = nbs.load_robot("two_link")
    law, smooth = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    held = nbs.certify(law, np.full(2, 5.0), reference=lambda t: smooth(t), period=1e-3).held
    assert not held.is_proved
    assert "largest_jerk" in held.line.because
    short = nbs.MinimumJerk([smooth(0.0).q, smooth(0.0).q + 0.1], [0.0, 1.0])
    assert nbs.certify(law, np.full(2, 5.0), reference=short, period=1e-3).held.is_proved
    longer = nbs.certify(law, np.full(2, 5.0), reference=short, duration=2.0, period=1e-3).held
    assert "largest_jerk" in longer.why_not


@pytest.mark.parametrize("lookahead", [-0.003, np.nan, np.inf, 0.002])
def test_a_look_ahead_out_of_range_is_refused(lookahead):
    robot = nbs.load_robot("two_link")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    with pytest.raises(nbs.ArgumentError, match="lookahead is"):
        nbs.certify(law, np.full(2, 5.0), reference=reference, period=0.001, lookahead=lookahead)


def test_what_the_proof_does_not_cover_is_said():
    robot = nbs.load_robot("two_link")
    reference, box = nbs.Sinusoid.for_robot(robot), np.full(2, 5.0)
    plain = nbs.NeuralBackstepping.for_robot(robot)
    assert "give the reference" in nbs.certify(plain, box, period=1e-3).held.line.because
    rough = nbs.NeuralBackstepping.for_robot(robot, potential="paper")
    assert not nbs.certify(rough, box, reference=reference, period=1e-3).held.is_proved


@pytest.mark.parametrize("seed", range(3))
def test_the_hessian_of_the_potential_changes_no_faster_than_its_bound(seed):
    robot = nbs.load_robot("ur5")
    law = nbs.NeuralBackstepping.for_robot(robot, seed=seed)
    rng, weights = np.random.default_rng(seed), np.diag(law.damping.floor.numpy())
    radii = rng.uniform(0.05, 0.3, 6)
    bound = law.stiffness_rate(radii, weights)
    z = rng.standard_normal((400, 2, 6))
    z *= radii * rng.uniform(0.0, 1.0, (400, 2, 1)) / np.linalg.norm(z, axis=-1, keepdims=True)
    z[:, 1] = z[:, 0] + 0.03 * (z[:, 1] - z[:, 0])
    hessian = law.potential_terms(np.repeat(z[:, :, None], 6, axis=2), np.broadcast_to(np.eye(6), (400, 2, 6, 6)))[2]
    change = (hessian[:, 0] - hessian[:, 1]) / np.sqrt(weights) / np.sqrt(weights)[:, None]
    distance = np.sqrt((weights * (z[:, 0] - z[:, 1]) ** 2).sum(axis=1))
    assert (np.abs(np.linalg.eigvalsh(0.5 * (change + change.swapaxes(1, 2)))).max(axis=1) <= bound * distance).all()


def states_of(law, certificate, level, now):
    """Random states with V at most the level, half of them with all that z1 leaves in the lightest motion."""
    rng, k, n = np.random.default_rng(0), certificate.constants, law.nv
    z1 = rng.standard_normal((2000, n)) @ np.linalg.inv(np.linalg.cholesky(k.stiffness))
    z1 *= (
        np.sqrt(rng.uniform(0.0, level, (2000, 1)))
        / np.linalg.norm(z1 @ np.linalg.cholesky(k.stiffness), axis=1)[:, None]
    )
    kept = np.maximum(level - law.potential_terms(z1, z1)[0], 0.0)
    q, mass = now.q + z1, law.dynamics.mass_matrix(now.q + z1)
    direction = rng.standard_normal((2000, n))
    direction[::2] = np.linalg.eigh(mass)[1][::2, :, 0]  # the lightest motion is the fastest
    energy = np.einsum("ki,kij,kj->k", direction, mass, direction)
    z2 = direction * np.sqrt(2.0 * kept / energy)[:, None]
    return q, z2 + law.errors(q, 0.0 * q, *now).v_r


@pytest.mark.parametrize(
    ("name", "torque", "sticky"),
    [("two_link", 5.0, 0.0), ("ur5", 2.0, 0.0), ("panda", 0.25, 0.0), ("two_link", 2.0, 1.0), ("ur5", 1.0, 0.3)],
)
def test_no_state_of_the_bounds_asks_for_more_torque_than_is_proved(name, torque, sticky):
    robot = nbs.load_robot(name)
    friction = nbs.JointFriction(np.full(robot.nv, 0.4 * sticky), np.full(robot.nv, sticky), transition=0.1)
    law = nbs.NeuralBackstepping.for_robot(robot, seed=1, friction=friction if sticky else None)
    reference = nbs.Sinusoid.for_robot(robot)
    certificate = nbs.certify(law, np.full(robot.nv, torque), reference=reference, period=2.5e-4)
    assert dict(certificate.assumptions)[Assumption.EFFORT] == "checked"
    now = Reference(*reference(np.random.default_rng(0).uniform(0.0, 10.0, 2000)))
    level = certificate.held.level if certificate.held.is_proved else certificate.storage
    q, v = states_of(law, certificate, level, now)
    asked = np.abs(law.torque(q, v, *now))
    wanted = law.dynamics.reference_torque(now.q, now.v, now.v, now.a)
    wanted = wanted + law.friction.torque(now.v) if sticky else wanted
    assert (asked - np.abs(wanted) <= certificate.held.room).all()
    assert (asked <= robot.effort_limit).all()


def test_a_torque_that_may_be_cut_off_is_named_with_its_joint():
    robot = nbs.load_robot("ur5")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    certificate = nbs.certify(law, np.full(6, 5.0), reference=reference, period=2.5e-4)
    assert dict(certificate.assumptions)[Assumption.EFFORT] == "checked in part"
    (named,) = (x for x in certificate.conditions if "largest torque of the law" in x.name)
    assert "wrist" in named.name
    assert named.right > named.left == 28.0
    assert not named.voids


def test_another_body_is_another_arm_for_what_is_kept():
    """Bounds are kept by the numbers of the model: an arm edited in place must not get those of its URDF."""
    robot = nbs.load_robot("two_link")
    constants = nbs.certify(nbs.NeuralBackstepping.for_robot(robot), np.full(2, 5.0)).constants
    before = CoriolisBounds.of(robot, constants)
    heavy = nbs.load_robot("two_link")
    heavy.model.inertias[2] = pin.Inertia(3.0 * heavy.model.inertias[2].mass, *_rest(heavy.model.inertias[2]))
    after = CoriolisBounds.of(heavy, constants)
    assert after.diagonal[0] > 1.5 * before.diagonal[0]
    assert CoriolisBounds.of(robot, constants) is before


def _rest(body):
    return body.lever, body.inertia


def test_a_jerk_that_is_none_is_refused():
    robot = nbs.load_robot("two_link")
    law, motion = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    for stated in (np.zeros(3), np.array([-1.0, 1.0]), np.array([np.nan, 1.0])):
        with pytest.raises(nbs.ArgumentError, match="largest_jerk"):
            nbs.certify(law, np.full(2, 5.0), reference=_Stating(motion, stated), period=1e-3)


class _Stating:
    """A motion that states a bound of its jerk."""

    def __init__(self, motion, jerk):
        self.motion, self.largest_jerk = motion, jerk

    def __call__(self, t):
        return self.motion(t)


@pytest.mark.parametrize(("name", "sticky"), [("two_link", 0.0), ("ur5", 0.0), ("ur5", 2.0)])
def test_no_state_of_the_bounds_is_further_from_a_reference_than_the_margins(name, sticky):
    """For any reference within the stated speeds, whatever its pose."""
    robot = nbs.load_robot(name)
    friction = nbs.JointFriction(np.full(robot.nv, sticky), np.full(robot.nv, sticky), transition=0.1)
    law = nbs.NeuralBackstepping.for_robot(robot, seed=1, friction=friction if sticky else None)
    certificate = nbs.certify(law, np.full(robot.nv, 1.0))
    margins = nbs.certified_margins(certificate, acceleration=2.0, velocity=1.0)
    rng = np.random.default_rng(1)
    corner = np.sign(rng.uniform(-1.0, 1.0, (2, 2000, robot.nv)))
    now = Reference(rng.uniform(-2.0, 2.0, (2000, robot.nv)), corner[0], 2.0 * corner[1])
    q, v = states_of(law, certificate, certificate.storage, now)
    speed = np.abs(v - now.v).max(axis=0)
    torque = np.abs(law.torque(q, v, *now) - law.dynamics.reference_torque(now.q, now.v, now.v, now.a)).max(axis=0)
    assert (speed <= margins.velocity).all()
    assert (torque <= margins.effort).all()
    assert (speed >= 0.2 * margins.velocity).any()
    assert (torque >= 0.1 * margins.effort).any()
    np.testing.assert_array_equal(margins.position, certificate.joint_errors)
    faster = nbs.certified_margins(certificate, acceleration=8.0, velocity=2.0)
    assert (faster.effort > margins.effort).all()
    np.testing.assert_array_equal(faster.velocity, margins.velocity)


def test_margins_are_refused_where_the_bounds_are_not_those_of_every_reference():
    robot = nbs.load_robot("two_link")
    law, still, box = nbs.NeuralBackstepping.for_robot(robot), nbs.Hold([0.0, 0.0]), np.full(2, 1.0)
    sticky = nbs.JointFriction(viscous=[3.0, 3.0], coulomb=[0.0, 0.0])
    slow = nbs.certify(law, box, friction=sticky, reference=still)
    heavier = nbs.certify(law, box, robot=robot.with_payload("tip", 3.0))
    for certificate, said in (
        (slow, "viscous friction of joint 'joint1' for a slower reference"),
        (nbs.certify(law, box, reference=still, period=2.5e-4), "with held torques are those of one reference"),
        (heavier, "the model differs from the arm"),
        (nbs.certify(law, np.zeros(2)), "allows no disturbance"),
    ):
        with pytest.raises(nbs.ArgumentError, match=said):
            nbs.certified_margins(certificate, acceleration=2.0, velocity=2.0)
    fast = nbs.certify(law, box, friction=sticky)
    margins = nbs.certified_margins(fast, acceleration=2.0, velocity=2.0)
    plain = nbs.certified_margins(nbs.certify(law, box), acceleration=2.0, velocity=2.0)
    assert (margins.effort > plain.effort).all()


def test_a_path_with_certified_margins_leaves_the_arm_within_its_limits():
    """A tool path in the least time, followed under torques at the edge of the box: no limit is reached."""
    robot = nbs.load_robot("two_link").with_effort_limit([60.0, 40.0])
    law, box = nbs.NeuralBackstepping.for_robot(robot, bandwidth=15.0), np.array([1.0, 1.0])
    margins = nbs.certified_margins(nbs.certify(law, box), acceleration=3.0, velocity=1.5)
    posture = nbs.tool_posture(robot, "tip")
    path = nbs.ToolPath.circle(robot.pose(posture, "tip")[:3, 3], 0.3, "xz")
    options = {"posture": posture, "fastest": True, "acceleration": 3.0}
    with pytest.raises(nbs.ArgumentError, match="are left for the motion"):
        nbs.tool_motion(robot.with_effort_limit(30.0), path, "tip", margins=margins, **options)
    motion = nbs.tool_motion(robot, path, "tip", margins=margins, **options)
    sampled = motion(np.linspace(0.0, motion.duration, 2001))
    assert np.abs(sampled.v).max() <= 1.5
    plant, steps = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot)), np.ceil(motion.duration / 2.5e-4)
    for push in (box, -box):
        wave = nbs.SquareWave(push, frequency=9.0)
        run = nbs.simulate(plant, law, motion, steps * 2.5e-4, 2.5e-4, disturbance=wave)
        assert not nbs.metrics.saturated_fraction(run).any()
        assert (np.abs(run.v) <= robot.velocity_limit).all()
        assert (np.abs(run.v - run.v_ref) <= margins.velocity).all()
        assert (np.abs(run.q - run.q_ref) <= margins.position).all()
