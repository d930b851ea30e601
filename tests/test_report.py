"""Reports: what is on the page of the results of commands, and what a browser makes of it."""

import json
import re
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.doors import at_the_shell
from nbs_pin.base.exceptions import FileFormatError
from nbs_pin.base.summaries import SUMMARY
from nbs_pin.benchmarks.bench import Row
from nbs_pin.certificates.tip_bound import tip_bound
from nbs_pin.cli.shell import parse
from nbs_pin.commands.reproduce import PARTS
from nbs_pin.controllers.registry import LAWS, build_law
from nbs_pin.reports import plotting
from nbs_pin.reports.captions import law_in_words, settings_in_words
from nbs_pin.reports.markdown import Section
from nbs_pin.reports.pages import written
from nbs_pin.reports.report import report
from nbs_pin.reports.report_tables import joints_table, numbers_table
from nbs_pin.reports.scene import positions
from nbs_pin.reports.verdicts import BAD, GOOD, WARNING, shares, verdict_of
from nbs_pin.robots.visuals import tips
from nbs_pin.simulation.run_figures import figures as tracking_figures
from tests.browser import Browser, find_chromium
from tests.commands import contents, printed_by, refusal, summary
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


def open_with_arms(browser, page, count):
    browser.open(page, "#t=0.5")
    built = (
        f"new Promise(done => {{ const look = () => report.scenes.length === {count} ? done(0) : setTimeout(look, 50); "
    )
    browser.evaluate(f"{built} look(); }})")


@pytest.mark.browser
@pytest.mark.parametrize(("width", "height", "dark"), [(1280, 800, False), (390, 844, True)])
def test_charts_and_arms_of_several_runs_share_one_time(folders, width, height, dark, tmp_path):
    if find_chromium() is None:
        pytest.skip("no Chromium: install it or set $CHROMIUM")
    page = report(folders, tmp_path / "a.html")
    with closing(Browser(width, height)) as browser:
        browser.resize(width, height, dark=dark)
        open_with_arms(browser, page, 2)
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
    found = {"arm": "a", "certificate": BOUNDS, "attack": None, "monitor": None, "tip_error_m": 0.2}
    assert "0.2 m (200 mm)" in verdict_of(found).text
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


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Samples of an arm."""
    folder = tmp_path_factory.mktemp("data")
    printed_by("collect", "two_link", "--samples", "200", "--out", folder)
    return folder / "data.npz"


def headings(monkeypatch):
    """The headings of all pictures that are drawn from now on."""
    drawn, draw = [], plotting._head
    monkeypatch.setattr(plotting, "_head", lambda figure, heading: (drawn.append(heading), draw(figure, heading)))
    return drawn


def test_a_picture_has_the_verdict_of_the_page(monkeypatch, tmp_path):
    robot, drawn = nbs.load_robot("two_link"), headings(monkeypatch)
    run = moving_run(robot)
    away = nbs.Run(**{**vars(run), "q": run.q_ref + 20.0, "q_ref": run.q_ref + 20.0})
    nbs.plot_tracking(away, tmp_path / "a.png", robot=robot)
    assert drawn[0].verdict == verdict_of(tracking_figures(away, robot))
    assert drawn[0].verdict.level == WARNING
    assert " Joint joint1 left its range by " in drawn[0].verdict.text
    why = {"code": "TIME", "time_s": 0.25, "why": "a sample is late."}
    for noted, level in (({"stopped": why}, BAD), ({"interrupted": True}, WARNING)):
        nbs.plot_tracking(nbs.Run(**{**vars(run), "q": run.q_ref, "info": noted}), tmp_path / "a.png", robot=robot)
        assert drawn.pop().verdict.level == level


REPORTED = {
    "track": "track two_link --duration 0.1",
    "several laws": "track two_link --controller nbs,pid --duration 0.1",
    "train": "train two_link --epochs 1 --starts 4 --duration 0.1 --frequencies 1",
    "collect": "collect two_link --samples 100",
    "learn": "learn DATA --model identified",
    "compare": "compare two_link --against two_link --samples 50 --trajectories 0",
    "certify": "certify two_link --disturbance 5",
    "run": "run two_link --duration 0.1",
    "bench": "bench --arms two_link",
    "reproduce": "reproduce --part fair",
}


@pytest.mark.parametrize("command", REPORTED)
def test_every_command_reports_the_verdict_that_it_prints(command, data, tmp_path, monkeypatch):
    robot = nbs.load_robot("two_link")
    at = nbs.PlantArm(nbs.MujocoPlant(robot), nbs.Sinusoid.for_robot(robot)(0.0).q, real_time=False)
    monkeypatch.setattr("nbs_pin.commands.run.arm_at", lambda *_: at)
    row = Row("joints", "chain", "nbs", {"joints": 1.0, "p50_us": 2.0, "two_rnea_us": 1.0})
    rows = [row, Row("control step", "a[b]", "nbs", {"p50_us": 3.0})]
    monkeypatch.setattr("nbs_pin.benchmarks.bench.bench", lambda *_, **__: iter(rows))
    section = Section("A part", "Text.", {"figure": 1.0})
    monkeypatch.setitem(PARTS, "fair", lambda *_: [section])
    drawn = headings(monkeypatch)
    words = REPORTED[command].replace("DATA", str(data)).split()
    printed = printed_by(*words, "--report", "--out", tmp_path / "a[b]")
    assert str(tmp_path / "a[b]" / "report.html") in printed.splitlines()
    told, page = summary(tmp_path / "a[b]"), (tmp_path / "a[b]" / "report.html").read_text()
    with at_the_shell():
        verdict = verdict_of(told["figures"])
    assert written(verdict.text) in page
    assert verdict.said in printed or command == "reproduce"
    assert f"nbs-pin {words[0]}" in told["command"]
    assert verdict in [heading.verdict for heading in drawn] or command in ("compare", "reproduce")
    assert ('"runs":[]' not in page) == (command in ("track", "several laws", "certify", "run"))


def test_what_stopped_the_guard_is_bad_on_page_and_picture():
    stopped = {"stopped": {"code": "TIME", "time_s": 0.25, "why": "a sample is late."}}
    for figures in (stopped, tracking_figures(moving_run(nbs.load_robot("two_link"))) | stopped):
        assert verdict_of(figures) == (BAD, "the guard stopped the arm after 0.25 s: a sample is late", ())


def test_a_sample_that_is_not_finite_is_no_number_and_no_convergence():
    """As a drive records it when its encoder fails."""
    robot = nbs.load_robot("two_link")
    run = moving_run(robot)
    q = run.q_ref.copy()
    q[-2] = np.nan
    figures = tracking_figures(nbs.Run(**{**vars(run), "q": q}), robot)
    json.dumps(figures, allow_nan=False)
    assert verdict_of(figures).level == WARNING
    assert "inf rad" in verdict_of(figures).said


def near_from(run, time):
    """The run, with an error of 1 rad until then and none after."""
    return nbs.Run(**{**vars(run), "q": run.q_ref + np.where(run.t < time, 1.0, 0.0)[:, None]})


@pytest.mark.parametrize(("time", "level"), [(0.0, GOOD), (0.65, GOOD), (0.75, WARNING), (0.98, WARNING), (2.0, BAD)])
def test_errors_that_only_end_near_zero_have_not_converged(time, level):
    """As those of a motion that crosses its reference when the run ends."""
    figures = tracking_figures(near_from(moving_run(nbs.load_robot("two_link"), duration=1.0), time))
    assert verdict_of(figures).level == level
    assert ("converged: from" in verdict_of(figures).said) == (level == GOOD)
    said = verdict_of({"laws": {"nbs": figures}}).said
    assert said.startswith("of the laws, nbs has the smallest error" if level == GOOD else "none of nbs converged")
    both = verdict_of(figures, interrupted=True)
    assert both.said == "interrupted before its end"
    assert both.level == (BAD if level == BAD else WARNING)


@pytest.mark.parametrize(
    ("before", "after", "share", "level"),
    [(1.0, 0.5, 0.2, GOOD), (1.0, 0.5, -0.2, WARNING), (None, 0.5, 0.2, GOOD), (None, None, 0.2, WARNING),
     (0.5, None, 0.2, BAD), (None, None, None, BAD), (1.0, 0.5, None, BAD), (1.0, 2.9, 0.2, BAD)],
)  # fmt: skip
def test_a_training_after_which_nothing_converges_is_not_praised(before, after, share, level):
    figures = {"held_out_cost_lowered_by": share, "fresh_duration_s": 3.0}
    figures |= {name: {"convergence_time_median_s": x} for name, x in (("before", before), ("after", after))}
    verdict = verdict_of(figures)
    assert verdict.level == level
    assert "None" not in verdict.text
    assert ("not finite" in verdict.said) == (share is None)


BOUNDS = {
    "void": [], "units": ["rad"], "error_rad": 0.1, "joint_errors_rad": [0.1], "joint_overshoots_rad": None,
    "joints": ["a"], "label": "PROVED", "disturbance": "‖τ_d‖ ≤ 1 N·m", "clock": "control periods of 1 ms",
    "unproved_hold": "",
}  # fmt: skip
KEPT = {"verdict": "promise kept", "is_kept": True, "broken": []}


@pytest.mark.parametrize(
    ("bounds", "monitor", "level"),
    [
        ({}, None, GOOD),
        ({"clock": "continuous time", "unproved_hold": "nothing is proved of torques held for 5 ms"}, None, WARNING),
        ({"label": "EMPIRICAL"}, None, WARNING),
        ({"void": ["ρ > 0"]}, None, BAD),
        ({}, KEPT, GOOD),
        ({}, KEPT | {"broken": ["effort limits"]}, WARNING),
        ({}, KEPT | {"is_kept": False}, BAD),
        ({"joint_overshoots_rad": [0.3]}, None, GOOD),
    ],
)
def test_a_promise_is_as_good_as_all_that_it_rests_on(bounds, monitor, level):
    found = {"arm": "a", "certificate": BOUNDS | bounds, "attack": None, "monitor": monitor, "useless": []}
    verdict = verdict_of(found)
    assert verdict.level == level
    assert (BOUNDS | bounds)["clock"] in verdict.said
    assert (BOUNDS | bounds)["unproved_hold"] in verdict.text.casefold()
    strays = "0.3 rad (17.2°)" if bounds.get("joint_overshoots_rad") else "0.1 rad (5.73°)"
    assert f"strays more than {strays}" in verdict.said


def columns_of(page):
    return re.findall(r"<th>(.*?)</th>", page)


def test_only_what_each_joint_has_is_a_column_whatever_is_as_long():
    """Two starts of an arm with two joints, and two costs of its training."""
    robot = nbs.load_robot("two_link")
    one, two = (tracking_figures(moving_run(robot, batch=batch)) for batch in ((), (2,)))
    assert columns_of(joints_table(two)) == ["joint", "effort limit"]
    assert set(columns_of(joints_table(one))) == {
        "joint", "RMS error", "RMS error late", "RMS error last 30 percent", "joint peak torque", "effort limit",
    }  # fmt: skip
    ratio = {"relative_error": {}, "joints": ["a", "b"], "mass_ratio": [0.9, 1.1], "torque_rms_Nm": [1.0, 2.0]}
    assert columns_of(joints_table(ratio)) == ["joint", "torque RMS"]


def test_numbers_of_arms_that_slide_are_in_metres_and_newtons():
    robot = nbs.load_robot(Path(__file__).parent / "data" / "gantry.urdf")
    figures = tracking_figures(nbs.Run(**{**vars(moving_run(robot)), "prismatic": robot.prismatic}))
    kinds = set(figures["units"]["torque"])
    assert kinds == {"N", "N·m"}
    cells = dict(re.findall(r"<tr><td class=text>(.*?)</td><td.*?>(.*?)</td></tr>", numbers_table({"a": figures})))
    assert cells["peak torque"].endswith(" N·m, N")
    assert cells["steady error"].endswith(" rad², m²")
    assert re.fullmatch(r".* rad \(.*°\), .* m \(.* mm\)|.* m \(.* mm\), .* rad \(.*°\)", cells["largest RMS error"])
    tool = {"units": figures["units"], "tool": {"rms_orientation_error_rad": 0.5}, "bandwidth_rad_per_s": 8.0}
    cells = dict(re.findall(r"<tr><td class=text>(.*?)</td><td.*?>(.*?)</td></tr>", numbers_table({"a": tool})))
    assert cells == {"tool: RMS orientation error": "0.5 rad (28.6°)", "bandwidth": "8 rad/s"}


def test_an_error_where_the_torque_is_constant_is_not_small():
    assert shares([0.5, 1e-13, 0.2], [0.0, 0.0, 2.0])[0] > 1e6
    assert shares([0.5, 1e-13, 0.2], [0.0, 0.0, 2.0])[1:] == [pytest.approx(5e-5), 0.1]
    assert shares([0.0, None], [0.0, 0.0]) == [0.0, np.inf]


def test_one_law_and_several_leave_nothing_of_each_other(tmp_path):
    several = {"run-nbs.npz", "run-pid.npz", "comparison.png", "summary.json"}
    one = {"run.npz", "tracking.png", "replay.html", "summary.json"}
    for law, files in (("nbs", one), ("nbs,pid", several), ("pid,pd-plus", None), ("nbs", one)):
        printed_by("track", "two_link", "--controller", law, "--duration", "0.05", "--force", "--out", tmp_path)
        files = files or {"run-pid.npz", "run-pd-plus.npz", "comparison.png", "summary.json"}
        assert contents(tmp_path).keys() == files
    assert nbs.Run.load(tmp_path / "run.npz").info["settings"]["controller"] == "nbs"


def test_a_joint_above_its_velocity_limit_is_told():
    robot = nbs.load_robot("panda")
    law, reference = nbs.NeuralBackstepping.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    plant, far = nbs.MujocoPlant(robot), reference(0.0).q + 0.3
    for start, is_fast in ((far, True), (reference(0.0).q, False)):
        found = tracking_figures(nbs.simulate(plant, law, reference, 3.0, 0.001, q0=start), robot)
        said = [line for line in verdict_of(found).more if "velocity limit" in line]
        assert any(found["above_velocity_limit_fraction"]) == bool(said) == is_fast
        assert not any(found["above_velocity_limit_fraction_late"])
    shares = {"above_velocity_limit_fraction": [0.0] * 6 + [0.5], "above_velocity_limit_fraction_late": [0.4] * 7}
    assert (verdict_of(found).level, verdict_of(found | shares).level) == (GOOD, WARNING)
    assert "panda_joint7 was above its velocity limit 50" in " ".join(verdict_of(found | shares).more)


def test_another_command_leaves_nothing_of_the_one_before(tmp_path):
    folder, mine = tmp_path / "results", tmp_path / "mine.txt"
    printed_by("track", "two_link", "--duration", "0.05", "--out", folder)
    mine.touch()
    (folder / "notes.txt").touch()
    kept = summary(folder)
    kept["files"] += ["../mine.txt", "..", 3, "notes"]  # a summary that somebody wrote
    (folder / "notes").mkdir()
    (folder / SUMMARY).write_text(json.dumps(kept))
    printed_by("certify", "two_link", "--disturbance", "1", "--force", "--out", folder)
    found = {file.name for file in folder.iterdir()}
    assert found == {"certificate.png", "run.npz", "summary.json", "notes.txt", "notes"}
    assert mine.exists()
    assert {"certificate.png", "run.npz"} <= set(summary(folder)["files"])


def test_no_command_removes_what_it_reads(tmp_path, capsys):
    folder = tmp_path / "results"
    printed_by("collect", "two_link", "--samples", "60", "--out", folder)
    learning = ("--model", "identified", "--robot", "two_link")
    printed_by("learn", folder / "data.npz", *learning, "--out", folder, "--force")
    assert {"data.npz", "model.nbs"} <= contents(folder).keys()
    law = nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link"))
    nbs.save(law, folder / "controller.nbs")  # a name that certify writes with --wanted
    printed_by("certify", folder / "controller.nbs", "--disturbance", "1", "--out", folder, "--force")
    assert {"controller.nbs", "certificate.png"} <= contents(folder).keys()
    assert "model.nbs" not in contents(folder)
    recorded = (folder / "run.npz").read_bytes()
    watching = ["certify", "two_link", "--disturbance", "1", "--monitor", str(folder / "run.npz")]
    assert "is read here" in refusal(cli.main([*watching, "--out", str(folder), "--force"]), capsys)
    assert (folder / "run.npz").read_bytes() == recorded
    tracked = ("--controller", folder / "controller.nbs", "--duration", "0.05")
    printed_by("track", "two_link", *tracked, "--out", folder, "--force")
    assert {"controller.nbs", "replay.html"} <= contents(folder).keys()


def test_a_page_of_other_folders_is_not_replaced_silently(folders, capsys, monkeypatch):
    where = folders[0].parent
    monkeypatch.chdir(where)
    (where / "report.html").write_text("mine")
    assert "'report.html' exists" in refusal(cli.main(["report", "first", "second"]), capsys)
    assert (where / "report.html").read_text() == "mine"
    assert cli.main(["report", "first", "second", "--force"]) == 0
    assert cli.main(["report", "first"]) == cli.main(["report", "first"]) == 0  # of one folder it is a part


@pytest.mark.filterwarnings("default::UserWarning")
def test_a_report_that_fails_costs_nothing_else(tmp_path, monkeypatch, capsys):
    def fails(*_):
        raise ValueError("no font")

    monkeypatch.setattr("nbs_pin.reports.report.report", fails)
    assert cli.main(["track", "two_link", "--duration", "0.05", "--report", "--out", str(tmp_path)]) == 0
    assert "report.html' was not drawn (ValueError: no font)" in capsys.readouterr().err
    assert (tmp_path / "run.npz").is_file()


def test_a_run_that_is_not_drawn_keeps_its_picture(folders, tmp_path):
    run = nbs.Run.load(folders[0] / "run.npz")
    gone = folder_of(tmp_path / "gone", run)
    nbs.plot_tracking(run, gone / "tracking.png")
    assert 'alt="tracking.png"' not in report([gone], tmp_path / "a.html").read_text()
    nbs.Run(**{**vars(run), "robot": "no/such.urdf"}).save(gone / "run.npz")
    assert 'alt="tracking.png"' in report([gone], tmp_path / "a.html").read_text()


@pytest.mark.parametrize("name", LAWS)
def test_a_compiled_law_has_the_name_of_the_law(name):
    robot = nbs.load_robot("two_link")
    law = build_law(name, robot, period=0.001)

    def run(law):
        return nbs.simulate(nbs.MujocoPlant(robot), law, nbs.Sinusoid.for_robot(robot), 0.01, 0.001)

    assert law_in_words(run(law.compile())) == law_in_words(run(law)) != "controller"


def test_settings_that_were_not_given_are_no_phrase():
    run = moving_run(nbs.load_robot("two_link"))
    none = dict.fromkeys(("bandwidth", "frequency", "start", "start_error", "disturbance", "seed", "arm", "controller"))
    info = {"controller": "PID()", "plant": "MuJoCo", "reference": "sinusoid", "settings": none}
    told = settings_in_words(nbs.Run(**{**vars(run), "info": info}))
    assert told[:2] == ["control every 4 ms", "sinusoid"]
    assert not any("None" in phrase for phrase in told)
    arm = {"payload": {"tip": {"mass": 2.5, "com": [0.0, 0.0, 0.0]}, "": 1.0}, "lock": ["a", "b"]}
    told = settings_in_words(nbs.Run(**{**vars(run), "info": info | {"settings": none | {"arm": arm}}}))
    assert told[-2:] == ["payload 2.5 kg at tip, 1 kg at the last link", "lock a, b"]


@pytest.mark.parametrize(
    "command", ["track a", "train a", "certify a", "collect a", "learn data.npz", "compare a", "reproduce", "bench"]
)
def test_every_command_that_writes_results_takes_the_option(command):
    assert parse([*command.split(), "--report"]).report
    assert not parse(command.split()).report
