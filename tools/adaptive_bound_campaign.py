"""How often the transient bound of an adaptive law is wrong: random loads, starts, motions and disturbances in MuJoCo.

    python tools/adaptive_bound_campaign.py                # 1,000 runs on two cores, about twenty minutes
    python tools/adaptive_bound_campaign.py --count 100 --seed 7
    python tools/adaptive_bound_campaign.py --search 1000  # transient_attack, so many runs for every arm and kind

Each run is an arm with an `AdaptiveLaw` that knows nothing of its load, of random mass and place within the box that
the bound is for: no load, a point or five points, often the heaviest at the edge. It starts on the reference or beside
it, with V(0) of the loaded arm counted, and follows a random smooth motion at 1 kHz, every third time under an
admissible disturbance. Every other arm has effort limits that it never reaches. A run whose torque is cut off is
counted and left out, since the bound assumes that none is. V and every |z1_i| at each instant are compared with the
bounds; the exit code is 1 if one is exceeded, and such a run is repeated with a quarter of the period, as the bound is
proved in continuous time. Ctrl-C reports what is done.

With --search, `transient_attack` searches instead: on every arm over the loads of a box from the reference, from starts
beside it, and under a disturbance, on random motions and postures.
"""

import argparse
import dataclasses
import math
import sys
from typing import Any

import joblib
import numpy as np

import nbs_pin as nbs
from nbs_pin.base.progress import tracked
from nbs_pin.certificates.torque_waves import random_disturbances
from nbs_pin.certificates.transient_search import loaded_storage
from nbs_pin.dynamics.pinocchio_tree import pack_model
from nbs_pin.motions.references import at_times

ARMS = ("two_link", "panda", "ur5", "xarm7")
LOADS = {"two_link": 0.5, "panda": 3.0, "ur5": 3.0, "xarm7": 2.0}
"""Largest load of each arm [kg]."""
PERIOD, AMPLE = 0.001, 20.0
"""Control period [s]; factor on the effort limits of arms that never reach them."""
NEAR, DISTURBED = 0.02, 0.3
"""Largest share of the effort limits that disturbs, and the share of runs that are disturbed."""

_LEAST = 1e-30  # of an arm that does not leave its reference


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of one run."""

    seed: int
    told: str
    arm: str
    cut: bool
    """Whether a torque was cut off; the ratios are NaN then."""
    storage: float
    """√(bound of V / largest V)."""
    joint: float
    """Least bound of |z1_i| / largest |z1_i|."""
    heavy: bool
    """Whether the load is a point of the largest mass at the edge of its box, from a start on the reference."""

    @property
    def broken(self) -> bool:
        """Whether a bound is exceeded."""
        return not self.cut and not min(self.storage, self.joint) >= 1.0 - 1e-9


def law_of(name: str, ample: bool, bandwidth: float, seed: int) -> nbs.AdaptiveLaw:
    """The law of an arm; its joints have no friction."""
    robot = nbs.load_robot(name)
    if ample:
        robot = robot.with_effort_limit(AMPLE * robot.effort_limit)
    inner = nbs.NeuralBackstepping.for_robot(robot, bandwidth=bandwidth, seed=seed)
    return nbs.AdaptiveLaw(inner, ["load"], load_mass=LOADS[name], period=PERIOD)


def load_in(rng: np.random.Generator, mass: float, radius: float) -> dict[str, Any]:
    """A load of the box, as `Robot.with_payload` takes it; no mass for none."""
    kind = rng.uniform()  # five points, as MuJoCo refuses what rounds to flatter than a plane of three
    masses = mass * rng.dirichlet(np.ones(6))[:5] if kind > 0.7 else np.array([mass * rng.uniform()])
    places = rng.normal(size=(len(masses), 3))
    places *= radius * (rng.uniform(size=(len(masses), 1)) ** (1.0 / 3.0) / np.linalg.norm(places, axis=1)[:, None])
    if kind < 0.1:
        return {"mass": 0.0}
    if kind < 0.5:
        masses = np.array([mass])
        places *= radius / max(float(np.linalg.norm(places)), 1e-12)
    total = float(masses.sum())
    com = masses @ places / total
    apart = places - com
    second = np.einsum("k,ki,kj->ij", masses, apart, apart)
    second = 0.5 * (second + second.T)
    inertia = np.trace(second) * np.eye(3) - second if len(masses) > 1 and radius > 0.0 else 0.0
    return {"mass": total, "com": com, "inertia": inertia}


def motion_in(rng: np.random.Generator, robot: nbs.Robot, duration: float) -> Any:
    """A random sinusoid within half the limits of the arm, or a posture at rest, that its motors can follow."""
    low, high = robot.sampling_range
    speed = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, np.pi)
    while True:
        frequency = rng.uniform(0.3, 3.0, robot.nv)
        most = np.minimum(0.25 * (high - low), 0.5 * speed / frequency)
        amplitude = most * rng.uniform(0.0, 1.0, robot.nv) * (rng.uniform() > 0.2)
        offset = rng.uniform(low + amplitude, high - amplitude)
        motion = nbs.Sinusoid(amplitude, frequency, rng.uniform(0.0, 2.0 * np.pi, robot.nv), offset)
        aim = at_times(motion, np.linspace(0.0, duration, 400), robot.nv)
        needed = nbs.inverse_dynamics(nbs.PinocchioDynamics(robot), *aim)
        if (np.abs(needed) < 0.9 * robot.effort_limit).all():
            return motion


def outcome(seed: int, period: float = PERIOD) -> Outcome:
    """One run against its bound, with this control period [s]."""
    rng = np.random.default_rng(seed)
    name, ample = str(rng.choice(ARMS)), seed % 2 == 1
    law = law_of(name, ample, float(rng.choice((4.0, 8.0))), int(rng.integers(3)))
    robot, inner = law.robot, law.law
    radius = float(rng.choice((0.0, 0.3, 1.0))) * min(law.load_radius or 0.0, law.load_across or 0.0)
    mass = LOADS[name] * float(rng.choice((0.25, 0.5, 1.0)))
    load, duration = load_in(rng, mass, radius), float(rng.integers(3, 6))
    frame = law.unknowns.bodies[0].name.removeprefix("load at ")
    loaded = robot if load["mass"] == 0.0 else robot.with_payload(frame, **load)
    motion = motion_in(rng, loaded, duration)
    begin = motion(np.zeros(1))
    size = 0.0 if rng.uniform() < 0.5 else float(10.0 ** rng.uniform(-4.0, -1.0))
    q0 = np.clip(begin.q[0] + size * rng.uniform(-1.0, 1.0, robot.nv), robot.lower, robot.upper)
    v0 = begin.v[0] + size * rng.uniform(-1.0, 1.0, robot.nv)
    truth = pack_model(loaded.model)
    start = float(loaded_storage(inner, truth, q0[None], v0[None], begin.q[:1], begin.v[:1])[0])
    box, given = np.zeros(robot.nv), {}
    if rng.uniform() < DISTURBED:
        limits = robot.effort_limit / (AMPLE if ample else 1.0)
        box = NEAR * rng.uniform() * np.where(np.isfinite(limits), limits, 20.0)
        steps = math.ceil(duration / PERIOD)
        waves = random_disturbances(nbs.Admissible.of(box, robot.nv), steps, PERIOD, 7, rng)
        wave = waves[int(rng.integers(7))]
        given["disturbance"] = lambda t, q, v: wave[min(int(t / PERIOD + 1e-6), steps - 1)]
    none = nbs.JointFriction(np.zeros(robot.nv), np.zeros(robot.nv))
    bound = nbs.transient_bound(law, mass, radius, start, disturbance=box, friction=none, duration=duration)
    run = nbs.simulate(nbs.MujocoPlant(loaded), law.compile(), motion, duration, period, q0=q0, v0=v0, **given)
    cut = bool((run.tau != run.tau_command).any())
    values = loaded_storage(inner, truth, run.q, run.v, run.q_ref, run.v_ref)
    largest = max(float(np.max(values)), _LEAST)
    errors = np.maximum(np.abs(nbs.metrics.error(run)).max(axis=0), _LEAST)
    told = (
        f"{name} ω={inner.inertial_rate:g}, load {load['mass']:.3g} of {mass:.3g} kg within {radius:g} m, start "
        f"{start:.3g} J, disturbance {box.max():.3g} N·m{', ample' * ample}"
    )
    point = load["mass"] == mass and np.linalg.norm(load["com"]) >= 0.99 * radius
    heavy = bool(point and size == 0.0 and not box.any())
    ratios = math.sqrt(bound.storage_within / largest), float((bound.joint_errors / errors).min())
    return Outcome(seed, told, name, cut, *((math.nan, math.nan) if cut else ratios), heavy)


def searched(name: str, runs: int, seed: int) -> bool:
    """`transient_attack` of an arm without and with starts and disturbances; whether every bound is kept."""
    rng, kept = np.random.default_rng(seed), True
    law = law_of(name, False, 8.0, seed)
    robot, radius = law.robot, min(law.load_radius or 0.0, law.load_across or 0.0)
    heavy = robot.with_payload(law.unknowns.bodies[0].name.removeprefix("load at "), LOADS[name])
    motions = [nbs.Sinusoid.for_robot(robot), *(motion_in(rng, heavy, 4.0) for _ in range(6))]
    box = NEAR * np.where(np.isfinite(robot.effort_limit), robot.effort_limit, 20.0)
    none = nbs.JointFriction(np.zeros(robot.nv), np.zeros(robot.nv))
    start = 0.2 * nbs.transient_bound(law, LOADS[name], radius, friction=none).divergence
    for kind, given in (
        ("from the reference", {}),
        ("from a start", {"start": start}),
        ("disturbed", {"disturbance": box, "duration": 1.0}),
    ):
        bound = nbs.transient_bound(law, LOADS[name], radius, friction=none, **given)
        found = nbs.transient_attack(bound, reference=motions, runs=runs, seed=seed, progress=True)
        kept &= found.is_kept
        print(
            f"  {name}, {kind} ({found.runs}, {found.cut} cut): bound ÷ found {found.ratio:.2f} in the tightest joint, "
            f"√V {math.sqrt(bound.storage_within / found.storage):.2f}; {found.verdict}",
            flush=True,
        )
    return kept


def main() -> int:
    """Run the campaign and print what it found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--search", type=int, default=0, help="runs of a search for every arm and kind")
    options = parser.parse_args()
    if options.search:
        return int(not all([searched(name, options.search, options.seed) for name in ARMS]))
    seeds, found = range(options.seed, options.seed + options.count), []
    with joblib.parallel_config(backend="loky", inner_max_num_threads=1):
        parallel = joblib.Parallel(n_jobs=options.workers, return_as="generator_unordered")
        jobs = parallel(joblib.delayed(outcome)(seed) for seed in seeds)
        try:
            for _ in tracked(seeds, "runs"):
                found.append(next(jobs))
        except KeyboardInterrupt:
            print(f"interrupted after {len(found)} of {len(seeds)} runs")
    return report(found)


def report(found: list[Outcome]) -> int:
    """Print the ratios of bounds to what was found, and every broken bound; 1 if there is one."""
    whole = [x for x in found if not x.cut]
    print(f"{len(found)} runs, of which {len(found) - len(whole)} with a torque cut off are left out")
    for arm in ARMS:
        for kind, kept in (("all", whole), ("heaviest load at the edge of its box", [x for x in whole if x.heavy])):
            own = [x for x in kept if x.arm == arm]
            if own:
                v, z = (np.array([getattr(x, name) for x in own]) for name in ("storage", "joint"))
                print(
                    f"  {arm}, {kind} ({len(own)}): √V bound/found least {v.min():.2f}, median {np.median(v):.2f}; "
                    f"|z1_i| least {z.min():.2f}, median {np.median(z):.2f}"
                )
    broken = [x for x in found if x.broken]
    for x in broken:
        again = outcome(x.seed, 0.25 * PERIOD)
        print(
            f"BROKEN, seed {x.seed}: √V {x.storage:.4f}, |z1_i| {x.joint:.4f}, and with a quarter of the period "
            f"{again.storage:.4f} and {again.joint:.4f}, {x.told}"
        )
    print(f"broken bounds: {len(broken)} of {len(whole)}")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
