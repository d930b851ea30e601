"""Runs on disk: what is written comes back, and nothing else is believed."""

import dataclasses
import io
import os
import zipfile

import numpy as np
import pytest

from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import HARMLESS, LARGEST, read_npz, write_npz
from nbs_pin.base.records import Run

SIGNALS = ("q", "v", "tau", "tau_command", "disturbance", "q_ref", "v_ref", "a_ref")


def make_run(batch=()):
    return Run(
        t=0.01 * np.arange(5),
        **dict(zip(SIGNALS, np.random.default_rng(0).normal(size=(8, 5, *batch, 2)), strict=True)),
        effort_limit=np.array([10.0, np.inf]),
        continuous=np.array([True, False]),
        joint_names=("shoulder", "ellbögen"),
        period=0.01,
        robot="two_link",
        robot_sha256="ab",
        robot_options={"gravity": [0.0, 0.0, -1.62], "lock": ["wrist"]},
        info={"controller": "PID", "seeds": [1, 2]},
    )


@pytest.fixture
def path(tmp_path):
    """A run in a file, in folders that were made for it."""
    path = tmp_path / "new" / "deeper" / "run.npz"
    make_run().save(path)
    return path


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_a_run_comes_back_bit_by_bit(path, batch):
    run = make_run(batch)
    run.save(path)
    again = Run.load(path)
    for entry in dataclasses.fields(Run):
        before, after = getattr(run, entry.name), getattr(again, entry.name)
        assert type(before) is type(after)
        np.testing.assert_array_equal(before, after)
    assert [file.name for file in path.parent.iterdir()] == ["run.npz"]


def test_runs_are_compared_by_identity():
    run = make_run()
    assert run == run  # a comparison of arrays would raise
    assert run != make_run()


def replaced(path, **arrays):
    data = {**read_npz(path), **arrays}
    write_npz(path, {key: value for key, value in data.items() if value is not None})
    return path


def test_a_run_without_robot_options_is_read(path):
    assert Run.load(replaced(path, robot_options=None)).robot_options == {}


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
        ({"info": np.array("{")}, "'info' cannot be read as JSON"),
        ({"info": np.array("[1]")}, "'info' is a list"),
        ({"robot_options": np.array("[1]")}, "'robot_options' is a list"),
        ({"robot_options": np.array(1.0)}, "'robot_options' is float64"),
    ],
)
def test_a_file_that_is_no_run_is_refused_by_key(path, arrays, reason):
    with pytest.raises(FileFormatError, match=f"run.npz: .*{reason}"):
        Run.load(replaced(path, **arrays))


@pytest.mark.parametrize("name", ["q", "tau", "a_ref"])
@pytest.mark.parametrize("number", [np.nan, -np.inf])
def test_what_cannot_be_loaded_is_not_saved_and_the_rows_before_it_are(path, name, number):
    """A run that diverged, on an arm or in another simulator."""
    before, run = path.read_bytes(), make_run((3,))
    getattr(run, name)[3, 1, 0] = number
    with pytest.raises(ArgumentError, match=rf"Run.save: {name} has numbers that are not finite in row 3; .*head\(3\)"):
        run.save(path)
    assert path.read_bytes() == before
    run.head(3).save(path)
    np.testing.assert_array_equal(getattr(Run.load(path), name), getattr(make_run((3,)), name)[:3])


@pytest.mark.parametrize(
    "wrong", [{"t": 0.01 * np.arange(5)[::-1]}, {"effort_limit": np.array([0.0, 1.0])}, {"q": np.full((5, 2), np.nan)}]
)
def test_both_ends_of_a_file_refuse_the_same(path, wrong):
    (name,) = wrong
    with pytest.raises(ArgumentError, match=f"Run.save: {name} has .*; correct it"):
        dataclasses.replace(make_run(), **wrong).save(path)
    with pytest.raises(FileFormatError, match=f"'{name}' has"):
        Run.load(replaced(path, **wrong))


def test_damage_is_refused_wherever_it_is(path):
    whole = path.read_bytes()
    for cut in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(FileFormatError, match=r"run\.npz"):
            Run.load(path)
    body = whole.index(b"q.npy") + 200  # inside the numbers of q: the zip's checksum must see it
    path.write_bytes(whole[:body] + bytes([whole[body] ^ 1]) + whole[body + 1 :])
    with pytest.raises(FileFormatError, match="not an intact npz"):
        Run.load(path)


def test_headers_are_not_believed(path):
    lying = io.BytesIO()
    np.lib.format.write_array_header_1_0(lying, {"descr": "<f8", "fortran_order": False, "shape": (2**40,)})
    for entry, reason in ((lying.getvalue() + b"\0" * 8, "declares"), (b"no array", "not an intact npz")):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("q.npy", entry)
        with pytest.raises(FileFormatError, match=reason):
            read_npz(path)


def test_a_bomb_is_refused_before_it_is_unpacked(path, monkeypatch):
    np.savez_compressed(path, q=np.zeros(1_000_000))
    assert path.stat().st_size < 20_000
    assert LARGEST == 2**31
    monkeypatch.setattr("nbs_pin.base.npz.LARGEST", 1_000_000)
    with pytest.raises(FileFormatError, match="at most 1000000"):
        read_npz(path)


def test_objects_are_neither_written_nor_read_and_the_old_file_stays(path):
    before = path.read_bytes()
    with pytest.raises(ValueError, match="Object arrays"):
        write_npz(path, {"a": np.zeros(1000), "b": np.array([{}], dtype=object)})
    for info in ({"plant": object()}, {"x": float("nan")}):
        with pytest.raises(ArgumentError, match="JSON"):
            dataclasses.replace(make_run(), info=info).save(path)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == ["run.npz"]
    np.savez(path, q=np.array([{}], dtype=object))
    with pytest.raises(FileFormatError, match="Object arrays"):
        read_npz(path)


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


def test_an_entry_that_nobody_needs_is_not_unpacked(path, monkeypatch):
    """Run.load takes what it knows; what else is in the file may be of any size or kind."""
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("unused.npy", bytes(2 * HARMLESS))
    assert Run.load(path).nv == 2
    with pytest.raises(FileFormatError, match=r"run\.npz: declares .* at most 100 times as many are unpacked"):
        read_npz(path)


def test_many_entries_of_the_same_bytes_are_one_bomb(path):
    np.savez_compressed(path, a=np.zeros(HARMLESS // 8), b=np.zeros(10))
    with pytest.raises(FileFormatError, match="at most 100 times"):
        read_npz(path)
    assert read_npz(path, {"b"})["b"].shape == (10,)


def test_directories_that_point_elsewhere_are_damage(path):
    """zipfile seeks before the beginning of the file: an OSError that is none of the disk."""
    content = path.read_bytes()
    for begin in (1, 64, 300):
        path.write_bytes(content[begin:])
        with pytest.raises(FileFormatError, match=r"run\.npz: not an intact npz file"):
            Run.load(path)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": ' * 100 + "1" + "}" * 100, '{"a": NaN}', '{"a": 1, "a": 2}'])
def test_json_that_would_overflow_the_stack_or_mislead_is_refused(path, text):
    arrays = dict(np.load(path)) | {"info": np.array(text)}
    write_npz(path, arrays)
    with pytest.raises(FileFormatError, match="'info' cannot be read as JSON"):
        Run.load(path)


def test_numbers_of_other_widths_and_byte_orders_become_float64(path):
    arrays = {name: x.astype(">f4") if x.dtype.kind == "f" else x for name, x in np.load(path).items()}
    write_npz(path, arrays)
    assert {Run.load(path).q.dtype, Run.load(path).effort_limit.dtype} == {np.dtype(float)}


@pytest.mark.parametrize("wrong", ["no", [1, 2, 3], [[True, False]], [True], 3.5])
def test_which_joints_slide_is_one_truth_value_per_joint(wrong):
    with pytest.raises(ArgumentError, match="Run: prismatic"):
        dataclasses.replace(make_run(), prismatic=wrong)
    assert dataclasses.replace(make_run(), prismatic=[False, True]).slides.tolist() == [False, True]
