"""Reports: what is on the page of the results of commands, and what a browser makes of it."""

import json
import re
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.certificates.tip_bound import tip_bound
from nbs_pin.cli.shell import parse
from nbs_pin.reports.report import report
from nbs_pin.reports.scene import positions
from nbs_pin.reports.verdicts import BAD, GOOD, verdict_of
from nbs_pin.robots.visuals import tips
from nbs_pin.simulation.run_figures import figures as tracking_figures
from tests.browser import Browser, find_chromium
from tests.test_replay import moving_run


def folder_of(where, run, **more):
    """A folder of results, as track writes it."""
    where.mkdir()
    run.save(where / "run.npz")
    robot = nbs.load_robot(run.robot)
    summary = {
        "settings": {"robot": run.robot, "seed": 3},
        "versions": {"nbs_pin": "9.9"},
        "figures": tracking_figures(run, robot),
    }
    (where / SUMMARY).write_text(json.dumps(summary | more))
    return where


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Results of two runs of one arm, of which the first does not converge."""
    folder, run = tmp_path_factory.mktemp("results"), moving_run(nbs.load_robot("two_link"), duration=1.0)
    better = nbs.Run(**{**vars(run), "q": run.q_ref + 0.01 * (run.q - run.q_ref)})
    typed = "nbs-pin track two_link --out '</script><b>'"
    return [folder_of(folder / "first", run, command=typed), folder_of(folder / "second", better)]


def test_the_page_has_verdicts_figures_command_and_seed_and_reaches_no_address(folders, tmp_path):
    text = report(folders, tmp_path / "a.html").read_text()
    shown = re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert shown.index("Not converged") < shown.index("Converged: from") < shown.index("Side by side")
    assert "--out &#x27;&lt;/script&gt;&lt;b&gt;&#x27;" in shown
    assert "nbs_pin 9.9 · seed 3" in shown
    late = tracking_figures(nbs.Run.load(folders[0] / "run.npz"))["rms_error_late_rad"]
    assert f"{late[0]:.3g} rad ({np.degrees(late[0]):.3g}°)" in shown
    without = re.sub(r'<script type="text/plain" id="licences">.*?</script>', "", text, count=1, flags=re.S)
    assert set(re.findall(r"https?://[^\s\"'<>)]+", without)) <= {"http://www.w3.org/1999/xhtml"}
    assert "default-src 'none'" in text
    assert len(text) < 3e6


def test_a_folder_without_summary_is_refused_and_an_arm_that_is_gone_is_named(folders, tmp_path):
    with pytest.raises(FileFormatError, match="no summary of results"):
        report([tmp_path], tmp_path / "a.html")
    run = nbs.Run.load(folders[0] / "run.npz")
    gone = folder_of(tmp_path / "gone", run)
    nbs.Run(**{**vars(run), "robot": "no/such.urdf"}).save(gone / "run.npz")
    text = report([gone], tmp_path / "a.html").read_text()
    assert "The arm is not drawn" in text
    assert "no/such.urdf" in text


@pytest.mark.browser
@pytest.mark.parametrize(("width", "height", "dark"), [(1280, 800, False), (390, 844, True)])
def test_charts_and_arms_of_several_runs_share_one_time(folders, width, height, dark, tmp_path):
    if find_chromium() is None:
        pytest.skip("no Chromium: install it or set $CHROMIUM")
    page = report(folders, tmp_path / "a.html")
    with closing(Browser(width, height)) as browser:
        browser.resize(width, height, dark=dark)
        browser.open(page, "#t=0.5")
        built = "new Promise(done => { const look = () => report.scenes.length === 2 ? done(0) : setTimeout(look, 50); "
        browser.evaluate(f"{built} look(); }})")
        runs = [nbs.Run.load(folder / "run.npz") for folder in folders]
        for scene, run in enumerate(runs):
            pose = browser.evaluate(f"report.scenes[{scene}].pose('tip')")
            at = nbs.load_robot("two_link").pose(run.q[np.searchsorted(run.t, 0.5)], "tip")
            np.testing.assert_allclose(np.reshape(pose, (4, 4)).T[:3, 3], at[:3, 3], atol=1e-3)
        error = browser.evaluate("report.plots()[0].data.map(row => [...row])")
        np.testing.assert_allclose(error[1:], [np.abs(run.q - run.q_ref)[:, 0] for run in runs], rtol=1e-4)
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
        shade = browser.evaluate("getComputedStyle(document.body).backgroundColor")
        assert shade == ("rgb(20, 25, 31)" if dark else "rgb(255, 255, 255)")
        assert browser.requests() == []
        assert [entry for entry in browser.complaints() if entry.get("entry", {}).get("level") != "warning"] == []


def test_verdicts_follow_the_figures():
    run = moving_run(nbs.load_robot("two_link"), duration=1.0)
    assert verdict_of(tracking_figures(run)).level == BAD
    better = nbs.Run(**{**vars(run), "q": run.q_ref})
    assert verdict_of(tracking_figures(better)).level == GOOD
    bounds = {"void": [], "units": ["rad"], "error_rad": 0.1, "joint_errors_rad": [0.1], "joints": ["a"]}
    bounds |= {"label": "PROVED", "disturbance": "‖τ_d‖ ≤ 1 N·m", "joint_overshoots_rad": None}
    bounds |= {"clock": "continuous time", "unproved_hold": ""}
    found = {"arm": "a", "certificate": bounds, "attack": None, "monitor": None, "tip_error_m": 0.2}
    said = verdict_of(found)
    assert said.level == GOOD
    assert "0.1 rad (5.73°)" in said.text
    assert "0.2 m (200 mm)" in said.text
    assert verdict_of(found | {"certificate": bounds | {"void": ["ρ > 0"]}}).level == BAD
    attack = {"error_rad": 0.2, "exceeds": True, "found_by": "waves", "duration_s": 1.0, "period_s": 1e-3}
    attack |= {"thorough": True, "verdict": "not kept"}
    assert verdict_of(found | {"attack": attack}).level == BAD


@pytest.mark.parametrize("name", ["two_link", "panda", "gantry.urdf"])
def test_no_tip_is_farther_than_its_bound_and_a_straight_arm_reaches_it(name):
    robot = nbs.load_robot(Path(__file__).parent / "data" / name if "." in name else name)
    rng, most = np.random.default_rng(0), np.full(robot.nv, 0.01)
    q = rng.uniform(*robot.one_turn_range, (2000, robot.nv))
    e = most * rng.choice([-1.0, 1.0], q.shape)
    gap = np.linalg.norm(positions(robot, tips(robot), q + e) - positions(robot, tips(robot), q), axis=-1)
    bound = tip_bound(robot, most, 1e3)
    assert 0.2 * bound < gap.max() <= bound
    if name == "two_link":
        stretched = np.zeros((2, 2))
        stretched[1] = most
        points = positions(robot, tips(robot), stretched)
        assert np.linalg.norm(points[1] - points[0]) == pytest.approx(bound, rel=1e-3)
        assert tip_bound(robot, most, 0.01) == pytest.approx(0.01 * np.hypot(2.0, 1.0))


@pytest.mark.parametrize(
    "command", ["track a", "train a", "certify a", "collect a", "learn data.npz", "compare a", "reproduce", "bench"]
)
def test_every_command_that_writes_results_takes_the_option(command):
    assert parse([*command.split(), "--report"]).report
    assert not parse(command.split()).report
