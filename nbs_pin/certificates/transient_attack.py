"""Search for the load, start and disturbance with which an adaptive law comes nearest to its transient bound.

The torque is held over each control period, so that a bound of the loop in continuous time can be exceeded; then the
same run with a quarter of the period tells whether the hold did it.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import differential_evolution

from nbs_pin.base.arguments import DURATION, PERIOD, SEED, a, checked, count, flag, maybe
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Run
from nbs_pin.base.shown import Cells, Shown
from nbs_pin.base.units import counted, measured
from nbs_pin.certificates.adaptive_bound import TransientBound
from nbs_pin.certificates.ensemble import MOST_PERIODS, TIME_CONSTANTS, motions_of, slowest_rate
from nbs_pin.certificates.transient_search import ROUNDING, Load, Reached, TransientSearch
from nbs_pin.controllers.compiled_adaptive import checked_period
from nbs_pin.motions.references import DesiredMotion

_LEAST_RUNS, _FINER = 10, 4


@dataclass(frozen=True, eq=False, repr=False)
class TransientAttack(Shown):
    """What `transient_attack` found; its values are lower bounds of the worst ones.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), load_mass=0.5)
        >>> found = nbs.transient_attack(nbs.transient_bound(law, 0.5), duration=0.2, runs=10)
        >>> found.is_kept, found.ratio > 1.0, len(found.run.t)
        (True, True, 201)
    """

    bound: TransientBound
    storage: float
    """Largest V of all runs [J]."""
    joint_errors: JointArray
    """Largest |z1_i| of all runs, joint by joint [rad, m]."""
    run: Run
    """The run with the largest |z1_i| as a share of its bound."""
    load: Load
    """The load of that run."""
    runs: int
    """How many runs were tried."""
    cut: int
    """How many of them were left out, as a torque was cut off, which the bound assumes that none is."""
    history: Float[np.ndarray, " rounds"]
    """The largest share of |z1_i| in its bound after every round of the search."""
    finer: Reached | None
    """The largest values of the run that exceeds a bound with a quarter of its period; None where none does, or
    a torque is cut off in it."""
    interrupted: bool
    """Whether Ctrl-C ended the search early."""

    @property
    def ratio(self) -> float:
        """Least bound of |z1_i| ÷ the largest one found."""
        with np.errstate(divide="ignore"):
            return float((self.bound.joint_errors / self.joint_errors).min())

    @property
    def is_kept(self) -> bool:
        """Whether no bound was exceeded, of V or of a joint."""
        return not Reached(self.storage, self.joint_errors).exceeds(self.bound)

    @property
    def verdict(self) -> str:
        """One sentence."""
        shares = self.joint_errors / self.bound.joint_errors
        k = int(shares.argmax())
        unit = self.bound.joint_units[k]
        error, most = (measured(float(x[k]), unit) for x in (self.joint_errors, self.bound.joint_errors))
        tried = counted(self.runs - self.cut, "run")
        if self.is_kept:
            said = f"of {tried} the nearest to its bound: {self.bound.joint_names[k]} was {error} off, of {most}"
            return f"{said}, with {self.load.told(self.bound.frame)}"
        beyond = f"V was {self.storage:.3g} J, beyond {self.bound.storage_within:.3g} J"
        if shares[k] > ROUNDING:
            beyond = f"{self.bound.joint_names[k]} was {error} off, beyond {most}"
        finer = "the same run with a quarter of the period"
        if self.finer is None:
            why = f"in {finer} a torque is cut off, so that it does not tell why"
        elif self.finer.exceeds(self.bound):
            why = f"{finer} exceeds it too: the hold of the torque alone does not explain it"
        else:
            why = f"{finer} stays within it: the hold of the torque did it, not the proof"
        return f"BOUND EXCEEDED: {beyond}; {why}"

    def summary(self) -> dict[str, Any]:
        """What was found as JSON can store it."""
        return {
            "runs": self.runs,
            "runs_left_out": self.cut,
            "interrupted": self.interrupted,
            "storage_J": self.storage,
            "joint_errors_rad": self.joint_errors.tolist(),
            "bound_over_found": self.ratio if math.isfinite(self.ratio) else None,
            "load_mass_kg": self.load.mass,
            "load_centre_m": self.load.centre.tolist(),
            "duration_s": float(self.run.t[-1]),
            "exceeds": not self.is_kept,
            "verdict": self.verdict,
        }

    def _facts(self) -> Iterable[str]:
        return self.bound.law.robot.name, f"bound ÷ found {self.ratio:.3g}", counted(self.runs, "run")

    def _cells(self) -> Cells:
        errors = self.bound.joint_errors.tolist(), self.joint_errors.tolist()
        each = zip(self.bound.joint_names, *errors, self.bound.joint_units, strict=True)
        rows = [(name, measured(most, unit), measured(x, unit)) for name, most, x, unit in each]
        return Cells(("joint", "error at most", "largest found"), rows)


@checked(
    bound=a(TransientBound, "a TransientBound, as transient_bound returns it"),
    duration=maybe(DURATION),
    period=maybe(PERIOD),
    runs=count(_LEAST_RUNS, 10_000_000, "runs"),
    seed=SEED,
    progress=flag,
)
def transient_attack(
    bound: TransientBound,
    *,
    reference: DesiredMotion | Sequence[DesiredMotion] | None = None,
    duration: float | None = None,
    period: float | None = None,
    runs: int = 1000,
    seed: int = 0,
    progress: bool = False,
) -> TransientAttack:
    """Search for the load, the start and the disturbance with which a law that adapts comes nearest to its bound.

    Differential evolution over the mass and the place of a point load in the box of the bound, over starts with at
    most the V(0) that it states, over square waves on the boundary of its disturbances with a rate and a phase per
    joint, and over motions. It begins with random ones and the load that is farthest from the first estimate.

    Args:
        bound: What is attacked.
        reference: One motion or several. None takes `Sinusoid.for_robot` and postures at rest.
        duration: Length of every run [s], at most that of the bound. None takes seven times the slowest time constant
            of the linearised loop, at most 4000 periods, or that of the bound.
        period: Control period [s]. None takes that of the law.
        runs: How many runs are simulated, at most.
        seed: Seed of the search and of the postures.
        progress: Show a progress bar. Ctrl-C ends the search and keeps what was found.

    Raises:
        ArgumentError: If arguments do not fit.
        SimulationDiverged: If a motion diverges.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link")), load_mass=0.5)
        >>> bound = nbs.transient_bound(law, 0.5, 0.05, disturbance=[0.5, 0.2], duration=0.2)
        >>> bool((nbs.transient_attack(bound, runs=10).joint_errors <= bound.joint_errors).all())
        True
    """
    period = bound.law.period if period is None else checked_period(period, bound.law.period)
    followed = motions_of(bound.law.law.dynamics, reference, seed)
    search = TransientSearch(bound, followed, _steps(bound, followed[0], duration, period), period)
    history, interrupted = _searched(search, runs, seed, progress)
    if search.best is None:
        raise ArgumentError(
            f"in each of {counted(search.runs, 'run')} a torque was cut off, where the bound does not hold; "
            "give a smaller load, start or disturbance, or a slower reference."
        )
    finer = None if search.beyond is None else search.repeated(search.beyond[1], _FINER)
    return TransientAttack(
        bound, search.storage, search.joint_errors, search.run(search.best), search.best.load, search.runs, search.cut,
        np.array(history), finer, interrupted,
    )  # fmt: skip


def _searched(search: TransientSearch, runs: int, seed: int, progress: bool) -> tuple[list[float], bool]:
    """The largest share after every round of at most so many runs, and whether Ctrl-C ended them."""
    size, known = max(5, min(runs // 2, round(math.sqrt(1.6 * runs)))), len(search.motions)
    rounds = runs // size
    begin = np.random.default_rng(seed).uniform(size=(size, search.size))
    begin[:known] = [search.expected(k, x) for k, x in enumerate(begin[:known])]
    ticks, history = tracked(range(rounds), search.told, progress), list[float]()

    def objective(x: Float[np.ndarray, "size runs"]) -> Float[np.ndarray, " runs"]:
        next(ticks)
        shares = search.shares(x.T)
        history.append(search.worst)
        return -shares

    try:
        differential_evolution(
            objective, [(0.0, 1.0)] * search.size, strategy="currenttobest1bin", maxiter=rounds - 1, init=begin,
            polish=False, tol=0.0, vectorized=True, updating="deferred", rng=np.random.default_rng((seed, 1)),
        )  # fmt: skip
    except KeyboardInterrupt:
        if search.best is None:
            raise
        return history, True
    return history, False


def _steps(bound: TransientBound, motion: DesiredMotion, duration: float | None, period: float) -> int:
    """The periods of a run; raises ArgumentError for more than are bounded."""
    if duration is None:
        steps = min(max(math.ceil(TIME_CONSTANTS / slowest_rate(bound.law.law, motion) / period), 10), MOST_PERIODS)
        duration = min(steps * period, bound.duration)
    if duration > bound.duration * ROUNDING:
        raise ArgumentError(
            f"duration is {duration:g} s, and the bound is for {bound.duration:g} s; give at most that, or a bound for"
            " longer."
        )
    return max(1, math.floor(duration / period + 1e-6))
