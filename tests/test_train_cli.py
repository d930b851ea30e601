"""`nbs-pin train`: what it writes and prints, what it refuses, and that Ctrl-C and --resume lose nothing."""

import os
import pty
import shlex
import signal
import subprocess
import sys

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.versions import versions
from nbs_pin.commands import train as training
from nbs_pin.reports.charts import plot_training
from nbs_pin.training import evaluation, trainer
from tests.commands import check_results_are_kept_unless_forced, contents, refusal, summary
from tests.test_plotting import drawn, png_size, sinusoid_run

QUICK = ("--starts", "6", "--duration", "0.3", "--frequencies", "1,2", "--epochs", "6", "--bandwidth", "4")
FILES = ["controller.nbs", "learning.png", "summary.json", "training.ckpt"]


def train(folder, *options, robot="two_link"):
    return cli.main(["train", robot, *QUICK, "-v", "--out", str(folder), *options])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where two_link was trained."""
    folder = tmp_path_factory.mktemp("trained") / "two_link"
    assert train(folder) == 0
    return folder


def outcome(folder):
    """Everything that a training decides: weights, and the cost of every epoch."""
    weights = nbs.load(folder / "controller.nbs").state_dict()
    curves = summary(folder)
    return {k: x.numpy().tobytes() for k, x in weights.items()}, curves["history"], curves["held_out"]


# Results.


def test_the_summary_holds_every_figure(folder):
    said = summary(folder)
    assert sorted(contents(folder)) == FILES
    assert said["versions"] == versions()
    assert said["robot_sha256"] == nbs.load_robot("two_link").sha256
    assert not said["interrupted"]
    figures = said["figures"]
    assert (figures["epochs"], figures["stopped"], figures["fresh_starts"]) == (6, "epochs", 40)
    assert len(said["history"]) == len(said["held_out"]) == 7
    best = figures["best_epoch"]
    assert figures["held_out_cost"] == [said["held_out"][0], said["held_out"][best]]
    assert figures["training_cost"] == [said["history"][0], said["history"][best]]
    assert said["held_out"][best] == min(said["held_out"]) < said["held_out"][0]
    assert figures["held_out_cost_lowered_by"] == 1.0 - said["held_out"][best] / said["held_out"][0]


def test_the_table_is_the_summary(tmp_path, capsys):
    assert train(tmp_path / "run", "--epochs", "2", "--optimiser", "lbfgs") == 0
    printed, figures = capsys.readouterr().out, summary(tmp_path / "run")["figures"]
    for before, after in (figures["training_cost"], figures["held_out_cost"]):
        assert f"{before:.4g}   {after:.4g}" in " ".join(printed.split()).replace(" ", "   ")
    for name, form in (("peak_torque_Nm", "{:.4g}"), ("rms_torque_Nm", "{:.4g}")):
        for when in ("before", "after"):
            assert form.format(figures[when][name]) in printed
    for when in ("before", "after"):
        assert f"{100.0 * figures[when]['saturated_fraction']:.2f} %" in printed
    assert f"lowered by {100.0 * figures['held_out_cost_lowered_by']:.1f} %" in printed
    assert printed.splitlines()[-4:-1] == [str(tmp_path / "run" / name) for name in training.FILES]


def test_fresh_starts_are_judged_as_simulate_would(folder):
    """One of the fresh motions again by `simulate`, and the figures from it alone."""
    robot = nbs.load_robot("two_link")
    law = nbs.load(folder / "controller.nbs", robot)
    plant = nbs.DynamicsPlant(nbs.PinocchioDynamics(robot))
    references = [nbs.Sinusoid.for_robot(robot, w) for w in (1.0, 2.0)]
    loop = training.Loop.of(plant, 2, 0.9, 0.005, plant_step=0.005, effort_limit=None, lookahead=None)
    batch = training.fresh_batch(loop, references, 0.3, seed=0)
    run = training.compared(law, batch)
    worst = nbs.metrics.convergence_time(run).max()
    assert summary(folder)["figures"]["after"]["convergence_time_worst_s"] == worst
    for k, reference in ((3, references[0]), (31, references[1])):
        again = nbs.simulate(plant, law, reference, 0.9, 0.005, q0=batch.q0[k], plant_step=0.005)
        np.testing.assert_allclose(run.q[:, k], again.q, atol=1e-9)
        assert np.abs(again.q[0] - again.q_ref[0]).max() <= 0.3


def test_a_trained_controller_can_be_tracked_and_trained_on(folder, tmp_path, capsys):
    saved = str(folder / "controller.nbs")
    track = ["track", "two_link", "--controller", saved, "--duration", "0.1", "--out", str(tmp_path / "a")]
    assert cli.main(track) == 0
    assert len(summary(tmp_path / "a")["settings"]["controller_sha256"]) == 64
    robot = nbs.load_robot("two_link")
    plain = nbs.simulate(nbs.MujocoPlant(robot), nbs.load(saved), nbs.Sinusoid.for_robot(robot), 0.1, 0.001)
    np.testing.assert_array_equal(nbs.Run.load(tmp_path / "a" / "run.npz").tau, plain.tau)
    assert train(tmp_path / "b", "--controller", saved, "--epochs", "1") == 0
    assert summary(tmp_path / "b")["history"][0] == summary(folder)["history"][summary(folder)["figures"]["best_epoch"]]


@pytest.mark.parametrize("law", ["nbs-paper", "slotine-li", "computed-torque", "pd-plus", "pd-gravity", "pid"])
def test_every_law_by_name_learns(tmp_path, capsys, law):
    assert train(tmp_path / law, "--controller", law, "--epochs", "3", "--learning-rate", "0.003") == 0
    history = summary(tmp_path / law)["history"]
    assert min(history) < history[0]


@pytest.mark.parametrize("cost", ["squared-error", "time-outside"])
def test_options_reach_the_training(tmp_path, capsys, cost, folder):
    options = ("--cost", cost, "--no-effort-limit", "--fixed-gains", "--patience", "5", "--learning-rate", "0.001")
    assert train(tmp_path / "run", *options) == 0
    before, after = (nbs.load(path / "controller.nbs") for path in (folder, tmp_path / "run"))
    assert before.rate.change.abs().min() > 0.0
    assert not after.rate.change.any()
    figures = summary(tmp_path / "run")["figures"]
    assert figures["after"]["saturated_fraction"] == 0.0
    assert figures["held_out_cost"][0] != summary(folder)["figures"]["held_out_cost"][0]


# Stopping and going on.


@pytest.mark.parametrize(
    ("optimiser", "call"),
    [("adam-backtracking", 6), ("adam-backtracking", 13), ("adam-backtracking", 15), ("lbfgs", 11)],
)
def test_ctrl_c_at_any_moment_and_resume_are_one_training(folder, tmp_path, capsys, monkeypatch, optimiser, call):
    """Interrupted in the middle of a cost or a gradient, --resume goes on to the same last bit."""
    calls, cost = [], trainer.running_cost

    def counted(*arguments):
        calls.append(1)
        value = cost(*arguments)
        if len(calls) == call:
            raise KeyboardInterrupt
        return value

    options, whole = ("--optimiser", optimiser), folder
    if optimiser == "lbfgs":
        whole = tmp_path / "whole"
        assert train(whole, *options) == 0
    monkeypatch.setattr(trainer, "running_cost", counted)
    assert train(tmp_path / "parts", *options) == 130
    assert "interrupted" in capsys.readouterr().err
    said = summary(tmp_path / "parts")
    assert said["interrupted"]
    assert len(said["history"]) in range(1, 7)
    assert "--resume to continue it" in refusal(train(tmp_path / "parts", *options), capsys)
    assert train(tmp_path / "parts", *options, "--resume") == 0
    assert outcome(tmp_path / "parts") == outcome(whole)


def next_command(printed):
    """The words of the command that the last line names."""
    return shlex.split(printed.splitlines()[-1].removeprefix("next: nbs-pin "))


def test_the_next_command_can_be_typed_as_it_is(tmp_path, capsys, monkeypatch):
    """Of a training with options of the arm and in a folder taken by itself: go on after Ctrl-C, then track."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out" / "train-two_link").mkdir(parents=True)
    (tmp_path / "out" / "train-two_link" / "summary.json").write_text("{}")
    calls, cost = [], trainer.running_cost

    def counted(*arguments):
        calls.append(1)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return cost(*arguments)

    monkeypatch.setattr(trainer, "running_cost", counted)
    options = ["--payload", "0.5", "--limits", "joint1.upper=3", "--effort-limit", "90"]
    assert cli.main(["train", "two_link", *QUICK, *options]) == 130
    again = next_command(capsys.readouterr().out)
    assert "--resume" in again
    assert cli.main(again) == 0
    assert not summary(tmp_path / "out" / "train-two_link-2")["interrupted"]
    on = next_command(capsys.readouterr().out)
    assert cli.main([*on, "--duration", "0.05", "--out", "out/tracked"]) == 0
    run = nbs.Run.load(tmp_path / "out" / "tracked" / "run.npz")
    assert run.effort_limit.tolist() == [90.0, 90.0]
    assert run.robot_options["payload"]


def test_resuming_what_is_done_changes_nothing(folder, tmp_path, capsys):
    before = outcome(folder)
    assert train(folder, "--resume") == 0
    assert outcome(folder) == before


def test_ctrl_c_before_the_first_epoch_leaves_nothing(tmp_path, capsys, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(trainer, "running_cost", interrupted)
    assert train(tmp_path / "run") == 130
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_real_signal_at_a_terminal(tmp_path, number, code):
    """The bar says the cost and the time left; the signal ends the training within an epoch, results written."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "nbs_pin.cli", "train", "two_link", *QUICK, "--epochs", "100000"]
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "run")], stderr=theirs, env=os.environ | {"COLUMNS": "120"}
    )
    os.close(theirs)
    shown = b""
    while b"cost" not in shown or not (tmp_path / "run" / "training.ckpt").exists():
        shown += os.read(ours, 4096)
    process.send_signal(number)
    assert process.wait(timeout=60) == code
    os.close(ours)
    assert b"from 0.0" in shown
    assert sorted(contents(tmp_path / "run")) == FILES
    figures = summary(tmp_path / "run")["figures"]
    assert figures["stopped"] == "interrupted"
    assert figures["epochs"] == len(summary(tmp_path / "run")["history"]) >= 5


# Refusals.


def test_results_of_another_training_are_kept_unless_forced(tmp_path, capsys):
    words = "training.ckpt of another or an unfinished training"
    check_results_are_kept_unless_forced(train, tmp_path, ["--seed", "2"], words, capsys)
    assert summary(tmp_path)["settings"]["seed"] == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("--seed=1", "it has --seed 0, and here is --seed 1"),
        ("--epochs=7", "it has --epochs 6, and here is --epochs 7"),
        ("--duration=0.4", "it has --duration 0.3, and here is --duration 0.4"),
        ("--bandwidth=7", "it differs in the law that it begins with, --controller or --bandwidth"),
        ("--starts=8", "it differs in --starts"),
        ("--start-error=0.2", "it differs in --start-error"),
        ("--frequencies=1,3", "it differs in --frequencies"),
        ("--effort-limit=50", "it differs in the effort limits"),
        ("--cost=squared-error", "it differs in --cost"),
        ("--fixed-gains", "it differs in --fixed-gains"),
    ],
)
def test_a_resume_of_another_training_is_refused_with_what_differs(folder, capsys, change, words):
    before = contents(folder)
    line = refusal(train(folder, "--resume", change), capsys)
    assert f"not a checkpoint of this training, as {words}; give its original settings" in line
    assert contents(folder) == before


@pytest.mark.parametrize("command", ["track", "train"])
def test_a_controller_of_another_arm_is_refused_in_a_sentence(folder, tmp_path, capsys, command):
    words = [command, "panda", "--controller", str(folder / "controller.nbs"), "--out", str(tmp_path / "run")]
    assert "is for the arm 'two_link'" in refusal(cli.main(words), capsys)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--frequencies 1,,2", "--frequencies is '1,,2'; give numbers above 0"),
        ("--frequencies -1", "frequencies"),
        ("--frequencies 500", "the reference needs the torque"),
        ("--starts 0", "give a whole number from 1"),
        ("--epochs 0", "give a whole number from 1"),
        ("--duration 0.3001", "expected a whole number; take for instance 0.3 s"),
        ("--period 0.2", "--period is '0.2'"),
        ("--learning-rate 0", "--learning-rate is '0'"),
        ("--controller nsb", "--controller is 'nsb'; did you mean nbs?"),
        ("--controller none.nbs", "none.nbs"),
        ("--cost time", "time"),
        ("--effort-limit 5 --no-effort-limit", "choose one"),
        ("--bandwidth 200", "at most 100 rad/s"),
        ("--resume", "training.ckpt"),
        ("--controller computed-torque --fixed-gains", "nothing to train besides its gains"),
    ],
)
def test_what_cannot_be_trained_is_refused_in_a_sentence(tmp_path, capsys, options, words):
    assert words in refusal(train(tmp_path / "run", *options.split()), capsys)
    assert not (tmp_path / "run").exists()


# The picture.


@pytest.mark.parametrize("held_out", [np.array([0.5, 0.3, 0.4]), np.empty(0)])
def test_the_picture_marks_the_best_epoch_and_draws_median_and_worst(tmp_path, monkeypatch, held_out):
    history, run = np.array([1.0, 0.5, 0.4]), sinusoid_run(2, batch=(5,))
    run.q[:] += 0.01 * np.arange(5)[:, None]
    best = int((held_out if held_out.size else history).argmin())
    figure = drawn(lambda: plot_training(history, held_out, best, run, run, tmp_path / "a.png"), monkeypatch)
    assert png_size(tmp_path / "a.png") == (1320, 504)
    costs, errors = figure.axes
    chosen = held_out if held_out.size else history
    marked = next(line for line in costs.lines if line.get_marker() == "o")
    assert marked.get_xydata().tolist() == [[int(chosen.argmin()), chosen.min()]]
    size = np.sqrt(nbs.metrics.squared_error(run))
    np.testing.assert_allclose(errors.lines[0].get_ydata(), np.median(size, axis=1))
    np.testing.assert_allclose(errors.lines[1].get_ydata(), size.max(axis=1))


# Motions that diverge.


def test_fresh_motions_that_diverge_are_told_and_not_counted(tmp_path, capsys):
    """A finite training of 0.1 s whose fresh motions of 0.3 s are not."""
    options = ("--controller", "computed-torque", "--period", "0.05", "--duration", "0.1", "--no-effort-limit")
    wide = ("--bandwidth", "10", "--start-error", "2", "--starts", "2", "--frequencies", "1", "--epochs", "1")
    assert train(tmp_path / "run", *options, *wide) == 0
    figures = summary(tmp_path / "run")["figures"]
    for when in ("before", "after"):
        assert {figures[when][name] for name in ("peak_torque_Nm", "rms_torque_Nm", "saturated_fraction")} == {None}
        assert figures[when]["convergence_time_worst_s"] is None
    assert capsys.readouterr().out.count("not finite") == 6


@pytest.mark.parametrize("without_kernels", [False, True])
def test_one_motion_that_diverges_leaves_the_others_their_figures(monkeypatch, without_kernels):
    robot = nbs.load_robot("two_link").with_effort_limit(np.inf)
    dynamics = nbs.PinocchioDynamics(robot)
    plant, law = nbs.DynamicsPlant(dynamics), nbs.ComputedTorque(dynamics, kp=25.0, kd=10.0)
    loop = training.Loop.of(plant, 2, 0.8, 0.05, plant_step=0.05, effort_limit=None, lookahead=None)
    batch = training.fresh_batch(loop, [nbs.Sinusoid.for_robot(robot, 1.0)], 0.1, seed=0, starts=5)
    batch.v0[2] = 1e3
    if without_kernels:
        moved = evaluation.motions
        monkeypatch.setattr(evaluation, "motions", lambda law, batch: moved(law, batch, "torch"))
    figures = training.fresh_figures(training.compared(law, batch))
    assert np.isfinite(figures["convergence_time_median_s"])
    assert figures["convergence_time_worst_s"] == np.inf
    for name in ("steady_error_rad2", "peak_torque_Nm", "rms_torque_Nm", "saturated_fraction"):
        assert np.isnan(figures[name])


def test_figures_of_fresh_motions_are_those_of_the_metrics():
    run = sinusoid_run(2, batch=(4,))
    run.q[:] += 0.03 * np.arange(4)[:, None]
    figures = training.fresh_figures(run)
    times = nbs.metrics.convergence_time(run)
    assert figures["convergence_time_median_s"] == np.median(times)
    assert figures["convergence_time_worst_s"] == times.max()
    assert figures["steady_error_rad2"] == nbs.metrics.steady_error(run).max()
    assert figures["rms_torque_Nm"] == pytest.approx(np.sqrt(np.mean(np.sum(run.tau[:-1] ** 2, axis=-1))))
    assert figures["peak_torque_Nm"] == np.abs(run.tau[:-1]).max()


def test_the_picture_ends_where_motions_diverge(tmp_path, monkeypatch):
    history, run = np.array([1.0, np.nan]), sinusoid_run(2, batch=(3,))
    middle = len(run.t) // 2
    run.q[middle:, 0] = np.nan
    run.q[middle:, 1] = 1e200
    figure = drawn(lambda: plot_training(history, np.empty(0), 0, run, run, tmp_path / "a.png"), monkeypatch)
    median, worst = (line.get_ydata() for line in figure.axes[1].lines[:2])
    assert np.isfinite(median[:middle]).all()
    assert np.isfinite(worst[:middle]).all()
    assert np.isnan(median[middle:]).all()
    assert np.isnan(worst[middle:]).all()
