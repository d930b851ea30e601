"""`nbs-pin compare`: what it writes and prints, what it refuses, and what it says of models that are no good."""

import csv

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.accuracy.compare import compare
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.versions import versions
from nbs_pin.commands import compare as comparison
from nbs_pin.commands.results import Results
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.lagrangian import LagrangianDynamics
from nbs_pin.dynamics.registry import make_network
from nbs_pin.identification.datasets import Dataset
from nbs_pin.robots.catalogue import find
from tests.commands import check_results_are_kept_unless_forced, printed_by, refusal, summary

QUICK = ("--samples", "50", "--trajectories", "4")


@pytest.fixture(scope="module")
def wrong(tmp_path_factory):
    """A URDF of three_link whose links weigh 4 % more."""
    path = tmp_path_factory.mktemp("urdf") / "heavy.urdf"
    path.write_text(find("three_link").path.read_text().replace('mass value="1"', 'mass value="1.04"'))
    return str(path)


@pytest.fixture(scope="module")
def compared(wrong, tmp_path_factory):
    """Where it was compared, and what was printed."""
    folder = tmp_path_factory.mktemp("compared") / "three_link"
    return folder, printed_by("compare", wrong, *QUICK, "-v", "--out", folder, "--against", "three_link")


def run(folder, model, *options):
    return cli.main(["compare", str(model), *QUICK, "-v", "--out", str(folder), *options])


def test_the_summary_is_what_compare_finds(compared, wrong):
    said, robot = summary(compared[0]), nbs.load_robot("three_link")
    assert sorted(path.name for path in compared[0].iterdir()) == sorted(comparison.FILES)
    assert said["versions"] == versions()
    assert said["robot_sha256"] == robot.sha256
    assert said["settings"]["against"] == "three_link"
    assert len(said["settings"]["model_sha256"]) == 64
    model = nbs.PinocchioDynamics(nbs.load_robot(wrong))
    loop = comparison.closed_loop(model, robot, 4)
    found = compare(model, nbs.PinocchioDynamics(robot), samples=50, run=loop)
    figures = said["figures"]
    assert figures["relative_error"] == found.errors._asdict()
    assert figures["relative_error"]["gravity"] == pytest.approx(0.04)
    assert figures["mismatch"]["c_Nm"] == found.mismatch.c
    assert figures["mismatch"]["violation_chance"] > 0.9
    assert figures["energy_drift"] == found.energy_drift
    assert [entry["at"] for entry in figures["by_speed"]] == list(found.by_speed.at)


def test_the_table_and_the_csv_are_the_summary(compared):
    folder, printed = compared
    figures = summary(folder)["figures"]
    for name in ("mass_matrix", "coriolis", "gravity", "inverse", "forward"):
        assert f"{figures['relative_error'][name]:.3g}" in printed
        assert f"{figures['along_run'][name]:.3g}" in printed
    assert f"{figures['mismatch']['c_Nm']:.3g} N·m on 4 starts" in printed
    assert printed.splitlines()[-3:] == [str(folder / name) for name in comparison.FILES]
    rows = list(csv.DictReader((folder / "errors.csv").read_text(encoding="utf-8").splitlines()))
    cells = {(row["figure"], row["where"]): row["value"] for row in rows}
    assert len(cells) == len(rows)
    assert float(cells["coriolis_error", "box"]) == figures["relative_error"]["coriolis"]
    assert float(cells["gravity_error", "distance × 2"]) == figures["by_distance"][-1]["gravity"]
    assert float(cells["torque_rms_Nm", "joint2"]) == figures["torque_rms_Nm"][1]
    assert float(cells["mismatch_rms_Nm", "joint3"]) == figures["mismatch"]["rms_Nm"][2]
    assert float(cells["mismatch_c_Nm", "closed loop"]) == figures["mismatch"]["c_Nm"]


def saved_law(robot):
    """A law, and its model, whose gravity is its own."""
    model = nbs.AnalyticDynamics(gravity=9.0, robot=robot)
    return nbs.ComputedTorque(model, kp=9.0, kd=6.0), model


def learned(robot):
    model = LagrangianDynamics(make_network("cholesky", [False, False], seed=3, widths=(4,)), robot)
    return model, model


@pytest.mark.parametrize(("make", "wrong", "rounding"), [(saved_law, "gravity", 0.0), (learned, "mass_matrix", 1e-9)])
def test_a_model_in_a_file_is_held_against_its_arm(tmp_path, capsys, make, wrong, rounding):
    robot = nbs.load_robot("two_link")
    stored, model = make(robot)
    nbs.save(stored, tmp_path / "stored.nbs")
    assert run(tmp_path / "a", tmp_path / "stored.nbs", "--joints", "2,1", "--trajectories", "0") == 0
    figures = summary(tmp_path / "a")["figures"]
    expected = compare(model, nbs.PinocchioDynamics(robot), samples=50, motions=0).errors._asdict()
    assert figures["relative_error"] == pytest.approx(expected, rel=rounding, abs=0.0)
    assert expected[wrong] > 0.05
    assert figures["mismatch"] is None
    assert "no closed loop was run" in capsys.readouterr().out


def test_the_box_can_be_that_of_data(wrong, tmp_path):
    rng = np.random.default_rng(0)
    q, v = 0.3 + 0.1 * rng.normal(size=(20, 3)), rng.normal(size=(20, 3)) * [1.0, 2.0, 3.0]
    t, first = 0.01 * np.arange(20), np.zeros(20, dtype=int)
    Dataset(q, v, v, v, t, first, np.arange(3), np.zeros(3, dtype=bool)).save(tmp_path / "data.npz")
    assert run(tmp_path / "a", wrong, "--against", "three_link", "--data", str(tmp_path / "data.npz")) == 0
    box = summary(tmp_path / "a")["figures"]["box"]
    np.testing.assert_array_equal(box["lower_rad"], q.min(axis=0))
    np.testing.assert_array_equal(box["upper_rad"], q.max(axis=0))
    np.testing.assert_array_equal(box["speed_rad_per_s"], np.abs(v).max(axis=0))
    assert run(tmp_path / "b", "two_link", "--against", "two_link", "--data", str(tmp_path / "data.npz")) == 2


def test_a_recorded_run_can_be_the_closed_loop(wrong, tmp_path, capsys):
    robot = nbs.load_robot("three_link")
    law = nbs.ComputedTorque(nbs.PinocchioDynamics(nbs.load_robot(wrong)), kp=100.0, kd=20.0)
    recorded = nbs.simulate(nbs.MujocoPlant(robot), law, nbs.Sinusoid.for_robot(robot, 1.0), 0.2, 0.002)
    recorded.save(tmp_path / "run.npz")
    assert run(tmp_path / "a", wrong, "--against", "three_link", "--along", str(tmp_path / "run.npz")) == 0
    assert "1 start is too few to bound further ones" in capsys.readouterr().out
    assert summary(tmp_path / "a")["figures"]["mismatch"]["trajectories"] == 1
    assert run(tmp_path / "b", wrong, "--against", "two_link", "--along", str(tmp_path / "run.npz")) == 2


def test_a_run_with_joint_friction_is_refused():
    """Its torques do not tell the acceleration, so friction would count as the model's error."""
    robot = nbs.load_robot("two_link")
    plant = nbs.MujocoPlant(robot, joint_friction=JointFriction(np.full(2, 0.5), np.full(2, 0.1)))
    law = nbs.ComputedTorque(nbs.PinocchioDynamics(robot), kp=100.0, kd=20.0)
    recorded = nbs.simulate(plant, law, nbs.Sinusoid.for_robot(robot, 1.0), 0.1, 0.002)
    with pytest.raises(ArgumentError, match="friction acted"):
        comparison.compare_models(nbs.PinocchioDynamics(robot), robot, samples=20, run=recorded)


def test_a_model_whose_law_is_unstable_still_has_its_errors(tmp_path):
    """Gravity beyond all measure: what the closed loop does is a result, not a crash."""
    robot = nbs.load_robot("two_link").with_effort_limit(np.inf)
    model = nbs.AnalyticDynamics(masses=(1e-3, 1e6), gravity=1e9, robot=robot)
    result = comparison.compare_models(model, robot, samples=20, trajectories=3)
    assert result.missing.startswith("the closed loop diverged")
    assert result.errors.mismatch is None
    assert result.errors.gravity > 100.0
    comparison.write_results(result, robot, Results(tmp_path, {}), "unstable")
    assert summary(tmp_path)["figures"]["no_closed_loop_because"].startswith("the closed loop diverged")


def test_an_arm_of_one_joint_has_no_map(tmp_path):
    robot = nbs.load_robot("two_link", lock=["joint2"])
    truth = nbs.PinocchioDynamics(robot)
    result = comparison.compare_models(truth, robot, samples=20, trajectories=0)
    assert result.heat is None
    comparison.write_results(result, robot, Results(tmp_path, {}), "one joint")
    assert (tmp_path / "errors.png").stat().st_size > 10_000


def test_results_of_another_comparison_are_kept_unless_forced(tmp_path, capsys):
    def again(folder, *options):
        return run(folder, "two_link", "--against", "two_link", "--trajectories", "0", *options)

    check_results_are_kept_unless_forced(again, tmp_path, ["--seed", "5"], "of another comparison", capsys)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("three_link", "give --against ROBOT"),
        ("three_link --against two_link", "the model has 3 joints"),
        ("none.nbs", "none.nbs"),
        ("three_link --against three_link --joints 2", "--joints is '2'; give two joints by number"),
        ("three_link --against three_link --joints 2,9", "give two different ones of 1 to 3"),
        ("three_link --against three_link --joints 1,1", "give two different ones of 1 to 3"),
        ("three_link --against three_link --speed 0", "--speed is '0'"),
        ("three_link --against three_link --samples 1", "--samples is '1'"),
        ("three_link --against three_link --data none.npz", "none.npz"),
        ("three_link --against three_link --along none.npz", "none.npz"),
        ("three_link --agains three_link", "did you mean --against?"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_a_sentence(tmp_path, capsys, options, words):
    model, *rest = options.split()
    assert words in refusal(run(tmp_path / "a", model, *rest), capsys)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("name", ["data.npz", "summary.json", "model.NBS", "gone.npz"])
def test_a_file_that_is_no_model_is_refused_as_such(tmp_path, capsys, name):
    if name != "gone.npz":
        (tmp_path / name).write_bytes(b"PK\x03\x04\xff\xfe")
    for options in ((), ("--against", "three_link")):
        line = refusal(run(tmp_path / "a", tmp_path / name, *options), capsys)
        assert f"{name}' is neither a model nor an arm; give a .nbs file with a model, or an arm" in line
        assert "UTF-8" not in line


def test_a_law_without_a_model_is_refused(tmp_path, capsys):
    nbs.save(nbs.PID.for_robot(nbs.load_robot("two_link")), tmp_path / "pid.nbs")
    code = run(tmp_path / "a", tmp_path / "pid.nbs", "--against", "two_link")
    assert "PID, which has no model of its arm" in refusal(code, capsys)
