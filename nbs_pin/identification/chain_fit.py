"""Fit of the chain network: geometry by descents from random trees, then bodies by convex least squares.

1. Levenberg–Marquardt from random trees over placements, bodies and friction, on a few hundred samples. A body may be
   any symmetric matrix, since the torque is linear in it. The descents of lowest cost are kept.
2. The same on all samples, then once more with every joint weighted by its residual.
3. With this geometry fixed, the physically consistent bodies that explain the data best (`identify.explain`).
4. Placements and these bodies together, then once more with axes at right angles where the data allow it.
"""

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from threadpoolctl import threadpool_limits

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import positive, told
from nbs_pin.base.doors import in_words
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.progress import tracked
from nbs_pin.dynamics.chain import Chain, random_tree
from nbs_pin.dynamics.coupled_network import CoupledNetwork
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pseudo_inertia import coordinates
from nbs_pin.identification.coupling import Coupling, geometry_of, in_motors, matrix_of
from nbs_pin.identification.datasets import Dataset
from nbs_pin.identification.drive_choice import Wanted
from nbs_pin.identification.drive_terms import DriveTerms
from nbs_pin.identification.explain import Bodies, IdentificationReport, contradicted, explain
from nbs_pin.identification.levenberg_marquardt import Descent, levenberg_marquardt
from nbs_pin.identification.physical_tree import PhysicalTree
from nbs_pin.identification.regressor import Geometry
from nbs_pin.identification.tree_search import Measurements, TreeEstimate, TreeGeometry
from nbs_pin.kernels.threads import cores

_FEW, _MOST = 400, 4_000
"""Samples used in the search, and after it at most."""
_EXACT = 1e-16
"""Cost of a descent below which it explains the data to rounding."""
_USUAL = 8
"""Random trees from which the typical size of a torque is taken."""
_ONE_AT_A_TIME = threading.Lock()
_AXIS = 4
"""Parameters that determine the axis of a joint, a line in space."""
_TRIES, _REACHED = 4, 2.0
"""Most trees for which physical bodies are sought; ratio of their cost to that of arbitrary bodies that suffices."""
_WAVE = 8
"""Descents between two checks of the termination criterion."""
_SAME, _FAR = 0.02, 0.1
"""Relative difference of cost within one minimum; ratio to the median cost below which finding it twice suffices."""
_UNLIKELY, _LIKELY = 9.0, 3.0
"""Increase of the sum of squares, in units of the noise, that right angles may cause: once, and for each angle."""
_ERRORS = 6.0, 3.0
"""Standard errors within which an angle may be a right one, tried in this order. If the torque is even in a tilt t, as
in a plane, noise acts on t²: where t² is three standard errors, t is six, as the error of t is that of t² over 2t."""
_LEAST = 1e-9
"""Lower bound of the residual by which a joint is weighted, as a share of its torque."""


@dataclass(frozen=True, eq=False)
class ChainFit:
    """A fitted chain network and the record of its fit."""

    network: Chain | CoupledNetwork
    """A chain; with rotors beside it where several joints turn them."""
    friction: JointFriction | None
    """Friction and offsets, None if there are none."""
    history: Float[np.ndarray, " steps"]
    """Torque nMSE at the start and after every step of the search's descent to this tree."""
    evaluations: int
    """Steps of all descents of the search."""
    costs: Float[np.ndarray, " starts"]
    """Torque nMSE at the end of each descent of the search."""
    stopped: str
    """"converged": a tree explained the data or the best minimum was found often enough, and physical bodies reach it.
    "starts": one of these failed. "interrupted": Ctrl-C ended the search."""
    bodies: IdentificationReport
    """Report on the bodies, for the placements found by the search."""
    seconds: float
    """Duration of the fit [s]."""


def fit_chain(
    data: Dataset,
    seed: int = 0,
    *,
    friction: bool | None = None,
    offset: bool | None = None,
    rotor_inertia: bool | None = None,
    coupled: Coupling | None = None,
    transition: float = 0.01,
    regularisation: float = 0.3,
    starts: int = 64,
    epsilon: float = 1e-12,
    right_angles: bool = True,
    progress: bool = False,
) -> ChainFit:
    """Fit a rigid tree; of the arm only the order and kinds of its joints are given.

    Args:
        data: Samples with torque.
        seed: Seed of the random trees.
        friction: Terms of friction to find, as in `identify`.
        offset: Constant torques to find, as in `identify`.
        rotor_inertia: Inertias of rotors behind gears to find, which a tree of bodies cannot represent; likewise.
        coupled: Motors that turn several joints; friction and rotors are theirs, the torques of the data the joints'.
        transition: Speed scale of the Coulomb friction [rad/s] (`JointFriction`).
        regularisation: γ, as in `identify`.
        starts: Most random trees; fewer if one explains the data to rounding or enough find the best minimum.
        epsilon: ε of the network [kg·m²].
        right_angles: Make axes of neighbouring joints parallel or perpendicular where the data do not contradict it, as
            in most arms. This reduces the error that noise causes when the geometry is unknown.
        progress: Show a progress bar. Ctrl-C ends the search and continues with the best tree so far, if there is one;
            after the search it ends the tries of further trees.

    Raises:
        ArgumentError: If the data have no torque, which arms of every scale explain, or as for `identify`.
    """
    began = time.perf_counter()
    positive("transition", transition, "rad/s")
    positive("regularisation", regularisation, "measurements")
    if not (isinstance(starts, int) and starts >= 1):
        raise ArgumentError(f"starts is {told(starts)}, expected a whole number ≥ 1 of random trees; 64 is usual.")
    if not data.tau.any():
        raise ArgumentError(
            f"{in_words(data, 'the data')} has no torque: arms of every scale move alike; record one with motors on."
        )
    network = Chain(data.parents.tolist(), data.prismatic.tolist(), epsilon)
    wanted = Wanted(friction, offset, rotor_inertia, transition)
    data, layout = data.thinned(_MOST), _layout(data.parents, data.prismatic)
    rng = np.random.default_rng(seed)
    # BLAS threads inside the threads of the search would only compete; the limit applies to the whole process.
    with _ONE_AT_A_TIME, threadpool_limits(1, "blas"):
        wanted, scaled, descents, interrupted = _searched(data, wanted, coupled, layout, starts, rng, progress)
        tries, stopped = _tries(
            sorted(descents, key=_cost)[:_TRIES],
            lambda one: _tried(one, data, scaled, coupled, wanted, regularisation, right_angles),
            progress,
        )
    best = min(tries, key=lambda found: found.cost)
    _write(best.physical, network)
    costs = np.array([_cost(descent) for descent in descents])
    converged = tries[-1].reached and _settled(costs)
    return ChainFit(
        network=_with_rotors(network, best.bodies.terms.rotors(best.physical.drag), coupled),
        friction=best.bodies.terms.friction(best.physical.drag, matrix_of(coupled)),
        history=np.array(best.descent.history),
        evaluations=sum(len(descent.history) for descent in descents),
        costs=costs,
        stopped="interrupted" if interrupted or stopped else "converged" if converged else "starts",
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
    """Whether they explain the data about as well as arbitrary symmetric bodies."""


def _tries(
    descents: Sequence[Descent[TreeEstimate]], trying: Callable[[Descent[TreeEstimate]], _Try], progress: bool
) -> tuple[list[_Try], bool]:
    """The bodies of one tree after the other until some explain the data, and whether Ctrl-C stopped it early."""
    tries: list[_Try] = []
    for descent in tracked(descents, "bodies of the best trees", progress):
        try:
            tries.append(trying(descent))
        except KeyboardInterrupt:
            if not tries:
                raise
            return tries, True
        if tries[-1].reached:
            break
    return tries, False


def _tried(
    descent: Descent[TreeEstimate],
    data: Dataset,
    scaled: Measurements,
    coupled: Coupling | None,
    wanted: Wanted,
    strength: float,
    right_angles: bool,
) -> _Try:
    """The physical bodies for the tree of a descent; `scaled` are the data of the search."""
    polished, moved = _polished(descent.at, scaled), in_motors(data, coupled)
    geometry = geometry_of(TreeGeometry(polished.at), coupled)
    bodies = explain(geometry, moved, wanted, strength, others=_AXIS * data.nv)
    chosen = _measured(data, bodies.terms, coupled, _needed(geometry, bodies, moved))
    physical = _physical(polished.at, bodies, chosen, strength, right_angles)
    cost = physical.whole().cost(chosen)
    return _Try(cost, descent, bodies, physical, cost <= _REACHED * polished.at.cost(scaled) + _EXACT)


def _needed(geometry: Geometry, bodies: Bodies, data: Dataset) -> Float[np.ndarray, "samples n"]:
    """The torque that bodies and rotors need [N·m]."""
    own = coordinates(bodies.factors @ bodies.factors.swapaxes(1, 2)).ravel()
    needed = geometry.regressor(data.q, data.v, data.a) @ own
    return needed if bodies.rotors is None else needed + bodies.rotors * data.a


def _measured(
    data: Dataset, terms: DriveTerms, coupled: Coupling | None, needed: np.ndarray | None = None
) -> Measurements:
    """The data, every motor scaled by its torque's standard deviation, at least 1e-3 of the largest RMS torque."""
    moved = in_motors(data, coupled)
    least = 1e-3 * np.sqrt(np.square(moved.tau).mean(axis=0).max())
    scale = np.maximum(moved.tau.std(axis=0), least)
    kinds = terms.factors(moved, needed)
    q, v, a, tau = (np.ascontiguousarray(x) for x in (data.q, data.v, data.a, moved.tau))
    return Measurements(q, v, a, tau, scale, kinds, None if coupled is None else np.linalg.inv(coupled.matrix))


def _in_units_of_random_trees(data: Measurements, layout: np.ndarray) -> Measurements:
    """The torques in units of the typical torque of random trees, whose bodies are of about 1 kg.

    Placements and bodies share one damping, so both should be of order one. Of the result only the geometry is used.
    """
    rng, still = np.random.default_rng(0), replace(data, tau=np.zeros_like(data.tau))
    trees = [TreeEstimate.of(random_tree(len(layout) // 2, rng), layout, len(data.kinds)) for _ in range(_USUAL)]
    usual = np.mean([np.square(tree.residual(still)).mean() for tree in trees])
    unit = np.sqrt(np.square(data.tau).mean() / usual)
    return replace(data, tau=data.tau / unit, scale=data.scale / unit)


def _layout(parents: Int[np.ndarray, " n"], prismatic: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " layout"]:
    """The layout array of the tree kernels."""
    return np.concatenate([[len(parents)], np.column_stack([parents, prismatic]).ravel()]).astype(np.int64)


def _cost(descent: Descent[TreeEstimate]) -> float:
    return descent.cost if np.isfinite(descent.cost) else np.inf


def _searched(
    data: Dataset,
    wanted: Wanted,
    coupled: Coupling | None,
    layout: np.ndarray,
    starts: int,
    rng: np.random.Generator,
    progress: bool,
) -> tuple[Wanted, Measurements, list[Descent[TreeEstimate]], bool]:
    """The terms still wanted after the search, the data in its units, its descents, and whether Ctrl-C ended it.

    Where it is left to the data whether there are drives, trees without them are tried first, as drives are known by
    what a tree leaves.
    """

    def scaled(terms: DriveTerms) -> Measurements:
        return _in_units_of_random_trees(_measured(data, terms, coupled), layout)

    if not wanted.is_settled:
        bare = wanted.settled()
        alone = scaled(bare.first(data.nv))
        descents, interrupted = _search(alone, layout, min(starts, _WAVE), rng.spawn(1)[0], progress)
        if interrupted or min(_cost(descent) for descent in descents) < _EXACT:
            return bare, alone, descents, interrupted
    searched = scaled(wanted.of_search(data.nv))
    try:
        return wanted, searched, *_search(searched, layout, starts, rng, progress)
    except KeyboardInterrupt:
        if wanted.is_settled:
            raise
        return bare, alone, descents, True


def _search(
    data: Measurements, layout: np.ndarray, starts: int, rng: np.random.Generator, progress: bool
) -> tuple[list[Descent[TreeEstimate]], bool]:
    """Descents from random trees on a few samples until `_settled`, and whether Ctrl-C ended them after some."""
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
    """Whether the search may end.

    It may if one descent explains the data to rounding, if two found the best minimum far below the median cost, or,
    after two waves, if a quarter found it.
    """
    best = costs.min()
    met = int((costs <= (1.0 + _SAME) * best).sum())
    return bool(
        best < _EXACT
        or (met >= 2 and best < _FAR * np.median(costs))
        or (len(costs) >= 2 * _WAVE and met >= 0.25 * len(costs))
    )


def _polished(guess: TreeEstimate, data: Measurements) -> Descent[TreeEstimate]:
    """The descent on all samples, then once more with every joint weighted by its residual."""
    even = levenberg_marquardt(guess, lambda x: x.normal(data), lambda x: x.cost(data), TreeEstimate.moved)
    left = np.sqrt(np.mean(np.square(even.at.residual(data)), axis=0))
    fair = replace(data, scale=np.maximum(left, _LEAST * data.scale))
    return levenberg_marquardt(even.at, lambda x: x.normal(fair), lambda x: x.cost(fair), TreeEstimate.moved)


def _physical(
    guess: TreeEstimate, bodies: Bodies, data: Measurements, strength: float, right_angles: bool
) -> PhysicalTree:
    """The descent over placements and physical bodies together, then once more with the likely right angles."""
    guess = replace(guess, drag=bodies.scalars)
    start = PhysicalTree(guess, bodies.factors, bodies.scalars, bodies.terms.signed, bodies.expected, strength)
    fair, free = _fair(start, bodies, data)
    if not right_angles:
        return free.at
    for errors in _ERRORS:
        held = _descent(free.at.at_right_angles(fair, errors), fair)
        worse = (held.cost - free.cost) * data.q.size
        if worse < _UNLIKELY + _LIKELY * np.count_nonzero(held.at.angles):
            return held.at
    return free.at


def _descent(start: PhysicalTree, data: Measurements) -> Descent[PhysicalTree]:
    return levenberg_marquardt(
        start, lambda x: x.normal(data), lambda x: x.cost(data), PhysicalTree.moved, iterations=300, stall=1e-4
    )


def _fair(start: PhysicalTree, bodies: Bodies, data: Measurements) -> tuple[Measurements, Descent[PhysicalTree]]:
    """The data in the units by which the joints are weighted, and the descent in them.

    Arbitrary bodies determine the placements less well than physical ones, so these may leave much until the placements
    move along. Only where they still leave far more than the noise are the joints weighted by their torque.
    """
    weighed = replace(data, scale=bodies.weighed)
    found = _descent(start, weighed)
    noise = bodies.report.noise
    if (bodies.weighed == noise).all():
        return weighed, found
    fair = replace(data, scale=noise)
    renewed = _descent(found.at, fair)
    left = np.sqrt(np.square(renewed.at.whole().residual(data)).mean(axis=0))
    if contradicted(noise, left, np.sqrt(np.square(data.tau).mean(axis=0))):
        return weighed, found
    return fair, renewed


def _write(tree: PhysicalTree, network: Chain) -> None:
    """Copy the tree into the parameters of the network."""
    with torch.no_grad():
        for name, value in tree.guess.tree(_triangular(tree.factors))._asdict().items():
            getattr(network, name).copy_(torch.from_numpy(value))


def _with_rotors(network: Chain, rotors: JointArray | None, coupled: Coupling | None) -> Chain | CoupledNetwork:
    """The network with these rotor inertias, which several joints turn where the drives are coupled."""
    if rotors is None:
        return network
    whole = network if coupled is None else CoupledNetwork(network, coupled.matrix)
    with torch.no_grad():
        whole.rotors.copy_(torch.from_numpy(np.sqrt(rotors)))
    return whole


def _triangular(factors: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 4 4"]:
    """Lower triangular L with LLᵀ = FFᵀ, from Fᵀ = QR as L = Rᵀ; FFᵀ may be singular after rounding."""
    return np.asarray(np.linalg.qr(factors.swapaxes(1, 2), mode="r")).swapaxes(1, 2)
