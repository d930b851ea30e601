"""The demos run and show what their first lines promise."""

import contextlib
import io
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

import nbs_pin as nbs

DEMOS = Path(__file__).parent.parent / "demos"


def run_demo(name, folder, call):
    """What `call` of the demo's `main` returns, as JSON, and what it printed."""
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as printed:
        demo = runpy.run_path(str(DEMOS / f"{name}.py"))
        found = eval(call, {"main": demo["main"], "nbs": nbs})
    return json.loads(json.dumps(found)), printed.getvalue()


def test_every_demo_says_first_what_to_see():
    demos = sorted(DEMOS.glob("*.py"))
    assert len(demos) >= 5
    for demo in demos:
        assert '"""' in demo.read_text()[:3], demo.name


def test_every_demo_is_run_here():
    run = set(re.findall(r'run_demo\(\s*"(\w+)"', Path(__file__).read_text()))
    assert run == {demo.stem for demo in DEMOS.glob("*.py")}


def test_a_demo_is_a_program(tmp_path):
    """In an interpreter of its own, as a reader types it."""
    program = [sys.executable, str(DEMOS / "any_urdf.py"), "two_link"]
    done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "Robot('two_link', 2 joints" in done.stdout
    assert (tmp_path / "out" / "demo" / "two_link.html").is_file()


def test_three_arms_meet_their_reference_and_leave_replays(tmp_path):
    results, printed = run_demo("three_arms", tmp_path, "main(duration=2.0)")
    for name in ("two_link", "three_link", "panda"):
        folder = tmp_path / "out" / "demo" / name
        assert sorted(path.name for path in folder.iterdir()) == ["replay.html", "run.npz", "tracking.png"]
        assert results[name]["near_after_s"] < 0.2
        assert results[name]["steady_error_rad"] < 1e-5
        assert results[name]["saturated_s"] < 0.2
    page = tmp_path / printed.strip().splitlines()[-1].removeprefix("Open ").removesuffix(" in a browser.")
    assert page.is_file()


def test_an_unknown_kilogram_is_bounded_and_a_known_one_is_nothing(tmp_path):
    errors, _ = run_demo("payload", tmp_path, "main(duration=2.5)")
    assert errors["NBS, no load"] < 1e-6
    assert errors["NBS, 1 kg known"] < 1e-6
    assert 3e-3 < errors["NBS, 1 kg unknown"] < 2e-2
    assert errors["computed torque, 1 kg unknown"] > 1.3 * errors["NBS, 1 kg unknown"]


def test_your_own_arm_tracks_and_a_slip_is_refused_by_line(tmp_path):
    (error, refusal), _ = run_demo("own_arm", tmp_path, "main(duration=3.0)")
    folder = tmp_path / "out" / "demo" / "own_arm"
    assert error < 1e-6
    assert (folder / "replay.html").stat().st_size > 100_000
    line = int(refusal.split("broken.urdf:")[1].split(":")[0])
    block = (folder / "broken.urdf").read_text().splitlines()[line - 1 : line + 3]
    assert "'nan'" in refusal
    assert any('mass value="nan"' in text for text in block)


def test_every_start_of_a_batch_converges_and_its_storage_never_rises(tmp_path):
    call = "(lambda r: [r.q.shape, nbs.metrics.convergence_time(r).tolist()])(main(starts=9, duration=1.0))"
    (shape, times), printed = run_demo("batch", tmp_path, call)
    assert shape == [501, 9, 2]
    assert max(times) < 0.3
    assert float(printed.rpartition("at most ")[2].split()[0]) < 1e-12
    assert printed.count("█") == 9


@pytest.mark.parametrize("epochs", [6])
def test_the_gradient_of_a_motion_is_right_and_lowers_its_cost(tmp_path, epochs):
    (disagreement, costs), _ = run_demo("torch_gradient", tmp_path, f"main(epochs={epochs})")
    assert disagreement < 1e-6
    assert len(costs) == epochs
    assert costs[-1] < 0.75 * costs[0]


def test_a_trained_controller_is_faster_and_its_storage_still_falls(tmp_path):
    figures, printed = run_demo("train_and_track", tmp_path, "main(epochs=15)")
    assert figures["share"] < 0.9
    assert figures["after"] < figures["before"]
    assert figures["rise"] < 1e-9
    folder = tmp_path / "out" / "demo" / "train"
    assert sorted(path.name for path in folder.iterdir()) == ["controller.nbs", "learning.png"]
    assert "lower the held-out cost by" in printed


def test_an_arm_by_name_or_path_is_tracked_and_replayed(tmp_path):
    error, printed = run_demo("any_urdf", tmp_path, "main('two_link', duration=1.0)")
    assert error < 1e-6
    assert "Robot('two_link', 2 joints" in printed
    assert (tmp_path / "out" / "demo" / "two_link.html").stat().st_size > 100_000


def test_the_hand_draws_its_circle_and_a_larger_one_is_refused(tmp_path):
    found, _ = run_demo("tool_circle", tmp_path, "main(duration=2.0)")
    assert found["error"] < 1e-6
    assert 0.5 < found["fastest"] < 2.0
    assert "circle of radius 0.6 m" in found["refusal"]


def test_a_switching_torque_passes_the_printed_bound_and_not_the_proved_one(tmp_path):
    errors, _ = run_demo("printed_bound", tmp_path, "main(duration=14.0)")
    assert errors["constant"] < errors["printed"] < errors["found"] <= errors["certified"]


def test_a_noisy_log_is_explained_up_to_its_noise(tmp_path):
    found, _ = run_demo("own_log", tmp_path, "main('two_link', samples=600)")
    assert found["over_noise"] < 2.5
    assert found["friction"] < 0.2
    assert (tmp_path / "out" / "demo" / "log" / "log.csv").read_text().startswith("t,trajectory,q_joint1,")


def test_faults_break_the_promise_and_an_honest_run_keeps_it(tmp_path):
    verdicts, _ = run_demo("faults", tmp_path, "main(duration=1.0)")
    assert verdicts["honest"] == "promise kept"
    assert "disturbance" in verdicts["torque too large"]
    assert "model" in verdicts["unknown load"]
    assert "effort limits" in verdicts["weak motor"]


def test_arms_nobody_tuned_follow_their_motions(tmp_path):
    errors, printed = run_demo("many_arms", tmp_path, "main(('two_link', 'z1'), duration=1.5)")
    assert max(errors.values()) < 1e-4
    assert printed.count("of a torque limit") == 2


def test_a_chain_learned_from_motions_is_the_arm_and_a_network_is_not(tmp_path):
    found, printed = run_demo("learned_model", tmp_path, "main('two_link', samples=300, iterations=5)")
    assert found["chain"] < 1e-8
    assert found["network"] > 1e-3
    assert found["tracking"] < 1e-5
    assert printed.count("torque off by") == 2


def test_the_row_of_the_paper_is_in_the_spread_and_its_index_is_most_of_the_error(tmp_path):
    rows, _ = run_demo("paper_row", tmp_path, "main(seeds=2).tolist()")
    for shifted, aligned, convergence, _ in rows:
        assert 1e-6 < shifted < 2e-6
        assert shifted > 10.0 * aligned
        assert 4.0 < convergence < 8.0


def test_two_kilograms_that_nobody_told_the_law_are_found_and_forgotten(tmp_path):
    found, _ = run_demo("adaptive", tmp_path, "main(duration=8.0)")
    assert found["adaptive"] < 0.1 * found["fixed"]
    assert abs(found["with"] - 2.0) < 0.1
    assert abs(found["after"]) < 0.1
    folder = tmp_path / "out" / "demo" / "adaptive"
    assert sorted(path.name for path in folder.iterdir()) == ["estimates.png", "replay.html"]
