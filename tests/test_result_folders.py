"""Folders of results: at every moment, whatever stops the process, their files belong to one run."""

import json
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path
from xml.etree import ElementTree

import pytest

import nbs_pin as nbs
from nbs_pin import cli
from nbs_pin.base.files import replaced_together
from nbs_pin.commands.results import Results
from tests.commands import contents, refusal, summary

KILLED = """
import os, sys
from pathlib import Path
from xml.etree import ElementTree
from nbs_pin.base.files import replaced_together
folder, last, seen = Path(sys.argv[1]), int(sys.argv[2]), 0
def killed(event, arguments):
    global seen
    if event in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.scandir", "fcntl.flock"):
        seen += 1
        if seen == last:
            os._exit(9)
sys.addaudithook(killed)
with replaced_together(folder, ["summary", "data", "more", "picture"]) as draft:
    for name in ("data", "more", "summary"):
        (draft / name).write_text("new")
(folder / "picture").write_text("new")
"""


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="no folder in which nothing can be created")
def test_a_folder_that_takes_no_files_is_named_itself():
    with pytest.raises(OSError, match=r"'/proc'$"), replaced_together(Path("/proc"), ["data"]):
        pass


def test_no_moment_of_a_kill_leaves_files_of_two_runs(tmp_path):
    """Killed before its k-th access to the disk, for every k; `data` never lacks."""
    seen = set()
    for k in range(1, 60):
        folder = tmp_path / str(k)
        folder.mkdir()
        for name in ("summary", "data", "more", "picture", "notes"):
            (folder / name).write_text("old")
        done = subprocess.run([sys.executable, "-c", KILLED, str(folder), str(k)], check=False)
        left = {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}
        assert left.pop("notes") == "old"  # files that are no results stay
        assert "data" in left
        assert len({text for text in left.values() if text}) == 1
        if "summary" in left and left["summary"] == "new":
            assert left.keys() >= {"data", "more"}
        seen.add((frozenset(left), *{text for text in left.values() if text}))
        if done.returncode == 0:
            break
    assert done.returncode == 0
    assert len(seen) >= 6


def test_what_a_killed_writer_left_is_cleared_away_and_what_a_living_one_writes_is_not(tmp_path):
    names = ["summary", "data"]
    subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), "12"], check=False)
    (abandoned,) = tmp_path.glob(".writing-*")
    os.utime(abandoned, (time.time() - 60.0, time.time() - 60.0))
    (tmp_path / ".writing-mine").symlink_to(tmp_path)
    with replaced_together(tmp_path, names) as slow:
        os.utime(slow, (0.0, 0.0))
        (slow / "data").write_text("slow")
        with replaced_together(tmp_path, names) as draft:
            (draft / "data").write_text("quick")
        assert not abandoned.exists()
        assert slow.exists()
    assert (tmp_path / "data").read_text() == "slow"
    assert sorted(path.name for path in tmp_path.iterdir()) == [".writing-mine", "data"]


def replace_by(folder, *new):
    with replaced_together(folder, ["summary", "data", "more"]) as draft:
        for name in new:
            (draft / name).write_text("new")


def test_an_interrupt_between_the_files_is_acted_on_after_the_last(tmp_path, monkeypatch):
    replaced, calls = os.replace, []

    def interrupted(source, target):
        calls.append(target)
        if len(calls) == 2:
            raise KeyboardInterrupt
        replaced(source, target)

    for name in ("summary", "data", "more"):
        (tmp_path / name).write_text("old")
    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        replace_by(tmp_path, "summary", "data")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"summary": "new", "data": "new"}


def test_a_failure_leaves_the_old_results_alone(tmp_path):
    (tmp_path / "data").write_text("old")
    with pytest.raises(FileNotFoundError):
        replace_by(tmp_path, "data", "no/folder")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"data": "old"}


# Drawings.


@pytest.fixture
def shell():
    """Warnings are printed, as they are outside the tests."""
    with warnings.catch_warnings():
        warnings.simplefilter("default", UserWarning)
        yield


def track(folder, *options):
    return cli.main(["track", "two_link", "--duration", "0.05", "--out", str(folder), *options])


@pytest.mark.parametrize("drawn", ["plot_tracking", "replay"])
@pytest.mark.parametrize("error", [ValueError("no\nfont"), MemoryError(), RecursionError("deep")])
def test_a_drawing_that_fails_costs_neither_run_nor_exit_code(drawn, error, tmp_path, shell, monkeypatch, capsys):
    def fails(*_, **__):
        raise error

    assert track(tmp_path, "--seed", "7") == 0
    monkeypatch.setattr(f"nbs_pin.commands.track.{drawn}", fails)
    capsys.readouterr()
    assert track(tmp_path, "--force") == 0
    name = {"plot_tracking": "tracking.png", "replay": "replay.html"}[drawn]
    printed = capsys.readouterr()
    (line,) = printed.err.splitlines()
    assert line.startswith(f"nbs-pin: warning: '{tmp_path / name}' was not drawn ({type(error).__name__}: ")
    assert name not in printed.out
    assert contents(tmp_path).keys() == {"run.npz", "summary.json", "tracking.png", "replay.html"} - {name}
    assert summary(tmp_path)["settings"] == nbs.Run.load(tmp_path / "run.npz").info["settings"]


def test_a_full_disk_while_drawing_is_told_and_keeps_the_run(tmp_path, monkeypatch, capsys):
    def fails(run, path, **_):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("nbs_pin.commands.track.plot_tracking", fails)
    code = track(tmp_path)
    assert f"'{tmp_path / 'tracking.png'}': no space left" in refusal(code, capsys)
    assert contents(tmp_path).keys() == {"run.npz", "summary.json"}


def test_ctrl_c_while_drawing_keeps_the_new_run_and_nothing_of_the_old(tmp_path, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    assert track(tmp_path) == 0
    monkeypatch.setattr("nbs_pin.commands.track.replay", interrupted)
    assert track(tmp_path, "--seed", "9", "--force") == 130
    assert "interrupted" in capsys.readouterr().err
    assert contents(tmp_path).keys() == {"run.npz", "summary.json", "tracking.png"}
    assert summary(tmp_path)["seed"] == nbs.Run.load(tmp_path / "run.npz").info["settings"]["seed"] == 9


@pytest.mark.parametrize("name", ["nan_box", "rgba_nan", "box_without_size", "mesh_name_5000"])
def test_an_arm_with_a_faulty_visual_is_tracked_and_drawn(name, tmp_path, shell, capsys):
    shape = '<geometry><box size="1 1 1"/></geometry>'
    visual = {
        "nan_box": shape.replace("1 1 1", "nan 1 1"),
        "rgba_nan": f'{shape}<material name="m"><color rgba="nan 0 0 1"/></material>',
        "box_without_size": "<geometry><box/></geometry>",
        "mesh_name_5000": f'<geometry><mesh filename="{"a" * 5000}.stl"/></geometry>',
    }[name]
    arm = tmp_path / "arm.urdf"
    arm.write_text(f"""<robot name="arm"><link name="base"/><link name="bob"><inertial><origin xyz="0 0 -0.5"/>
      <mass value="1"/><inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial>
      <visual>{visual}</visual></link><joint name="hinge" type="revolute"><parent link="base"/><child link="bob"/>
      <axis xyz="1 0 0"/><limit lower="-1.5" upper="1.5" effort="50" velocity="2"/></joint></robot>""")
    assert cli.main(["track", str(arm), "--duration", "0.02", "--out", str(tmp_path / "run")]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("nbs-pin: warning: link 'bob' is drawn as a capsule: ")
    assert len(contents(tmp_path / "run")) == 4


# Default folders.


def results(folder, seed, **more):
    return Results(Path(folder), {"settings": {"seed": seed}}, **more)


def held_by(folder, facts, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / name).write_text("")
    (folder / "summary.json").write_text(json.dumps(facts))


def test_a_default_folder_steps_aside_for_other_results_and_comes_back_for_its_own(tmp_path):
    base, names = tmp_path / "track-panda", ("run.npz", "summary.json")
    for seed, folder in enumerate(["track-panda", "track-panda-2", "track-panda-3"]):
        taken = results(base, seed, is_default=True).check(names, False)
        assert taken.folder.name == folder
        held_by(taken.folder, taken.facts, "run.npz")
    for seed, folder in enumerate(["track-panda", "track-panda-2", "track-panda-3"]):
        assert results(base, seed, is_default=True).check(names, False).folder.name == folder
        assert results(base, seed, is_default=True).held("run.npz").folder.name == folder
    assert results(base, 9, is_default=True).check(names, True).folder == base  # --force replaces
    with pytest.raises(nbs.NbsPinError, match=r"holds run\.npz of another run; give another --out, or --force"):
        results(base, 9).check(names, False)


def test_an_unfinished_training_is_not_left_behind(tmp_path):
    base, names = tmp_path / "train-panda", ("training.ckpt", "controller.nbs", "summary.json")
    settings = {"whole": {"interrupted": False}, "unfinished": "training.ckpt"}
    mine = results(base, 0, is_default=True)
    held_by(base, mine.facts | {"interrupted": True}, "training.ckpt")
    with pytest.raises(nbs.NbsPinError, match=r"holds training\.ckpt"):
        mine.check(names, False, **settings)
    assert results(base, 1, is_default=True).check(names, False, **settings).folder.name == "train-panda-2"
    (base / "summary.json").unlink()  # killed before it was written
    with pytest.raises(nbs.NbsPinError, match=r"holds training\.ckpt"):
        results(base, 1, is_default=True).check(names, False, **settings)


def test_the_next_command_of_the_shell_is_not_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for seed in ("1", "2", "2", "1"):
        assert cli.main(["track", "two_link", "--duration", "0.05", "--seed", seed]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["track-two_link", "track-two_link-2"]
    assert [summary(tmp_path / "out" / f"track-two_link{more}")["seed"] for more in ("", "-2")] == [1, 2]


def test_pictures_are_vectors_too_if_asked_and_none_is_left_of_another_run(tmp_path, capsys):
    words = ["track", "two_link", "--duration", "0.2", "--out", str(tmp_path)]
    assert cli.main([*words, "--svg"]) == 0
    assert str(tmp_path / "tracking.svg") in capsys.readouterr().out.splitlines()
    drawing = ElementTree.parse(tmp_path / "tracking.svg").getroot()
    assert drawing.tag.endswith("svg")
    assert (tmp_path / "tracking.png").exists()
    assert "svg" not in summary(tmp_path)["settings"]
    assert cli.main([*words, "--seed", "1", "--force"]) == 0
    assert not (tmp_path / "tracking.svg").exists()
    assert "tracking.svg" not in capsys.readouterr().out
