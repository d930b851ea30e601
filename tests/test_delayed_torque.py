"""Torques that act late, on differences of encoder readings: the inequality over holds, adversaries, refusals."""

import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.claims import Label
from nbs_pin.base.records import Reference
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.coriolis import CoriolisBounds
from nbs_pin.certificates.hold import hold_of, rows_in_g
from nbs_pin.certificates.sampled_law import Fed, SampledLaw
from nbs_pin.certificates.sampled_loop import _ENLARGED, _excess, kept_level
from nbs_pin.certificates.sampled_motion import SampledMotion
from nbs_pin.certificates.sampling import Timing
from nbs_pin.controllers.gains import Gains, effective_inertia

SUBSTEPS = 24
H, STEP = 1e-3, 2.0 * math.pi * 2.0**-16
READINGS = {
    "late": (1.0, False),
    "half late": (0.5, False),
    "differences": (0.0, True),
    "late differences": (1.0, True),
    "half late differences": (0.5, True),
}


@cache
def law_of(name, feed=None):
    """Gains that suit readings of 16 bits at 1 kHz: little damping per inertia."""
    robot = nbs.load_robot(name)
    inertia = effective_inertia(robot, nbs.PinocchioDynamics(robot))
    gains = Gains(4.0, 160.0 * inertia, 20.0 * inertia)
    law = nbs.NeuralBackstepping.for_robot(robot, gains=gains, seed=3, friction=feed)
    return law, nbs.Sinusoid.for_robot(robot, 1.0)


def loop_of(name, readings, bits=16, torque=5.0, feed=None):
    share, differenced = READINGS[readings]
    law, reference = law_of(name, feed)
    certificate = nbs.certify(law, np.full(law.nv, torque), reference=reference, friction=feed)
    constants, n = certificate.constants, law.nv
    arm = CoriolisBounds.of(law.dynamics.robot, constants)
    motion = arm.motion(SampledMotion.of(reference, n, 10.0), constants.floor, reference.largest_jerk)
    numbers = certificate.comparison.t, certificate.comparison.alpha, certificate.friction.gap.arm.viscous
    steps = np.full(n, 2.0 * math.pi * 2.0**-bits) if differenced else None
    read, fed = (H, (0.5 + share) * H, share * H, steps), Fed.of(feed, constants, certificate.comparison.power)
    unfed = np.abs(certificate.friction.gap.viscous)
    return SampledLaw(law, constants, arm, motion, *numbers, *read, fed, unfed), certificate, reference


def weights(timing, j, age):
    """K_j: the share of what is read that is older than `age` into the hold j before the present one."""
    age = age + (j - 1) * timing.period
    if timing.differenced:
        return np.clip(1.0 - (age - timing.delay) / timing.period, 0.0, 1.0)
    return np.where(age < timing.delay, 1.0, 0.0)


class Motion:
    """A motion of many joints' worth of holds from the reference, under torques that jump within the holds."""

    def __init__(self, loop, reference, torque, rng, holds, rubbing=None):
        self.loop, self.reference, self.begin = loop, reference, float(rng.uniform(0.0, 5.0))
        self.dt, n = loop.h / SUBSTEPS, loop.law.nv
        self.shift, self.rubbing = rng.uniform(0.0, 1.0, n), rubbing or nbs.JointFriction(loop.friction, np.zeros(n))
        self.past = 3 * SUBSTEPS
        before = reference(self.begin + self.dt * np.arange(-self.past, 1))
        self.q, self.v = [*before.q], [*before.v]
        self.seen, self.errors_of_readings, self.push = [], [], []
        wave = np.sign(rng.standard_normal((holds // 8 + 2, n)))
        for k in range(holds):
            self.hold(k, wave[k // 8] if rng.uniform() < 0.8 else np.sign(rng.standard_normal(n)), torque, rng)
        self.q, self.v = np.array(self.q), np.array(self.v)
        self.errors = loop.law.errors(self.q, self.v, *self.at(np.arange(-self.past, holds * SUBSTEPS + 1)))
        self.mass = loop.law.dynamics.mass_matrix(self.q)

    def at(self, substep):
        return self.reference(self.begin + self.dt * np.atleast_1d(substep))

    def read(self, row):
        """The position as read, and its error."""
        if self.loop.step is None:
            return self.q[row], 0.0 * self.q[row]
        with np.errstate(divide="ignore", invalid="ignore"):
            read = (np.round(self.q[row] / self.loop.step - self.shift) + self.shift) * self.loop.step
        read = np.where(self.loop.step > 0.0, read, self.q[row])
        return read, read - self.q[row]

    def hold(self, k, sign, torque, rng):
        loop, law = self.loop, self.loop.law
        sample = k * SUBSTEPS - round(loop.delay / self.dt)
        row = self.past + sample
        (q, error), v = self.read(row), self.v[row]
        if loop.step is not None:
            v = (q - self.read(row - SUBSTEPS)[0]) / loop.h
        now = Reference(*(x[0] for x in self.at(sample)))
        aim = Reference(*(x[0] for x in self.reference(np.array([self.begin + self.dt * sample + loop.lead]))))
        seen = q + loop.lead * v + 0.5 * loop.lead**2 * now.a, v + loop.lead * now.a
        tau, jump = law.torque(*seen, *aim), int(rng.integers(0, 2 * SUBSTEPS))
        self.errors_of_readings.append(error)
        self.seen.append((seen, law.errors(*seen, *aim)))
        for i in range(SUBSTEPS):
            push = torque * (sign if i < jump else -sign)
            self.push.append(push)
            state = self.step(self.q[-1], self.v[-1], tau + push)
            self.q.append(state[0])
            self.v.append(state[1])

    def step(self, q, v, tau):
        rate = lambda q, v: self.loop.law.dynamics.forward_dynamics(q, v, tau - self.rubbing.torque(v))  # noqa: E731
        h = self.dt
        a = rate(q, v)
        b = rate(q + 0.5 * h * v, v + 0.5 * h * a)
        c = rate(q + 0.5 * h * v + 0.25 * h * h * a, v + 0.5 * h * b)
        d = rate(q + h * v + 0.5 * h * h * b, v + h * c)
        return q + h * v + h * h / 6.0 * (a + b + c), v + h / 6.0 * (a + 2.0 * b + 2.0 * c + d)

    def rows(self, k):
        begin = self.past + k * SUBSTEPS
        return slice(begin, begin + SUBSTEPS + 1)

    def mean(self, x):
        return (x.sum(axis=0) - 0.5 * (x[0] + x[-1])) / SUBSTEPS

    def y(self, k):
        z2 = self.errors.z2[self.rows(k)]
        return 0.5 * (z2[0] + z2[-1])

    def g(self, k):
        """(x, |ȳ|, w, n) of hold k."""
        rows, constants = self.rows(k), self.loop.constants
        lost = self.mean((self.errors.gradient[rows] ** 2 * constants.rate).sum(axis=1))
        y, seen = self.y(k), self.seen[k][1].z2
        extra = self.loop.law.damping_force(seen) - constants.floor @ seen
        w = constants.omega * y @ self.mean(self.mass[rows]) @ y
        return np.sqrt(np.maximum([lost, y @ constants.floor @ y, w, seen @ extra], 0.0))

    def suprema(self, k):
        rows, floor, e = self.rows(k), self.loop.constants.floor, self.errors
        z2, mass = e.z2[rows], self.mass[rows]
        speed = lambda x: np.sqrt(np.einsum("ki,ij,kj->k", x, floor, x)).max()  # noqa: E731
        energy = lambda x: np.sqrt(np.einsum("ki,kij,kj->k", x, mass[: len(x)], x)).max()  # noqa: E731
        dual = lambda x: np.sqrt(np.einsum("ki,ij,kj->k", x, np.linalg.inv(floor), x)).max()  # noqa: E731
        rate, bend = (self.v - self.at(np.arange(len(self.v)) - self.past).v)[rows], np.diff(z2, axis=0) / self.dt
        loss = np.sqrt((e.gradient[rows] ** 2 * self.loop.constants.rate).sum(axis=1)).max()
        force = np.einsum("kij,kj->ki", 0.5 * (mass[1:] + mass[:-1]), bend)
        found = dual(e.gradient[rows]), loss, speed(z2), energy(z2), speed(rate), energy(rate), dual(force)
        return np.array([*found, speed(bend), energy(bend)])

    def storage(self, k, centre):
        """V* at the beginning of hold k: Φ + ½z2ᵀ(M − (½h + T)D₀)z2 + hH + E."""
        loop, row = self.loop, self.past + k * SUBSTEPS
        own, z2 = loop.constants.floor - np.diag(loop.friction), self.errors.z2[row]
        value = self.errors.value[row]
        value += 0.5 * z2 @ (self.mass[row] - (0.5 * loop.h + loop.timing.age) * own) @ z2
        for j in range(1, loop.timing.holds + 1):
            for i in range(1, j + 1):
                if k >= i:
                    late = weights(loop.timing, j, loop.h - self.dt * (np.arange(SUBSTEPS) + 0.5))
                    moved = late @ np.diff(self.errors.z2[self.rows(k - i)], axis=0)
                    value += loop.h * self.y(k - i) @ own @ moved
        if k > 0 and loop.step is not None:
            (q, _), e = self.seen[k - 1]
            error = self.errors_of_readings[k - 1]
            held = own + (centre + loop.constants.omega) * self.mean(self.mass[self.rows(k - 1)])
            turned = loop.law.dynamics.reference_torque(q, e.v_r, error, 0.0 * q) - loop.law.dynamics.gravity(q)
            value += self.y(k - 1) @ (held @ error - turned)
        return float(value)


CASES = [(name, bits) for name, (_, differenced) in READINGS.items() for bits in (16, 200)[: 1 + differenced]]


@pytest.mark.parametrize(("readings", "bits"), CASES)
def test_storage_with_its_history_changes_within_its_bound_in_every_hold(readings, bits):
    """The inequality of docs/certificates.md §13 with the largest g so far in place of those of earlier holds."""
    loop, certificate, reference = loop_of("two_link", readings, bits)
    level = kept_level(loop, certificate.storage).level
    assert level < 3.0 * certificate.storage
    hold = next(x for x in (hold_of(loop, level, more * level) for more in _ENLARGED) if x is not None)
    rows = rows_in_g(hold)
    excess, spread, ends = _excess(hold, rows)
    centre, nearest = hold.curve.centre, 0.0
    for seed in range(2):
        motion = Motion(loop, reference, 5.0, np.random.default_rng(seed), 80)
        largest = np.zeros(5)
        largest[4] = 1.0
        for k in range(80):
            g, before, after = motion.g(k), motion.storage(k, centre), motion.storage(k + 1, centre)
            largest[:4] = np.maximum(largest[:4], g)
            suprema = motion.suprema(k)
            assert (suprema <= np.array(rows) @ largest * (1.0 + 1e-3)).all()
            assert (suprema <= np.array([float(x) for x in hold.sups])).all()
            y, part = motion.y(k), motion.rows(k)
            push = np.mean(motion.push[k * SUBSTEPS : (k + 1) * SUBSTEPS], axis=0)
            rest = (after - before) / loop.h + g @ g - y @ push
            allowed = loop.t * (spread @ largest) + largest @ excess @ largest
            # The exact changes cancel, so that little is left of either sign: 0.36 and −0.16 of it.
            assert -0.25 * allowed <= rest <= 0.45 * allowed
            nearest = max(nearest, rest / allowed)
            mean = motion.mean(motion.errors.value[part]) + 0.5 * y @ motion.mean(motion.mass[part]) @ y
            assert 0.5 * (before + after) - mean <= largest @ ends @ largest + 1e-9
            assert after <= level
    assert nearest > 0.02


@pytest.mark.parametrize("readings", READINGS)
def test_friction_that_late_and_coarse_readings_feed_forward_stays_within_its_terms(readings):
    """The same inequality, for an arm that rubs as the law expects, with little else to disturb it."""
    friction = nbs.JointFriction([0.3, 0.1], [1.0, 0.3])
    loop, certificate, reference = loop_of("two_link", readings, torque=1.0, feed=friction)
    level = kept_level(loop, certificate.storage).level
    assert certificate.storage < level < math.inf
    hold = next(x for x in (hold_of(loop, level, more * level) for more in _ENLARGED) if x is not None)
    rows, centre = rows_in_g(hold), hold.curve.centre
    excess, spread, _ = _excess(hold, rows)
    motion = Motion(loop, reference, 1.0, np.random.default_rng(0), 80, friction)
    largest, nearest = np.eye(5)[4], 0.0
    for k in range(80):
        g, before, after = motion.g(k), motion.storage(k, centre), motion.storage(k + 1, centre)
        largest[:4] = np.maximum(largest[:4], g)
        filled = motion.suprema(k) / (np.array(rows) @ largest)
        assert (filled <= 1.0 + 1e-3).all()
        nearest = max(nearest, filled.max())
        push = np.mean(motion.push[k * SUBSTEPS : (k + 1) * SUBSTEPS], axis=0)
        rest = (after - before) / loop.h + g @ g - motion.y(k) @ push
        assert rest <= loop.t * (spread @ largest) + largest @ excess @ largest
        assert after <= level
    assert nearest > 0.5


def played(law, reference, readings, disturbances, shifts, duration=1.0):
    """‖z1‖ of held loops from the reference, (rows, motions), under torques that are held too."""
    share, differenced = READINGS[readings]
    plant = nbs.DynamicsPlant(law.dynamics)
    shape, lag = (len(disturbances), law.nv), round(share)
    lead = (0.5 + share) * H
    steps = round(duration / H)
    target = reference(H * np.arange(-lag, steps) + lead)
    desired = reference(H * np.arange(-1 - lag, steps + 1))
    quantised = lambda q: (np.round(q / STEP - shifts) + shifts) * STEP if differenced else q  # noqa: E731
    states = [np.broadcast_to(x, shape) for x in desired.q[: 2 + lag]]
    q, v = states[-1], np.broadcast_to(desired.v[1 + lag], shape)
    speeds, sizes = [np.broadcast_to(x, shape) for x in desired.v[: 2 + lag]], []
    for k in range(steps):
        read, a = quantised(states[-1 - lag]), desired.a[1 + k]
        rate = (read - quantised(states[-2 - lag])) / H if differenced else speeds[-1 - lag]
        aim = (np.broadcast_to(x[k], shape) for x in target)
        tau = law.torque(read + lead * rate + 0.5 * lead**2 * a, rate + lead * a, *aim)
        for _ in range(2):
            q, v = plant.step(q, v, tau + disturbances[:, k], 0.5 * H)
        states.append(q)
        speeds.append(v)
        sizes.append(np.linalg.norm(q - desired.q[2 + lag + k], axis=-1))
    return np.array(sizes)


def worst_found(law, reference, readings, box, seeds=24, duration=1.0):
    """The largest ‖z1‖ under square waves and the worst torques of the loop that reads exactly and acts at once."""
    rng, steps, n = np.random.default_rng(0), round(duration / H), law.nv
    found = nbs.attack(law, box, reference=reference, duration=duration, period=H, rounds=3)
    t = H * np.arange(steps)
    rates = np.geomspace(1.0, 100.0, seeds - 8)[:, None, None]
    waves = np.sign(np.sin(rates * t[:, None] + rng.uniform(0.0, 2.0 * np.pi, (seeds - 8, 1, n))))
    tried = np.concatenate([waves, np.repeat(found.disturbance[None, :steps] / box, 8, axis=0)]) * box
    return played(law, reference, readings, tried, rng.uniform(0.0, 1.0, (seeds, n)), duration).max()


@pytest.mark.parametrize("readings", ["late", "late differences"])
def test_no_motion_found_of_a_late_loop_exceeds_its_bound(readings):
    law, reference = law_of("two_link")
    box, (share, differenced) = np.full(2, 5.0), READINGS[readings]
    encoders = nbs.Encoders.of_bits(16) if differenced else None
    certificate = nbs.certify(law, box, reference=reference, period=H, delay=share * H, encoders=encoders)
    assert certificate.label is Label.PROVED
    assert dict(certificate.assumptions)[Assumption.TIME] == "checked"
    assert certificate.held.readings.lookahead == pytest.approx((0.5 + share) * H)
    found = worst_found(law, reference, readings, box)
    assert 0.4 * certificate.error < found <= certificate.error


def test_the_finer_the_encoders_and_the_shorter_the_delay_the_smaller_is_the_bound():
    loop, certificate, _ = loop_of("two_link", "late differences")
    plain = kept_level(replace(loop, delay=0.0, lead=0.5 * H, step=None), certificate.storage).level
    levels = [kept_level(replace(loop, step=loop.step * share), certificate.storage).level for share in (1.0, 0.3, 0.0)]
    assert levels == sorted(levels, reverse=True)
    shares = (1.0, 0.5, 0.1, 0.0)
    late = [replace(loop, delay=d * H, lead=(0.5 + d) * H, step=None) for d in shares]
    levels = [kept_level(x, certificate.storage).level for x in late]
    assert levels == sorted(levels, reverse=True)
    assert levels[-1] == plain


@pytest.mark.parametrize("readings", READINGS)
def test_the_weights_of_a_reading_have_the_ages_that_are_stated(readings):
    share, differenced = READINGS[readings]
    timing = Timing(H, (0.5 + share) * H, share * H, differenced)
    ages = H * (np.arange(4000) + 0.5) / 4000
    kept = np.array([weights(timing, j, ages) for j in range(1, timing.holds + 1)])
    means = kept.mean(axis=1)
    assert H * means.sum() == pytest.approx(timing.age, rel=1e-3)
    assert H * (means @ np.arange(1, len(means) + 1)) == pytest.approx(timing.backlog, rel=1e-3)
    assert kept.sum(axis=0).std() == pytest.approx(timing.unevenness, rel=1e-2, abs=1e-9)
    assert H * (kept.std(axis=1) @ np.arange(1, len(means) + 1)) == pytest.approx(timing.jitter, rel=1e-2, abs=1e-9)
    assert timing.holds == math.ceil(share + differenced)


def test_readings_that_are_late_and_coarse_are_proved_for_ur5_where_it_is_slow():
    """Small torques and a slow motion: the bound of the Coriolis terms allows no more."""
    robot = nbs.load_robot("ur5")
    inertia = effective_inertia(robot, nbs.PinocchioDynamics(robot))
    gains = Gains(4.0, 200.0 * inertia, 25.0 * inertia)
    law = nbs.NeuralBackstepping.for_robot(robot, gains=gains, damping_ceiling=0.01, seed=3)
    reference, box = nbs.Sinusoid.for_robot(robot, 0.2), np.full(6, 0.25)
    given = {"delay": H, "encoders": nbs.Encoders.of_bits(18)}
    certificate = nbs.certify(law, box, reference=reference, period=H, **given)
    assert certificate.label is Label.PROVED
    assert certificate.error < 3.0 * nbs.certify(law, box, reference=reference).error
    assert "1 ms after its reading, on encoder readings" in certificate.held.line.because


def test_rotors_allow_coarser_readings_of_an_arm_of_six_joints():
    robot = nbs.load_robot("ur5e")
    inertia = effective_inertia(robot, nbs.PinocchioDynamics(robot))
    gains = Gains(2.2, 170.0 * inertia, 23.0 * inertia)
    law = nbs.NeuralBackstepping.for_robot(robot, gains=gains, damping_ceiling=0.05)
    for weights in law.potential.network.parameters():
        weights.data *= 0.3
    reference, box = nbs.Sinusoid.for_robot(robot, 0.2), np.full(6, 0.5)
    given = {"delay": H, "encoders": nbs.Encoders.of_bits(16)}
    certificate = nbs.certify(law, box, reference=reference, period=H, **given)
    assert certificate.label is Label.PROVED
    assert certificate.held.is_proved
    found = worst_found(law, reference, "late differences", box)
    assert found <= certificate.error <= 5.0 * found


def test_a_certificate_file_states_delay_and_encoders(tmp_path):
    law, reference = law_of("two_link")
    given = {"delay": 0.5 * H, "encoders": nbs.Encoders.of_bits(16)}
    certificate = nbs.certify(law, np.full(2, 5.0), reference=reference, period=H, **given)
    nbs.write_certificate(certificate, tmp_path / "certificate.json")
    held = json.loads((tmp_path / "certificate.json").read_text())["held"]
    assert held["delay"] == 0.5 * H
    assert held["encoder_steps"] == [STEP, STEP]
    assert held["lookahead"] == pytest.approx(H)


def test_what_is_not_proved_of_a_late_loop_is_no_bound():
    """A delay that is stated and not proved contradicts the bounds in continuous time."""
    law, reference = law_of("two_link")
    given = {"reference": reference, "period": H, "delay": H, "encoders": nbs.Encoders.of_bits(8)}
    certificate = nbs.certify(law, np.full(2, 5.0), **given)
    assert not certificate.held.is_proved
    assert certificate.label is Label.EMPIRICAL
    begin = reference(np.zeros(1)).q[0] + 0.01
    start = nbs.certify(law, np.full(2, 5.0), q0=begin, reference=reference, period=H, delay=H)
    assert "start away" in start.held.why_not


def test_times_out_of_range_are_refused():
    law, reference = law_of("two_link")
    for delay in (-1e-4, 2e-3, math.nan):
        with pytest.raises(nbs.ArgumentError, match="delay is"):
            nbs.certify(law, np.full(2, 5.0), reference=reference, period=H, delay=delay)
    with pytest.raises(nbs.ArgumentError, match="half a period is usual"):
        nbs.certify(law, np.full(2, 5.0), reference=reference, period=H, delay=0.5 * H, lookahead=2e-3)
    with pytest.raises(nbs.ArgumentError, match="control period"):
        nbs.certify(law, np.full(2, 5.0), reference=reference, delay=H)


def test_a_recorded_motion_that_begins_at_speed_has_no_past_to_read():
    """Held before its first sample, it jumps where the first readings fall, which no bound covers."""
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot, bandwidth=4.0, period=0.00025)
    t = np.linspace(0.0, 1.0, 201)
    start = np.array([0.2, -0.3])
    ramp = nbs.Sampled(t, start + 0.5 * t[:, None])
    rest = nbs.Sampled(t, start + 0.5 * (t**3)[:, None])
    for motion, words in ((ramp, "begin at rest"), (rest, "")):
        certificate = nbs.certify(law, [0.5, 0.5], reference=motion, duration=0.9, period=0.00025, delay=0.00025)
        assert words in certificate.held.why_not
        assert bool(words) == bool(certificate.held.why_not)
        assert not words or not certificate.held.is_proved
    plain = nbs.certify(law, [0.5, 0.5], reference=ramp, duration=0.9, period=0.00025)
    assert plain.held.why_not == ""


def test_the_storage_of_a_late_loop_has_the_bound_that_was_proved():
    robot = nbs.load_robot("two_link")
    law = nbs.NeuralBackstepping.for_robot(robot, bandwidth=4.0, period=0.00025)
    motion = nbs.Sinusoid.for_robot(robot)
    late = nbs.certify(law, [0.5, 0.5], reference=motion, period=0.00025, delay=0.00025)
    assert late.held.is_proved
    assert late.held.level / (1.0 - 0.5 * 0.00025 * late.constants.nu) == late.held_storage(0.0) < np.inf
    assert late.held_storage(0.0) > late.storage
    assert late.storage_bound(np.zeros(1), 0.0) == late.held_storage(0.0)
    assert late.held_storage(1e3 * late.held.level) == np.inf
