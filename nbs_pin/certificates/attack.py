"""An adversary: the worst admissible disturbance it can find for a closed loop, to hold beside what is certified.

Every motion starts on its reference, z1 = z2 = 0, and the torque is held over each control period. What it finds is a
lower bound of the worst error, never an upper one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from numbers import Integral

import numpy as np
from jaxtyping import Bool, Float, Int

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, floats
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Run
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.ensemble import LoopEnsemble, Peaks, law_of
from nbs_pin.certificates.torque_waves import FASTEST, SLOWEST, constant, in_step, random_disturbances, square
from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.motions.references import DesiredMotion

__all__ = ["Attack", "Peaks", "attack", "random_disturbances", "worst_of"]


@dataclass(frozen=True, eq=False)
class Attack:
    """The worst that was found, a lower bound of the worst there is."""

    error: float
    """Largest ‖z1(t)‖ [rad] of all motions tried."""
    joint_errors: JointArray
    """Largest |z1_i(t)| [rad], each over all motions tried."""
    disturbance: Float[np.ndarray, "steps n"]
    """The τ_d [N·m] that reached `error`, held over each period."""
    run: Run
    """Its motion."""
    found_by: str
    """What found it: "constant", "square wave" or "bang-bang ascent" ("steepest ascent" in a ball)."""
    history: Float[np.ndarray, " stages"]
    """Largest ‖z1‖ [rad] known after the waves and after every round of ascent; it never falls."""
    duration: float
    """Length of every motion [s]."""
    period: float
    """Control period [s]."""


def attack(
    controller: Controller,
    disturbance: PerJoint | Admissible,
    *,
    reference: DesiredMotion | Sequence[DesiredMotion] | None = None,
    plant_dynamics: DynamicsProvider | None = None,
    duration: float | None = None,
    period: float = 0.001,
    rounds: int = 6,
    starts: int = 12,
    seed: int = 0,
    effort_limit: PerJoint = np.inf,
    progress: bool = False,
) -> Attack:
    """The worst ‖z1‖ and |z1_i| that a search over admissible disturbances finds.

    Constants and square waves of 1 to 300 rad/s come first. From the worst of them, of every motion and for each joint
    by itself, the torque climbs the gradient of ‖z1‖² or z1_i² at the end, or at the time of the peak: at every instant
    it becomes the admissible torque of greatest inner product with the gradient, which in a linear loop is the exact
    worst case of z1_i after one round; where that overshoots, it does so only at the instants that promise most.

    disturbance: one bound per joint, a bound on ‖τ_d‖ or an `Admissible`. reference: the motion to follow, or several;
    None takes the arm's own (`Sinusoid.for_robot`) and postures held still. plant_dynamics: the truth, None for what
    the controller believes; it has the friction that the controller feeds forward.
    duration [s]: None takes seven times the slowest time constant of the loop linearised at the start, at most 4000
    periods. period: control period [s]. rounds: of ascent. starts: disturbances that climb, beside one per joint.
    effort_limit: [N·m], none, as certificates assume. progress: show a progress bar on a terminal.

    Raises ArgumentError for arguments that do not fit, and for a law without a model, as gradients go through one;
    SimulationDiverged when a motion leaves the finite numbers.
    """
    for name, value, least in (("rounds", rounds, 0), ("starts", starts, 1), ("seed", seed, 0)):
        _check_count(name, value, least)
    ensemble = LoopEnsemble.of(controller, reference, plant_dynamics, duration, period, effort_limit, seed)
    admissible, rng = Admissible.of(disturbance, controller.nv), np.random.default_rng(seed)
    names, motion, waves = _waves(ensemble, admissible, rng)
    peaks = ensemble.peaks(motion, waves, progress)
    pack = _Ascent.of(motion, waves, peaks, starts)
    history = [float(peaks.error.max())]
    for k in tracked(range(rounds), lambda: f"attack: {history[-1]:.4g} rad so far", progress):
        pack = pack.ascend(ensemble, admissible, at_end=k % 2 == 0)
        history.append(max(history[-1], float(pack.peaks.error.max())))
    worst = int(pack.peaks.error.argmax())
    ascent = "bang-bang ascent" if admissible.radius is None else "steepest ascent"
    found_by = ascent if pack.ascended[worst] else names[pack.origin[worst]]
    return Attack(
        error=history[-1],
        joint_errors=np.maximum(peaks.joint_errors.max(axis=0), pack.joint_errors),
        disturbance=pack.torque[worst],
        run=ensemble.run(int(pack.motion[worst]), pack.torque[worst], attack=found_by),
        found_by=found_by,
        history=np.array(history),
        duration=ensemble.loop.steps * period,
        period=period,
    )


def worst_of(
    controller: Controller,
    disturbances: Float[np.ndarray, "count steps n"],
    reference: DesiredMotion | Sequence[DesiredMotion] | None = None,
    *,
    plant_dynamics: DynamicsProvider | None = None,
    period: float = 0.001,
    effort_limit: PerJoint = np.inf,
    seed: int = 0,
    progress: bool = False,
) -> Peaks:
    """Largest errors under each of the disturbances [N·m], held over each period; several motions take turns.

    Arguments as in `attack`, errors too. Raises ArgumentError for disturbances of another shape or not finite.
    """
    law_of(controller)
    _check_count("seed", seed, 0)
    disturbances = floats("disturbances", disturbances)
    if disturbances.ndim != 3 or disturbances.shape[-1] != controller.nv or 0 in disturbances.shape:
        raise ArgumentError(
            f"the disturbances have shape {disturbances.shape}, expected (count, steps, {controller.nv}); correct them."
        )
    if not np.isfinite(disturbances).all():
        raise ArgumentError("the disturbances hold numbers that are not finite; correct them.")
    duration = disturbances.shape[1] * period
    ensemble = LoopEnsemble.of(controller, reference, plant_dynamics, duration, period, effort_limit, seed)
    return ensemble.peaks(np.arange(len(disturbances)) % len(ensemble.scenes), disturbances, progress)


def _check_count(name: str, value: int, least: int) -> None:
    if not isinstance(value, Integral) or value < least:
        raise ArgumentError(f"{name} is {value!s:.80}, expected a whole number ≥ {least}; correct it.")


def _waves(
    ensemble: LoopEnsemble, admissible: Admissible, rng: np.random.Generator
) -> tuple[list[str], Int[np.ndarray, " count"], Float[np.ndarray, "count steps n"]]:
    """Constants, square waves of one rate and of a rate per joint, on every motion: names, motions and torques."""
    n, t = ensemble.loop.plant.nv, ensemble.loop.period * np.arange(ensemble.loop.steps)
    names, motion, waves = [], [], []
    rates = np.geomspace(SLOWEST, FASTEST, 12).tolist()
    for k, rate in product(range(len(ensemble.scenes)), [None, None, *rates]):
        names.append("constant" if rate is None else "square wave")
        motion.append(k)
        waves.append(constant(admissible, t, n, rng) if rate is None else in_step(admissible, t, n, rng, rate))
    for k, _ in product(range(len(ensemble.scenes)), range(4)):
        names.append("square wave")
        motion.append(k)
        waves.append(square(admissible, t, n, rng))
    return names, np.array(motion), np.array(waves)


@dataclass(frozen=True, eq=False)
class _Ascent:
    """Disturbances that climb side by side; each keeps the worst it has been."""

    motion: Int[np.ndarray, " count"]
    torque: Float[np.ndarray, "count steps n"]
    """[N·m]"""
    weights: Float[np.ndarray, "count n"]
    """What each climbs, Σ w_i z1_i²: all joints, or one."""
    origin: Int[np.ndarray, " count"]
    """The wave each began as."""
    ascended: Bool[np.ndarray, " count"]
    """Whether it is another by now."""
    share: Float[np.ndarray, " count"]
    """How much of what the gradient promises the next step takes."""
    peaks: Peaks
    """Of every torque."""
    joint_errors: JointArray
    """Largest |z1_i| [rad] of all that was tried."""

    @classmethod
    def of(
        cls, motion: Int[np.ndarray, " waves"], waves: Float[np.ndarray, "waves steps n"], peaks: Peaks, starts: int
    ) -> "_Ascent":
        """The worst wave of every motion, then the second worst …, and for each joint the one that moves it most."""
        order = np.argsort(-peaks.error, kind="stable")
        rank = np.array([int((motion[order[:k]] == motion[order[k]]).sum()) for k in range(len(order))])
        first = order[np.argsort(rank, kind="stable")][:starts]
        chosen = np.concatenate([first, peaks.joint_errors.argmax(axis=0)])
        n, count = waves.shape[-1], len(chosen)
        return cls(
            motion=motion[chosen],
            torque=waves[chosen],
            weights=np.concatenate([np.ones((len(first), n)), np.eye(n)]),
            origin=chosen,
            ascended=np.zeros(count, dtype=bool),
            share=np.ones(count),
            peaks=Peaks(*(x[chosen] for x in peaks)),
            joint_errors=peaks.joint_errors.max(axis=0),
        )

    def ascend(self, ensemble: LoopEnsemble, admissible: Admissible, *, at_end: bool) -> "_Ascent":
        """One step each; one that gained nothing is undone, and its next step is a quarter as long."""
        gradient = ensemble.torque_gradient(self.motion, self.torque, self.weights, at_end)
        trial = _towards(admissible, self.torque, gradient, self.share)
        found = ensemble.peaks(self.motion, trial)
        before, after = (np.sqrt((self.weights * p.joint_errors**2).max(axis=1)) for p in (self.peaks, found))
        whole = self.weights.all(axis=1)
        better = np.where(whole, found.error > self.peaks.error, after > before)
        kept = [np.where(better.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
                for new, old in zip((trial, *found), (self.torque, *self.peaks), strict=True)]  # fmt: skip
        return replace(
            self,
            torque=kept[0],
            peaks=Peaks(*kept[1:]),
            ascended=self.ascended | better,
            share=np.where(better, np.minimum(1.0, 2.0 * self.share), 0.25 * self.share),
            joint_errors=np.maximum(self.joint_errors, found.joint_errors.max(axis=0)),
        )


def _towards(
    admissible: Admissible,
    torque: Float[np.ndarray, "count steps n"],
    gradient: Float[np.ndarray, "count steps n"],
    share: Float[np.ndarray, " count"],
) -> Float[np.ndarray, "count steps n"]:
    """The torque where it promises least, and the admissible one that the gradient asks for where it promises most."""
    wanted = np.where(gradient == 0.0, torque, admissible.towards(gradient))
    gain = (gradient * (wanted - torque)).sum(axis=-1)
    order = np.argsort(-gain, axis=1)
    gained = np.cumsum(np.take_along_axis(gain, order, axis=1), axis=1)
    taken = gained <= share[:, None] * gained[:, -1:] * (1.0 + 1e-9)
    taken[:, 0] = True
    chosen = np.empty_like(taken)
    np.put_along_axis(chosen, order, taken, axis=1)
    return np.where(chosen[..., None], wanted, torque)
