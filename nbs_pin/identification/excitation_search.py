"""The search for an exciting motion: many random starts, of which the best are followed further."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Reference
from nbs_pin.identification.excitation_problem import Problem, Weight, demand
from nbs_pin.motions.fourier import Fourier
from nbs_pin.robots.collisions import SelfDistances

_STAGES = (
    (Weight(1e2, 4.0, 5), 20),
    (Weight(1e2, 4.0, 5), 20),
    (Weight(1e3, 8.0, 8), 60),
    (Weight(1e4, 16.0, 10), 150),
)
"""Weights and most iterations of each stage. Those that are far ahead after 20 iterations mostly stay so to the end."""
_KEPT = 4
"""One start in so many goes on to the next stage."""
_MEMORY = 10
"""Corrections of L-BFGS."""
_POSTURES = 2000
"""Random postures among which one is sought that the arm can hold."""
_PER_WAVE, _FEWEST = 400, 2000
"""Instants per period of the highest harmonic, and in all, at which a motion is judged; distances at the fewest."""
_SPARE = 1e-4
"""Share of the bounds that is left, beyond what a wave can rise between two such instants."""
_SCALES = (1.0 - _SPARE, 0.99, 0.98, 0.96, 0.93, 0.88, 0.8, 0.65, 0.4, 0.2, 0.1, 0.03, 0.01)
"""How much smaller waves are made until they lie within the bounds."""


class Found(NamedTuple):
    """The result of a search."""

    motion: Fourier
    condition: float
    clearance: float
    """Least distance between bodies [m], inf without any."""
    nearest: tuple[str, str] | None
    """The links that come so near to each other."""
    interrupted: bool


class Failure(NamedTuple):
    """Why there is no motion; without either, because every motion that was found leaves the bounds."""

    joint: int | None
    """The joint that cannot hold the arm in any posture that was tried."""
    nearest: tuple[str, str] | None
    """The links that are too near to each other in all of them."""


def search(
    problem: Problem, every: SelfDistances | None, starts: int, seed: int, progress: bool = False
) -> Found | Failure:
    """The best motion within the bounds, or why there is none; Ctrl-C ends the search with the best so far.

    `every`: all distances, where `problem.near` has those that matter, or None. Raises KeyboardInterrupt if there is
    no motion yet.
    """
    rng = np.random.default_rng(seed)
    posture = _postures(problem, every, rng)
    first = next(posture)
    if isinstance(first, Failure):
        return first
    walk = _Walk(problem)
    tasks = [(stage, k) for stage in range(len(_STAGES)) for k in range(_share(starts, stage))]
    found: list[Found] = []
    interrupted = False
    try:
        for stage, k in tracked(tasks, walk.told, progress):
            if stage == 0:
                offset = first if k == 0 else next(posture)
                assert not isinstance(offset, Failure)
                walk.follow(_begin(problem, offset, rng), stage)
            else:
                walk.follow(walk.best(stage - 1)[k], stage)
            if stage == len(_STAGES) - 1:
                found += _finished(problem, every, [walk.ends[-1][2]], first)
    except KeyboardInterrupt:
        interrupted = True
        if not walk.ends:
            raise
    if not found:
        latest = max(stage for stage, _, _ in walk.ends)
        found = _finished(problem, every, walk.best(latest), first)
    if not found:
        return Failure(None, None)
    return min(found, key=lambda one: one.condition)._replace(interrupted=interrupted)


def _share(starts: int, stage: int) -> int:
    """How many starts a stage follows."""
    return int(-(-starts // _KEPT**stage))


class _Walk:
    """The minima that were found, by stage."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self.ends: list[tuple[int, float, np.ndarray]] = []

    def follow(self, x: np.ndarray, stage: int) -> None:
        """Go down from x by the rules of the stage."""
        weight, most = _STAGES[stage]
        options = {"maxiter": most, "maxfun": 2 * most, "maxcor": _MEMORY}
        ended = minimize(self._problem.value, x.ravel(), args=(weight,), jac=True, method="L-BFGS-B", options=options)
        self.ends.append((stage, float(ended.fun), ended.x.reshape(x.shape)))

    def best(self, stage: int) -> list[np.ndarray]:
        """The ends of a stage, the best first."""
        return [x for of, _, x in sorted(self.ends, key=lambda end: end[1]) if of == stage]

    def told(self) -> str:
        """What the progress bar says."""
        if not self.ends:
            return "searching"
        latest = max(stage for stage, _, _ in self.ends)
        value = min(value for stage, value, _ in self.ends if stage == latest)
        return f"searching, condition number about {np.exp(value):.3g}"


def _postures(
    problem: Problem, every: SelfDistances | None, rng: np.random.Generator
) -> Iterator[Float[np.ndarray, " n"] | Failure]:
    """Random postures within the bounds, in units of the half ranges, again and again the same if they are few."""
    bounds, n = problem.bounds, problem.robot.nv
    drawn = np.concatenate([np.zeros((1, n)), 0.8 * rng.uniform(-1.0, 1.0, (_POSTURES, n))])
    q = bounds.middle + bounds.half * drawn
    still = np.zeros_like(q)
    held = demand(problem.robot, Reference(q, still, still)) <= bounds.torque
    good = np.asarray(held.all(axis=1))
    if not good.any():
        yield Failure(int(np.argmin(held.mean(axis=0))), None)
    if every is not None and good.any():
        clear = every(q[good]) >= every.least
        if not clear.all(axis=1).any():
            yield Failure(None, every.pairs[int(np.argmin(clear.mean(axis=0)))])
        good[good] = clear.all(axis=1)
    while True:
        yield from rng.permutation(drawn[good])


def _begin(problem: Problem, offset: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random coefficients about a posture, as fast as the joints may, at most over their ranges."""
    x = np.concatenate([offset[None], rng.standard_normal((problem.shape[0] - 1, len(offset)))])
    motion = problem.motion(x)
    moved = motion(np.linspace(0.0, motion.duration, 20 * problem.harmonics))
    bounds, middle = problem.bounds, motion.offset
    rates = np.abs(moved.v).max(axis=0) / bounds.velocity, np.abs(moved.a).max(axis=0) / bounds.acceleration
    x[1:] /= np.maximum.reduce([*rates, np.abs(moved.q - middle).max(axis=0) / (2.0 * bounds.half)])
    return x


def _finished(
    problem: Problem, every: SelfDistances | None, ends: list[np.ndarray], posture: np.ndarray
) -> list[Found]:
    """The ends of the search within the bounds, about `posture`, which is, if their own mean postures are not."""
    moved = [np.concatenate([posture[None], x[1:]]) for x in ends]
    tried = (_within(problem, every, x) or _within(problem, every, other) for x, other in zip(ends, moved, strict=True))
    return [one for one in tried if one is not None]


def _within(problem: Problem, every: SelfDistances | None, x: np.ndarray) -> Found | None:
    """The motion with its waves as large as the bounds let them be, None if its mean posture is beyond them.

    The waves of each joint follow from its range, velocity and acceleration; torque and distances make all smaller.
    """
    bounds = problem.bounds
    dense = np.linspace(0.0, problem.duration, max(_FEWEST, _PER_WAVE * problem.harmonics))
    coarse = dense[:: max(1, len(dense) // _FEWEST)]
    full = problem.motion(x)
    moved, room = full(dense), bounds.half - np.abs(full.offset - bounds.middle)
    if (room <= 0.0).any():
        return None
    up, down = bounds.middle + bounds.half - full.offset, full.offset - bounds.middle + bounds.half
    away = moved.q - full.offset
    used = [away / up, -away / down, np.abs(moved.v) / bounds.velocity, np.abs(moved.a) / bounds.acceleration]
    own = 1.0 / np.maximum(1.0, np.max(used, axis=(0, 1)))

    def smaller(scale: float) -> Fourier:
        return problem.motion(np.concatenate([x[:1], scale * own * x[1:]]))

    def keeps(scale: float) -> bool:
        motion = smaller(scale)
        if (demand(problem.robot, motion(dense)) > (1.0 - _SPARE) * bounds.torque).any():
            return False
        return every is None or bool((every(motion(coarse).q) >= every.least).all())

    scale = next((x for x in _SCALES if keeps(x)), 0.0)
    if scale == 0.0:
        return None
    motion = smaller(scale)
    condition = problem.units.condition(motion(coarse[:-1]))
    if every is None or not every.pairs:
        return Found(motion, condition, np.inf, None, False)
    nearest = every(motion(coarse).q).min(axis=0)
    return Found(motion, condition, float(nearest.min()), every.pairs[int(np.argmin(nearest))], False)
