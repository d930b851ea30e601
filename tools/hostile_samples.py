"""Ten million random hostile samples through the guard: no torque may be illegal.

Readings, references, commands and gravity are numbers of every size, NaN and inf; time stands still, jumps and goes
back; samples go missing, faults come and go, and the guard begins anew from time to time.

    python tools/hostile_samples.py --count 10000000
"""

import argparse
import math
import sys
import time
from typing import Any

import numpy as np
from numba import njit

import nbs_pin as nbs
from nbs_pin.kernels import guarding as at

SIZES = np.array([0.0, 1e-300, 1e-9, 1e-3, 0.1, 1.0, 3.0, 30.0, 1e3, 1e6, 1e30, 1e99, 1e101, 1e200, 1.7e308])


@njit(nogil=True)
def hostile(rng: Any, usual: Any, odd: float, sizes: Any, x: Any) -> None:
    """Fill x with numbers near usual ones, or, at a chance of `odd`, with any."""
    for i in range(len(x)):
        x[i] = usual[i] + 1e-3 * rng.normal()
        if rng.random() < odd:
            kind = rng.integers(0, 10)
            if kind == 0:
                x[i] = np.nan
            elif kind == 1:
                x[i] = np.inf if rng.random() < 0.5 else -np.inf
            else:
                x[i] = sizes[rng.integers(0, len(sizes))] * rng.normal()


@njit(nogil=True)
def campaign(rng: Any, config: Any, begin: Any, rate: Any, count: int, sizes: Any) -> Any:
    """Number of illegal torques, of instants by mode, and of stops by code."""
    n = (len(config) - at.NUMBERS) // at.VECTORS
    effort = config[at.NUMBERS + at.EFFORT * n : at.NUMBERS + (at.EFFORT + 1) * n]
    state, t, h = begin.copy(), 0.0, config[at.LENGTH]
    q, v, q_ref, v_ref, external, command, gravity, last = (
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
    )
    zero, modes, codes, illegal, odd = np.zeros(n), np.zeros(3, np.int64), np.zeros(17, np.int64), 0, 0.0
    at_tau = at.SCALARS + at.TAU * n
    for k in range(count):
        if k % 400 == 0:  # anew, and another kind of hostility
            state[:], t = begin, 0.0
            odd = (0.0, 1e-3, 0.02, 0.3)[rng.integers(0, 4)]
        last[:] = state[at_tau : at_tau + n]
        t += h if rng.random() > odd else (0.0, -1.0, 5e-3, 0.1, 1e9, np.nan)[rng.integers(0, 6)]
        hostile(rng, zero, odd, sizes, q)
        hostile(rng, zero, odd, sizes, v)
        hostile(rng, zero, 0.3 * odd, sizes, q_ref)
        hostile(rng, zero, 0.3 * odd, sizes, v_ref)
        hostile(rng, zero, 0.3 * odd, sizes, external)
        hostile(rng, effort, 0.1 + odd, sizes, command)
        hostile(rng, zero, odd, sizes, gravity)
        at.admit(config, state, t, rng.random() > odd, rng.random() < odd, q, v, q_ref, v_ref, external)
        fault = rng.integers(0, 17) if rng.random() < 0.01 * odd else 0
        at.release(config, state, command, gravity, fault)
        for i in range(n):
            tau = state[at_tau + i]
            legal = abs(tau) <= effort[i] and abs(tau - last[i]) <= rate[i] * h  # NaN is not
            illegal += 0 if legal else 1
        modes[int(state[at.MODE])] += 1
        if state[at.MODE] == at.STOPPED:
            codes[int(state[at.CODE])] += 1
    return illegal, modes, codes


def run(name: str, count: int, seed: int = 0, compensated: bool = False, function: Any = campaign) -> Any:
    """The campaign for an arm; `campaign.py_func` as function spares a short one the compiler."""
    guard = nbs.Guard.for_robot(nbs.load_robot(name), compensated=compensated)
    n = guard.nv
    begin = guard.begin(np.zeros(n), np.zeros(n), np.zeros(n))
    config = guard.config.copy()
    rows = config[at.NUMBERS :].reshape(at.VECTORS, n)
    rows[at.LOWER], rows[at.UPPER] = -math.inf, math.inf  # the samples are about zero
    return function(np.random.default_rng(seed), config, begin, guard.torque_rate, count, SIZES)


def main() -> int:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000_000)
    parser.add_argument("--arm", default="panda")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    bad, began = 0, time.perf_counter()
    for compensated in (False, True):
        illegal, modes, codes = run(options.arm, options.count // 2, options.seed, compensated)
        bad += illegal
        said = ", ".join(f"{nbs.Mode(k).name} {x}" for k, x in enumerate(modes))
        told = ", ".join(f"{nbs.Fault(k).name} {x}" for k, x in enumerate(codes) if x)
        print(f"{options.arm}, {'with' if compensated else 'without'} gravity added: {illegal} illegal; {said}; {told}")
    print(f"{options.count} samples in {time.perf_counter() - began:.0f} s, {bad} illegal torques")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
