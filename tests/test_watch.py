"""What a monitor may conclude: from proved bounds, instants compared, whole turns, threads and broken samples."""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.encoders import Encoders
from nbs_pin.certificates.energy_balance import LoopSamples, balance
from nbs_pin.certificates.loop_model import CompiledModel, PlainModel
from nbs_pin.identification.measurement import quantised

PERIOD, BOX = 0.001, np.array([5.0, 5.0])
FIELDS = ("q", "v", "q_ref", "v_ref", "a_ref", "tau", "tau_command")


@cache
def robot():
    return nbs.load_robot("two_link")


@cache
def law():
    return nbs.NeuralBackstepping.for_robot(robot(), bandwidth=8.0)


@cache
def held(off=0.0):
    """A certificate with bounds for torques held for a period, from a start `off` the reference [rad]."""
    reference = nbs.Sinusoid.for_robot(robot())
    start = {"q0": reference(0.0).q + off, "v0": reference(0.0).v} if off else {}
    found = nbs.certify(law(), BOX, reference=reference, period=PERIOD, **start)
    assert found.held.is_proved
    return found


@cache
def run_from(off, share=1.0, duration=0.5):
    """The loop of these certificates under a share of the disturbance that they allow."""
    reference = nbs.Sinusoid.for_robot(robot())
    start = reference(np.zeros(1))
    return nbs.simulate(
        nbs.DynamicsPlant(law().dynamics),
        law(),
        reference,
        duration,
        PERIOD,
        q0=start.q[0] + off,
        v0=start.v[0],
        disturbance=nbs.SquareWave(share * BOX, 12.0),
    )


def read(run, bits=16):
    return replace(run, q=quantised(run.q, 2.0**-bits, robot().prismatic))


def watched(watch, run, rows=None):
    memory, said = None, []
    for k in range(len(run.t)) if rows is None else rows:
        aim = nbs.Reference(run.q_ref[k], run.v_ref[k], run.a_ref[k])
        one, memory = watch.step(memory, float(run.t[k]), run.q[k], run.v[k], aim, run.tau[k], run.tau_command[k])
        said.append(one)
    return said


# Held torques: what is proved is V ≤ V' ÷ (1 − ½hν)


def test_v_is_no_more_than_the_proved_level_allows():
    """V' = Φ + ½z2ᵀ(M − ½hD₀)z2 ≤ V, and (1 − ½hν)V ≤ V', in random states; next to equality where Φ = 0."""
    certificate, rng = held(), np.random.default_rng(0)
    floor, share = certificate.constants.floor, 0.5 * PERIOD * certificate.constants.nu
    q, v, away = rng.normal(size=(3, 5000, 2))
    q_ref, v_ref = q - away * (rng.random((5000, 1)) < 0.5), 0.0 * q
    e, storage = law().errors(q, v, q_ref, v_ref, 0.0 * q), law().storage(q, v, q_ref, v_ref)
    lost = 0.25 * PERIOD * np.einsum("ki,ij,kj->k", e.z2, floor, e.z2)
    assert 0.8 < (lost / storage).max() / share <= 1.0
    assert (lost >= 0.0).all()


@pytest.mark.parametrize("off", [0.0, 0.02])
def test_the_bound_of_v_with_held_torques_is_that_of_every_start_below_its_level(off):
    certificate = held(off)
    proof, nu = certificate.held, certificate.constants.nu
    assert proof.level > certificate.storage
    assert (proof.level_from_start > proof.level) == (off > 0.0)
    for initial, level, reach in (
        (0.0, proof.level, proof.potential),
        (proof.level, proof.level, proof.potential),
        (proof.level_from_start, proof.level_from_start, proof.potential_from_start),
    ):
        wanted = np.full(3, level / (1.0 - 0.5 * PERIOD * nu))
        assert certificate.storage_bound(np.array([0.0, 0.1, 9.0]), initial) == pytest.approx(wanted, rel=1e-12)
        assert not certificate.is_continuous_from(initial)
        error = np.sqrt(reach * np.linalg.inv(certificate.stiffness).diagonal())
        assert certificate.from_start(initial)[1] == pytest.approx(error, rel=1e-6)
    beyond = 1.01 * proof.level_from_start
    assert certificate.is_continuous_from(beyond)
    continuous = replace(certificate, held=None)
    assert not continuous.is_continuous_from(beyond)
    t = np.linspace(0.0, 1.0, 5)
    assert np.array_equal(certificate.storage_bound(t, beyond), continuous.storage_bound(t, beyond))


@pytest.mark.parametrize("off", [0.0, 0.02])
def test_a_loop_within_the_proof_is_compared_with_it_and_one_beyond_it_is_told_so(off):
    certificate, run = held(off), run_from(off)
    seen, said = nbs.monitor(run, certificate), watched(nbs.Watch(certificate), run)
    proved = certificate.held.storage(float(seen.storage[0]), certificate.constants.nu)
    assert seen.promise == pytest.approx(np.full(len(run.t), proved))
    assert [one.promise for one in said] == pytest.approx(seen.promise)
    assert [one.error_bound for one in said] == pytest.approx(seen.error_bound)
    assert {seen.verdict, *(one.verdict for one in said)} == {"promise kept"}
    far = run_from(0.05)
    for verdict in (
        nbs.monitor(far, certificate).verdict,
        nbs.monitor(read(far), certificate, encoders=Encoders.of_bits(16)).verdict,
        watched(nbs.Watch(certificate), far)[-1].verdict,
    ):
        assert verdict.startswith("promise kept; from V(0) = ")
        assert verdict.endswith("nothing is proved for held torques, and the bounds are those of continuous time")


def test_v_between_its_bound_in_continuous_time_and_that_with_held_torques_breaks_no_promise():
    """A disturbance beyond its bound lifts V there."""
    certificate, run = held(), run_from(0.0, 1.4)
    seen = nbs.monitor(run, certificate)
    assert certificate.storage < seen.storage.max() < seen.promise.min()
    assert "V" not in seen.excesses
    assert "V" in nbs.monitor(run, replace(certificate, held=None)).excesses
    assert Assumption.DISTURBANCE in seen.broken
    assert "V" not in {name for one in watched(nbs.Watch(certificate), run) for name in one.excesses}


# From readings: what was compared


@cache
def free():
    """A certificate that holds from every start."""
    return nbs.certify(law(), BOX)


def test_a_reading_that_is_lost_again_and_again_leaves_the_watch_blind_and_it_says_so():
    run = read(run_from(0.0))
    spoiled = run.q.copy()
    spoiled[50::50, 0] = np.nan
    watch = nbs.Watch(free(), Encoders.of_bits(16))
    said = watched(watch, replace(run, q=spoiled))
    assert all(np.isnan(one.storage) for one in said)
    assert said[-2].blind == pytest.approx(run.t[-2])
    assert said[-2].verdict == f"no bound was exceeded, but V and torques have not been compared for {run.t[-2]:.4g} s"
    assert not any("kept" in one.verdict for one in said)
    said = watched(watch, run)
    full = next(k for k, one in enumerate(said) if np.isfinite(one.storage))
    assert all(one.blind == pytest.approx(t) for one, t in zip(said[:full], run.t, strict=False))
    assert {(one.blind, one.verdict) for one in said[full:]} == {(0.0, "promise kept")}
    spoiled = run.q.copy()
    spoiled[300, 0] = np.nan
    said = watched(watch, replace(run, q=spoiled))
    assert said[350].blind == pytest.approx(0.051)


@pytest.mark.parametrize("how", ["uneven", "short"])
def test_a_run_without_any_full_window_is_no_promise_kept(how):
    run = read(run_from(0.0))
    if how == "uneven":
        run = replace(run, t=run.t + 0.03 * PERIOD * (np.arange(len(run.t)) % 2))
    else:
        run = replace(run, t=run.t[:60], disturbance=run.disturbance[:60], **{x: getattr(run, x)[:60] for x in FIELDS})
    seen = nbs.monitor(run, free(), encoders=Encoders.of_bits(16))
    assert not seen.compared.any()
    assert not seen.is_kept
    assert seen.blind == np.inf
    assert not seen.excesses
    assert seen.verdict.startswith("no bound was exceeded, but V and torques were not compared at any time")


@pytest.mark.parametrize("lost", [range(1, 2), range(1, 300), range(1, 400, 2)])
def test_a_start_that_is_not_read_twice_in_a_row_is_taken_from_later_with_its_own_time(lost):
    """V(0) and the bound that falls from it belong to one instant."""
    run = read(run_from(0.05, duration=0.7))
    spoiled = run.q.copy()
    spoiled[lost] = np.nan
    certificate = free()
    said = watched(nbs.Watch(certificate, Encoders.of_bits(16)), replace(run, q=spoiled))
    assert [k for k, one in enumerate(said) if one.excesses] == list(lost)
    assert not any(one.broken for one in said)
    first = lost[-1] + 2  # two instants in a row
    later = watched(nbs.Watch(certificate, Encoders.of_bits(16)), run, range(first - 1, len(run.t)))
    assert [one.promise for one in said[first:]] == pytest.approx([one.promise for one in later[1:]], nan_ok=True)
    assert [one.error_bound for one in said[first:]] == pytest.approx([one.error_bound for one in later[1:]])


# Threads


@pytest.mark.parametrize("encoders", [None, Encoders.of_bits(16)])
@pytest.mark.parametrize("kind", [CompiledModel, PlainModel])
def test_threads_that_share_a_watch_read_what_each_would_alone(encoders, kind):
    run, certificate = read(run_from(0.0)), free()
    watch = nbs.Watch(certificate, encoders)
    watch._way.__dict__["model"] = kind(certificate.controller)
    alone, before = watched(watch, run, range(250)), sys.getswitchinterval()
    try:
        sys.setswitchinterval(1e-6)
        with ThreadPoolExecutor(4) as pool:
            found = list(pool.map(lambda _: watched(watch, run, range(250)), range(4)))
    finally:
        sys.setswitchinterval(before)
    for said in found:
        assert [one.storage for one in said] == pytest.approx([one.storage for one in alone], rel=1e-12, nan_ok=True)
        assert [one.verdict for one in said] == [one.verdict for one in alone]
        if encoders is None:
            change = [one.balance.disturbance[0] for one in said[1:]]
            assert change == pytest.approx([one.balance.disturbance[0] for one in alone[1:]], rel=1e-9, abs=1e-9)


# Continuous joints


@cache
def turning():
    """A kinova whose continuous joints turn through ±π, its run with and without whole turns, and a certificate."""
    arm = nbs.load_robot("kinova")
    rule = nbs.NeuralBackstepping.for_robot(arm)
    begin = np.where(arm.continuous, np.pi - 0.05, 0.5 * (np.maximum(arm.lower, -3.0) + np.minimum(arm.upper, 3.0)))
    reference = nbs.MinimumJerk([begin, begin + np.where(arm.continuous, 0.4, 0.0)], [0.0, 0.5])
    plant = nbs.DynamicsPlant(rule.dynamics)
    wave = nbs.SquareWave(np.full(arm.nv, 0.05), 9.0)
    run = nbs.simulate(plant, rule, reference, 0.3, PERIOD, disturbance=wave, check=False)

    def within(q):
        return np.where(arm.continuous, np.remainder(q + np.pi, 2.0 * np.pi) - np.pi, q)

    wrapped = replace(run, q=within(run.q), q_ref=within(run.q_ref))
    assert (np.abs(np.diff(wrapped.q, axis=0)) > 6.0).any()
    return rule, run, wrapped, nbs.certify(rule, np.full(arm.nv, 0.1))


def test_positions_of_continuous_joints_count_modulo_a_turn():
    rule, run, wrapped, certificate = turning()
    seen, other = nbs.monitor(run, certificate), nbs.monitor(wrapped, certificate)
    assert seen.verdict == other.verdict == "promise kept"
    assert other.storage == pytest.approx(seen.storage, rel=1e-6, abs=1e-12)
    for one, two in zip(seen.balance[:-1], other.balance[:-1], strict=True):
        assert two == pytest.approx(one, abs=1e-6 * max(np.abs(one).max(), 1.0))
    said = watched(nbs.Watch(certificate), wrapped)
    assert {one.verdict for one in said} == {"promise kept"}
    encoders = Encoders.of_bits(20)
    readings = replace(wrapped, q=quantised(wrapped.q, encoders.step, rule.dynamics.robot.prismatic))
    assert nbs.monitor(readings, certificate, encoders=encoders).broken == ()


def test_a_whole_turn_between_two_samples_changes_no_number_of_the_balance():
    rule, run, wrapped, _ = turning()
    k = int(np.argmax((np.abs(np.diff(wrapped.q, axis=0)) > 6.0).any(axis=1)))
    rows = [[np.ascontiguousarray(np.stack([getattr(x, name)[j] for name in FIELDS])) for j in (k, k + 1)]
            for x in (run, wrapped)]  # fmt: skip
    for model in (CompiledModel(rule), PlainModel(rule)):
        (terms, vectors), (others, other) = (model.period(*two, PERIOD, model.storage(two[0])) for two in rows)
        assert others[:7] == pytest.approx(terms[:7], rel=1e-6, abs=1e-8)
        assert other == pytest.approx(vectors, rel=1e-6, abs=1e-8)
    at = LoopSamples.of(wrapped).rows(0)
    flow = balance(rule, at.rows(slice(k, k + 1)), at.rows(slice(k + 1, k + 2)), np.zeros(1))
    assert flow.unexplained[0] == pytest.approx(other[1], rel=1e-6, abs=1e-8)


# Samples that no arithmetic survives


@pytest.mark.parametrize("value", [1e160, -1e31, 1e308])
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("encoders", [None, Encoders.of_bits(16)])
def test_a_sample_too_large_to_multiply_is_named_and_leaves_nothing_behind(field, value, encoders):
    run = read(run_from(0.0))
    spoiled = getattr(run, field).copy()
    spoiled[100, 1] = value
    bad = replace(run, **{field: spoiled})
    seen, said = nbs.monitor(bad, free(), encoders=encoders), watched(nbs.Watch(free(), encoders), bad, range(400))
    (name,) = seen.excesses
    assert f"of joint2, which is {value:.3g}, too large for any arm" in name
    assert [k for k, one in enumerate(said) if one.excesses] == np.flatnonzero(seen.exceeded).tolist() == [100]
    assert not seen.is_wrong
    assert seen.broken == () == said[-1].broken
    assert said[-1].verdict == "promise kept"
    if encoders is None:
        memory = None
        watch = nbs.Watch(free())
        for k in range(120):
            aim = nbs.Reference(bad.q_ref[k], bad.v_ref[k], bad.a_ref[k])
            _, memory = watch.step(memory, float(bad.t[k]), bad.q[k], bad.v[k], aim, bad.tau[k], bad.tau_command[k])
        assert np.isfinite([memory.excess, memory.held, memory.storage]).all()


def test_a_time_beyond_any_run_is_refused():
    run, watch = run_from(0.0), nbs.Watch(free())
    aim = nbs.Reference(run.q_ref[0], run.v_ref[0], run.a_ref[0])
    with pytest.raises(ArgumentError, match="expected a finite time"):
        watch.step(None, 1e160, run.q[0], run.v[0], aim, run.tau[0], run.tau_command[0])


@pytest.mark.parametrize("model", [CompiledModel, PlainModel])
def test_storage_never_rounds_below_zero(model):
    """V = Φ(z1) + ½z2ᵀMz2 ≥ 0 where Φ(z) − Φ(0) cancels, so that a watch may begin on the reference itself."""
    rng, of_law, watch = np.random.default_rng(0), model(law()), nbs.Watch(held())
    values = []
    for _ in range(300):
        q, v, size = rng.uniform(-1.0, 1.0, 2), rng.normal(size=2), 10.0 ** rng.uniform(-18.0, -8.0)
        sample = np.zeros((len(FIELDS), 2))
        sample[0], sample[1], sample[2:4] = q, v, (q, v) + size * rng.normal(size=(2, 2))
        values.append(of_law.storage(sample))
        seen, _ = watch.step(None, 0.0, q, v, Reference(*sample[2:5]), sample[5], sample[6])
        assert seen.verdict == "promise kept"
    assert min(values) == 0.0 < max(values)
