"""How often a certificate is wrong: random laws, references, starts, loads and periods in MuJoCo.

    python tools/certificate_campaign.py                # 2,000 set-ups on two cores, about two hours
    python tools/certificate_campaign.py --count 100 --seed 7

Each set-up is an arm of the catalogue with its limits and friction, an NBS, sliding-mode or Slotine–Li law with random
gains and weights, a reference, a start, a disturbance box, a period and, for a quarter of them, an unknown payload.
Its certificate is made as a user would, and MuJoCo runs it under constants, square waves and jumps within the box. A
number labelled PROVED that a run exceeds is printed with the set-up that breaks it, and the exit code is 1. A set-up is
calm if no run leaves the bounds of its certificate or saturates; the share of these that keep PROVED is printed, since
a label that is always EMPIRICAL says nothing.
"""

import argparse
import collections
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import joblib
import numpy as np

import nbs_pin as nbs
from nbs_pin.base.exceptions import CertificateRefused, NbsPinError
from nbs_pin.base.progress import tracked
from nbs_pin.certificates.torque_waves import random_disturbances

ARMS = ("two_link", "two_link", "three_link", "three_link", "ur3", "ur5", "ur10", "xarm7", "z1", "panda", "kinova")
PERIODS = (0.00025, 0.0005, 0.001, 0.002, 0.005, 0.01)
DURATION, RUNS = 1.5, 6
"""Length of a run [s], and runs of each set-up."""
LOADED = 0.25
"""Share of the set-ups with an unknown payload; every second run carries all of it, the others none."""


@dataclass(frozen=True)
class Outcome:
    """What became of one set-up."""

    seed: int
    told: str
    arm: str
    label: str
    """Of the certificate, or "refused"."""
    held: bool
    """Whether held torques are in its bounds."""
    worst: float
    """Largest error over its bound in all runs; inf if a run diverged."""
    saturated: bool
    void: str
    """The first condition that fails."""

    @property
    def broken(self) -> bool:
        """Whether a run exceeds what is PROVED."""
        return self.label == "PROVED" and self.worst > 1.0 + 1e-9

    @property
    def calm(self) -> bool:
        """Whether every run stayed within the bounds, without saturation."""
        return self.label != "refused" and self.worst <= 1.0 and not self.saturated


def setup(seed: int) -> tuple[str, nbs.Robot, Any, dict[str, Any], np.ndarray, float]:
    """What is told of a set-up, its arm, law, arguments of `certify`, disturbance box and period."""
    rng = np.random.default_rng(seed)
    name = str(rng.choice(ARMS))
    robot, period = nbs.load_robot(name), float(rng.choice(PERIODS))
    bandwidth, designed = float(rng.choice((4.0, 8.0, 15.0, 30.0))), float(rng.choice((0.0005, 0.001, 0.003, 0.01)))
    bandwidth = min(bandwidth, 0.4 / max(period, designed))
    kind, feed = str(rng.choice(("nbs", "nbs", "nbs", "sliding-mode", "slotine-li"))), rng.uniform() < 0.5
    friction = nbs.JointFriction.of(robot) if feed and (robot.damping.any() or robot.friction.any()) else None
    common = {"bandwidth": bandwidth, "period": designed, "friction": friction}
    times = 1.0
    if kind == "nbs":
        law: Any = nbs.NeuralBackstepping.for_robot(robot, seed=seed, **common)
        times = float(10.0 ** rng.uniform(0.0, np.log10(30.0))) if rng.uniform() < 0.5 else 1.0
        for network in (law.potential.network, law.damping.diagonal, law.damping.lower):
            for weights in network.parameters():
                weights.data *= times
    elif kind == "sliding-mode":
        law = nbs.SlidingMode.for_robot(robot, switching=float(rng.uniform(0.1, 3.0)), **common)
    else:
        law = nbs.SlotineLi.for_robot(robot, **common)
    frequency, share = float(rng.uniform(0.3, 3.0)), float(10.0 ** rng.uniform(-3.0, -0.5))
    reference = nbs.Sinusoid.for_robot(robot, frequency=frequency)
    limits = np.where(np.isfinite(robot.effort_limit), robot.effort_limit, 20.0)
    box = share * limits * rng.uniform(0.3, 1.0, robot.nv)
    begin = reference(np.zeros(1))
    given: dict[str, Any] = {"reference": reference, "duration": DURATION, "period": period}
    apart = bool(rng.uniform() < 0.5)
    if apart:
        size = float(10.0 ** rng.uniform(-3.0, -0.3))
        given |= {"q0": begin.q[0] + size * rng.uniform(-1.0, 1.0, robot.nv), "v0": begin.v[0]}
    loaded = bool(rng.uniform() < LOADED)
    if loaded:
        given["uncertainty"] = nbs.Uncertainty(payload=nbs.Payload(float(10.0 ** rng.uniform(-2.0, 0.3))))
    told = (
        f"{name} {kind} ω={bandwidth:.3g} designed for {1e3 * designed:g} ms, weights × {times:.3g}, {1e3 * period:g}"
        f" ms, {share:.2g} of the effort, sinusoid {frequency:.2g} rad/s{', apart' * apart}{', fed' * bool(friction)}"
        f"{', ' + str(given['uncertainty']) if loaded else ''}"
    )
    return told, robot, law, given, box, period


def outcome(seed: int) -> Outcome:
    """One set-up, certified and simulated."""
    warnings.simplefilter("ignore")
    told, robot, law, given, box, period = setup(seed)
    nothing = Outcome(seed, told, robot.name, "refused", False, 0.0, False, "")
    try:
        certificate = nbs.certify(law, box, **given)
    except (CertificateRefused, NbsPinError) as error:
        return replace(nothing, void=str(error).split(";")[0])
    size, joints = certificate.overshoot or (certificate.error, certificate.joint_errors)
    worst, saturated = 0.0, False
    for run in runs(robot, law, given, box, period, seed):
        if run is None:
            worst = np.inf
            break
        errors = law.dynamics.difference(run.q, run.q_ref)
        worst = max(worst, float(np.linalg.norm(errors, axis=-1).max()) / size, float((np.abs(errors) / joints).max()))
        saturated |= bool((run.tau != run.tau_command).any())
    held = certificate.held is not None and certificate.held.is_proved
    void = certificate.void[0] if certificate.void else ""
    return replace(nothing, label=str(certificate.label), held=held, worst=worst, saturated=saturated, void=void)


def runs(
    robot: nbs.Robot, law: Any, given: dict[str, Any], box: np.ndarray, period: float, seed: int
) -> Iterator[nbs.Run | None]:
    """Motions of the arm in MuJoCo under admissible disturbances, None for one that diverged."""
    steps = round(DURATION / period)
    waves = random_disturbances(nbs.Admissible.of(box, robot.nv), steps, period, RUNS, np.random.default_rng(seed))
    start = {key: given[key] for key in ("q0", "v0") if key in given}
    load = given["uncertainty"].payload if "uncertainty" in given else None
    for k, wave in enumerate(waves):
        arm = robot if load is None or k % 2 else load.on(robot)
        plant = nbs.MujocoPlant(arm, joint_friction="keep")
        try:
            yield nbs.simulate(
                plant, law, given["reference"], steps * period, period, disturbance=_Held(wave, period), **start
            )
        except nbs.SimulationDiverged:
            yield None


@dataclass(frozen=True)
class _Held:
    """A disturbance that is held over each control period."""

    wave: np.ndarray
    period: float

    def __call__(self, t: float, q: Any, v: Any) -> np.ndarray:
        return np.asarray(self.wave[min(int(t / self.period + 1e-6), len(self.wave) - 1)])


def main() -> int:
    """Run the campaign and print what it found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    seeds = range(options.seed, options.seed + options.count)
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=options.workers, return_as="generator_unordered")
        jobs = parallel(joblib.delayed(outcome)(seed) for seed in seeds)
        found = [next(jobs) for _ in tracked(seeds, "certificates")]
    return report(found)


def report(found: list[Outcome]) -> int:
    """Print the counts, every broken bound, and why calm set-ups lost their label; 1 if a bound is broken."""
    labels = collections.Counter(x.label for x in found)
    print(f"{len(found)} set-ups: " + ", ".join(f"{n} {label}" for label, n in labels.most_common()))
    proved = [x for x in found if x.label == "PROVED"]
    print(f"PROVED with held torques: {sum(x.held for x in proved)}; worst error over its bound: "
          f"{max((x.worst for x in proved), default=0.0):.3f}")  # fmt: skip
    calm = [x for x in found if x.calm]
    kept = sum(x.label == "PROVED" for x in calm)
    print(f"calm: {len(calm)}, of which {kept} PROVED ({100.0 * kept / max(len(calm), 1):.0f} %)")
    for void, n in collections.Counter(x.void for x in calm if x.void).most_common(8):
        print(f"  {n:4d} calm, but: {void}")
    broken = [x for x in found if x.broken]
    for x in broken:
        print(f"BROKEN, seed {x.seed}: {x.worst:.3g} of its bound, {x.told}")
    print(f"broken bounds labelled PROVED: {len(broken)}")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
