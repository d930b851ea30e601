"""The runner of campaigns: every result whole or absent, whatever ends the process, and the same from any workers."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

from nbs_pin.base.exceptions import ArgumentError, FileFormatError, SimulationDiverged
from nbs_pin.campaigns.journal import JOURNAL, Journal, Outcome, forget
from nbs_pin.campaigns.runner import run_jobs
from nbs_pin.simulation.processes import in_processes

PLAN = {"seed": 0, "arm": {"name": "panda", "load": 2.0}}
CHILD = """
import sys, time
from nbs_pin.campaigns.runner import run_jobs

def work(number):
    time.sleep(0.004)
    return {"square": number * number, "third": number / 3.0}

if __name__ == "__main__":
    folder, workers, processes = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "processes"
    jobs = {f"{k:04d}": k for k in range(150)}
    print("begun", flush=True)
    run_jobs(work, jobs, folder, {"jobs": 150}, workers=workers, processes=processes)
    print("done", flush=True)
"""
SQUARES = {f"{k:04d}": {"square": k * k, "third": k / 3.0} for k in range(150)}


def square(number):
    if number == 3:
        raise SimulationDiverged("the third diverges.")
    return {"square": number * number, "third": number / 3.0}


def jobs(count):
    return {f"{k}": k for k in range(count)}


def told(outcomes):
    return {key: (outcome.result, outcome.failure) for key, outcome in outcomes.items()}


@pytest.mark.parametrize("shared", [{}, {"workers": 3}, {"workers": 2, "processes": True}])
def test_outcomes_are_the_same_from_any_workers(tmp_path, shared):
    found = run_jobs(square, jobs(9), tmp_path, PLAN, **shared)
    assert list(found) == list(jobs(9))
    expected = {key: ({"square": k * k, "third": k / 3.0}, "") for key, k in jobs(9).items()}
    assert told(found) == expected | {"3": (None, "the third diverges.")}


def test_a_cluster_does_the_same(tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        found = run_jobs(square, jobs(9), tmp_path / "cluster", PLAN, cluster=cluster.scheduler_address)
    assert told(found) == told(run_jobs(square, jobs(9), tmp_path / "here", PLAN))


def test_a_cluster_that_is_not_there_is_told_in_a_sentence(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("nbs_pin.campaigns.runner._CONNECTING", 0.5)
    with pytest.raises(ArgumentError, match=r"no scheduler answers at 'tcp://127.0.0.1:1'"):
        run_jobs(square, jobs(2), tmp_path, PLAN, cluster="tcp://127.0.0.1:1")


def test_what_was_done_is_not_done_again(tmp_path):
    done = []

    def noted(number):
        done.append(number)
        return square(number)

    run_jobs(noted, jobs(5), tmp_path, PLAN)
    found = run_jobs(noted, jobs(8), tmp_path, PLAN)
    assert done == list(range(8))  # the failure, too, is an outcome
    assert told(found) == told(run_jobs(square, jobs(8), tmp_path / "other", PLAN))


def test_results_of_another_plan_are_refused_by_what_changed(tmp_path):
    run_jobs(square, jobs(2), tmp_path, PLAN)
    other = {"seed": 0, "arm": {"name": "ur5"}, "laws": 2}
    with pytest.raises(ArgumentError, match="another plan") as refused:
        run_jobs(square, jobs(2), tmp_path, other)
    for words in ("arm.name 'panda' where it is now 'ur5'", "arm.load 2.0", "no laws, which is now 2"):
        assert words in str(refused.value)
    assert "seed" not in str(refused.value)


def test_an_error_of_the_program_ends_it_and_keeps_what_was_done(tmp_path):
    def broken(number):
        return {"share": 1.0 / (number - 4)}

    with pytest.raises(ZeroDivisionError):
        run_jobs(broken, jobs(9), tmp_path, PLAN)
    with Journal.opened(tmp_path, PLAN) as journal:
        assert list(journal.outcomes) == ["0", "1", "2", "3"]


def test_a_line_that_was_not_finished_is_done_again(tmp_path):
    run_jobs(square, jobs(5), tmp_path, PLAN)
    path = tmp_path / JOURNAL
    whole = path.read_bytes()
    for cut in (1, 7, len(whole.splitlines()[-1])):
        path.write_bytes(whole[:-cut])
        assert told(run_jobs(square, jobs(5), tmp_path, PLAN))["4"] == ({"square": 16, "third": 4 / 3}, "")
        assert len(path.read_bytes().splitlines()) == 6


@pytest.mark.parametrize("line", [b"{", b"[]", b'{"key": 1}', b'{"key": "2", "seconds": 0.1}', b'{"x": NaN}', b"\xff"])
def test_a_damaged_line_is_named(tmp_path, line):
    run_jobs(square, jobs(3), tmp_path, PLAN)
    lines = (tmp_path / JOURNAL).read_bytes().splitlines(keepends=True)
    (tmp_path / JOURNAL).write_bytes(b"".join([*lines[:2], line + b"\n", *lines[3:]]))
    with pytest.raises(FileFormatError, match="line 3"):
        run_jobs(square, jobs(3), tmp_path, PLAN)


def test_a_file_of_something_else_is_refused(tmp_path):
    (tmp_path / JOURNAL).write_text('{"format": "other"}\n')
    with pytest.raises(FileFormatError, match="first line"):
        run_jobs(square, jobs(3), tmp_path, PLAN)


@pytest.mark.parametrize("content", [b'{"my": "precious data"}', b"1, 2\n3, 4", b"x"])
def test_a_file_of_something_else_stays_as_it_is(tmp_path, content):
    (tmp_path / JOURNAL).write_bytes(content)
    with pytest.raises(FileFormatError):
        run_jobs(square, jobs(2), tmp_path, PLAN)
    assert (tmp_path / JOURNAL).read_bytes() == content


def test_line_ends_of_another_system_cost_nothing(tmp_path):
    before = run_jobs(square, jobs(4), tmp_path, PLAN)
    path = tmp_path / JOURNAL
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    run_jobs(square, jobs(6), tmp_path, PLAN)
    assert told(run_jobs(square, jobs(4), tmp_path, PLAN)) == told(before)


def test_a_journal_that_another_process_has_open_is_not_emptied(tmp_path):
    with Journal.opened(tmp_path, PLAN) as journal:
        journal.add(Outcome("a", {"x": 1}, "", 0.0))
        with pytest.raises(ArgumentError, match="another process"):
            forget(tmp_path)
    forget(tmp_path)
    with Journal.opened(tmp_path, {"another": "plan"}) as journal:
        assert not journal.outcomes


def test_two_processes_do_not_share_a_folder(tmp_path):
    with Journal.opened(tmp_path, PLAN), pytest.raises(ArgumentError, match="another process"):
        run_jobs(square, jobs(3), tmp_path, PLAN)


def test_a_full_disk_leaves_what_is_there(tmp_path, monkeypatch):
    """The disk takes a part of a line only; afterwards there is room again."""
    written = os.write

    def full(file, content):
        if b'"key": "6"' in bytes(content):
            written(file, bytes(content)[:9])
            raise OSError(28, "No space left on device")
        return written(file, content)

    monkeypatch.setattr("nbs_pin.campaigns.journal.os.write", full)
    with pytest.raises(OSError, match="No space left") as error:
        run_jobs(square, jobs(9), tmp_path, PLAN)
    assert error.value.filename == str(tmp_path / JOURNAL)
    monkeypatch.undo()
    assert [json.loads(line).get("key") for line in (tmp_path / JOURNAL).read_text().splitlines()[1:]] == list("012345")
    assert told(run_jobs(square, jobs(9), tmp_path, PLAN)) == told(run_jobs(square, jobs(9), tmp_path / "b", PLAN))


def test_results_that_json_cannot_store_are_an_error_of_the_program(tmp_path):
    with pytest.raises(ValueError, match="Out of range float"):
        run_jobs(lambda _: {"x": float("nan")}, jobs(1), tmp_path, PLAN)
    assert run_jobs(square, jobs(1), tmp_path, PLAN)["0"].result == {"square": 0, "third": 0.0}


@contextmanager
def child(script, folder, workers, kind):
    """The campaign of CHILD in a process group of its own, after its first words."""
    command = [sys.executable, str(script), str(folder), str(workers), kind]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0)
    try:
        assert process.stdout.readline() == "begun\n", process.stderr.read()
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "child.py"
    path.write_text(CHILD)
    return path


def finished(script, folder, workers=2, kind="threads"):
    with child(script, folder, workers, kind) as process:
        assert process.communicate()[0] == "done\n"
    lines = [json.loads(line) for line in (folder / JOURNAL).read_text().splitlines()[1:]]
    assert len(lines) == len(SQUARES)  # none twice
    return {line["key"]: line["result"] for line in lines}


@pytest.mark.parametrize(("workers", "kind", "stop"), [
    (1, "threads", signal.SIGKILL), (2, "threads", signal.SIGKILL), (2, "processes", signal.SIGKILL),
    (2, "threads", signal.SIGINT), (2, "processes", signal.SIGINT),
])  # fmt: skip
def test_a_killed_campaign_goes_on(tmp_path, script, workers, kind, stop):
    folder = tmp_path / "results"
    with child(script, folder, workers, kind) as process:
        deadline = time.monotonic() + 30.0
        while time.monotonic() < deadline:
            if (folder / JOURNAL).exists() and len((folder / JOURNAL).read_bytes().splitlines()) > 5:
                break
            time.sleep(0.002)
        time.sleep(random.random() * 0.05)
        os.killpg(process.pid, stop)
        process.wait(timeout=30.0)
    kept = len((folder / JOURNAL).read_bytes().splitlines()) - 1
    assert 0 < kept < len(SQUARES)
    assert finished(script, folder, workers, kind) == SQUARES


def test_an_outcome_is_in_the_file_when_add_returns(tmp_path):
    with Journal.opened(tmp_path, PLAN) as journal:
        journal.add(Outcome("a", {"x": 0.1}, "", 0.5))
        journal.add(Outcome("b", None, "it fails.", 0.25))
        assert json.loads((tmp_path / JOURNAL).read_text().splitlines()[1])["result"] == {"x": 0.1}
        first = dict(journal.outcomes)
    with Journal.opened(tmp_path, PLAN) as journal:
        assert journal.outcomes == first


@pytest.mark.filterwarnings("ignore:A worker stopped")  # as an error it ends loky's own thread, and nothing comes back
def test_a_process_may_grow_by_what_a_later_task_needs():
    """loky would replace it."""

    def grown(_):
        kept = vars(sys).setdefault("kept", [])  # of the process
        kept.append(np.ones(50_000_000 if len(kept) == 1 else 1))  # 400 MB by the second task
        time.sleep(1.1)
        return os.getpid()

    assert len(set(in_processes(grown, [(k,) for k in range(6)], 2))) == 2
