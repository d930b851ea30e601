"""Machine code on disk: whatever happens to its files, a kernel gives its numbers and the files are made anew."""

import os
import random
import subprocess
import sys

import pytest

SCRIPT = """
import warnings
import numpy as np
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    from nbs_pin.kernels.matrices import times
    out = np.empty(2)
    times(np.array([1.0, 2.0, 3.0, 4.0]), np.ones(2), out)
hits, misses = sum(times.stats.cache_hits.values()), sum(times.stats.cache_misses.values())
print(out.tolist(), hits, misses, [str(w.message) for w in told], sep="|")
"""


def run(folder):
    """Numbers, times loaded, times compiled, and warnings."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stderr == ""
    numbers, hits, misses, told = done.stdout.strip().split("|")
    assert numbers == "[3.0, 7.0]"
    return int(hits), int(misses), told


def flipped(content, seed):
    spoilt, draw = bytearray(content), random.Random(seed)
    for _ in range(20):
        spoilt[draw.randrange(len(spoilt))] ^= 1 << draw.randrange(8)
    return bytes(spoilt)


DAMAGES = {
    "empty": lambda content: b"",
    "random": lambda content: random.Random(1).randbytes(len(content)),
    "truncated": lambda content: content[: len(content) // 2],
    "one bit": lambda content: content[:-5] + bytes([content[-5] ^ 1]) + content[-4:],
    "twenty bits": lambda content: flipped(content, 2),
    "the first byte": lambda content: content[1:],
}


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A folder with the machine code of a kernel."""
    folder = tmp_path_factory.mktemp("cache")
    assert run(folder) == (0, 1, "[]")
    assert run(folder) == (1, 0, "[]")
    return folder


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_machine_code_is_told_once_and_made_anew(kept, damage):
    for ending in ("nbi", "nbc"):
        files = [*kept.rglob(f"*.{ending}")]
        assert files
        for file in files:
            file.write_bytes(DAMAGES[damage](file.read_bytes()))
        hits, misses, told = run(kept)
        assert (hits, misses) == (0, 1)
        assert told.count("is damaged: it is compiled again and replaced") == told.count("machine code in") == 1
        assert run(kept) == (1, 0, "[]")


def test_a_folder_that_vanishes_is_made_again(tmp_path):
    assert run(tmp_path / "new") == (0, 1, "[]")
    for file in (tmp_path / "new").rglob("*.nbc"):
        file.unlink()
    assert run(tmp_path / "new") == (0, 1, "[]")
    assert run(tmp_path / "new") == (1, 0, "[]")


def test_what_another_version_kept_is_ignored(kept, monkeypatch):
    """A folder that was written by other sources is no damage."""
    for file in kept.rglob("*.nbi"):
        name = file.name.replace(".sealed", "")
        (file.parent / name).write_bytes(b"of an earlier version")
    assert run(kept) == (1, 0, "[]")
