"""A law exported as C, compiled on this machine and called through ctypes."""

import ctypes
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from nbs_pin.base.arrays import Vectors
from nbs_pin.base.exceptions import NbsPinError
from nbs_pin.base.records import Reference
from nbs_pin.benchmarks.exported import COMPILER, FLAGS, can_compile
from nbs_pin.controllers.controller import Controller

_NAME = "entered_law"
_SIZE = f"""
#include <stddef.h>
#include "{_NAME}.h"

size_t size_of_state(void) {{ return sizeof({_NAME}_state); }}
"""


class CLaw(Controller):
    """The law in C; its memory is the bytes of the state that the C code keeps. It clips torques to the arm's limits.

    Raises:
        NbsPinError: If there is no compiler, or it fails.
        ArgumentError: If the law has no form in C.
    """

    def __init__(self, law: Controller) -> None:
        self._nv = law.nv
        if not can_compile():
            raise NbsPinError(f"a law in C needs the compiler {COMPILER}, which is not installed; install it.")
        with tempfile.TemporaryDirectory() as folder:  # a library that is loaded needs its file no longer
            header = law.export(Path(folder) / _NAME)
            size, library = header.parent / "size.c", header.parent / "law.so"
            size.write_text(_SIZE)
            command: list[str | Path] = [COMPILER, *FLAGS, "-fPIC", "-shared", header.with_suffix(".c"), size]
            command += ["-lm", "-o", library]
            built = subprocess.run(command, capture_output=True, text=True, check=False)
            if built.returncode:
                raise NbsPinError(f"{COMPILER} could not compile the law ({built.stderr.strip()[-300:]}); check it.")
            functions = ctypes.CDLL(str(library))
        functions.size_of_state.restype = ctypes.c_size_t
        self._start, self._step = functions[f"{_NAME}_start"], functions[f"{_NAME}_step"]
        self._size = int(functions.size_of_state())

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self._nv

    def initial_memory(self, q: Vectors) -> UInt8[np.ndarray, " bytes"]:
        """The state after a torque of 0."""
        state, nothing = np.zeros(self._size, np.uint8), np.zeros(self.nv)
        self._start(_at(state), _at(nothing))
        return state

    def step(
        self, memory: UInt8[np.ndarray, " bytes"], q: Vectors, v: Vectors, reference: Reference, period: float
    ) -> tuple[Vectors, UInt8[np.ndarray, " bytes"]]:
        """The torque of the C code, and its state after it."""
        state, tau = memory.copy(), np.empty(self.nv)
        given = [np.ascontiguousarray(x, dtype=float) for x in (q, v, *reference)]
        self._step(_at(state), *map(_at, given), ctypes.c_double(period), _at(tau))
        return tau, state


def _at(array: np.ndarray) -> Any:
    return array.ctypes.data_as(ctypes.c_void_p)
