"""Runs on disk: what is written comes back, and nothing else is believed."""

import dataclasses
import io
import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import LARGEST, read_npz, write_npz
from nbs_pin.base.records import Run


def make_run(batch=(), rows=5, n=2):
    rng = np.random.default_rng(0)
    q, v, tau, tau_command, disturbance, q_ref, v_ref, a_ref = rng.normal(size=(8, rows, *batch, n))
    return Run(
        t=0.01 * np.arange(rows),
        q=q,
        v=v,
        tau=tau,
        tau_command=tau_command,
        disturbance=disturbance,
        q_ref=q_ref,
        v_ref=v_ref,
        a_ref=a_ref,
        effort_limit=np.array([10.0, np.inf]),
        continuous=np.array([True, False]),
        joint_names=("shoulder", "ellbögen"),
        period=0.01,
        robot="two_link",
        robot_sha256="ab",
        robot_options={"gravity": [0.0, 0.0, -1.62], "lock": ["wrist"]},
        info={"controller": "PID", "seeds": [1, 2]},
    )


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_a_run_comes_back_bit_by_bit(tmp_path, batch):
    run = make_run(batch)
    run.save(tmp_path / "run.npz")
    again = Run.load(tmp_path / "run.npz")
    for entry in dataclasses.fields(Run):
        before, after = getattr(run, entry.name), getattr(again, entry.name)
        assert type(before) is type(after)
        np.testing.assert_array_equal(before, after)
    assert [path.name for path in tmp_path.iterdir()] == ["run.npz"]


def test_missing_folders_are_made(tmp_path):
    make_run().save(tmp_path / "new" / "deeper" / "run.npz")
    assert Run.load(tmp_path / "new" / "deeper" / "run.npz").nv == 2


def test_runs_are_compared_by_identity():
    run = make_run()
    assert run == run  # a comparison of arrays would raise
    assert run != make_run()


def test_a_run_without_robot_options_is_read(tmp_path):
    assert Run.load(replaced(tmp_path / "run.npz", robot_options=None)).robot_options == {}


def replaced(path, **arrays):
    make_run().save(path)
    data = {**read_npz(path), **arrays}
    write_npz(path, {key: value for key, value in data.items() if value is not None})
    return path


@pytest.mark.parametrize(
    ("arrays", "reason"),
    [
        ({"q": None}, "no 'q'"),
        ({"format": None}, "no 'format'"),
        ({"format": np.array("nbs_pin run 99")}, "format 'nbs_pin run 99'"),
        ({"v": np.zeros((5, 3))}, r"'v' has shape \(5, 3\), expected \(5, 2\)"),
        ({"q": np.zeros(5)}, "'q' has shape"),
        ({"t": np.zeros(4)}, "'t' has shape"),
        ({"effort_limit": np.zeros(3)}, "'effort_limit' has shape"),
        ({"joint_names": np.array(["a"])}, "'joint_names' has shape"),
        ({"tau": np.full((5, 2), np.nan)}, "'tau' has numbers that are not finite"),
        ({"effort_limit": np.array([1.0, np.nan])}, "'effort_limit'"),
        ({"period": np.array(0.0)}, "'period'"),
        ({"t": 0.01 * np.arange(5)[::-1]}, "'t'"),
        ({"q": np.zeros((5, 2), dtype=int)}, "'q' is int64, expected real numbers"),
        ({"info": np.array("{")}, "'info' is not JSON"),
        ({"info": np.array("[1]")}, "'info' is a list"),
        ({"robot_options": np.array("[1]")}, "'robot_options' is a list"),
        ({"robot_options": np.array(1.0)}, "'robot_options' is float64"),
    ],
)
def test_a_file_that_is_no_run_is_refused_by_key(tmp_path, arrays, reason):
    with pytest.raises(FileFormatError, match=f"run.npz: .*{reason}"):
        Run.load(replaced(tmp_path / "run.npz", **arrays))


def test_damage_is_refused_wherever_it_is(tmp_path):
    path = tmp_path / "run.npz"
    make_run().save(path)
    whole = path.read_bytes()
    for cut in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(FileFormatError, match=r"run\.npz"):
            Run.load(path)
    body = whole.index(b"q.npy") + 200  # inside the numbers of q: the zip's checksum must see it
    path.write_bytes(whole[:body] + bytes([whole[body] ^ 1]) + whole[body + 1 :])
    with pytest.raises(FileFormatError, match="not an intact npz"):
        Run.load(path)


def entry_with(shape, data=b"\0" * 8):
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return buffer.getvalue() + data


def test_headers_are_not_believed(tmp_path):
    path = tmp_path / "run.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("q.npy", entry_with((2**40,)))
    with pytest.raises(FileFormatError, match="declares"):
        read_npz(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("q.npy", b"no array")
    with pytest.raises(FileFormatError, match="not an intact npz"):
        read_npz(path)


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    np.savez_compressed(path, q=np.zeros(1_000_000))
    assert path.stat().st_size < 20_000
    assert LARGEST == 2**31
    monkeypatch.setattr("nbs_pin.base.npz.LARGEST", 1_000_000)
    with pytest.raises(FileFormatError, match="at most 1000000"):
        read_npz(path)


def test_objects_are_neither_written_nor_read(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, q=np.array([{}], dtype=object))
    with pytest.raises(FileFormatError, match="Object arrays"):
        read_npz(path)
    with pytest.raises(ValueError, match="Object arrays"):
        write_npz(path, {"q": np.array([{}], dtype=object)})
    with pytest.raises(ArgumentError, match="JSON"):
        dataclasses.replace(make_run(), info={"plant": object()}).save(path)
    with pytest.raises(ArgumentError, match="JSON"):
        dataclasses.replace(make_run(), info={"x": float("nan")}).save(path)


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "run.npz"
    make_run().save(path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="Object arrays"):
        write_npz(path, {"a": np.zeros(1000), "b": np.array([{}], dtype=object)})
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.npz"]


def test_a_killed_write_never_leaves_half_a_file(tmp_path):
    path = tmp_path / "run.npz"
    write_npz(path, {"q": np.zeros(200_000)})
    program = (
        "import sys, numpy as np; from nbs_pin.base.npz import write_npz; print('on', flush=True)\n"
        "while True: write_npz(sys.argv[1], {'q': np.random.rand(200_000)})"
    )
    for delay in (0.01, 0.03, 0.05):
        with subprocess.Popen([sys.executable, "-c", program, str(path)], stdout=subprocess.PIPE) as process:
            process.stdout.readline()
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(delay)
            process.kill()
        assert read_npz(path)["q"].shape == (200_000,)


def test_the_file_keeps_the_users_permissions(tmp_path):
    mask = os.umask(0o027)
    try:
        make_run().save(tmp_path / "run.npz")
    finally:
        os.umask(mask)
    assert (tmp_path / "run.npz").stat().st_mode & 0o777 == 0o640


def test_a_missing_run_is_not_found(tmp_path):
    with pytest.raises(FileNotFoundError):
        Run.load(tmp_path / "none.npz")
