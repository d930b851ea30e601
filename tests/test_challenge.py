"""The challenge: motions within limits, what laws see, entrants that cost only themselves, promises, scores."""

import contextlib
import json
import math
import shutil
import signal
import subprocess
import sys
import time
from contextlib import closing

import numpy as np
import psutil
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.benchmarks.c_law import CLaw
from nbs_pin.benchmarks.challenge_page import challenge_page
from nbs_pin.benchmarks.challenge_tables import STANDINGS
from nbs_pin.benchmarks.challenge_tasks import ARMS, DURATION, MOTIONS, PERIOD, SAID, START_ERROR, course_of, motion_of
from nbs_pin.benchmarks.challenge_trial import Through, figures_of, run_task
from nbs_pin.benchmarks.conditions import CONDITIONS
from nbs_pin.benchmarks.contest import Contest, entrants_of
from nbs_pin.benchmarks.entrants import PROMISING, SHIPPED, Entrant
from nbs_pin.benchmarks.judging import Budget, Job, judge
from nbs_pin.benchmarks.promises import promised_by
from nbs_pin.benchmarks.scores import UNFINISHED, row_of, standings
from nbs_pin.campaigns.journal import JOURNAL
from nbs_pin.certificates.structure import lyapunov_law
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.controller import MemorylessController
from nbs_pin.controllers.registry import LAWS, build_law
from nbs_pin.reports.verdicts import BAD, GOOD, verdict_of
from nbs_pin.robots.places import tool_frame
from tests.browser import Browser, find_chromium
from tests.commands import contents, printed_by, refusal, summary
from tools import challenge_table

TWO_LINK = course_of("two_link", 0)
ENTRANTS = '''
import os, sys, time
import numpy as np

def spring(robot, period):
    """Pulls the arm along, and remembers how often it was asked."""
    count = [0]
    def torque(q, v, q_d, v_d, a_d, t):
        count[0] += 1
        assert abs(t - (count[0] - 0.5) * period) < 1e-9 or count[0] > 5000
        return -200.0 * (q - q_d) - 40.0 * (v - v_d)
    return torque

def raises(robot, period):
    def torque(q, v, q_d, v_d, a_d, t):
        if t > 0.5:
            raise ValueError("no more")
        return np.zeros(robot.nv)
    return torque

def leaves(robot, period):
    os.closerange(3, 256)
    while True:
        time.sleep(1.0)

def odd(robot, period):
    raise ValueError("bad \\udc80")

def nan(robot, period):
    return lambda q, v, q_d, v_d, a_d, t: q * np.nan

def short(robot, period):
    return lambda q, v, q_d, v_d, a_d, t: [0.0]

def writes(robot, period):
    def torque(q, v, q_d, v_d, a_d, t):
        q[:] = q_d
        return q
    return torque

def quits(robot, period):
    sys.exit("goodbye")

def dies(robot, period):
    return lambda *given: os.abort()

def sleeps(robot, period):
    return lambda *given: time.sleep(3600.0)

def nothing(robot, period):
    return 5.0

def once(robot, period):
    """Hangs in its first run of all."""
    mark = os.environ["MARK"]
    if not os.path.exists(mark):
        open(mark, "w").close()
        while True:
            pass
    return spring(robot, period)

def promise(task):
    assert task.robot.nv == 2 and task.period == 0.001
    return {"nominal": 0.5, "delay": [1e-9, 1e-9], "load": None, "friction": -1.0}[task.condition.name]
'''


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "entrants.py"
    path.write_text(ENTRANTS)
    return path


def job(entrant, conditions=("nominal", "delay"), kind="run", **budget):
    return Job(kind, str(entrant), "two_link", 0, ("sinusoid",), conditions, Budget(**budget))


# Tasks.


@pytest.mark.parametrize("arm", ARMS)
def test_every_motion_leaves_room_for_loads_and_starts_where_the_law_can_catch_it(arm):
    course = course_of(arm, 3)
    robot = course.robot
    t = np.linspace(0.0, DURATION, 1000)
    for name in MOTIONS:
        motion = motion_of(robot, name)
        nbs.check_reference(motion, robot, DURATION)
        loaded = robot.with_payload(tool_frame(robot), 2.0).with_effort_limit(0.95 * robot.effort_limit)
        nbs.check_reference(motion, loaded, DURATION)
        assert (np.abs(motion(t).v) <= 0.6 * robot.velocity_limit + 1e-9).all()
        assert np.ptp(motion(t).q, axis=0).max() > 0.2
        q, v = course.start(name)
        assert (np.abs(q - motion(0.0).q) <= START_ERROR).all()
        assert np.array_equal(v, motion(0.0).v)


def test_starts_and_bodies_come_from_the_seed_and_motions_do_not():
    same, other = course_of("two_link", 0), course_of("two_link", 1)
    assert np.array_equal(same.start("moves")[0], course_of.__wrapped__("two_link", 0).start("moves")[0])
    assert not np.array_equal(same.start("moves")[0], other.start("moves")[0])
    assert not np.array_equal(same.start("moves")[0] - same.start("sinusoid")[0], np.zeros(2))
    q = np.array([0.3, 0.2])
    masses = [course.plant("inertia").mass_matrix(q) for course in (same, other)]
    assert not np.allclose(*masses, rtol=1e-3)
    assert np.array_equal(masses[0], course_of.__wrapped__("two_link", 0).plant("inertia").mass_matrix(q))


# What a law sees, and what reaches the arm.


class Spy(MemorylessController):
    """A law that keeps what it is given."""

    nv = 2

    def __init__(self, law):
        self.law, self.seen, self.given = law, [], []

    def torque(self, q, v, q_ref, v_ref, a_ref):
        tau = self.law.torque(q, v, q_ref, v_ref, a_ref)
        self.seen.append((q, v, q_ref))
        self.given.append(tau)
        return tau


def test_exact_readings_in_time_are_the_loop_of_simulate():
    law, task = build_law("pd-plus", TWO_LINK.robot), TWO_LINK.task("sinusoid", "nominal")
    plain = run_task(law, TWO_LINK, "sinusoid", "nominal")
    (q0, v0), plant = TWO_LINK.start("sinusoid"), TWO_LINK.plant("nominal")
    through = Through(law, task, plant, q0 - PERIOD * v0)
    run = nbs.simulate(plant, through, task.reference, DURATION, PERIOD, q0=q0, v0=v0, lookahead=0.0)
    np.testing.assert_array_equal(run.q, plain.q)
    np.testing.assert_array_equal(run.tau, plain.tau)


def test_late_torques_are_those_of_the_reading_before():
    spy = Spy(build_law("pd-plus", TWO_LINK.robot))
    run = run_task(spy, TWO_LINK, "sinusoid", "delay")
    assert np.array_equal(run.tau_command[0], np.zeros(2))
    np.testing.assert_array_equal(run.tau_command[1:], spy.given[:-1])


def test_encoders_give_whole_steps_and_their_differences():
    spy = Spy(build_law("pd-plus", TWO_LINK.robot))
    run = run_task(spy, TWO_LINK, "sinusoid", "encoders")
    step, lead = 2.0 * np.pi / 2**14, 0.5 * PERIOD
    read = step * np.rint(np.concatenate([[run.q[0] - PERIOD * run.v[0]], run.q]) / step)
    speed = np.diff(read, axis=0) / PERIOD
    q, v = np.array([x[:2] for x in spy.seen[:-1]]).swapaxes(0, 1)
    np.testing.assert_allclose(v, (speed + lead * run.a_ref)[:-1], rtol=1e-9, atol=1e-9)
    ahead = read[1:] + lead * (speed + 0.5 * lead * run.a_ref)
    np.testing.assert_allclose(q, ahead[:-1], rtol=1e-9, atol=1e-12)
    assert 0.5 * step * 0.9 < np.abs(read[1:] - run.q).max() <= 0.5 * step * (1.0 + 1e-9)


def test_figures_count_from_a_second_on_and_tell_limits_that_were_left():
    run = run_task(build_law("computed-torque", TWO_LINK.robot), TWO_LINK, "sinusoid", "nominal")
    found = figures_of(run, TWO_LINK.robot)
    z1 = run.q[1000:] - run.q_ref[1000:]
    assert found.rms == pytest.approx(float(np.sqrt(np.mean(np.sum(z1**2, axis=1)))), rel=1e-12)
    assert found.worst == pytest.approx(np.abs(z1).max(axis=0))
    assert found.peak == max(found.worst)
    assert found.saturated == 0.0
    assert found.left == ""
    run.tau[10] = run.effort_limit
    assert figures_of(run, TWO_LINK.robot).saturated == pytest.approx(1.0 / (len(run.t) - 1))
    run.v[7, 1] = 1e3
    assert figures_of(run, nbs.load_robot("two_link", limits={"*": {"velocity": 10.0}})).left == (
        "joint 'joint2' was faster than its velocity limit at t = 0.007 s"
    )


# Entrants.


@pytest.mark.parametrize("name", ["nobody", "c:nobody", "nowhere.py:make", "test_challenge.py:a b", ""])
def test_an_entrant_that_is_not_there_is_refused(name):
    with pytest.raises(ArgumentError, match=r"no entrant|no file"):
        Entrant.read(name)


def test_names_of_ours_are_laws_and_those_with_certificates_are_asked_for_promises():
    assert [Entrant.read(name).name for name in SHIPPED] == list(SHIPPED)
    proved = set()
    for name in LAWS:
        law = build_law(name, TWO_LINK.robot)
        with contextlib.suppress(nbs.CertificateRefused):
            proved |= {name} if isinstance(law, AdaptiveLaw) or lyapunov_law(law) else set()
    assert proved == set(PROMISING)
    assert entrants_of(["pid", "sliding-mode"])[-2:] == (Entrant("c:nbs"), Entrant("sliding-mode"))
    assert entrants_of(["pid"], alone=True) == (Entrant("pid"),)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler here")
@pytest.mark.parametrize("name", ["nbs", "adaptive", "pid"])
def test_a_law_in_c_runs_like_the_law(name):
    law = build_law(name, TWO_LINK.robot, period=PERIOD, seed=0)
    ours, theirs = (run_task(one, TWO_LINK, "sinusoid", "load") for one in (law, CLaw(law)))
    np.testing.assert_allclose(theirs.q, ours.q, rtol=1e-9, atol=1e-9)
    limit = TWO_LINK.robot.effort_limit
    assert (np.abs(theirs.tau_command) <= limit).all()  # it clips for itself


def test_callables_are_made_anew_for_every_run(file):
    found = judge(job(f"{file}:spring", ("nominal", "nominal", "delay")))
    assert len(found) == 2  # the same task twice has one answer
    assert all("result" in answer for answer in found.values()), found


@pytest.mark.parametrize(("name", "words"), [
    ("raises", "at t = 0.500 s raised ValueError (no more)"),
    ("nan", "gave the torque [nan, nan] at t = 0.000 s"),
    ("short", "gave a torque of shape (1,) at t = 0.000 s, expected (2,)"),
    ("writes", "read-only"),
    ("quits", "SystemExit: goodbye"),
    ("nothing", "made 5.0; return a callable"),
    ("missing", "has no function 'missing'"),
])  # fmt: skip
def test_what_goes_wrong_in_an_entrant_is_a_sentence_for_each_of_its_tasks(file, name, words):
    found = judge(job(f"{file}:{name}"))
    assert list(found) == ["sinusoid nominal", "sinusoid delay"]
    for answer in found.values():
        assert words in answer["failure"]


def test_an_entrant_whose_file_cannot_be_read_is_told(tmp_path):
    path = tmp_path / "broken.py"
    path.write_text("import nothing_of_that_name\n")
    (answer, _) = judge(job(f"{path}:make")).values()
    assert "ModuleNotFoundError" in answer["failure"]


def test_an_entrant_that_kills_its_process_is_given_up_after_two_stops(file):
    found = judge(job(f"{file}:dies", ("nominal", "delay", "load")))
    said = [answer["failure"] for answer in found.values()]
    assert said[:2] == ["its process ended during a run (signal 6)"] * 2
    assert said[2] == "not run, as it was stopped before on this arm"


def test_an_entrant_that_sleeps_is_ended_with_its_process(file):
    found = judge(job(f"{file}:sleeps", ("nominal",), run=1.0))
    assert found == {"sinusoid nominal": {"failure": "stopped: a run took more than 1 s"}}
    own = psutil.Process().children(recursive=True)
    assert not [child for child in own if child.is_running() and "entrant_process" in " ".join(child.cmdline())]


def test_an_entrant_that_closes_its_connection_is_told(file):
    found = judge(job(f"{file}:leaves", ("nominal",), run=30.0))
    assert found == {"sinusoid nominal": {"failure": "its process closed its connection during a run"}}


def test_a_reason_that_is_no_text_is_told(file):
    (answer,) = judge(job(f"{file}:odd", ("nominal",))).values()
    assert "ValueError" in answer["failure"]
    answer["failure"].encode()


def test_entrants_that_tables_would_call_the_same_are_refused(file, tmp_path):
    other = tmp_path / "elsewhere" / file.name
    other.parent.mkdir()
    other.write_text(file.read_text())
    with pytest.raises(ArgumentError, match="two entrants are called"):
        entrants_of([f"{file}:spring", f"{other}:spring"])


def test_after_a_stop_the_next_tasks_are_run(file, tmp_path, monkeypatch):
    monkeypatch.setenv("MARK", str(tmp_path / "mark"))
    found = judge(job(f"{file}:once", ("nominal", "delay"), run=15.0))
    assert found["sinusoid nominal"] == {"failure": "stopped: a run took more than 15 s"}
    assert found["sinusoid delay"]["result"]["rms"] > 0.0


def test_a_process_that_does_not_start_in_time_is_told(file):
    found = judge(job(f"{file}:spring", start=0.01))
    said = "not run: stopped: its start took more than 0.01 s"
    assert found == {"sinusoid nominal": {"failure": said}, "sinusoid delay": {"failure": said}}


# Promises.


def test_promises_of_a_file_are_asked_for_in_a_process_of_their_own(file):
    found = judge(job(f"{file}:spring", ("nominal", "delay", "load", "friction"), kind="promise"))
    told = [answer.get("result") for answer in found.values()]
    assert told[:3] == [{"promise": [0.5, 0.5]}, {"promise": [1e-9, 1e-9]}, {"promise": None}]
    assert "give one error > 0" in found["sinusoid friction"]["failure"]


@pytest.mark.parametrize("name", ["nbs", "slotine-li", "adaptive"])
@pytest.mark.parametrize("condition", ["nominal", "friction"])
def test_our_laws_keep_what_they_promise(name, condition):
    law = build_law(name, TWO_LINK.robot, period=PERIOD, seed=0)
    bound = promised_by(law, TWO_LINK.task("sinusoid", condition))
    worst = figures_of(run_task(law, TWO_LINK, "sinusoid", condition), TWO_LINK.robot).worst
    assert (np.array(worst) <= bound).all()
    assert (bound < 1.0).all()


def test_our_laws_promise_nothing_of_which_nothing_is_proved():
    laws = {name: build_law(name, TWO_LINK.robot, period=PERIOD, seed=0) for name in ("nbs", "adaptive", "pd-plus")}
    for condition in ("delay", "encoders"):
        assert all(promised_by(law, TWO_LINK.task("sinusoid", condition)) is None for law in laws.values())
    assert promised_by(laws["pd-plus"], TWO_LINK.task("sinusoid", "nominal")) is None
    assert promised_by(laws["adaptive"], TWO_LINK.task("sinusoid", "inertia")) is None


# Scores.


def answer(rms, worst=(0.01, 0.02), left=""):
    result = {"rms": rms, "peak": max(worst), "saturated": 0.25, "worst": worst, "left": left}
    return {"result": result}


TASK = ("two_link", "sinusoid", "nominal")


def test_a_promise_is_kept_if_every_joint_keeps_it():
    kept = row_of("a", TASK, answer(0.01), [0.02, 0.04])
    assert (kept.promise, kept.promise_over_worst) == ("kept", pytest.approx(2.0))
    broken = row_of("a", TASK, answer(0.01), [0.0099, 0.04])
    assert broken.promise == "broken"
    assert row_of("a", TASK, answer(0.01), None).promise == "none"
    assert row_of("a", TASK, answer(0.01, left="it left"), [1.0, 1.0]).promise == "broken"
    assert row_of("a", TASK, {"failure": "it raised"}, [1.0, 1.0]).promise == "broken"
    assert row_of("a", TASK, {"failure": "it raised"}, None).promise == "none"


def test_what_is_not_finished_counts_as_a_large_error():
    rows = [
        row_of("a", TASK, answer(0.01), None),
        row_of("a", TASK, {"failure": "it raised"}, None),
        row_of("b", TASK, answer(0.2), [1.0, 1.0]),
        row_of("b", TASK, answer(5.0), [0.001, 1.0]),
        row_of("c", TASK, answer(0.001, left="it left"), None),
        row_of("c", TASK, answer(0.003), None),
    ]
    found = {each.entrant: each for each in standings(rows)}
    assert list(found) == ["c", "a", "b"]
    assert found["a"].mean_error_rad == pytest.approx(0.5 * (0.01 + UNFINISHED))
    assert found["b"].mean_error_rad == pytest.approx(0.5 * (0.2 + UNFINISHED))
    assert (found["a"].finished, found["c"].finished, found["b"].finished) == (1, 1, 2)
    assert (found["b"].promised, found["b"].broken) == (2, 1)
    assert found["a"].promise_over_worst is None
    assert found["a"].peak_error_rad == 0.02
    verdict = verdict_of({"standings": [each._asdict() for each in standings(rows)]})
    assert verdict.level == BAD
    assert verdict.said == "tracked best by c (501 mrad), then by a (505 mrad), on the mean of all tasks"
    assert verdict.more[0] == "promises kept: 1 of 2 by b"
    assert verdict.more[1] == "tasks not finished: 1 of 2 by c, 1 of 2 by a"
    assert verdict_of({"standings": [found["a"]._asdict()]}).level == GOOD


def test_the_page_of_the_docs_lists_every_task_and_takes_new_tables():
    page = challenge_table.PAGE.read_text()
    for name in (*ARMS, *(f"`{name}`" for name in (*MOTIONS, *CONDITIONS))):
        assert f"| {name} |" in page or name in page
    assert SAID.keys() == MOTIONS.keys()
    again = challenge_table.with_tables(page, "| new |\n")
    assert "<!-- challenge.md -->\n| new |\n<!-- end -->" in again
    assert challenge_table.with_tables(again, "") != again
    heads = [head for head, _ in STANDINGS]
    assert all(head in page for head in heads)  # the table is there, with all of its columns


# The whole of it.


def contest(*names, **tasks):
    few = {"arms": ("two_link",), "motions": ("sinusoid",), "conditions": ("nominal", "delay")}
    return Contest(tuple(map(Entrant, names)), **(few | tasks))


def test_the_same_seed_gives_the_same_table_and_others_cost_an_entrant_nothing(file, tmp_path):
    alone = contest("pid", "pd-plus").held(tmp_path / "a", workers=1)
    beside = contest("pid", "pd-plus", f"{file}:nan", f"{file}:quits").held(tmp_path / "b", workers=3)
    assert beside[:4] == alone
    assert [row.failed for row in beside[4:]] != ["", "", "", ""]
    assert all(row.counted == UNFINISHED for row in beside[4:])
    other = contest("pid", seed=1).held(tmp_path / "c")
    assert other[0].rms_error_rad != alone[0].rms_error_rad


def test_an_entrant_may_be_added_and_a_changed_file_is_run_again(file, tmp_path):
    both = contest("pid", f"{file}:nan")
    first = both.held(tmp_path / "out")
    lines = (tmp_path / "out" / JOURNAL).read_text().splitlines()
    assert both.held(tmp_path / "out") == first
    assert (tmp_path / "out" / JOURNAL).read_text().splitlines() == lines
    file.write_text(ENTRANTS.replace("q * np.nan", "q * 0.0"))
    again = both.held(tmp_path / "out")
    assert again[:2] == first[:2]
    assert again[2].failed != first[2].failed
    with pytest.raises(ArgumentError, match="another plan"):
        contest("pid", seed=1).held(tmp_path / "out")


def shell(folder):
    arguments = ["--alone", "--entrant", "pid", "--arms", "two_link", "three_link", "--motions", "sinusoid",
                 "--conditions", "nominal", "--workers", "1", "--out", str(folder)]  # fmt: skip
    return [sys.executable, "-m", "nbs_pin.cli", "challenge", *arguments]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The table of a challenge that nothing has stopped."""
    folder = tmp_path_factory.mktemp("whole")
    subprocess.run(shell(folder), check=True, capture_output=True)
    return (folder / "tasks.csv").read_bytes()


@pytest.mark.parametrize("stop", [signal.SIGKILL, signal.SIGINT])
def test_a_challenge_that_is_killed_goes_on_and_leaves_no_process(stop, whole, tmp_path):
    folder = tmp_path / "killed"
    process = subprocess.Popen(shell(folder), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 300.0
    while not (folder / JOURNAL).exists() or len((folder / JOURNAL).read_text().splitlines()) < 2:
        assert time.monotonic() < end
        assert process.poll() is None
        time.sleep(0.02)
    workers = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(stop)
    process.wait(60.0)
    assert not psutil.wait_procs(workers, timeout=60.0)[1]
    assert len((folder / JOURNAL).read_text().splitlines()) == 2
    subprocess.run(shell(folder), check=True, capture_output=True)
    assert (folder / "tasks.csv").read_bytes() == whole
    assert len((folder / JOURNAL).read_text().splitlines()) == 3


def test_the_command_writes_its_page_and_tables(file, tmp_path, capsys):
    options = ["--alone", "--entrant", f"{file}:spring", f"{file}:raises", "--arms", "two_link", "--motions",
               "sinusoid", "--conditions", "nominal", "delay", "--out", tmp_path / "out"]  # fmt: skip
    printed = printed_by("challenge", *options, "-v")
    assert printed.startswith("tracked best by entrants.py:spring (")
    assert "tasks not finished: 2 of 2 by entrants.py:raises" in printed
    figures = summary(tmp_path / "out")["figures"]
    first, last = figures["standings"]
    assert (first["entrant"], first["promised"], first["broken"]) == ("entrants.py:spring", 2, 1)
    assert last["mean_error_rad"] == UNFINISHED
    assert math.isclose(figures["errors_by_condition_rad"]["entrants.py:raises"]["delay"], UNFINISHED)
    page = (tmp_path / "out" / "challenge.html").read_text()
    for words in ("Standings", "Broken promises", "Not finished", "no more", "How it is judged", "delay"):
        assert words in page
    written = (tmp_path / "out" / "challenge.md").read_text()
    assert written.startswith("| entrant | mean [mrad] |")
    assert "Seed 0" in written
    rows = (tmp_path / "out" / "tasks.csv").read_text().splitlines()
    assert len(rows) == 5
    before = contents(tmp_path / "out")
    capsys.readouterr()
    printed_by("challenge", *options)
    assert contents(tmp_path / "out")["tasks.csv"] == before["tasks.csv"]
    capsys.readouterr()
    assert "another plan" in refusal(cli.main([*map(str, ("challenge", *options, "--seed", 1))]), capsys)
    assert json.loads((tmp_path / "out" / JOURNAL).read_text().splitlines()[0])["plan"]["seed"] == 0


def test_results_of_another_command_stay(tmp_path, capsys):
    (tmp_path / "tasks.csv").write_text("mine")
    told = refusal(cli.main(["challenge", "--quick", "--out", str(tmp_path)]), capsys)
    assert "--force" in told
    assert (tmp_path / "tasks.csv").read_text() == "mine"


@pytest.mark.parametrize(("options", "words"), [
    (["--alone"], "no --entrant"),
    (["--entrant", "nobody"], "no entrant 'nobody'"),
    (["--motions", "dance"], "--motions has 'dance'; give some of sinusoid"),
    (["--conditions", "rain"], "--conditions has 'rain'; give some of nominal"),
    (["--arms", "no_arm"], "no robot 'no_arm'"),
])  # fmt: skip
def test_bad_options_are_refused_in_a_sentence(options, words, tmp_path, capsys):
    assert words in refusal(cli.main(["challenge", *options, "--out", str(tmp_path / "out")]), capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.browser
@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_stays_on_its_screen_and_asks_for_nothing(width, tmp_path):
    if find_chromium() is None:
        pytest.skip("no Chromium: install it or set $CHROMIUM")
    long = "a_file_of_somebody_with_a_name_that_is_much_too_long_for_a_phone.py:make_the_law_of_mine"
    names, conditions = (long, "nbs", "<b>bold</b>"), tuple(CONDITIONS)
    whole = contest(*names, arms=ARMS, motions=tuple(MOTIONS), conditions=conditions)
    rows = []
    for name in names:
        for k, condition in enumerate(conditions):
            given = answer(10.0 ** (-k)) if k else {"failure": "it raised " + "words " * 60}
            rows.append(row_of(name, ("panda", "moves", condition), given, [0.001, 0.1] if k == 2 else None))
    facts = {"settings": {"seed": 0}, "date": "2026-01-01", "machine": {"processor": "x"}, "versions": {"python": "3"}}
    verdict = verdict_of({"standings": [each._asdict() for each in standings(rows)]})
    path = tmp_path / "challenge.html"
    path.write_bytes(challenge_page(whole, rows, verdict, facts))
    with closing(Browser(width, 844)) as browser:
        browser.resize(width, 844)
        browser.open(path)
        browser.evaluate("document.querySelectorAll('details').forEach((x) => x.open = true)")
        assert browser.evaluate("document.documentElement.scrollWidth") <= width
        assert browser.evaluate("document.querySelectorAll('.lane i').length") == len(rows)
        inside = "[...document.querySelectorAll('.lane i')].every((x) => x.offsetLeft >= 0 && "
        assert browser.evaluate(inside + "x.offsetLeft + x.offsetWidth <= x.parentNode.offsetWidth)")
        assert browser.evaluate("document.querySelectorAll('main b').length > 0 && !document.querySelector('td b')")
        assert browser.requests() == []
        assert browser.complaints() == []
