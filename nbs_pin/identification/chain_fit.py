"""The chain network from data: geometry by many descents from random trees, then the bodies by convex least squares.

1. From a random tree, Levenberg–Marquardt over placements, bodies and friction on a few hundred samples, bodies being
   any symmetric matrices, in which torque is linear. Of all descents the lowest counts.
2. The same once more on all samples, each joint weighted by the residual it was left with.
3. For that geometry, the bodies that can exist and explain the data best, as for an arm whose geometry is known
   (`identification.explain`).
4. Placements and these bodies together, then once more with axes at right angles where the data allow it.
"""

import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from threadpoolctl import threadpool_limits

from nbs_pin.base.checks import positive
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.progress import tracked
from nbs_pin.dynamics.chain import Chain, random_tree
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.identify import Bodies, IdentificationReport, explain
from nbs_pin.identification.levenberg_marquardt import Descent, levenberg_marquardt
from nbs_pin.identification.physical_tree import PhysicalTree
from nbs_pin.identification.regressor import Scalars
from nbs_pin.identification.tree_search import Measurements, TreeEstimate
from nbs_pin.kernels.threads import cores

_FEW = 400
"""Samples that the search looks at."""
_EXACT = 1e-16
"""Weighted residual below which a descent has found the arm."""
_USUAL = 8
"""Random trees that show which torques are usual."""
_ONE_AT_A_TIME = threading.Lock()
_AXIS = 4
"""Numbers that place the axis of a joint."""
_TRIES, _REACHED = 4, 2.0
"""Trees that physical bodies are sought for, until their residual is at most so many times that of any bodies."""
_WAVE = 8
"""Descents between two looks at the results."""
_SAME, _FAR = 0.02, 0.1
"""Descents whose costs differ by less than this share met in one minimum; one this far below the usual is no chance."""
_UNLIKELY, _LIKELY = 9.0, 3.0
"""Squared residuals, in units of the noise, that right angles may cost: once, and for each."""
_ERRORS = 6.0, 3.0
"""Standard errors within which an angle may be right, first the first. Where the torque is even in a tilt t, as in
a plane, noise makes t² and not t: t² of three standard errors is t of six, as its own error is that of t² over 2t."""
_LEAST = 1e-9
"""Least residual that a joint is credited with, as a share of its torque."""


@dataclass(frozen=True, eq=False)
class ChainFit:
    """A chain network, and how it was found."""

    network: Chain
    friction: JointFriction | None
    """Viscous and Coulomb friction, if they were to be learned."""
    history: Float[np.ndarray, " steps"]
    """Torque nMSE after every step of the descent that won."""
    evaluations: int
    """Steps of all descents."""
    costs: Float[np.ndarray, " starts"]
    """Torque nMSE where each descent of the search ended."""
    stopped: str
    """"converged": one tree explained the data, or the best minimum was met often enough, and physical bodies reach it.
    "starts": neither. "interrupted": Ctrl-C ended the search."""
    bodies: IdentificationReport
    """How the bodies were found, for the placements of the search."""
    seconds: float
    """What it took [s]."""


def fit_chain(
    data: Dataset,
    seed: int = 0,
    *,
    friction: bool = False,
    rotor_inertia: bool = False,
    transition: float = 0.01,
    regularisation: float = 0.3,
    starts: int = 64,
    epsilon: float = 1e-12,
    right_angles: bool = True,
    progress: bool = False,
) -> ChainFit:
    """The rigid tree that moves as the data do; of the arm only the order and the kinds of its joints are given.

    friction: also find viscous and Coulomb coefficients ≥ 0, for the speed `transition` [rad/s] at which they turn.
    rotor_inertia: also find the inertias ≥ 0 of rotors behind gears, which an arm has and a tree of bodies has not.
    regularisation: see `identify`. starts: most random trees to descend from; a search ends as soon as one explains the
    data to rounding, or the best minimum has been met often enough. epsilon: ε of the network [kg·m²]. right_angles:
    axes of neighbouring joints that the data do not tell from parallel or perpendicular become so, as most arms are
    built, which spares part of what unknown geometry costs under noise. progress: show a bar at a terminal. Ctrl-C ends
    the search and goes on with the best tree so far, if there is one.
    Raises ArgumentError for data without torque, which arms of every scale explain, and as `identify` does.
    """
    began = time.perf_counter()
    positive("transition", transition, "rad/s")
    positive("regularisation", regularisation, "measurements")
    if not (isinstance(starts, int) and starts >= 1):
        raise ArgumentError(f"starts is {starts}, expected a whole number ≥ 1 of random trees; 64 is usual.")
    if not data.tau.any():
        raise ArgumentError(f"{data!r} has no torque: arms of every scale move so; record one with motors on.")
    network = Chain(data.parents.tolist(), data.prismatic.tolist(), epsilon)
    scalars = Scalars(friction, rotor_inertia, transition)
    measured, layout = _measured(data, scalars), _layout(data.parents, data.prismatic)
    handy, rng = _in_handy_units(measured, layout), np.random.default_rng(seed)
    # BLAS threads below the threads of the search would only wait for each other; the limit is the whole process's.
    with _ONE_AT_A_TIME, threadpool_limits(1, "blas"):
        descents, interrupted = _search(handy, layout, starts, rng, progress)
        tries: list[_Try] = []
        for descent in sorted(descents, key=_cost)[:_TRIES]:
            polished = _polished(descent.at, handy)
            bodies = explain(TreeGeometry(polished.at), data, scalars, regularisation, others=_AXIS * data.nv)
            physical = _physical(polished.at, bodies, measured, regularisation, right_angles)
            cost = physical.whole().cost(measured)
            tries.append(_Try(cost, descent, bodies, physical, cost <= _REACHED * polished.at.cost(handy) + _EXACT))
            if tries[-1].reached:
                break
    best = min(tries, key=lambda found: found.cost)
    _write(best.physical, network, rotor_inertia)
    costs, drag = np.array([_cost(descent) for descent in descents]), best.physical.drag
    converged = tries[-1].reached and _settled(costs)
    return ChainFit(
        network=network,
        friction=JointFriction(drag[0], drag[1], transition) if friction else None,
        history=np.array(best.descent.history),
        evaluations=sum(len(descent.history) for descent in descents),
        costs=costs,
        stopped="interrupted" if interrupted else "converged" if converged else "starts",
        bodies=best.bodies.report,
        seconds=time.perf_counter() - began,
    )


class _Try(NamedTuple):
    """Physical bodies for one tree of the search."""

    cost: float
    descent: Descent[TreeEstimate]
    bodies: Bodies
    physical: PhysicalTree
    reached: bool
    """Whether they explain the data about as well as any bodies."""


@dataclass(frozen=True, eq=False)
class TreeGeometry:
    """The placements of a guess, as `identification` asks for them."""

    guess: TreeEstimate

    @property
    def names(self) -> Sequence[str]:
        """Numbers: data know no names."""
        return [f"joint {i + 1}" for i in range(len(self.guess.positions))]

    @property
    def places(self) -> tuple[Sequence[int], Float[np.ndarray, "n 3"]]:
        """Parents and positions [m]."""
        return self.guess.layout[1::2].tolist(), self.guess.positions

    def regressor(
        self, q: Float[np.ndarray, "rows n"], v: Float[np.ndarray, "rows n"], a: Float[np.ndarray, "rows n"]
    ) -> Float[np.ndarray, "rows n unknowns"]:
        """Derivatives of the torque with respect to the bodies."""
        return self.guess.regressor(q, v, a)


def _measured(data: Dataset, scalars: Scalars) -> Measurements:
    """The data with every joint weighted by the spread of its torque, at least a thousandth of the largest."""
    least = 1e-3 * np.sqrt(np.square(data.tau).mean(axis=0).max())
    scale = np.maximum(data.tau.std(axis=0), least)
    kinds = scalars.factors(data.v, data.a)
    q, v, a, tau = (np.ascontiguousarray(x) for x in (data.q, data.v, data.a, data.tau))
    return Measurements(q, v, a, tau, scale, kinds)


def _in_handy_units(data: Measurements, layout: np.ndarray) -> Measurements:
    """The torques in the unit in which random trees of 1 kg make such torques.

    Descents scale placements and bodies alike, so both should be about one. The bodies that are found in this unit are
    not looked at: only their geometry is.
    """
    rng, still = np.random.default_rng(0), replace(data, tau=np.zeros_like(data.tau))
    trees = [TreeEstimate.of(random_tree(len(layout) // 2, rng), layout, len(data.kinds)) for _ in range(_USUAL)]
    usual = np.mean([np.square(tree.residual(still)).mean() for tree in trees])
    unit = np.sqrt(np.square(data.tau).mean() / usual)
    return replace(data, tau=data.tau / unit, scale=data.scale / unit)


def _layout(parents: Int[np.ndarray, " n"], prismatic: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " layout"]:
    """The tree layout of the kernels."""
    return np.concatenate([[len(parents)], np.column_stack([parents, prismatic]).ravel()]).astype(np.int64)


def _cost(descent: Descent[TreeEstimate]) -> float:
    return descent.cost if np.isfinite(descent.cost) else np.inf


def _search(
    data: Measurements, layout: np.ndarray, starts: int, rng: np.random.Generator, progress: bool
) -> tuple[list[Descent[TreeEstimate]], bool]:
    """Descents from random trees on a few samples, until one is good enough or the best has been met often enough.

    Also whether Ctrl-C ended it, which it does once there is a tree to go on with.
    """
    few = data.some(np.sort(rng.permutation(len(data.q))[:_FEW]))
    descents: list[Descent[TreeEstimate]] = []

    def descend(child: np.random.Generator) -> Descent[TreeEstimate]:
        start = TreeEstimate.of(random_tree(len(layout) // 2, child), layout, len(data.kinds))
        return levenberg_marquardt(
            start, lambda x: x.normal(few), lambda x: x.cost(few), TreeEstimate.moved, iterations=150, patience=12
        )

    def label() -> str:
        return f"searching, nMSE {min((_cost(x) for x in descents), default=np.inf):.1e}"

    with ThreadPoolExecutor(cores()) as pool:
        for _ in tracked(range(-(-starts // _WAVE)), label, progress):
            try:
                descents.extend(list(pool.map(descend, rng.spawn(min(_WAVE, starts - len(descents))))))
            except KeyboardInterrupt:
                if not descents:
                    raise
                return descents, True
            if _settled(np.array([_cost(x) for x in descents])):
                break
    return descents, False


def _settled(costs: np.ndarray) -> bool:
    """Whether more descents are worth their time.

    Enough is one that explains the data to rounding; or the best minimum met twice where it lies far below the usual
    one; or, after two waves, met by a quarter of all.
    """
    best = costs.min()
    met = int((costs <= (1.0 + _SAME) * best).sum())
    return bool(
        best < _EXACT
        or (met >= 2 and best < _FAR * np.median(costs))
        or (len(costs) >= 2 * _WAVE and met >= 0.25 * len(costs))
    )


def _polished(guess: TreeEstimate, data: Measurements) -> Descent[TreeEstimate]:
    """The descent on all samples, then again with every joint weighted by what it was left with."""
    even = levenberg_marquardt(guess, lambda x: x.normal(data), lambda x: x.cost(data), TreeEstimate.moved)
    left = np.sqrt(np.mean(np.square(even.at.residual(data)), axis=0))
    fair = replace(data, scale=np.maximum(left, _LEAST * data.scale))
    return levenberg_marquardt(even.at, lambda x: x.normal(fair), lambda x: x.cost(fair), TreeEstimate.moved)


def _physical(
    guess: TreeEstimate, bodies: Bodies, data: Measurements, strength: float, right_angles: bool
) -> PhysicalTree:
    """The descent over placements and physical bodies together, then again with the angles that it leaves likely."""
    fair = replace(data, scale=bodies.report.noise)

    def descend(start: PhysicalTree) -> Descent[PhysicalTree]:
        return levenberg_marquardt(
            start, lambda x: x.normal(fair), lambda x: x.cost(fair), PhysicalTree.moved, iterations=300, stall=1e-4
        )

    free = descend(PhysicalTree(guess, bodies.factors, bodies.scalars, bodies.expected, strength))
    if not right_angles:
        return free.at
    for errors in _ERRORS:
        held = descend(free.at.at_right_angles(fair, errors))
        worse = (held.cost - free.cost) * data.q.size
        if worse < _UNLIKELY + _LIKELY * np.count_nonzero(held.at.angles):
            return held.at
    return free.at


def _write(tree: PhysicalTree, network: Chain, rotor_inertia: bool) -> None:
    """The tree into the parameters of the network."""
    with torch.no_grad():
        for name, value in tree.guess.tree(_triangular(tree.factors))._asdict().items():
            getattr(network, name).copy_(torch.from_numpy(value))
        if rotor_inertia:
            network.rotors.copy_(torch.from_numpy(np.sqrt(tree.drag[-1])))


def _triangular(factors: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Lower triangular factors of the same FFᵀ, which need not be positive definite after rounding: FᵀQ = R, L = Rᵀ."""
    return np.asarray(np.linalg.qr(factors.swapaxes(1, 2), mode="r")).swapaxes(1, 2)
