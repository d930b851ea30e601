"""The cost of an exported law on this machine: compiled with gcc, called from C, each call timed alone."""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nbs_pin.controllers.controller import Controller

COMPILER = "gcc"
FLAGS = ("-std=c99", "-O3", "-march=native", "-fno-math-errno", "-ffp-contract=fast")
"""Those of the package's Makefile."""
_TIMED = """
#define _POSIX_C_SOURCE 200809L
#include <time.h>
#include "{name}.h"

void timed(const double *states, int count, int calls, double *ns)
{{
    const double nothing[{n}] = {{0}};
    {name}_state state;
    {name}_start(&state, nothing);
    for (int k = 0; k < calls; k++) {{
        const double *x = states + 5 * {n} * (k % count);
        double tau[{n}];
        struct timespec begin, end;
        clock_gettime(CLOCK_MONOTONIC, &begin);
        {name}_step(&state, x, x + {n}, x + 2 * {n}, x + 3 * {n}, x + 4 * {n}, 0.001, tau);
        clock_gettime(CLOCK_MONOTONIC, &end);
        ns[k] = 1e9 * (double)(end.tv_sec - begin.tv_sec) + (double)(end.tv_nsec - begin.tv_nsec);
    }}
}}
"""


def can_compile() -> bool:
    """Whether there is a compiler."""
    return shutil.which(COMPILER) is not None


def step_times(
    controller: Controller, states: Float[np.ndarray, "states 5 n"], calls: int
) -> tuple[Float[np.ndarray, " calls"], int]:
    """Wall times of single steps of the law in C [µs], the states taken in turn, and bytes of its code and data."""
    with tempfile.TemporaryDirectory() as folder:
        header = controller.export(Path(folder) / "timed_law")
        (header.parent / "timed.c").write_text(_TIMED.format(name=header.stem, n=controller.nv))
        law, library, timed = (header.parent / name for name in ("law.o", "timed.so", "timed.c"))
        subprocess.run([COMPILER, *FLAGS, "-fPIC", "-c", header.with_suffix(".c"), "-o", law], check=True)
        subprocess.run([COMPILER, *FLAGS, "-fPIC", "-shared", timed, law, "-lm", "-o", library], check=True)
        sizes = subprocess.run(["size", law], check=True, capture_output=True, text=True).stdout.splitlines()[1].split()
        times, given = np.empty(calls), np.ascontiguousarray(states, dtype=float)
        first, last = (array.ctypes.data_as(ctypes.c_void_p) for array in (given, times))
        ctypes.CDLL(str(library)).timed(first, len(given), calls, last)
    return 1e-3 * times, sum(map(int, sizes[:3]))
