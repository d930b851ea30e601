"""`nbs-pin collect`: what it writes, what it prints, and what it refuses."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.versions import versions
from nbs_pin.commands import collect as collecting
from nbs_pin.identification import collect as recording
from nbs_pin.identification.collect import collect
from nbs_pin.identification.datasets import load_dataset
from nbs_pin.identification.measurement import Noise
from tests.commands import check_results_are_kept_unless_forced, refusal, summary
from tests.test_plotting import png_size

QUICK = ("--samples", "80", "--sampling", "0.01", "--duration", "0.4")
ROBOT = nbs.load_robot("two_link")


def run(folder, *options, robot="two_link"):
    return cli.main(["collect", robot, *QUICK, "-v", "--out", str(folder), *options])


def collected(folder, options, robot="two_link"):
    assert run(folder, *options.split(), robot=robot) == 0
    return load_dataset(folder / "data.npz")


def test_the_files_are_the_data_and_what_they_cover(tmp_path):
    data, said = collected(tmp_path, ""), summary(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(collecting.FILES)
    expected = collect(ROBOT, samples=80, sampling=0.01, duration=0.4)
    assert_array_equal(data.tau, expected.tau)
    assert data.about == expected.about
    assert said["versions"] == versions()
    assert said["robot_sha256"] == ROBOT.sha256
    figures = said["figures"]
    assert (figures["samples"], figures["trajectories"]) == (80, 2)
    assert figures["q_least_rad"] == data.q.min(axis=0).tolist()
    assert figures["peak_torque_Nm"] == np.abs(data.tau).max(axis=0).tolist()
    assert figures["rms_velocity_rad_per_s"] == pytest.approx(np.linalg.norm(data.v, axis=0) / np.sqrt(80))
    width, height = png_size(tmp_path / "coverage.png")
    assert width > height > 400


def test_the_options_are_those_of_collect(tmp_path):
    data = collected(tmp_path / "x", "--encoder-bits 14 --torque-noise 0.2 --seed 4 --sampling 0.02")
    expected = collect(ROBOT, samples=80, seed=4, noise=Noise(2.0**-14, 0.2), sampling=0.02, duration=0.4)
    for name in ("q", "v", "a", "tau"):
        assert_array_equal(getattr(data, name), getattr(expected, name))
    uniform = collected(tmp_path / "y", "--recipe uniform --speed 1 --friction", robot="xarm7")
    assert uniform.about["friction"]["coulomb"] == [1.0] * 7
    assert np.abs(uniform.v).max() <= 1.0
    passive = collected(tmp_path / "z", "--recipe passive --differentiated")
    assert passive.about["acceleration"] == "differentiated"


def test_the_table_is_the_summary(tmp_path, capsys):
    assert run(tmp_path / "x") == 0
    printed, figures = capsys.readouterr().out, summary(tmp_path / "x")["figures"]
    for joint in range(2):
        (row,) = (row for row in map(str.split, printed.splitlines()) if row[:1] == [figures["joints"][joint]])
        assert row[1:3] == [f"{figures[key][joint]:.3g}" for key in ("q_least_rad", "q_most_rad")]
        assert " ".join(row[-2:]) == f"{100.0 * figures['at_torque_limit_fraction'][joint]:.1f} %"
    assert "80 samples of 2 trajectories" in printed
    assert printed.splitlines()[-4:-1] == [str(tmp_path / "x" / name) for name in collecting.FILES]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--samples 0", "--samples is '0'"),
        ("--sampling 0.0005", "--sampling is '0.0005'"),
        ("--sampling 0.0015", "whole number"),
        ("--encoder-bits 2", "--encoder-bits is '2'"),
        ("--torque-noise -1", "--torque-noise"),
        ("--recipe uniform --encoder-bits 16", "nothing to differentiate"),
        ("--friction", "the URDF of two_link states none"),
    ],
)
def test_what_cannot_be_meant_is_refused(tmp_path, capsys, options, words):
    assert words in refusal(run(tmp_path / "x", *options.split()), capsys)
    assert not (tmp_path / "x").exists()


def test_other_data_are_replaced_only_by_force(tmp_path, capsys):
    check_results_are_kept_unless_forced(run, tmp_path, ["--seed", "1"], "holds data.npz of other data", capsys)


def test_the_default_folder_names_the_arm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["collect", "double_pendulum", "--recipe", "uniform", "--samples", "3"]) == 0
    assert load_dataset(tmp_path / "out" / "collect-double_pendulum" / "data.npz").nv == 2


def test_ctrl_c_keeps_the_whole_trajectories(tmp_path, monkeypatch, capsys):
    whole = collected(tmp_path / "whole", "")
    read, calls = recording._Instruments.read, []

    def interrupted(self, bench, generator, count):
        if len(calls) == stop:
            raise KeyboardInterrupt
        calls.append(count)
        return read(self, bench, generator, count)

    monkeypatch.setattr(recording._Instruments, "read", interrupted)
    stop = 1
    assert run(tmp_path / "part") == 130
    printed = capsys.readouterr()
    assert "interrupted before its end" in printed.out
    assert "interrupted" in printed.err
    part = load_dataset(tmp_path / "part" / "data.npz")
    assert len(part) == 40
    for name in ("t", "q", "v", "a", "tau"):
        assert_array_equal(getattr(part, name), getattr(whole, name)[:40])
    assert (part.about["interrupted"], whole.about["interrupted"]) == (True, False)
    assert summary(tmp_path / "part")["interrupted"]
    stop, calls[:] = 0, []
    assert run(tmp_path / "none") == 130
    assert not (tmp_path / "none" / "data.npz").exists()
    monkeypatch.undo()
    assert run(tmp_path / "part") == 2  # a part is not the result of the command
