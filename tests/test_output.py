"""What commands say: the verdict first, tables when asked for, a next command that can be typed, and what is kept."""

import json
import shlex
import subprocess

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.units import measured
from nbs_pin.commands import following, reproduce
from nbs_pin.reports.markdown import Section
from tests.commands import contents, printed_by, refusal, summary

TRACK = ("track", "two_link", "--duration", "0.05")


@pytest.mark.parametrize(
    ("value", "unit", "told"),
    [
        (np.pi / 180.0, "rad", "0.0175 rad (1°)"),
        (0.0012, "m", "0.0012 m (1.2 mm)"),
        (5.0, "N·m", "5 N·m"),
        (np.inf, "rad", "inf rad"),
    ],
)
def test_a_number_is_told_with_what_one_pictures(value, unit, told):
    assert measured(value, unit) == told


def test_the_verdict_comes_first_and_the_table_when_asked_for(tmp_path):
    brief = printed_by(*TRACK, "--out", tmp_path / "a").splitlines()
    full = printed_by(*TRACK, "--out", tmp_path / "b", "-v").splitlines()
    figures = summary(tmp_path / "a")["figures"]
    worst = max(figures["rms_error_last_30_percent_rad"])
    assert brief[0] == full[0]
    assert brief[0].startswith("two_link, nbs in mujoco: converged: from ")
    assert measured(worst, "rad") in brief[0]
    assert not any(line.split()[:1] == ["joint1"] for line in brief)
    assert sum(line.split()[:1] == ["joint1"] for line in full) == 1
    assert summary(tmp_path / "b")["settings"] == summary(tmp_path / "a")["settings"]


def test_what_is_promised_is_one_sentence_in_degrees(tmp_path):
    options = ("certify", "two_link", "--disturbance", "5", "--out")
    lines = printed_by(*options, tmp_path / "a").splitlines()
    certificate = summary(tmp_path / "a")["figures"]["certificate"]
    strays = measured(max(certificate["joint_errors_rad"]), "rad")
    assert lines[0].startswith(f"PROVED: no joint of two_link strays more than {strays} from its motion under ")
    assert "control periods of 1 ms" in lines[0]
    assert len(lines) < 10
    slow = printed_by(*options, tmp_path / "b", "--period", "0.005").splitlines()
    assert "continuous time" in slow[0]
    assert slow[1].startswith("nothing is proved of torques held for 5 ms: the longest period with a proof is ")
    longest = float(slow[1].split("proof is ")[1].split()[0]) * 1e-3
    assert slow[1].endswith("ms; two_link states no rotor inertia: if its motors have any, --armature … may allow more")
    fast = nbs.certify(
        nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link"), period=0.005),
        [5.0, 5.0],
        reference=nbs.Sinusoid.for_robot(nbs.load_robot("two_link")),
        period=0.99 * longest,
    )
    assert fast.unproved_hold == ""


def test_nothing_promised_is_said_first_and_is_an_exit_code_of_its_own(tmp_path, capsys):
    assert cli.main(["certify", "two_link", "--disturbance", "1e6", "--out", str(tmp_path / "a")]) == cli.NO_PROMISE
    assert capsys.readouterr().out.startswith("NOT PROMISED: that no joint of two_link strays ")


def test_the_next_command_can_be_typed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["collect", "two_link", "--samples", "40", "--recipe", "uniform", "--out", "some data"]
    for expected in ("learn", "compare"):
        *_, following = printed_by(*words).splitlines()
        assert following.startswith(f"next: nbs-pin {expected} ")
        words = shlex.split(following)[2:]
        assert cli.parse(words) is not None
    assert printed_by(*words, "--trajectories", "0", "--samples", "20").startswith("model.nbs against two_link: ")


def test_several_laws_follow_one_motion(tmp_path):
    folder = tmp_path / "laws"
    nbs.save(nbs.SlotineLi.for_robot(nbs.load_robot("two_link")), tmp_path / "mine.nbs")
    laws = f"nbs,pid,{tmp_path / 'mine.nbs'}"
    options = (*TRACK, "--start-error", "0.1", "--controller", laws, "--out", folder)
    printed = printed_by(*options)
    runs = {name: nbs.Run.load(folder / f"run-{name}.npz") for name in ("nbs", "pid", "mine")}
    assert contents(folder).keys() == {"run-nbs.npz", "run-pid.npz", "run-mine.npz", "comparison.png", "summary.json"}
    assert [run.info["controller"] for run in runs.values()] == ["NeuralBackstepping", "PID", "SlotineLi"]
    found = summary(folder)
    for name, run in runs.items():
        np.testing.assert_array_equal(run.q_ref, runs["nbs"].q_ref)
        assert found["figures"]["laws"][name]["rms_torque_Nm"] == float(nbs.metrics.rms_torque(run))
        assert any(line.split()[:1] == [name] for line in printed.splitlines())
    alone = tmp_path / "alone"
    printed_by(*TRACK, "--start-error", "0.1", "--controller", "pid", "--out", alone)
    np.testing.assert_array_equal(nbs.Run.load(alone / "run.npz").tau, runs["pid"].tau)
    assert printed_by(*options) == printed
    nbs.save(nbs.PID.for_robot(nbs.load_robot("two_link")), tmp_path / "mine.nbs")
    assert cli.main([*map(str, options)]) == 2  # another controller in the file


@pytest.mark.parametrize(
    ("laws", "words"),
    [("nbs,nbs", "twice"), ("nbs,pdi", "did you mean pid?"), ("nbs,", "give nbs"), ("pid,a/pid.nbs", "one name")],
)
def test_laws_that_cannot_be_meant_are_refused(laws, words, tmp_path, capsys):
    assert words in refusal(cli.main([*TRACK, "--controller", laws, "--out", str(tmp_path / "a")]), capsys)


def test_ctrl_c_keeps_what_was_simulated(tmp_path, monkeypatch, capsys):
    """The rows up to the interrupt are those of the whole run."""
    options = ("track", "two_link", "--duration", "0.4", "--start-error", "0.1", "--out")
    assert cli.main([*options, str(tmp_path / "whole")]) == 0
    streamed = following.stream

    def interrupted(*arguments, **settings):
        blocks = streamed(*arguments, **settings, block=100)
        yield next(blocks)
        yield next(blocks)
        raise KeyboardInterrupt

    monkeypatch.setattr(following, "stream", interrupted)
    assert cli.main([*options, str(tmp_path / "part")]) == 130
    assert "interrupted" in capsys.readouterr().err
    whole, part = (nbs.Run.load(tmp_path / name / "run.npz") for name in ("whole", "part"))
    assert part.t[-1] == pytest.approx(0.2)
    for name in ("t", "q", "v", "q_ref", "tau"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[:201])
    assert summary(tmp_path / "part")["interrupted"]
    assert not summary(tmp_path / "whole")["interrupted"]
    monkeypatch.undo()
    assert cli.main([*options, str(tmp_path / "part")]) == 2  # a part is not the result of the command
    assert cli.main([*options, str(tmp_path / "part"), "--force"]) == 0
    assert contents(tmp_path / "part")["run.npz"] == contents(tmp_path / "whole")["run.npz"]


def test_ctrl_c_keeps_the_sections_that_are_done(tmp_path, monkeypatch, capsys):
    def part(folder, seed, progress):
        yield Section("First", "Done.", {"first": 1})
        raise KeyboardInterrupt

    monkeypatch.setitem(reproduce.PARTS, "paper", part)
    assert cli.main(["reproduce", "--out", str(tmp_path / "a")]) == 130
    page = (tmp_path / "a" / "report.md").read_text()
    assert "## First\n\nDone." in page
    assert "interrupted before its end" in page
    said = json.loads((tmp_path / "a" / "summary.json").read_text())
    assert (said["figures"], said["interrupted"]) == ({"first": 1}, True)


def test_a_quick_page_is_asked_of_every_part(tmp_path, monkeypatch):
    seen = {}
    for name in reproduce.PARTS:
        monkeypatch.setitem(reproduce.PARTS, name, lambda *given, name=name: seen.setdefault(name, given[3:]) and [])
    printed_by("reproduce", "--part", "all", "--quick", "--out", tmp_path / "a")
    assert seen == {name: (scale,) for name, scale in reproduce.QUICK.items()}


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_the_shell_completes_commands_and_options(shell, tmp_path):
    script = printed_by("--tyro-print-completion", shell)
    for word in ("certify", "--disturbance", "computed-torque"):
        assert word in script
    if shell == "bash":
        (tmp_path / "nbs-pin.bash").write_text(script)
        subprocess.run(["bash", "-n", str(tmp_path / "nbs-pin.bash")], check=True)
