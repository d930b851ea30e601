"""Sentences at the shell name what can be typed there; the same in Python name arguments."""

import shutil

import numpy as np
import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.doors import argument, as_loaded, at_the_shell, names_of, option, own_arm
from nbs_pin.base.exceptions import ArgumentError, RobotNotFound
from nbs_pin.cli.typed import flags, given
from tests.commands import printed_by, refusal

PYTHON = ("load_robot", "robot=", "nbs.", "Dataset(", "path:", "start=", "loss=", "=True", "MujocoPlant")
"""What nobody can type at the shell."""


@pytest.fixture
def arm(tmp_path):
    """A URDF of one's own, which can be taken away."""
    urdf = tmp_path / "own" / "arm.urdf"
    urdf.parent.mkdir()
    shutil.copy(nbs.load_robot("two_link").urdf.path, urdf)
    return urdf


def told(capsys, *arguments):
    """The refusal of a command, which must not speak Python."""
    line = refusal(cli.main([*map(str, arguments)]), capsys)
    assert not [word for word in PYTHON if word in line], line
    return line


def run_of(robot, folder):
    law, motion = nbs.PD.for_robot(robot), nbs.Sinusoid.for_robot(robot)
    nbs.simulate(nbs.MujocoPlant(robot), law, motion, 0.1, 0.01, plant_step=0.001).save(folder / "run.npz")
    return folder / "run.npz"


def data_of(robot, folder):
    nbs.collect(robot, "uniform", samples=60).save(folder / "data.npz")
    return folder / "data.npz"


def law_of(robot, folder):
    nbs.save(nbs.NeuralBackstepping.for_robot(robot), folder / "law.nbs")
    return folder / "law.nbs"


@pytest.mark.parametrize(
    ("file", "command", "remedy"),
    [
        (run_of, ("replay",), "--robot ROBOT"),
        (data_of, ("learn", "--model", "identified"), "--robot ROBOT"),
        (law_of, ("certify", "--disturbance", "0.1"), "--against ROBOT"),
        (law_of, ("compare", "--trajectories", "0", "--samples", "20"), "--against ROBOT"),
    ],
)
def test_an_arm_that_is_gone_is_asked_for_by_the_option_that_takes_it(arm, tmp_path, capsys, file, command, remedy):
    made = file(nbs.load_robot(arm, gravity=1.62), tmp_path)
    out = ("--out", tmp_path / "results" / "page.html") if command[0] == "replay" else ("--out", tmp_path / "results")
    moved = arm.rename(tmp_path / "moved.urdf")
    name, *rest = command
    line = told(capsys, name, made, *rest, *out)
    assert (
        f"is of the arm {arm} --gravity 0.0,0.0,-1.62, which is not there; put it back, or give it as {remedy}." in line
    )
    printed_by(name, made, *rest, *out, remedy.split()[0], moved, "--gravity", "1.62")
    moved.rename(arm)
    printed_by(name, made, *rest, *out, "--force")


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ("track two_link --controller nofile.nbs", "--controller"),
        ("track two_link --reference nofile.csv", "--reference"),
        ("train two_link --controller nofile.nbs", "--controller"),
        ("replay nofile", "RUN"),
        ("replay nofile.mcap", "RUN"),
        ("export-run nofile", "RUN"),
        ("learn nofile.npz", "DATA"),
        ("compare nofile.nbs", "MODEL"),
        ("compare two_link --against two_link --data nofile.npz", "--data"),
        ("compare two_link --against two_link --along nofile.npz", "--along"),
        ("certify nofile.nbs --disturbance 1", "CONTROLLER"),
        ("certify two_link --disturbance 1 --monitor nofile.npz", "--monitor"),
    ],
)
def test_a_file_that_is_not_there_is_named_by_its_option(command, named, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert f"error: {named}: no such file 'nofile" in told(capsys, *command.split())


def test_a_run_in_a_folder_is_named_by_the_option_of_the_folder(capsys, tmp_path):
    assert f"error: RUN: no such file '{tmp_path}/run.npz'" in told(capsys, "replay", tmp_path)


@pytest.mark.filterwarnings("ignore:.*only zero torque")
@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("track two_link --disturbance constant:1e300", "--disturbance is 'constant:1e300'"),
        ("replay run.npz --start 3", "--start 3 does not exist"),
        ("learn still.npz --robot two_link --model identified", "the data has no torque"),
        ("learn still.npz --model cholesky", "use --loss acceleration"),
        (
            "learn still.npz --model residual --robot two_link --loss acceleration",
            "takes no --loss acceleration; it takes --optimiser, --iterations, --transition.",
        ),
        ("learn data.npz --model chain --iterations 3", "takes no --iterations 3; it takes --transition"),
        ("train two_link --controller pd-plus --fixed-gains", "has nothing to train besides its gains"),
        ("track two_link --disturbance constant:1e12 --no-effort-limit", "after t = 0 s: the plant: Nan"),
    ],
)
def test_remedies_can_be_typed(command, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot = nbs.load_robot("two_link")
    run_of(robot, tmp_path)
    data_of(robot, tmp_path)
    still = nbs.load_log("data.npz")
    np.savez(
        "still.npz", **{name: getattr(still, name) for name in ("q", "v", "a", "t", "trajectory")}, tau=0.0 * still.q
    )
    assert words in told(capsys, *command.split())


def test_the_home_folder_is_meant_wherever_a_path_begins_with_it(tmp_path, monkeypatch, capsys):
    """The shell itself expands ~ neither in --out=~/x nor between quotation marks."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    printed_by("track", "two_link", "--duration", "0.1", "--out=~/run")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]
    assert nbs.Run.load("~/run/run.npz").nv == 2
    printed_by("replay", "~/run", "--out", "~/page.html")
    assert (tmp_path / "page.html").is_file()
    nbs.save(nbs.PD.for_robot(nbs.load_robot("two_link")), "~/law.nbs")
    assert (tmp_path / "law.nbs").is_file()
    printed_by("track", "two_link", "--duration", "0.1", "--out", tmp_path / "own", "--controller", "~/law.nbs")
    shutil.copy(nbs.load_robot("two_link").urdf.path, tmp_path / "arm.urdf")
    printed_by("track", "~/arm.urdf", "--duration", "0.1", "--out", tmp_path / "arm")
    assert f"--reference: no such file '{tmp_path}/no.csv'" in told(
        capsys, "track", "two_link", "--reference", "~/no.csv"
    )


def test_the_same_sentences_in_python(arm, tmp_path):
    run = nbs.Run.load(run_of(nbs.load_robot(arm, lock=["joint2"]), tmp_path))
    arm.unlink()
    words = (
        r"is of the arm load_robot\('.*arm.urdf', lock=\['joint2'\]\), which is not there; .* robot=load_robot\(…\)\."
    )
    with pytest.raises(RobotNotFound, match=words):
        nbs.replay(run, tmp_path / "page.html")
    with pytest.raises(ArgumentError, match="start=3 does not exist"):
        nbs.replay(run, tmp_path / "page.html", nbs.load_robot("two_link", lock=["joint2"]), start=3)
    with pytest.raises(ArgumentError, match=r"^Run.load: path: no such file"):
        nbs.Run.load(tmp_path / "no.npz")


def test_the_words_of_the_shell_are_those_of_its_options():
    typed = cli.parse(["track", "panda", "--reference", "a.csv", "--lock", "panda_joint7", "--arg", "a:=b"])
    names, texts = flags(typed), given(typed)
    assert [names[name] for name in ("robot", "reference", "effort_limit")] == [
        "ROBOT",
        "--reference",
        "--effort-limit",
    ]
    assert "zero_limits" not in names
    assert (texts["panda"], texts["a.csv"], texts["panda_joint7"], texts["a:=b"]) == (
        "ROBOT",
        "--reference",
        "--lock",
        "--arg",
    )
    with at_the_shell(names, texts):
        assert own_arm() == "ROBOT"
        assert argument("load_reference", "path", "a.csv") == "--reference"
        assert argument("track", "period", 3.0) == "--period"
        assert argument("simulate", "plant_steps", 3.0) == "plant steps"
        assert names_of(["seed", "widths", "lookahead"]) == ["--seed", "--lookahead"]
        assert (
            as_loaded("panda", {"limits": {"*": {"effort": None}}, "repair": False}) == "panda --limits '*.effort=inf'"
        )
        assert option("xacro_args", {"a": "b"}) == "--arg a:=b"
    assert own_arm() == "robot=load_robot(…)"
    assert argument("simulate", "period", 3.0) == "simulate: period"
    assert names_of(["seed", "widths"]) == ["seed", "widths"]
