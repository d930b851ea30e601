"""`nbs-pin collect`: what it writes, what it prints, and what it refuses."""

import json

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.versions import versions
from nbs_pin.commands import collect as collecting
from nbs_pin.identification.collect import collect
from nbs_pin.identification.datasets import load_dataset
from nbs_pin.identification.measurement import Noise
from tests.test_plotting import png_size

QUICK = ("--samples", "80", "--sampling", "0.01", "--duration", "0.4")


def run(folder, *options, robot="two_link"):
    return cli.main(["collect", robot, *QUICK, "--out", str(folder), *options])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where data of two_link lie."""
    folder = tmp_path_factory.mktemp("collected") / "two_link"
    assert run(folder) == 0
    return folder


def summary(folder):
    return json.loads((folder / "summary.json").read_text())


def test_the_files_are_the_data_and_what_they_cover(folder):
    assert sorted(path.name for path in folder.iterdir()) == sorted(collecting.FILES)
    data, said = load_dataset(folder / "data.npz"), summary(folder)
    expected = collect(nbs.load_robot("two_link"), samples=80, sampling=0.01, duration=0.4)
    assert_array_equal(data.tau, expected.tau)
    assert data.about == expected.about
    assert said["versions"] == versions()
    assert said["robot_sha256"] == nbs.load_robot("two_link").sha256
    figures = said["figures"]
    assert (figures["samples"], figures["trajectories"]) == (80, 2)
    assert figures["q_least_rad"] == data.q.min(axis=0).tolist()
    assert figures["peak_torque_Nm"] == np.abs(data.tau).max(axis=0).tolist()
    assert figures["rms_velocity_rad_per_s"] == pytest.approx(np.linalg.norm(data.v, axis=0) / np.sqrt(80))
    width, height = png_size(folder / "coverage.png")
    assert width > height > 400


def test_the_options_are_those_of_collect(tmp_path):
    assert (
        run(tmp_path / "x", "--encoder-bits", "14", "--torque-noise", "0.2", "--seed", "4", "--sampling", "0.02") == 0
    )
    data = load_dataset(tmp_path / "x" / "data.npz")
    noise = Noise(2.0**-14, 0.2)
    robot = nbs.load_robot("two_link")
    expected = collect(robot, samples=80, seed=4, noise=noise, sampling=0.02, duration=0.4)
    for name in ("q", "v", "a", "tau"):
        assert_array_equal(getattr(data, name), getattr(expected, name))
    assert run(tmp_path / "y", "--recipe", "uniform", "--speed", "1", "--friction", robot="xarm7") == 0
    uniform = load_dataset(tmp_path / "y" / "data.npz")
    assert uniform.about["friction"]["coulomb"] == [1.0] * 7
    assert np.abs(uniform.v).max() <= 1.0
    assert run(tmp_path / "z", "--recipe", "passive", "--differentiated") == 0
    assert load_dataset(tmp_path / "z" / "data.npz").about["acceleration"] == "differentiated"


def test_the_table_is_the_summary(tmp_path, capsys):
    assert run(tmp_path / "x") == 0
    printed, figures = capsys.readouterr().out, summary(tmp_path / "x")["figures"]
    for joint in range(2):
        row = next(line for line in printed.splitlines() if figures["joints"][joint] in line).split()
        assert row[1:3] == [f"{figures[key][joint]:.3g}" for key in ("q_least_rad", "q_most_rad")]
        assert row[-1] == f"{figures['at_torque_limit_fraction'][joint]:.1%}"
    assert "80 samples of 2 trajectories" in printed
    assert printed.splitlines()[-3:] == [str(tmp_path / "x" / name) for name in collecting.FILES]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--samples", "0"), "--samples is '0'"),
        (("--sampling", "0.0005"), "--sampling is '0.0005'"),
        (("--sampling", "0.0015"), "whole number"),
        (("--encoder-bits", "2"), "--encoder-bits is '2'"),
        (("--torque-noise", "-1"), "--torque-noise"),
        (("--recipe", "uniform", "--encoder-bits", "16"), "nothing to differentiate"),
        (("--friction",), "the URDF of two_link states none"),
    ],
)
def test_what_cannot_be_meant_is_refused(tmp_path, capsys, options, words):
    assert run(tmp_path / "x", *options) == 2
    said = capsys.readouterr().err
    assert words in said
    assert len(said.splitlines()) == 1
    assert not (tmp_path / "x").exists()


def test_other_data_are_replaced_only_by_force(folder, capsys):
    before = (folder / "data.npz").read_bytes()
    assert run(folder, "--seed", "1") == 2
    assert "holds data.npz of other data" in capsys.readouterr().err
    assert (folder / "data.npz").read_bytes() == before
    assert run(folder) == 0
    assert run(folder, "--seed", "1", "--force") == 0
    assert (folder / "data.npz").read_bytes() != before
    assert run(folder, "--force") == 0


def test_the_default_folder_names_the_arm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["collect", "double_pendulum", "--recipe", "uniform", "--samples", "3"]) == 0
    assert load_dataset(tmp_path / "out" / "collect-double_pendulum" / "data.npz").nv == 2
