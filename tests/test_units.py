"""Units belong to the joint: whatever is said of one that slides is in m and N, of one that turns in rad and N·m."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.units import SLIDING, TURNING, by_quantity, column, over_joints, several, units
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.commands.robots import _cells, describe
from nbs_pin.reports.plotting import plot_tracking
from tests.commands import printed_by, summary

GANTRY = Path(__file__).parent / "data" / "gantry.urdf"  # prismatic, revolute and continuous
JOINTS = ("rail", "hinge", "spin")
TURNS = re.compile(r"\d (rad|N·m)")
SLIDES = re.compile(r"\d (m|N)\b(?!·)")


def check_rows(printed):
    """Every row that begins with a joint's name has numbers in the units of that joint, and one of each has some."""
    rows = {line.split()[0]: line for line in printed.splitlines() if line.split() and line.split()[0] in JOINTS}
    assert rows.keys() == set(JOINTS)
    for joint, row in rows.items():
        own, others = (SLIDES, TURNS) if joint == "rail" else (TURNS, SLIDES)
        assert own.search(row), row
        assert not others.search(row), row


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gantry") / "run"
    return folder, printed_by("track", GANTRY, "-v", "--duration", "0.05", "--start-error", "0.05", "--out", folder)


def test_units_are_those_of_the_quantities():
    mixed = [True, False]
    assert units("torque", mixed) == ("N", "N·m")
    assert several(units("position", mixed)) == several(units("position", mixed[::-1])) == "rad, m"
    assert by_quantity(mixed)["stiffness"] == ["N/m", "N·m/rad"]
    assert column("peak", ["1", "none"], ["N", "N·m"]) == ("peak", ["1 N", "none"])
    assert column("peak", ["1", "2"], ["N·m", "N·m"]) == ("peak\n[N·m]", ["1", "2"])
    for turning, sliding in zip(TURNING, SLIDING, strict=True):
        assert over_joints(turning, [False, False]) == turning
        assert over_joints(turning, [True]) == sliding
        assert set(over_joints(turning, mixed).split(", ")) == {turning, sliding}
    assert over_joints("1/s", mixed) == "1/s"


def test_track_prints_stores_and_draws_the_units_of_each_joint(tracked, tmp_path, monkeypatch):
    folder, printed = tracked
    check_rows(printed)
    assert "‖error‖ stays below 0.1 rad, m" in printed
    assert summary(folder)["figures"]["units"]["torque"] == ["N", "N·m", "N·m"]
    run = nbs.Run.load(folder / "run.npz")
    assert run.prismatic.tolist() == [True, False, False]
    drawn = []
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda figure, *_, **__: drawn.append(figure))
    plot_tracking(run, tmp_path / "picture.png")
    grid = np.array(drawn[0].axes).reshape(3, 3)
    for axes, unit in ((grid[0, 0], "[m]"), (grid[0, 2], "[N]"), (grid[1, 1], "[rad]"), (grid[2, 2], "[N·m]")):
        assert unit in [text.get_text() for text in axes.texts]
    assert [axes.get_title(loc="left") for axes in grid[0]] == ["position", "|error|", "torque"]
    assert '"position":"m"' in (folder / "replay.html").read_text()


def test_a_run_of_an_earlier_version_is_taken_to_turn(tracked, tmp_path):
    run = dataclasses.replace(nbs.Run.load(tracked[0] / "run.npz"), prismatic=None)
    run.save(tmp_path / "old.npz")
    again = nbs.Run.load(tmp_path / "old.npz")
    assert again.prismatic is None
    assert {of.position for of in again.units} == {"rad"}


def test_collect_prints_the_units_of_each_joint(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    folder = tmp_path / "data"
    check_rows(printed_by("collect", GANTRY, "-v", "--samples", "60", "--recipe", "uniform", "--out", folder))
    assert summary(folder)["figures"]["units"]["acceleration"] == ["m/s²", "rad/s²", "rad/s²"]


def test_certificates_state_the_units_of_each_joint():
    robot = nbs.load_robot(GANTRY)
    law = nbs.NeuralBackstepping.for_robot(robot)
    certificate = nbs.certify(law, [1.0, 2.0, 3.0])
    assert certificate.disturbance == "|τ_d,i| ≤ (1 N, 2 N·m, 3 N·m)"
    assert certificate.summary()["disturbance"] == certificate.disturbance
    named = {line.name: line.unit for line in certificate.lines}
    assert (named["|z1| of rail"], named["|z1| of hinge"], named["‖z1‖"]) == ("m", "rad", "rad, m")
    whole = [line.unit for line in certificate.lines if line.unit in TURNING and "|z1|" not in line.name]
    assert not whole  # what is said of all joints is not said in the units of those that turn alone
    assert nbs.certify(law, 1.0).disturbance == "‖τ_d‖ ≤ 1 N·m, N"
    turning = nbs.load_robot("two_link")
    assert nbs.certify(nbs.NeuralBackstepping.for_robot(turning), 5.0).disturbance == "‖τ_d‖ ≤ 5 N·m"
    assert str(Admissible.of([1.0, 1.0], 2)) == "|τ_d,i| ≤ 1 N·m on every joint"


def test_the_weakest_motor_is_told_in_its_units():
    robot = nbs.load_robot(GANTRY)
    assert _cells(describe("gantry", robot))[2] == "400 N, 10 to 60"
    with pytest.warns(UserWarning, match=r"joint 'rail' of gantry needs .* from an error of 0\.3 m"):
        nbs.NeuralBackstepping.for_robot(robot.with_effort_limit([0.1, 1e6, 1e6]))


@pytest.mark.parametrize(("name", "unit"), [(GANTRY, "N·m, N"), ("two_link", "N·m")])
def test_limits_and_bounds_are_asked_for_in_the_units_of_the_joints(name, unit):
    robot = nbs.load_robot(name)
    with pytest.raises(nbs.ArgumentError, match=rf"expected one number > 0 or {robot.nv} of them \[{unit}\]"):
        robot.with_effort_limit(-1.0)
    with pytest.raises(nbs.ArgumentError, match=r"one on each \|τ_d,i\| \[N·m, N where it slides\]"):
        Admissible.of([1.0] * 9, robot.nv)
