"""The files of contracts, in a session of their own: there every call checks the shapes of its arrays."""

import subprocess
import sys
from pathlib import Path

from tests.conftest import CONTRACTS

ROOT = Path(__file__).parent.parent


def session(*arguments, cwd=ROOT):
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=cwd,
    )


def test_contracts_are_kept():
    done = session(*(f"tests/{name}.py" for name in sorted(CONTRACTS)))
    assert done.returncode == 0, done.stdout + done.stderr
