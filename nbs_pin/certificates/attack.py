"""Search for the worst admissible disturbance of a closed loop, to compare with the certified bound.

Every motion starts on its reference, z1 = z2 = 0, and the torque is held over each control period. The result is a
lower bound of the worst error, never an upper one.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from nbs_pin.base.arguments import DURATION, PERIOD, SEED, checked, count, flag, maybe
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.checks import PerJoint, floats
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.progress import tracked
from nbs_pin.base.records import Run
from nbs_pin.base.shown import Shown
from nbs_pin.base.units import measured, several, units
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.ensemble import LoopEnsemble, Peaks, law_of
from nbs_pin.certificates.torque_waves import FASTEST, SLOWEST, constant, in_step, random_disturbances, square
from nbs_pin.controllers.controller import Controller
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.motions.references import DesiredMotion

__all__ = ["Attack", "Peaks", "attack", "random_disturbances", "worst_of"]


@dataclass(frozen=True, eq=False, repr=False)
class Attack(Shown):
    """The worst motion that `attack` found; its errors are lower bounds of the worst ones.

    Example:
        >>> import nbs_pin as nbs
        >>> law = nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link"))
        >>> found = nbs.attack(law, [5.0, 5.0], duration=0.1, rounds=0)
        >>> 0.0 < found.error < 0.02  # rad, ‖z1‖; found.run is the motion
        True
    """

    error: float
    """Largest ‖z1(t)‖ of all motions tried [rad]."""
    joint_errors: JointArray
    """Largest |z1_i(t)| of all motions tried, joint by joint [rad]."""
    disturbance: Float[np.ndarray, "steps n"]
    """The τ_d that reached `error`, held over each period [N·m]."""
    run: Run
    """The motion under `disturbance`."""
    found_by: str
    """Kind of `disturbance`: "constant", "square wave" or "bang-bang ascent" ("steepest ascent" in a ball)."""
    history: Float[np.ndarray, " stages"]
    """Largest ‖z1‖ found after the initial waves and after every round of ascent, non-decreasing [rad]."""
    duration: float
    """Length of every motion [s]."""
    period: float
    """Control period [s]."""
    interrupted: bool = False
    """Whether Ctrl-C ended the ascent before its last round."""

    def _facts(self) -> Iterable[str]:
        unit = several(of.position for of in self.run.units)
        return f"worst ‖z1‖ found {measured(self.error, unit)}", self.found_by, f"{self.duration:.4g} s"


@checked(
    plant_dynamics=maybe(MODEL),
    duration=maybe(DURATION),
    period=PERIOD,
    rounds=count(0, 10_000),
    starts=count(1, 100_000),
    seed=SEED,
    progress=flag,
)
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
    """Search for the admissible disturbance that causes the largest ‖z1‖, and the largest |z1_i| of every joint.

    It starts with constants and square waves of 1 to 300 rad/s. From the worst of them it follows the gradient of ‖z1‖²
    or z1_i² at the final time and at the peak, in turn: at every instant the torque becomes the admissible one with the
    greatest inner product with the gradient, in a linear loop the exact worst case of z1_i after one round. After a
    step without gain, only the instants with the greatest predicted gain change.

    Args:
        controller: A law with a model.
        disturbance: One bound per joint on |τ_d,i|, one number that bounds ‖τ_d‖ [N·m], or an `Admissible`.
        reference: One motion or several. None takes `Sinusoid.for_robot` and postures at rest.
        plant_dynamics: The true dynamics. None takes the controller's model. Joint friction is the one fed forward.
        duration: Length of every motion [s]. None takes seven times the slowest time constant of the linearised loop,
            at most 4000 periods.
        period: Control period [s].
        rounds: Rounds of gradient ascent.
        starts: Disturbances to improve, besides one per joint.
        seed: Seed of postures and waves.
        effort_limit: Saturation of the torque [N·m]. Certificates assume none.
        progress: Show a progress bar.

    Raises:
        ArgumentError: If an argument does not fit, or the law has no model for the gradients to pass through.
        SimulationDiverged: If a motion diverges.
        KeyboardInterrupt: If Ctrl-C comes before the gradients are followed; later it ends the search.

    Example:
        >>> import nbs_pin as nbs
        >>> controller = nbs.NeuralBackstepping.for_robot(nbs.load_robot("two_link"))
        >>> found = nbs.attack(controller, [5.0, 5.0], duration=0.1, rounds=0)
        >>> found.error < nbs.certify(controller, [5.0, 5.0]).error
        True
    """
    ensemble = LoopEnsemble.of(controller, reference, plant_dynamics, duration, period, effort_limit, seed)
    admissible, rng = Admissible.of(disturbance, controller.nv), np.random.default_rng(seed)
    names, motion, waves = _waves(ensemble, admissible, rng)
    peaks = ensemble.peaks(motion, waves, progress)
    pack = _Ascent.of(motion, waves, peaks, starts)
    history = [float(peaks.error.max())]
    pack = _ascended(pack, ensemble, admissible, rounds, history, progress)
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
        interrupted=len(history) <= rounds,
    )


@checked(plant_dynamics=maybe(MODEL), period=PERIOD, seed=SEED, progress=flag)
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
    """Largest errors under each held disturbance [N·m]; arguments as in `attack`, several motions are used in turn."""
    law_of(controller)
    disturbances = floats("disturbances", disturbances)
    if disturbances.ndim != 3 or disturbances.shape[-1] != controller.nv or 0 in disturbances.shape:
        raise ArgumentError(
            f"the disturbances have shape {disturbances.shape}, expected (count, steps, {controller.nv}); correct them."
        )
    if not np.isfinite(disturbances).all():
        raise ArgumentError("the disturbances contain numbers that are not finite; correct them.")
    duration = disturbances.shape[1] * period
    ensemble = LoopEnsemble.of(controller, reference, plant_dynamics, duration, period, effort_limit, seed)
    return ensemble.peaks(np.arange(len(disturbances)) % len(ensemble.scenes), disturbances, progress)


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
    """Disturbances that are improved side by side; each keeps its best value so far."""

    motion: Int[np.ndarray, " count"]
    torque: Float[np.ndarray, "count steps n"]
    """[N·m]"""
    weights: Float[np.ndarray, "count n"]
    """Weights of the objective Σ w_i z1_i²: all joints, or one."""
    origin: Int[np.ndarray, " count"]
    """Index of the wave each started from."""
    ascended: Bool[np.ndarray, " count"]
    """Whether it has changed since."""
    share: Float[np.ndarray, " count"]
    """Share of the predicted gain that the next step takes."""
    peaks: Peaks
    """Largest errors under every torque."""
    joint_errors: JointArray
    """Largest |z1_i| of all torques tried [rad]."""

    @classmethod
    def of(
        cls, motion: Int[np.ndarray, " waves"], waves: Float[np.ndarray, "waves steps n"], peaks: Peaks, starts: int
    ) -> "_Ascent":
        """The worst wave of every motion, then the second worst …, and for each joint the worst one."""
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
        """One step each; a step without gain is undone, and the next one is a quarter as long."""
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


def _ascended(
    pack: _Ascent, ensemble: LoopEnsemble, admissible: Admissible, rounds: int, history: list[float], progress: bool
) -> _Ascent:
    """The disturbances after some rounds, or after those before Ctrl-C; the largest error of each → history."""
    arm = ensemble.loop.plant.robot
    unit = several(units("position", [False] if arm is None else arm.prismatic))
    try:
        for k in tracked(range(rounds), lambda: f"attack: {history[-1]:.4g} {unit} so far", progress):
            pack = pack.ascend(ensemble, admissible, at_end=k % 2 == 0)
            history.append(max(history[-1], float(pack.peaks.error.max())))
    except KeyboardInterrupt:  # what was found until then is a motion as any other
        pass
    return pack


def _towards(
    admissible: Admissible,
    torque: Float[np.ndarray, "count steps n"],
    gradient: Float[np.ndarray, "count steps n"],
    share: Float[np.ndarray, " count"],
) -> Float[np.ndarray, "count steps n"]:
    """The torque, replaced by the admissible one along the gradient at the instants of greatest predicted gain."""
    wanted = np.where(gradient == 0.0, torque, admissible.towards(gradient))
    gain = (gradient * (wanted - torque)).sum(axis=-1)
    order = np.argsort(-gain, axis=1)
    gained = np.cumsum(np.take_along_axis(gain, order, axis=1), axis=1)
    taken = gained <= share[:, None] * gained[:, -1:] * (1.0 + 1e-9)
    taken[:, 0] = True
    chosen = np.empty_like(taken)
    np.put_along_axis(chosen, order, taken, axis=1)
    return np.where(chosen[..., None], wanted, torque)
