"""The bench measures what it says and notices what moved; no time is asserted."""

import json

import numpy as np
import pytest

from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.benchmarks import bench
from nbs_pin.benchmarks.exported import can_compile
from nbs_pin.benchmarks.serial_chains import serial_chain
from nbs_pin.cli import main
from nbs_pin.dynamics.pinocchio import PinocchioDynamics


@pytest.mark.parametrize("joints", [1, 4, 30])
def test_a_chain_is_an_arm_of_that_many_joints_and_that_mass(joints):
    robot = serial_chain(joints, reach=2.0, mass=6.0)
    assert robot.nv == joints
    assert sum(inertia.mass for inertia in robot.model.inertias) == pytest.approx(6.0)
    mass = PinocchioDynamics(robot).mass_matrix(np.zeros(joints))
    assert np.linalg.eigvalsh(mass).min() > 0.0


def test_rows_carry_their_percentiles_in_order(monkeypatch):
    monkeypatch.setattr(bench, "LAWS", ("nbs", "pid"))
    rows = list(bench.bench(("two_link",), calls=1000, chains=(2,)))
    control = [row for row in rows if row.what == "control step"]
    assert [row.how for row in control] == ["nbs", "pid"]
    for row in control:
        figures = row.figures
        assert 0.0 < figures["p50_us"] <= figures["p99_us"] <= figures["p99.9_us"] <= figures["max_us"]
        assert figures["over_two_rnea"] == pytest.approx(figures["p50_us"] / figures["two_rnea_us"])
    kinds = {"control step", "guarded step", "plant step", "simulate", "model torque", "joints", "training epoch"}
    kinds |= {"step in C", "joints in C"} if can_compile() else set()
    assert {row.what for row in rows} == kinds
    for row in rows:
        if row.what == "step in C":
            assert row.figures["python_over_c"] == pytest.approx(row.figures["python_us"] / row.figures["p50_us"])
        if row.what == "guarded step":
            assert row.figures["guard_us"] == pytest.approx(row.figures["p50_us"] - row.figures["law_us"])
    assert {row.how for row in rows if row.what == "model torque"} == {"pinocchio", "chain", "cholesky"}
    assert len({row.key for row in rows}) == len(rows)
    json.dumps(bench.summary(rows), allow_nan=False)


def test_compare_names_what_moved_by_more_than_a_tenth():
    new = [bench.Row("control step", "panda", "nbs", {"p50_us": 12.0, "max_us": 105.0, "fresh": 1.0})]
    old = {
        "rows": [{"what": "control step", "arm": "panda", "how": "nbs", "figures": {"p50_us": 10.0, "max_us": 100.0}}]
    }
    assert bench.compare(new, bench.rows_of(old)) == [("control step/panda/nbs", "p50_us", 10.0, 12.0)]
    for wrong in ({}, [], {"rows": [{}]}, {"rows": 1}):
        with pytest.raises(ArgumentError, match=r"is not a summary\.json of a bench"):
            bench.rows_of(wrong)


def test_an_hour_in_short_keeps_its_memory_and_its_error():
    row = bench.endurance_row(serial_chain(2), duration=60.0)
    assert row.figures["last_over_first_error"] == pytest.approx(1.0, rel=0.2)
    assert row.figures["memory_growth_MB"] < 5.0


def test_the_command_writes_its_summary_and_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "LAWS", ("pd-plus",))
    monkeypatch.setattr(bench, "bench", lambda arms, calls, long: iter(
        [bench.control_row(serial_chain(n), "pd-plus", 1000, what="joints") for n in (1, 2)]))  # fmt: skip
    assert main(["bench", "--arms", "two_link", "--out", str(tmp_path / "a")]) == 0
    assert main(["bench", "--out", str(tmp_path / "b"), "--compare", str(tmp_path / "a" / "summary.json")]) == 0
    assert json.loads((tmp_path / "b" / "summary.json").read_text())["rows"][1]["arm"] == "chain_2"
    assert (tmp_path / "b" / "joints.png").stat().st_size > 5000
    (tmp_path / "no.json").write_text("{")
    assert main(["bench", "--compare", str(tmp_path / "no.json")]) == 2
    assert "is not JSON" in capsys.readouterr().err


def test_too_few_calls_are_refused():
    with pytest.raises(ArgumentError, match="calls is 10, expected at least 1000"):
        next(bench.bench(calls=10))
