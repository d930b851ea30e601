"""A short form of `make fuzz-files`: every reader refuses damaged files in one sentence, or reads finite numbers."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TOOL = [sys.executable, str(ROOT / "tools" / "fuzz_files.py")]


@pytest.mark.parametrize("seed", [0, 1])
def test_damaged_files_are_told_or_read(seed):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [*TOOL, "--count", "144", "--seed", str(seed), "--workers", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=300)
    assert done.returncode == 0, done.stdout
    assert "144 files, 0 faults" in done.stdout
    rows = [line.split() for line in done.stdout.splitlines()[1:15]]
    assert len(rows) == 14
    assert all(int(row[1]) > 0 for row in rows)  # some of every kind are refused
    assert sum(int(row[2]) for row in rows) > 5  # and some are read


def test_a_fault_is_an_exit_code_and_a_case_that_can_be_repeated(tmp_path):
    """The tool, given a reader that fails, says so."""
    script = f"""
import sys
sys.path.insert(0, {str(ROOT / "tools")!r})
import fuzz_files
def read(path):
    yield 1.0 / (len(path.read_bytes()) % 2)
fuzz_files.READERS = {{"motion.csv": read}}
sys.argv[1:] = ["--count", "20", "--workers", "1"]
sys.exit(fuzz_files.main())
"""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "TMPDIR": tempfile.gettempdir()}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1
    assert "of motion.csv: untyped: ZeroDivisionError" in done.stdout
