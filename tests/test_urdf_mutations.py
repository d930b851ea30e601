"""Files broken at random: what is accepted is a sound arm, and what is refused is refused in our own words."""

import re
import warnings

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from nbs_pin.base.exceptions import RobotError
from nbs_pin.robots.catalogue import find
from nbs_pin.robots.robot import load_robot
from tests.test_urdf import write

ARM = find("two_link").path.read_bytes()

NASTY = [
    "nan", "inf", "-1", "0", "-0.0", "1e-320", "1e-12", "1e-6", "1e6", "1e20", "1e200", "1e400", "1_0", "0x10", "1,5",
    "٣", "2", "3.5", "-7", "''", "x", "9e-1",
]  # fmt: skip


def accepted(path):
    """The arm in the file, or None if it is refused in our own words."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            return load_robot(path)
        except RobotError:
            return None


def sound(robot, rng):
    """M(q) finite and positive definite at fresh configurations within the limits."""
    low = np.where(np.isfinite(robot.lower), robot.lower, -np.pi)
    high = np.where(np.isfinite(robot.upper), robot.upper, np.pi)
    data = robot.model.createData()
    for q in rng.uniform(low, high, (8, robot.nv)):
        mass = pin.crba(robot.model, data, q)
        scale = np.sqrt(np.diag(mass))
        if not np.isfinite(mass).all() or not np.linalg.eigvalsh(mass / scale / scale[:, None])[0] > 0:
            return False
    return True


@pytest.mark.parametrize("name", ["two_link", "three_link", "ur5"])
def test_whatever_mutated_numbers_are_accepted_give_a_sound_arm(name, tmp_path):
    """Of such files Pinocchio alone accepts a fifth with a singular, indefinite or non-finite M."""
    text = find(name).path.read_text()
    numbers = list(re.finditer(r'(?<==")[-+\d.e ]+(?=")', text))
    rng = np.random.default_rng(1)
    count = 0
    for trial in range(250):
        spot = numbers[rng.integers(len(numbers))]
        words = spot.group().split()
        words[rng.integers(len(words))] = NASTY[rng.integers(len(NASTY))]
        robot = accepted(write(tmp_path, text[: spot.start()] + " ".join(words) + text[spot.end() :]))
        assert robot is None or sound(robot, rng), (trial, spot.group(), words)
        count += robot is not None
    assert 25 < count < 225


@settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    where=st.integers(0, len(ARM)),
    cut=st.integers(0, 40),
    insert=st.one_of(
        st.binary(max_size=8), st.sampled_from([b"<", b">", b'"', b"<link/>", b"<joint/>", b"&x;", b"<!--"])
    ),
)
def test_broken_bytes_are_refused_by_our_own_errors_alone(where, cut, insert, tmp_path):
    robot = accepted(write(tmp_path, ARM[:where] + insert + ARM[where + cut :]))
    assert robot is None or sound(robot, np.random.default_rng(0))
