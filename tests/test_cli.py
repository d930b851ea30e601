"""The command line: what it writes, what it prints, what it refuses, and what it leaves behind when stopped."""

import os
import re
import resource
import shlex
import signal
import subprocess
import sys
import time
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.versions import versions
from nbs_pin.cli.values import OptionError, parse_disturbance, plain_number
from nbs_pin.commands import track as tracking
from nbs_pin.robots.catalogue import find
from nbs_pin.simulation import metrics
from tests.commands import check_results_are_kept_unless_forced, contents, refusal, summary

ROOT = str(Path(__file__).parent.parent)
NBS_PIN = (sys.executable, "-m", "nbs_pin.cli")
TRACKS = {
    "two_link": "--duration 1.5 --start-error 0.3 --disturbance square:2,1@8 --seed 3",
    "panda": "--duration 0.6 --period 0.002 --plant pinocchio --controller computed-torque",
}


def nbs_pin(*arguments, **options):
    return subprocess.run([*NBS_PIN, *arguments], capture_output=True, text=True, check=False, **options)


@pytest.fixture(scope="module", params=TRACKS)
def tracked(request, tmp_path_factory):
    """An arm's name, the folder it was tracked in, and what was printed."""
    cwd = tmp_path_factory.mktemp(request.param)
    done = nbs_pin("track", request.param, "-v", *TRACKS[request.param].split(), cwd=cwd)
    assert (done.returncode, done.stderr) == (0, "")
    return request.param, cwd / "out" / f"track-{request.param}", done.stdout


@pytest.fixture(scope="module")
def two_link(tmp_path_factory):
    """A folder with a short run of two_link."""
    folder = tmp_path_factory.mktemp("results") / "run"
    assert track(folder) == 0
    return folder


def track(folder, *options):
    return cli.main(["track", "two_link", "--duration", "0.1", "--out", str(folder), *options])


def motion_in(page):
    """The poses and times that a replay plays."""
    found = re.findall(r'"(?:poses|times|q)":"([^"]+)"', page.read_text())
    assert len(found) == 4  # the times of the poses, and those of the positions
    return found


# Tracking.


def test_track_leaves_four_files_that_say_the_same(tracked):
    name, folder, _ = tracked
    assert sorted(path.name for path in folder.iterdir()) == ["replay.html", "run.npz", "summary.json", "tracking.png"]
    run, said = nbs.Run.load(folder / "run.npz"), summary(folder)
    assert said["figures"].items() >= metrics.summary(run).items()
    last = metrics.rms_error(run, after=0.7 * run.t[-1]).tolist()
    assert said["figures"]["rms_error_last_30_percent_rad"] == last
    assert said["settings"] == run.info["settings"]
    assert said["versions"] == run.info["versions"] == versions()
    assert said["robot_sha256"] == run.robot_sha256 == nbs.load_robot(name).sha256
    assert said["wall_time_s"] > 0.0
    assert (folder / "tracking.png").read_bytes().startswith(b"\x89PNG")
    assert (folder / "replay.html").read_text().startswith("<!DOCTYPE html>")


def test_track_prints_the_figures_it_stores(tracked):
    _, folder, printed = tracked
    figures = summary(folder)["figures"]
    rows = {line.split()[0]: line.split()[1:] for line in printed.splitlines() if line.split()}
    for i, joint in enumerate(figures["joints"]):
        errors = [figures[f"rms_error_{which}rad"][i] for which in ("", "late_", "last_30_percent_")]
        torques = [figures["joint_peak_torque_Nm"][i], figures["effort_limit_Nm"][i]]
        assert rows[joint] == [*(f"{e:.2e}" for e in errors), *(f"{x:.4g}" for x in torques)]
    cut = figures["saturated_fraction"]
    assert (f"{100.0 * cut:.2f} % of the time" if cut else "no torque was cut") in printed
    assert f"from {figures['convergence_time_s']:.3g} s on" in printed
    *_, following = lines = printed.splitlines()
    assert lines[-5:-1] == [f"out/{folder.name}/{name}" for name in tracking.FILES]
    assert following == f"next: nbs-pin replay out/{folder.name} --open"


def test_the_options_reach_the_run(tracked):
    name, folder, _ = tracked
    run, settings = nbs.Run.load(folder / "run.npz"), summary(folder)["settings"]
    offset = run.q[0] - run.q_ref[0]
    if name == "two_link":
        np.testing.assert_allclose(offset, [0.3, -0.3], atol=1e-15)
        assert not run.v[0].any()
        np.testing.assert_array_equal(np.unique(np.abs(run.disturbance[:-1]), axis=0), [[2.0, 1.0]])
        assert len(np.unique(run.disturbance[:-1, 0])) == 2
        assert run.info["controller"] == "NeuralBackstepping"
        assert (run.t[-1], run.period, settings["seed"]) == (1.5, 0.001, 3)
        assert "MujocoPlant" in run.info["plant"]
    else:
        np.testing.assert_array_equal(run.q[0], run.q_ref[0])
        np.testing.assert_array_equal(run.v[0], run.v_ref[0])
        assert not run.disturbance.any()
        assert run.info["controller"] == "ComputedTorque"
        assert (run.t[-1], run.period, settings["seed"]) == (0.6, 0.002, 0)
        assert "PinocchioDynamics" in run.info["plant"]


PAPERS = (
    "track two_link --plant pinocchio --controller nbs-paper --reference paper --period 0.01 --no-effort-limit "
    "--integrator euler --plant-step 0.01 --lookahead 0 --start 0,0"
)


def test_the_papers_row_is_one_command(tmp_path, capsys):
    for out, more in (("a", "--start=-0.5,1"), ("b", "")):
        assert cli.main(f"{PAPERS} --seed 3 --duration 0.5 --out {tmp_path / out} {more}".split()) == 0
    far, run = (nbs.Run.load(tmp_path / out / "run.npz") for out in "ab")
    assert far.q[0].tolist() == [-0.5, 1.0]
    dynamics = nbs.PinocchioDynamics(nbs.load_robot("two_link"))
    plant, law = nbs.DynamicsPlant(dynamics, integrator="euler"), nbs.paper_controller(dynamics, seed=3)
    options = {"q0": np.zeros(2), "plant_step": 0.01, "lookahead": 0.0, "effort_limit": np.inf}
    same = nbs.simulate(plant, law, nbs.paper_reference(2), duration=0.5, period=0.01, **options)
    np.testing.assert_array_equal(run.q, same.q)
    assert np.isinf(run.effort_limit).all()


def test_an_effort_limit_reaches_the_law(tmp_path, capsys):
    assert track(tmp_path, "--controller", "pid", "--start-error", "1", "--effort-limit", "40") == 0
    run, arm = nbs.Run.load(tmp_path / "run.npz"), nbs.load_robot("two_link").with_effort_limit(40.0)
    assert (run.effort_limit == 40.0).all()
    motion = nbs.Sinusoid.for_robot(arm)
    start = motion(0.0).q + np.array([1.0, -1.0])
    same = nbs.simulate(nbs.MujocoPlant(arm), nbs.PID.for_robot(arm), motion, 0.1, 0.001, q0=start)
    np.testing.assert_array_equal(run.q, same.q)


def test_a_motion_from_a_file_is_followed_for_its_length(tmp_path, capsys):
    t = np.arange(0.0, 0.3, 0.01)
    q = np.column_stack([0.1 * t**2, 0.2 - 0.1 * t**2])
    motion = tmp_path / "motion.csv"
    motion.write_text("t,joint2,joint1\n" + "".join(f"{a},{c},{b}\n" for a, (b, c) in zip(t, q, strict=True)))
    names = nbs.load_robot("two_link").joint_names
    assert names == ("joint1", "joint2")
    assert cli.main(["track", "two_link", "--reference", str(motion), "--out", str(tmp_path / "run")]) == 0
    run = nbs.Run.load(tmp_path / "run" / "run.npz")
    assert run.t[-1] == pytest.approx(0.29)
    np.testing.assert_allclose(run.q_ref[::10], q, atol=1e-9)
    assert np.abs(run.q - run.q_ref).max() < 1e-5


def test_an_arm_from_a_file_is_found_again_from_anywhere(tmp_path, monkeypatch, capsys):
    urdf = find("two_link").path.read_text()
    (tmp_path / "arm.urdf").write_text(urdf.replace('name="two_link"', 'name="my/arm"'))
    monkeypatch.chdir(tmp_path)
    assert cli.main(["track", "arm.urdf", "--duration", "0.05"]) == 0
    folder = tmp_path / "out" / "track-my_arm"
    monkeypatch.chdir("/")
    assert cli.main(["replay", str(folder), "--out", str(tmp_path / "again.html")]) == 0
    assert motion_in(tmp_path / "again.html") == motion_in(folder / "replay.html")


def test_results_of_another_run_are_kept_unless_forced(two_link, capsys):
    before = contents(two_link)
    assert track(two_link) == 0
    assert contents(two_link)["run.npz"] == before["run.npz"]
    check_results_are_kept_unless_forced(track, two_link, ["--seed", "1"], "--force", capsys)
    assert summary(two_link)["seed"] == 1


# Refusals: exit code 2 and one sentence.

REFUSED = {
    "": f"no command was given; give one of {', '.join(cli.COMMANDS)}, or see nbs-pin --help.",
    "--hlep": "no command is called '--hlep'; did you mean --help?",
    "trak panda": "no command 'trak'; did you mean track?",
    "track": "ROBOT",
    "track pand": "did you mean panda?",
    "track no/arm.urdf": "no file 'no/arm.urdf'",
    "track panda x": "takes no argument 'x'",
    "track panda --durtion 3": "did you mean --duration?",
    "track panda --duration": "--duration was given no value; see nbs-pin track --help.",
    "track panda --reference cirle:0.1 --frame panda_hand": "did you mean circle?",
    "track panda --armature joint1=0.2": "did you mean panda_joint1?",
    "track panda --plant gazebo": "--plant is 'gazebo'; give mujoco, pinocchio.",
    "track panda --duration 1.0005": "expected a whole number",
    "track panda --duration 90000 --period 1e-5": "GB",
    "track panda --bandwidth 600": "at most 500 rad/s",
    "track panda --frequency 50": "of joint 'panda_joint",
    "track two_link --effort-limit 1": "outside [-1, 1]",
    "track two_link --effort-limit 1 --no-effort-limit": "choose one",
    "track two_link --start 0.1,0.2 --start-error 0.1": "choose one",
    "track two_link --start 0.1": "1 numbers for 2 joints",
    "track two_link --integrator semi_implicit_euler": "integrator 'semi_implicit_euler' is unknown",
    "track two_link --plant-step 0.0007": "expected a whole number",
    "track two_link --reference sinus": "did you mean sinusoid?",
    "track two_link --reference none.csv": "no such file 'none.csv'",
    "track two_link --disturbance constant:1,2,3": "3 torques for 2 joints",
    "track two_link --out /proc/nowhere": "'/proc/nowhere': no such file",
    "replay none.npz": "no such file 'none.npz'",
    "robots pandas": "did you mean panda",
}
WRONG = {
    "--duration": ("nan", "inf", "0", "-1", "1_0", "٣", "1e-400", "ten"),
    "--frequency": ("nan", "0", "-1"),
    "--period": ("0", "1e-9", "10", "nan"),
    "--bandwidth": ("-8", "inf"),
    "--start-error": ("-0.1", "4", "nan"),
    "--effort-limit": ("0", "inf"),
    "--start": ("nan,0", "0,", "0;1", "0,1_0"),
    "--plant-step": ("0", "nan", "1"),
    "--lookahead": ("-1", "inf"),
    "--seed": ("-1", "1.5", "1_0", "99999999999"),
    "--disturbance": ("5", "constant", "constant:nan", "square:5", "sine:5@0", "noise:-1", "noise:1@2", "sin:5@8"),
}
REFUSED |= {f"track panda {flag} {x}": f"{flag} is '{x}'" for flag, values in WRONG.items() for x in values}


@pytest.mark.parametrize("command", REFUSED)
def test_bad_input_is_refused_in_one_sentence(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert REFUSED[command] in refusal(cli.main(command.split()), capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("target", ["--out {0}/run.npz", "--out {0}/run.npz/deeper"])
def test_a_file_is_no_folder(two_link, target, capsys):
    before = contents(two_link)
    assert refusal(cli.main(["track", "two_link", *target.format(two_link).split()]), capsys)
    assert contents(two_link) == before


def test_a_full_disk_is_one_sentence_and_leaves_nothing(tmp_path):
    # A file may grow to 20 kB here; the run needs more.
    done = nbs_pin(
        *("track", "two_link", "--duration", "1", "--out", str(tmp_path / "run")),
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
        env={"PATH": "/usr/bin", "PYTHONDONTWRITEBYTECODE": "1", "MPLCONFIGDIR": str(tmp_path)},
    )
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("nbs-pin: error: ")
    assert f"'{tmp_path / 'run' / 'run.npz'}': file too large" in done.stderr
    assert not (tmp_path / "run").exists()


# Interruptions.


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stop_in_the_simulation_leaves_nothing(tmp_path, number, code):
    folder = tmp_path / "run"
    process = subprocess.Popen([*NBS_PIN, "track", "two_link", "--duration", "1000", "--out", str(folder)])
    while not folder.exists():
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    assert process.wait(timeout=60) == code
    assert not folder.exists()


def test_a_stop_within_text_that_is_executed_has_its_exit_code(tmp_path):
    """Python remembers an interrupt that leaves an exec of text, though it was handled, and ends by the signal."""
    script = (
        "import os, signal, sys\nimport nbs_pin.cli.shell as shell\nfrom nbs_pin.cli import main\n"
        "def run(arguments, stops, ready):\n"
        "    ready()\n"
        "    try:\n        exec('import os, signal; os.kill(os.getpid(), signal.SIGINT); sum(range(10**7))')\n"
        "    except KeyboardInterrupt:\n        print('kept')\n        return stops[0]\n"
        "shell.run = run\nsys.argv = ['nbs-pin']\nsys.exit(main())\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "kept\n", "")


def is_handled(process, number):
    """Whether the process has a handler for the signal; before that it is the interpreter that starts."""
    caught = re.search(r"SigCgt:\s*(\w+)", Path(f"/proc/{process.pid}/status").read_text())
    return caught is not None and bool(int(caught[1], 16) >> (number - 1) & 1)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stop_while_modules_are_imported_is_one_line(tmp_path, number, code):
    for delay in (0.0, 0.002, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0):
        command = [*NBS_PIN, "track", "two_link", "--duration", "1000", "--out", str(tmp_path / "run")]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while not is_handled(process, signal.SIGTERM):  # Python itself handles SIGINT somewhat earlier
            assert process.poll() is None
        time.sleep(delay)
        process.send_signal(number)
        printed = process.communicate(timeout=60)
        assert (process.returncode, *printed) == (code, "", "nbs-pin: interrupted.\n"), delay
        assert not (tmp_path / "run").exists()


def test_what_would_make_a_library_fail_is_one_sentence(tmp_path):
    gone = tmp_path / "gone"
    shell = 'cd "$1"; rmdir "$1"; exec "$2" -m nbs_pin.cli robots'
    gone.mkdir()
    command = ["sh", "-c", shell, "sh", str(gone), sys.executable]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": ROOT})
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "the current folder no longer exists" in done.stderr
    done = nbs_pin("robots", env=os.environ | {"NUMBA_NUM_THREADS": "abc"})
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "NUMBA_NUM_THREADS is 'abc'" in done.stderr


def test_a_stop_the_moment_the_folder_is_made_leaves_nothing(tmp_path, monkeypatch, capsys):
    make = Path.mkdir

    def made_and_interrupted(self, **options):
        make(self, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "mkdir", made_and_interrupted)
    assert track(tmp_path / "run") == 130
    assert not list(tmp_path.iterdir())


def test_a_reader_who_leaves_early_is_no_error():
    process = subprocess.Popen([*NBS_PIN, "robots"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait(timeout=60) == 0
    process.stderr.close()


# Replay, robots, help.


def test_replay_draws_what_track_drew(two_link, tmp_path, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)
    page = tmp_path / "page.html"
    assert cli.main(["replay", str(two_link / "run.npz"), "--out", str(page), "--open"]) == 0
    assert motion_in(page) == motion_in(two_link / "replay.html")
    assert opened == [page.as_uri()]
    assert capsys.readouterr().out == f"{page}\n"
    assert "--force" in refusal(cli.main(["replay", str(two_link), "--out", str(page)]), capsys)
    for command in ("replay", "report"):
        assert "ends in .html" in refusal(cli.main([command, str(two_link), "--out", str(page.parent / "a")]), capsys)
    assert cli.main(["replay", str(two_link), "--out", str(page), "--force"]) == 0


def test_replay_goes_beside_the_run_and_refuses_what_is_none(two_link, capsys):
    (two_link / "replay.html").unlink()
    assert cli.main(["replay", str(two_link)]) == 0
    assert capsys.readouterr().out == f"{two_link / 'replay.html'}\n"
    assert (two_link / "replay.html").is_file()
    assert "not an intact npz file" in refusal(cli.main(["replay", str(two_link / "summary.json")]), capsys)
    for options in (["--start", "1"], ["--robot", "panda"], ["--out", str(two_link)]):
        assert refusal(cli.main(["replay", str(two_link), *options]), capsys)


def test_robots_lists_every_arm(capsys):
    assert cli.main(["robots"]) == 0
    printed = capsys.readouterr().out
    rows = {line.split()[0]: line.split()[1:] for line in printed.splitlines() if line.split()}
    assert rows.keys() >= set(nbs.ROBOT_NAMES)
    assert rows["panda"] == ["7", "12", "to", "87", "0", "viscous"]
    assert rows["kinova"] == ["6", "20", "to", "80", "3", "no"]
    assert rows["z1"][-2:] == ["viscous,", "Coulomb"]
    assert rows["double_pendulum"][1] == "none"
    assert ".xacro" in printed
    assert "nbs-pin[xacro]" in printed


def test_robots_shows_the_joints_and_frames_of_one_arm(capsys):
    assert cli.main(["robots", "panda", "--armature", "panda_joint2=0.25", "--payload", "2@panda_hand"]) == 0
    printed = capsys.readouterr().out
    rows = {line.split()[0]: line.split()[1:] for line in printed.splitlines() if line.split()}
    assert rows["panda_joint2"] == ["-1.76", "to", "1.76", "2.175", "87", "0.003", "0", "0.25"]
    frames = printed.split("Frames (--frame): ")[1].split(".")[0].split(", ")
    robot = nbs.load_robot("panda", payload={"panda_hand": 2.0})
    assert tuple(frames) == robot.frames
    assert f"{sum(body.mass for body in robot.model.inertias):.4g} kg" in printed


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"nbs-pin {nbs.__version__}\n"


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_the_example_in_each_help_is_a_command(command, capsys):
    assert cli.main([command, "--help"]) == 0
    example = re.search(r"^Example: nbs-pin (.+)$", capsys.readouterr().out, re.MULTILINE)
    parsed = cli.parse(shlex.split(example[1]))
    assert type(parsed).__name__.lower() == command.replace("-", "")


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_the_help_says_in_words_what_is_done_without_an_option(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main([command, "--help"]) == 0
    printed = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    assert "(default: )" not in printed
    assert not re.search(r"\bNone\b|\(default: \(", printed)


def test_help_is_quick_because_it_imports_no_engine():
    code = "import sys; from nbs_pin.cli import main; main(['track', '--help']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"torch", "pinocchio", "mujoco", "matplotlib", "meshcat", "scipy", "trimesh", "numpy"}
    assert "--start-error" in done.stdout
    assert not heavy & set(done.stdout.splitlines()[-1].split())


# The words of options.


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_plain_number_is_what_it_says(x):
    assert plain_number(repr(x)) == x


@given(st.text("0123456789.eE+-_ ٣²nainfx", max_size=8))
def test_text_is_a_number_or_refused_but_never_misread(text):
    value = plain_number(text)
    assert value is None or (text.isascii() and "_" not in text and float(text) == value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("constant:5", [5.0, 5.0]),
        ("constant:5,-3", [5.0, -3.0]),
        ("square:2@10", [-2.0, -2.0]),
        ("sine:1,4@10", [np.sin(4.0), 4.0 * np.sin(4.0)]),
    ],
)
def test_a_disturbance_is_the_torque_it_says(text, expected):
    torque = parse_disturbance(text).build(2, 0.001, 0)(0.4, np.zeros(2), np.zeros(2))
    np.testing.assert_allclose(torque, expected, rtol=1e-14)


def test_noise_has_its_deviation_and_changes_every_period_with_its_seed():
    zero = np.zeros(2)
    noise, other = (parse_disturbance("noise:0.5").build(2, 0.01, seed) for seed in (1, 2))
    samples = np.array([noise(0.01 * k, zero, zero) for k in range(2000)])
    assert samples.std() == pytest.approx(0.5, rel=0.05)
    assert (noise(0.0, zero, zero) == noise(0.005, zero, zero)).all()
    assert (noise(0.0, zero, zero) != other(0.0, zero, zero)).all()


def test_no_disturbance_is_none_and_a_wrong_count_is_refused():
    assert parse_disturbance("none").build(7, 0.001, 0) is None
    with pytest.raises(OptionError, match="2 torques for 7 joints"):
        parse_disturbance("constant:1,2").build(7, 0.001, 0)
