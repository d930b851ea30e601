"""The monitor: V̇ is the sum of its terms for any model, promises are kept, and what breaks one is named."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

import nbs_pin as nbs
from nbs_pin.accuracy.mismatch import mismatch
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.assumptions import Promise, jumps
from nbs_pin.certificates.attack import attack, random_disturbances
from nbs_pin.certificates.certify import certify
from nbs_pin.certificates.claims import Assumption
from nbs_pin.certificates.energy_balance import LoopSamples, balance, beyond, storage_of
from nbs_pin.certificates.monitor import monitor
from nbs_pin.certificates.online_monitor import Watch
from nbs_pin.controllers.neural_backstepping import NeuralBackstepping
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.registry import make_network
from nbs_pin.motions.disturbances import ConstantTorque, SinusoidalTorque, SquareWave
from nbs_pin.motions.references import Sinusoid
from nbs_pin.reports.certificate_charts import plot_certificate, plot_monitor
from nbs_pin.reports.plotting import ACTUAL, ERROR, LIMIT, REFERENCE, SATURATED, TORQUE

BOUND = np.array([5.0, 3.0])
WAVE = SquareWave(BOUND, 9.0)


@pytest.fixture(scope="module")
def robot():
    return nbs.load_robot("two_link")


@pytest.fixture(scope="module")
def law(robot):
    return NeuralBackstepping.for_robot(robot, bandwidth=8.0)


@pytest.fixture(scope="module")
def certificate(law):
    return certify(law, BOUND)


def run_of(law, *, truth=None, friction=None, period=0.001, duration=0.2, off=0.0, effort_limit=np.inf, torque=None):
    robot = law.dynamics.robot
    plant = nbs.DynamicsPlant(law.dynamics if truth is None else truth, friction=friction)
    reference = Sinusoid.for_robot(robot, 2.0)
    start = {} if off == 0.0 else {"q0": reference(np.zeros(1)).q[0] + off}
    start |= {"effort_limit": effort_limit, "disturbance": torque, "check": False}  # beyond the limits as well
    return nbs.simulate(plant, law, reference, duration, period, **start)


def residual(law, run):
    """max |V̇ − its terms|, and the size of V̇."""
    flow = flow_of(law, run)
    terms = flow.potential + flow.damping + flow.disturbance + flow.held + flow.saturation
    return np.abs(flow.change - terms).max(), np.abs(flow.change).max()


def flow_of(law, run):
    at = LoopSamples.of(run).rows(0)
    return balance(law, at.rows(slice(-1)), at.rows(slice(1, None)), np.diff(storage_of(law, at)))


def learned(robot, seed=0):
    return nbs.LagrangianDynamics(make_network("cholesky", [False, False], seed=seed), robot)


@pytest.mark.parametrize("case", ["exact", "learned", "friction", "saturated", "paper"])
def test_the_terms_sum_to_the_rate_of_v_to_second_order(robot, law, case):
    """The identity of docs/theory.md §2, with M̂ for M and w for τ_d, along motions of the true arm."""
    kept = {"off": 0.2, "torque": ConstantTorque(BOUND)}
    if case == "learned":
        law = NeuralBackstepping(learned(robot), law.potential, law.damping, rate=law.rate.numpy(), inertial_rate=8.0)
        kept |= {"truth": nbs.PinocchioDynamics(robot)}
    elif case == "friction":
        friction = JointFriction(np.array([0.4, 0.2]), np.array([0.5, 0.3]), transition=0.5)
        law = NeuralBackstepping(
            law.dynamics, law.potential, law.damping, rate=law.rate.numpy(), inertial_rate=8.0, friction=friction
        )
        kept |= {"friction": friction}
    elif case == "saturated":
        kept |= {"effort_limit": 20.0}
    elif case == "paper":
        law = NeuralBackstepping.for_robot(robot, damping="paper", potential="paper")
    period = {"paper": 0.0005}.get(case, 0.001)
    coarse, size = residual(law, run_of(law, period=period, duration=0.1, **kept))
    fine, _ = residual(law, run_of(law, period=0.5 * period, duration=0.1, **kept))
    assert coarse < 2e-2 * size
    # The paper's ∇²Φ jumps where a pre-activation passes 0: within that one period the rate of V has no middle.
    assert fine < (1.0 if case == "paper" else 0.35) * coarse


def test_what_is_unexplained_is_the_disturbance_of_an_exact_model(law):
    run = run_of(law, torque=SinusoidalTorque(BOUND, 7.0), off=0.1)
    found = flow_of(law, run).unexplained
    wanted = BOUND * np.sin(7.0 * (run.t[:-1] + 0.0))[:, None]
    assert np.abs(found - wanted).max() < 1e-2


def test_what_is_unexplained_is_also_the_error_of_the_model(robot, law):
    """A truth with friction that the model leaves out: viscous·v is what is missing."""
    friction = JointFriction(np.array([2.0, 1.0]), np.zeros(2))
    run = run_of(law, friction=friction, off=0.1)
    found = flow_of(law, run).unexplained
    middle = 0.5 * (run.v[1:] + run.v[:-1])
    assert np.abs(found + friction.viscous * middle).max() < 2e-2


def test_storage_and_promise_are_those_of_law_and_certificate(law, certificate):
    run = run_of(law, off=0.1)
    seen = monitor(run, certificate)
    assert seen.storage == pytest.approx(law.storage(run.q, run.v, run.q_ref, run.v_ref), rel=1e-12)
    assert np.array_equal(seen.promise, certificate.storage_bound(run.t, float(seen.storage[0])))
    assert np.array_equal(seen.error, np.linalg.norm(run.q - run.q_ref, axis=-1))
    size, joints = certificate.from_start(float(seen.storage[0]))
    assert seen.error_bound[0] == pytest.approx(size)
    assert seen.joint_bounds[0] == pytest.approx(joints)
    assert np.array_equal(seen.joint_errors, np.abs(run.q - run.q_ref))


@pytest.mark.parametrize("share", [0.5, 20.0])
def test_bounds_of_errors_fall_with_the_promise_and_never_below_what_the_start_allows(law, certificate, share):
    """From V(0) > V∞ they are those of Φ ≤ V ≤ the promise; from V(0) < V∞ they stay, as V may rise to V∞."""
    initial, t = share * certificate.storage, np.linspace(0.0, 2.0, 9)
    bounds = Promise(certificate, initial).bounds(t)
    promised = certificate.storage_bound(t, initial)
    wanted = [certificate.from_start(float(x) if share > 1.0 else initial) for x in promised]
    assert bounds[:, 0] == pytest.approx(promised)
    assert bounds[:, 1] == pytest.approx([size for size, _ in wanted])
    assert bounds[:, 2:] == pytest.approx(np.array([joints for _, joints in wanted]))
    assert (bounds[-1, 1] < bounds[0, 1]) == (share > 1.0)


@pytest.mark.parametrize("seed", [None, 0, 1, 2])
def test_admissible_disturbances_and_none_keep_the_promise(law, certificate, seed):
    if seed is None:
        run = run_of(law)
    else:
        torque = random_disturbances(certificate.admissible, 300, 0.001, 8, np.random.default_rng(seed))[seed]
        run = run_of(law, off=0.05 * seed, torque=lambda t, q, v: torque[min(int(t / 0.001 + 1e-6), 299)] + 0.0 * q)
    seen = monitor(run, certificate)
    assert seen.is_kept
    assert not seen.is_wrong
    assert seen.verdict == "promise kept"
    assert seen.broken == ()
    assert not seen.saturated.any()


def test_the_worst_attack_keeps_the_promise_and_a_smaller_promise_is_called_wrong(law, certificate):
    run = attack(law, BOUND, duration=0.2, rounds=1, starts=1).run
    assert monitor(run, certificate).is_kept
    level = certificate.level._replace(storage=0.05 * certificate.storage)
    seen = monitor(run, replace(certificate, level=level))
    assert seen.is_wrong
    assert "the certificate is wrong" in seen.verdict
    error = 0.5 * float(monitor(run, certificate).error.max())
    seen = monitor(run, replace(certificate, error=error))
    assert seen.is_wrong
    assert not (seen.storage > seen.promise).any()


def test_a_joint_beyond_its_own_bound_is_named(robot, law, certificate):
    """Each |z1_i| has a bound of its own, and it is broken though V and ‖z1‖ keep theirs."""
    run = run_of(law, torque=WAVE, duration=0.1)
    peak = np.abs(run.q - run.q_ref).max(axis=0)
    smaller = replace(certificate, joint_errors=np.array([certificate.joint_errors[0], 0.5 * peak[1]]))
    assert monitor(run, certificate).excesses == {}
    seen = monitor(run, smaller)
    assert list(seen.excesses) == [f"|z1| of {robot.joint_names[1]}"]
    assert np.array_equal(seen.exceeded, np.abs(run.q - run.q_ref)[:, 1] > 0.5 * peak[1] * (1.0 + 1e-9))
    assert seen.is_wrong
    assert robot.joint_names[1] in seen.verdict
    said = watched(Watch(smaller), run)
    assert [bool(s.excesses) for s in said] == seen.exceeded.tolist()
    assert {name for s in said for name in s.excesses} == set(seen.excesses)


@pytest.mark.parametrize("torque", [None, ConstantTorque([0.5, 0.0])], ids=["calm", "disturbed"])
def test_without_any_disturbance_every_torque_is_beyond_the_bound(law, torque):
    """V∞ = 0, so times the bound means nothing: energies do."""
    run, none = run_of(law, torque=torque, off=0.05, duration=0.06), certify(law, np.zeros(2))
    seen = monitor(run, none)
    assert np.isfinite(seen.error_bound).all()
    assert not seen.is_wrong
    assert (Assumption.DISTURBANCE in seen.broken) == (torque is not None)
    assert not any("wrong" in s.verdict for s in watched(Watch(none), run))


def test_a_joint_without_disturbance_leaves_the_check_of_errors_alive(law):
    """Any torque on it is infinitely many times its bound, and a false bound of ‖z1‖ is called wrong all the same."""
    run = run_of(law, torque=SquareWave(np.array([5.0, 0.0]), 9.0))
    one_sided = certify(law, np.array([5.0, 0.0]))
    assert not monitor(run, one_sided).is_wrong
    assert monitor(run, one_sided).is_kept
    seen = monitor(run, replace(one_sided, error=1e-3 * one_sided.error))
    assert list(seen.excesses) == ["‖z1‖"]
    # V ≤ V∞ bounds ‖z1‖ by itself, so this error is false only if V∞ is.
    level = one_sided.level._replace(storage=0.05 * one_sided.storage)
    seen = monitor(run, replace(one_sided, level=level, potential=level.storage, error=0.05 * one_sided.error))
    assert seen.is_wrong
    assert "‖z1‖" in seen.excesses
    bounds = np.array([[1.0, 0.1, 0.1, 0.1]])
    accounted = Promise(one_sided, 0.0).accounted(bounds, np.zeros(1), np.array([np.inf]))
    assert np.isfinite(accounted).all()


def test_faster_decay_than_there_is_is_called_wrong(law, certificate):
    run = run_of(law, off=0.3)
    level = certificate.level._replace(c=20.0 * certificate.level.c, storage=1e-6)
    assert monitor(run, certificate).is_kept
    assert monitor(run, replace(certificate, level=level)).is_wrong


@pytest.mark.parametrize("size", [4.0, 8.0, 16.0])
def test_a_disturbance_beyond_its_bound_is_named(law, certificate, size):
    seen = monitor(run_of(law, torque=SquareWave(size * BOUND, 9.0)), certificate)
    assert not seen.is_kept
    assert not seen.is_wrong
    assert Assumption.DISTURBANCE in seen.broken
    assert not {Assumption.MODEL, Assumption.EFFORT, Assumption.WRAP} & set(seen.broken)
    assert Assumption.DISTURBANCE in seen.verdict


@pytest.mark.parametrize("limit", [5.0, 10.0])
def test_saturation_is_named_and_its_intervals_are_those_of_the_run(law, certificate, limit):
    run = run_of(law, off=0.6, effort_limit=limit)
    seen = monitor(run, certificate)
    assert np.array_equal(seen.saturated, (run.tau != run.tau_command).any(axis=-1)[:-1])
    assert seen.saturated.any()
    assert Assumption.EFFORT in seen.broken
    assert not seen.is_wrong
    assert Assumption.MODEL not in seen.broken


@pytest.fixture(scope="module")
def fallen(law, certificate):
    """An arm too weak to hold itself."""
    return monitor(run_of(law, off=0.6, effort_limit=2.0, duration=0.6), certificate)


def test_saturation_that_breaks_the_promise_accounts_for_it(fallen):
    assert not fallen.is_kept
    assert not fallen.is_wrong
    assert Assumption.EFFORT in fallen.verdict


@pytest.mark.parametrize("torque", [None, ConstantTorque([0.1, 0.1])], ids=["nothing on record", "on record"])
def test_an_arm_that_is_not_the_model_is_named(law, torque):
    """With a disturbance on record the model is to blame, without one it may be either."""
    friction = JointFriction(np.array([1.0, 1.0]), np.array([6.0, 6.0]))
    seen = monitor(run_of(law, friction=friction, torque=torque), certify(law, 0.1 * BOUND))
    assert Assumption.MODEL in seen.broken
    assert not seen.is_wrong
    assert (Assumption.DISTURBANCE in seen.broken) == (torque is None)
    assert (f"{Assumption.MODEL}, or {Assumption.DISTURBANCE}" in seen.verdict) == (torque is None)


def test_a_torque_held_too_long_is_named(law):
    still = certify(law, 0.01 * BOUND)
    assert monitor(run_of(law, period=0.001, off=0.3), still).broken == ()
    seen = monitor(run_of(law, period=0.02, off=0.3), still)
    assert Assumption.TIME in seen.broken
    assert not {Assumption.MODEL, Assumption.DISTURBANCE, Assumption.EFFORT} & set(seen.broken)
    assert not seen.is_wrong


def test_a_reference_that_jumps_is_named(robot):
    """V jumps with it; that is no fault of the certificate."""
    law = NeuralBackstepping.for_robot(robot.with_effort_limit(np.inf))
    hold, plant = nbs.Hold(np.zeros(2)), nbs.DynamicsPlant(law.dynamics)

    def stepping(t):
        aim = hold(t)
        return Reference(aim.q + np.where(np.asarray(t) >= 0.05, 0.2, 0.0)[..., None], aim.v, aim.a)

    seen = monitor(nbs.simulate(plant, law, stepping, 0.1, 0.001), certify(law, np.full(2, 0.1)))
    assert Assumption.REFERENCE in seen.broken
    assert not seen.is_kept
    assert not seen.is_wrong


@pytest.mark.parametrize("rate", [0.1, 3.0, 30.0, 300.0])
def test_a_smooth_reference_is_never_said_to_jump(law, rate):
    """At every phase: where the velocity turns, its change over a period is next to nothing."""
    t = 0.001 * np.arange(4000.0)
    aim = Sinusoid(np.array([0.5, -1.0]), rate, np.array([0.0, 1.0]))(t)
    at = LoopSamples(t, aim.q, aim.v, aim.q, aim.v, aim.a, 0.0 * aim.q, 0.0 * aim.q)
    assert not jumps(law, at)[Assumption.REFERENCE].any()
    after = (t >= t[2000])[:, None]
    drift = 0.7 * rate * after
    for q, v in ((aim.q + 0.7 * after, aim.v), (aim.q + drift * (t - t[2000])[:, None], aim.v + drift)):
        broken = jumps(law, LoopSamples(t, q, v, q, v, aim.a, 0.0 * q, 0.0 * q))[Assumption.REFERENCE]
        assert np.flatnonzero(broken).tolist() == [1999]


def test_an_error_that_wraps_is_named():
    """A continuous joint thrown over its top by a torque no law could hold."""
    robot = nbs.load_robot("kinova")
    law = NeuralBackstepping.for_robot(robot)
    assert robot.continuous.any()
    joint = int(np.flatnonzero(robot.continuous)[0])
    certificate = certify(law, np.ones(robot.nv))
    run = run_of(law, duration=0.01)
    q = run.q.copy()
    q[5:, joint] = run.q_ref[5:, joint] + np.pi + 0.01
    q[:5, joint] = run.q_ref[:5, joint] + np.pi - 0.01
    seen = monitor(replace(run, q=q), certificate)
    assert Assumption.WRAP in seen.broken
    assert not seen.is_wrong


def test_a_learned_models_error_is_granted_where_the_certificate_counts_it(robot, law):
    """‖δ‖ ≤ a‖q‖ + b‖v‖ + c beside τ_d is no broken assumption; more than that is."""
    model = NeuralBackstepping(learned(robot), law.potential, law.damping, rate=law.rate.numpy(), inertial_rate=8.0)
    run = run_of(model, truth=nbs.PinocchioDynamics(robot), off=0.05)
    found = mismatch(model.dynamics, nbs.PinocchioDynamics(robot), run)
    empirical = replace(certify(law, 0.1 * BOUND), controller=model)
    plain = monitor(run, empirical)
    granted = monitor(run, replace(empirical, mismatch=found))
    little = monitor(run, replace(empirical, mismatch=found._replace(a=0.0, b=0.0, c=1e-3)))
    assert Assumption.MODEL in plain.broken
    assert Assumption.MODEL not in granted.broken
    assert Assumption.MODEL in little.broken
    assert np.isfinite(plain.storage).all()


def test_starts_of_a_batch_are_monitored_one_by_one(law, certificate):
    robot, starts = law.dynamics.robot, np.array([[0.1, 0.0], [0.0, 0.2], [-0.1, 0.1]])
    reference = Sinusoid.for_robot(robot, 2.0)
    q0 = reference(np.zeros(1)).q[0] + starts
    plant = nbs.DynamicsPlant(law.dynamics)
    run = nbs.simulate(plant, law, reference, 0.05, 0.001, q0=q0)
    for k in range(3):
        alone = monitor(nbs.simulate(plant, law, reference, 0.05, 0.001, q0=q0[k]), certificate)
        assert monitor(run, certificate, start=k).storage == pytest.approx(alone.storage, rel=1e-9)
    with pytest.raises(ArgumentError, match="start 3"):
        monitor(run, certificate, start=3)


def watched(watch, run):
    memory, said = None, []
    for k in range(len(run.t)):
        reference = Reference(run.q_ref[k], run.v_ref[k], run.a_ref[k])
        one, memory = watch.step(memory, float(run.t[k]), run.q[k], run.v[k], reference, run.tau[k], run.tau_command[k])
        said.append(one)
    return said


@pytest.mark.parametrize(
    "kept", [{}, {"off": 0.6, "effort_limit": 2.0}, {"torque": SquareWave(8.0 * BOUND, 9.0)}, {"torque": WAVE}], ids=str
)
@pytest.mark.parametrize("share", [1.0, 0.05])
def test_a_watch_says_live_what_the_monitor_says_afterwards(law, certificate, kept, share):
    """Of a certificate that promises too much too."""
    level = certificate.level._replace(storage=share * certificate.storage)
    certificate, run = replace(certificate, level=level), run_of(law, duration=0.06, **kept)
    seen = monitor(replace(run, disturbance=0.0 * run.disturbance), certificate)
    said = watched(Watch(certificate), run)
    for name in ("error", "error_bound", "storage", "promise"):
        assert [getattr(s, name) for s in said] == pytest.approx(getattr(seen, name), rel=1e-9)
    assert [not s.is_kept for s in said] == seen.exceeded.tolist()
    assert said[-1].broken == seen.broken
    assert said[0].balance is None
    assert said[5].balance.change[0] == pytest.approx(seen.balance.change[4], rel=1e-9, abs=1e-9)
    assert any("the certificate is wrong" in s.verdict for s in said) == (share < 1.0 and kept.get("torque") is WAVE)
    assert all(s.verdict.startswith("promise kept") for s in said) == seen.is_kept


def test_a_watch_wants_instants_in_order(law, certificate):
    run, watch = run_of(law, duration=0.01), Watch(certificate)
    reference = Reference(run.q_ref[0], run.v_ref[0], run.a_ref[0])
    row = (run.q[0], run.v[0], reference, run.tau[0], run.tau_command[0])
    _, memory = watch.step(None, 0.5, *row)
    with pytest.raises(ArgumentError, match="in order"):
        watch.step(memory, 0.5, *row)


def test_a_run_of_another_arm_is_refused(law, certificate):
    run = run_of(NeuralBackstepping.for_robot(nbs.load_robot("ur5")), duration=0.01)
    with pytest.raises(ArgumentError, match="of the arm 'ur5'"):
        monitor(run, certificate)
    with pytest.raises(ArgumentError, match="6 joints"):
        monitor(replace(run, robot_sha256=""), certificate)
    own = run_of(law, duration=0.01)
    assert monitor(replace(own, robot_sha256=""), certificate).is_kept
    with pytest.raises(ArgumentError, match="give a run of that arm"):
        monitor(replace(own, robot_sha256="0" * 64), certificate)


def test_what_is_no_certificate_or_no_run_is_refused(law, certificate, without_type_checks):
    run = run_of(law, duration=0.01)
    with pytest.raises(ArgumentError, match="certificate is a NeuralBackstepping; give a Certificate"):
        monitor(run, law)
    with pytest.raises(ArgumentError, match="give the certificate"):
        Watch(law)
    with pytest.raises(ArgumentError, match="run is a Certificate; give what simulate returned"):
        monitor(certificate, certificate)


@pytest.mark.parametrize("admissible", [Admissible(box=np.array([1.0, 2.0])), Admissible(radius=1.5)])
def test_beyond_is_the_least_torque_to_take_away(admissible):
    rng = np.random.default_rng(0)
    torque = rng.normal(0.0, 3.0, (200, 2))
    rest = beyond(admissible, torque)
    assert admissible.contains(torque - rest)
    inside = np.array([admissible.contains(row) for row in torque])
    assert np.array_equal(~inside, rest.any(axis=-1))
    for other in admissible.towards(rng.normal(size=(50, 2))):
        assert (np.linalg.norm(torque - other, axis=-1) >= np.linalg.norm(rest, axis=-1) - 1e-12)[~inside].all()
    size = np.linalg.norm(rest, axis=-1)
    granted = np.linalg.norm(beyond(admissible, torque, np.full(200, 0.5)), axis=-1)
    assert granted == pytest.approx(np.maximum(size - 0.5, 0.0), abs=1e-12)


def test_storage_of_many_states_is_that_of_each(law):
    rng = np.random.default_rng(0)
    rows = [rng.normal(size=(3, 1500, 2)) for _ in range(7)]
    at = LoopSamples(np.zeros((3, 1500)), *rows)  # more than fit at once
    few = law.storage(*(x[:, ::500] for x in rows[:4]))
    assert storage_of(law, at)[:, ::500] == pytest.approx(few, rel=1e-12)


def pixels(path, colour):
    """How many pixels of the picture have that colour, or nearly."""
    return int((np.abs(imread(path)[..., :3] - to_rgb(colour)).max(axis=-1) < 0.02).sum())


def test_pictures_show_what_they_are_of(law, certificate, fallen, tmp_path):
    """Every line and bar leaves its colour, and none where there is nothing to show."""
    found = attack(law, BOUND, duration=0.05, rounds=1, starts=1)
    with_attack = plot_certificate(certificate, found, tmp_path / "certificate.png")
    bounds = plot_certificate(certificate, None, tmp_path / "bounds.png")
    assert pixels(with_attack, ERROR) > 300  # the worst motion, and the bars of what was found
    assert pixels(bounds, ERROR) == 0
    kept = plot_monitor(monitor(found.run, certificate), tmp_path / "kept.png")
    broken = plot_monitor(fallen, tmp_path / "broken.png")
    assert min(pixels(kept, colour) for colour in (ACTUAL, LIMIT, ERROR, REFERENCE, TORQUE)) > 100
    assert pixels(broken, SATURATED) > 100 > pixels(kept, SATURATED)
    joint = replace(certificate, joint_errors=0.1 * found.joint_errors)
    of_joint = plot_monitor(monitor(found.run, joint), tmp_path / "joint.png")
    assert pixels(of_joint, "#7a4fa3") > pixels(kept, "#7a4fa3") + 100


def test_the_torque_seen_is_told_beside_the_declared_one_and_changes_no_verdict(law, certificate):
    run = run_of(law, torque=WAVE, duration=1.0)
    seen = monitor(run, certificate)
    observed = nbs.MomentumObserver(law.dynamics).observe(run)
    assert np.array_equal(seen.external.torque, observed.torque)
    assert np.array_equal(seen.external.declared, BOUND)
    assert (seen.external.largest <= BOUND * 1.001).all()  # a mean of admissible torques is admissible
    assert (seen.external.largest > 0.9 * BOUND).all()
    assert "declared" in str(seen.external)
    assert "more than" not in str(seen.external)
    assert seen.verdict == "promise kept"
    pushed = monitor(run_of(law, torque=ConstantTorque([1.0, 4.0]), duration=1.0), certificate)
    told = "the momentum shows at most 4 N·m from outside on joint2, of 3 N·m declared"
    assert str(pushed.external) == f"{told}; more than declared on 1 of 2 joints"
    assert Assumption.DISTURBANCE in pushed.broken  # by the balance of power, not by the observer


def test_the_torque_seen_of_a_ball_is_a_norm(law):
    seen = monitor(run_of(law, torque=ConstantTorque([3.0, 4.0]), duration=1.0), certify(law, 6.0)).external
    assert seen.size == pytest.approx(5.0, abs=1e-3)
    assert str(seen) == "the momentum shows at most 5 N·m from outside, of 6 declared"


def test_friction_that_is_fed_forward_is_no_torque_from_outside(robot):
    friction = JointFriction(viscous=[0.5, 0.3], coulomb=[1.0, 0.5], transition=0.1)
    law = NeuralBackstepping.for_robot(robot, bandwidth=8.0, friction=friction)
    run = run_of(law, friction=friction, duration=0.5)
    assert monitor(run, certify(law, BOUND)).external.largest.max() < 0.01


def test_a_row_that_is_not_finite_is_not_observed(law, certificate):
    run = run_of(law, torque=ConstantTorque([1.0, 1.0]), duration=0.5)
    q = run.q.copy()
    q[200:210] = np.nan
    seen = monitor(replace(run, q=q), certificate).external
    assert np.isnan(seen.torque[200:210]).all()
    assert np.isfinite(np.delete(seen.torque, np.s_[200:210], axis=0)).all()
    assert np.isfinite(seen.largest).all()
    assert np.allclose(seen.torque[-1], 1.0, atol=1e-3)
