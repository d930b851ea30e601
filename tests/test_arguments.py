"""Arguments of public functions: hostile ones are refused in a sentence, callbacks cannot write, threads may share."""

import math
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, strategies as st

import nbs_pin as nbs
from nbs_pin.base.arguments import checked, count, number
from nbs_pin.base.checks import LARGEST, all_finite, floats, integral, is_usual, real
from nbs_pin.dynamics.registry import make_network

sys.path.insert(0, str(Path(__file__).parent.parent / "tools"))

ROBOT = nbs.load_robot("two_link")
LAW = nbs.NeuralBackstepping.for_robot(ROBOT)
PLANT = nbs.DynamicsPlant.for_robot(ROBOT)
MOTION = nbs.Sinusoid.for_robot(ROBOT)


@given(st.floats(), st.floats(-1e3, 1e3), st.floats(0.0, 1e3))
def test_a_number_is_taken_exactly_if_it_lies_in_its_range(x, least, width):
    check = number(least=least, most=least + width)
    if math.isfinite(x) and least <= x <= least + width:
        assert check("x", x) == x
    else:
        with pytest.raises(nbs.ArgumentError, match=r"^x is .*; give a finite number"):
            check("x", x)


@given(st.one_of(st.integers(), st.floats(), st.booleans(), st.complex_numbers(), st.text(), st.none()))
def test_a_count_is_a_whole_number_whatever_its_type(x):
    is_whole = not isinstance(x, bool | str | complex) and x is not None and math.isfinite(x) and x == int(x)
    assert (integral(x) == x) if is_whole else integral(x) is None
    try:
        assert count(0, 10)("x", x) == x
    except nbs.ArgumentError:
        assert not (is_whole and 0 <= x <= 10)


@pytest.mark.parametrize(
    "value",
    [
        np.ma.masked_array([0.1, 0.2], mask=[False, True]),
        [np.ma.masked, 0.1],
        np.array([1j, 0.0]),
        np.array(["0.1", "0.2"]),
        np.array(["2026-01-01"], dtype="datetime64[D]"),
        np.array([True, False]),
        [0.1, None],
        [[0.1], [0.1, 0.2]],
        torch.zeros(2, requires_grad=True),
        [torch.tensor(0.1, requires_grad=True)],
        np.broadcast_to(0.0, (10**6, 10**6)),
        range(10**12),
        "0.1",
        None,
        object(),
        (x for x in (0.1, 0.2)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_only_real_numbers_become_arrays(value):
    with pytest.raises(nbs.ArgumentError, match=r"^q "):
        floats("q", value)


@given(st.lists(st.one_of(st.integers(-(2**40), 2**40), st.floats(width=32)), min_size=1))
def test_numbers_become_the_same_array_however_they_are_given(values):
    for form in (values, tuple(values), np.array(values, dtype=float), np.array(values, dtype=">f8")):
        assert np.array_equal(floats("q", form), np.array(values, dtype=float), equal_nan=True)
    assert all(real(x) == x or math.isnan(x) for x in values)


def test_the_sentence_names_the_function_the_argument_what_was_given_and_what_to_give():
    @checked(speed=number(above=0.0, most=2.0, unit="m/s"))
    def move(far, speed=1.0):
        return far * speed

    assert move(3.0) == move(3.0, speed=np.float32(1.0)) == move(3, 1) == 3.0
    for call in (lambda: move(1.0, -1), lambda: move(1.0, speed=-1)):
        with pytest.raises(nbs.ArgumentError) as error:
            call()
        assert str(error.value).endswith("move: speed is -1; give a finite number > 0 and at most 2 [m/s].")


@pytest.mark.parametrize(
    "seed", [-1, math.nan, 2**70, 1.5, "1", None, np.asmatrix([1.0, 2.0]), [1, 2]], ids=lambda seed: type(seed).__name__
)
def test_seeds_are_whole_numbers(seed):
    doors = [
        lambda: nbs.train(LAW, PLANT, [MOTION], starts=1, duration=0.02, period=0.01, epochs=1, seed=seed),
        lambda: nbs.collect(ROBOT, "uniform", 10, seed),
        lambda: nbs.NeuralBackstepping.for_robot(ROBOT, seed=seed),
        lambda: nbs.TorqueNoise(1.0, 0.01, seed),
        lambda: nbs.attack(LAW, 1.0, seed=seed),
        lambda: nbs.compare(PLANT.dynamics, PLANT.dynamics, seed=seed),
    ]
    for door in doors:
        with pytest.raises(nbs.ArgumentError, match="seed is"):
            door()


@pytest.mark.parametrize(
    ("arguments", "limit"),
    [
        ({"plant_step": 1e-12}, "expected at most 100000"),
        ({"duration": 1e6, "period": 1e-5}, r"expected at most 1e\+07"),
        ({"duration": 1e4, "q0": np.zeros((1000, 2))}, "more than 1073741824 numbers"),
        ({"workers": 10**6}, "from 1 to 1024"),
        ({"period": 1e-308}, "> 0"),
    ],
)
def test_one_argument_cannot_ask_for_work_without_end(arguments, limit):
    with pytest.raises(nbs.ArgumentError, match=limit):
        nbs.simulate(PLANT, LAW, MOTION, **({"duration": 0.05, "period": 0.001} | arguments))


def test_callbacks_cannot_write_into_the_loop_and_what_they_raise_is_named():
    def writes(t, q, v):
        q *= 1.5
        return 0.0 * q

    def fails(t):
        raise KeyError("user code")

    loop = (PLANT, LAW, MOTION, 0.01, 0.001)
    with pytest.raises(nbs.ArgumentError, match=r"the disturbance raised ValueError .*read-only") as error:
        nbs.simulate(*loop, disturbance=writes)
    assert isinstance(error.value.__cause__, ValueError)
    with pytest.raises(nbs.ArgumentError, match="the reference raised KeyError"):
        nbs.check_reference(fails, ROBOT, 1.0)
    kept = nbs.simulate(*loop, disturbance=lambda t, q, v: 0.0 * q)
    assert np.array_equal(kept.q, nbs.simulate(*loop).q)


def test_a_plant_that_writes_into_its_arguments_does_not_change_the_record():
    class Careless(nbs.DynamicsPlant):
        def step(self, q, v, tau, duration):
            after = super().step(q, v, tau, duration)
            q[:], v[:] = 7.0, 7.0
            return after

    careless = nbs.simulate(Careless(PLANT.dynamics), LAW, MOTION, 0.01, 0.001)
    assert np.array_equal(careless.q, nbs.simulate(PLANT, LAW, MOTION, 0.01, 0.001).q)


def in_threads(function, rows, rounds=300):
    """Whether `function` gives every thread what it gives alone."""
    alone = [function(row) for row in rows]

    def agrees(k):
        return all(np.array_equal(function(rows[k]), alone[k]) for _ in range(rounds))

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(len(rows)) as pool:
            return all(pool.map(agrees, range(len(rows))))
    finally:
        sys.setswitchinterval(before)


def test_one_compiled_law_one_plant_and_one_watch_serve_many_threads():
    states, zero = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 2, 2)), np.zeros(2)
    law, plant = LAW.compile(), nbs.MujocoPlant(ROBOT)
    assert in_threads(lambda x: law.torque(*x, zero, zero, zero), states)
    assert in_threads(lambda x: np.array(plant.step(*x, zero, 0.001)), states)
    assert in_threads(lambda x: plant.mass_matrix(x[0]), states)
    assert in_threads(lambda x: np.array(PLANT.step(*x, zero, 0.001)), states)
    assert in_threads(lambda x: PLANT.dynamics.reference_torque(*x, zero, zero), states)
    network = nbs.LagrangianDynamics(make_network("cholesky", [False, False], seed=0), ROBOT)  # no tree: another kernel
    learned = nbs.NeuralBackstepping.for_robot(ROBOT, dynamics=network).compile()
    assert in_threads(lambda x: learned.torque(*x, zero, zero, zero), states)
    pid = nbs.PID.for_robot(ROBOT).compile()
    rest, aim = pid.initial_memory(zero), nbs.Reference(zero, zero, zero)
    assert in_threads(lambda x: pid.step(rest, *x, aim, 0.001)[0], states)
    watch, aim = nbs.Watch(nbs.certify(LAW, [5.0, 5.0])), nbs.Reference(zero, zero, zero)
    _, memory = watch.step(None, 0.0, zero, zero, aim, zero, zero)
    assert in_threads(lambda x: watch.step(memory, 0.001, *x, aim, zero, zero)[0].storage, states)


@pytest.mark.parametrize("large", [1e160, 1e200, 1.7e308])
def test_finite_numbers_never_give_a_torque_that_is_none(large):
    zero, q = np.zeros(2), np.array([large, 0.0])
    for law in (LAW, LAW.compile(), nbs.ComputedTorque.for_robot(ROBOT), nbs.PD.for_robot(ROBOT).compile()):
        for state in ((q, zero), (zero, q)):
            with np.errstate(over="ignore", invalid="ignore"), suppress(nbs.ArgumentError):
                assert np.isfinite(law.torque(*state, zero, zero, zero)).all()
    assert large > LARGEST


@pytest.mark.filterwarnings("ignore")
def test_hostile_arguments_meet_a_sentence_at_every_door(tmp_path, monkeypatch):
    from fuzz_api import FAULTS, attempt

    monkeypatch.chdir(tmp_path)  # some name files to write
    found = [attempt(0, call, quick=True) for call in range(1000)]
    assert not [outcome for outcome in found if outcome.kind in FAULTS]
    assert len({outcome.door for outcome in found}) > 150


@pytest.mark.parametrize("size", [3, 4096, 4097, 100_000])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 10.0 * LARGEST])
def test_one_bad_number_is_found_in_short_and_in_long_arrays(size, bad):
    x = np.linspace(-1.0, 1.0, size)
    assert is_usual(x)
    assert all_finite(x)
    x[size // 2] = bad
    assert not is_usual(x)
    assert all_finite(x) == bool(np.isfinite(bad))
    x[size // 2] = 0.9 * LARGEST
    assert is_usual(x)
