"""What the adaptive law keeps of its promises, with one set of default settings for all arms.

    python tools/adaptive_campaign.py                        # every row on four arms; half an hour
    python tools/adaptive_campaign.py --rows ab --arms panda fr3_like
    python tools/adaptive_campaign.py --rows d --arms panda --minutes 60

Arms are in MuJoCo at 1 kHz with their effort limits. `fr3_like` is a panda whose plant has the rotors and the dry
friction of a real one, of which the law knows nothing. The rows:

    a  2 kg at the tool from 5 s on, a sinusoid: errors, and what the law believes after an excited minute
    b  the same on motions that no setting was chosen on
    c  no load: the price of adaptation
    d  ±5 N·m on every joint as a square wave, a sine and random switching: drift and wind-up
    e  encoders of 16 bits, and differences of their readings as velocities
    f  random updates of any size: no estimate may leave its set
    g  time of a compiled step, as a multiple of the fixed law's
    h  a constant 5 N·m on every joint with adapts=["offsets"]: integral action

The table and a json file are written after every row of an arm, so that an interrupted campaign keeps what it has. The
exit code is 1 if a figure misses what is asked.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from adaptive_updates import Updates, updates
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

import nbs_pin as nbs
from nbs_pin.identification.measurement import quantised
from nbs_pin.robots.places import tool_frame

ARMS = ("panda", "ur5", "xarm7", "fr3_like")
PERIOD, LOAD, PICKED = 0.001, 2.0, 5.0
"""Control period [s], mass of the load [kg] and when it is picked up [s]."""
PUSH = 5.0
"""Size of the disturbances of rows d and h [N·m]."""
ROTORS = [0.195] * 4 + [0.074] * 3  # [kg·m²]
COULOMB = [1.14, 1.0, 0.9, 0.8, 0.5, 0.4, 0.25]  # [N·m]
LAWS = {"NeuralBackstepping": nbs.NeuralBackstepping, "SlotineLi": nbs.SlotineLi, "SlidingMode": nbs.SlidingMode}


class Finding(NamedTuple):
    """One figure, and the largest that is asked for, if any."""

    row: str
    arm: str
    what: str
    value: float
    unit: str
    asked: float | None = None

    @property
    def misses(self) -> bool:
        """Whether it is larger than asked, or no number."""
        return self.asked is not None and not self.value <= self.asked


class Options(NamedTuple):
    """Sizes of the campaign."""

    motions: int = 6
    minutes: float = 10.0
    updates: int = 10_000_000
    seconds: float = 20.0
    longest: float = 60.0
    """How long row h waits for an error to vanish [s]."""


class Arm(NamedTuple):
    """What the laws believe, and the arm that they act on."""

    name: str
    belief: nbs.Robot
    truth: nbs.Robot
    bare: nbs.Plant
    loaded: nbs.Plant

    @property
    def picks_up(self) -> nbs.Plant:
        """The arm that takes the load at `PICKED`."""
        return nbs.ChangingPlant(self.bare, [(PICKED, self.loaded)])


@cache
def arm(name: str) -> Arm:
    """The arm of that name."""
    belief = nbs.load_robot("panda" if name == "fr3_like" else name)
    truth = belief
    if name == "fr3_like":
        truth = belief.with_armature(ROTORS).with_friction(coulomb=COULOMB)
    heavy, keep = truth.with_payload(tool_frame(belief), LOAD), "keep" if name == "fr3_like" else "drop"
    return Arm(name, belief, truth, *(nbs.MujocoPlant(x, joint_friction=keep) for x in (truth, heavy)))


@cache
def laws(name: str) -> tuple[nbs.Controller, nbs.AdaptiveLaw]:
    """The fixed law and the adaptive one around it, with default settings."""
    return nbs.NeuralBackstepping.for_robot(arm(name).belief), nbs.AdaptiveLaw.for_robot(arm(name).belief)


def held_out(robot: nbs.Robot, seed: int) -> nbs.Sinusoid:
    """A random motion."""
    rng = np.random.default_rng(seed)
    return nbs.Sinusoid.for_robot(robot, amplitude=rng.uniform(0.2, 0.5), frequency=rng.uniform(0.5, 1.6))


def excited(robot: nbs.Robot) -> nbs.Sinusoid:
    """A motion whose joints have frequencies of their own, so that their accelerations are not alike."""
    like = nbs.Sinusoid.for_robot(robot, frequency=2.5, amplitude=0.4)
    return nbs.Sinusoid(like.amplitude, np.linspace(1.0, 2.5, robot.nv), like.phase, like.offset)


def errors(run: nbs.Run) -> tuple[float, float]:
    """Worst RMS error of a joint in the last quarter, and worst error in the last half [mrad]."""
    end = float(run.t[-1])
    late = nbs.metrics.error(run)[run.t >= 0.5 * end]
    return 1e3 * float(nbs.metrics.rms_error(run, 0.75 * end).max()), 1e3 * float(np.abs(late).max())


def simulated(plant: nbs.Plant, law: nbs.Controller, motion: Any, seconds: float, **settings: Any) -> nbs.Run:
    """The run; checks of the reference would refuse a law that believes another arm."""
    return nbs.simulate(plant, law, motion, seconds, PERIOD, check=False, **settings)


def load(name: str, options: Options) -> Iterator[Finding]:
    """Row a."""
    one, (fixed, law) = arm(name), laws(name)
    motion = nbs.Sinusoid.for_robot(one.belief)
    rms, peak = errors(simulated(one.picks_up, law, motion, options.seconds))
    old, old_peak = errors(simulated(one.picks_up, fixed, motion, options.seconds))
    yield Finding("a", name, "RMS error, last quarter", rms, "mrad", 1.0)
    yield Finding("a", name, "  of the fixed law", old, "mrad")
    yield Finding("a", name, "largest error, last half", peak, "mrad", 3.0)
    yield Finding("a", name, "  of the fixed law", old_peak, "mrad")
    run = simulated(one.picks_up, law, excited(one.belief), PICKED + 3.0 * options.seconds)
    belief = law.estimate(run.estimates[-1])
    yield Finding("a", name, "mass, error after a minute", 100 * abs(float(belief.load_mass) / LOAD - 1.0), "%", 5.0)
    yield Finding(
        "a", name, "centre, error after a minute", 1e3 * float(np.linalg.norm(belief.load_centre)), "mm", 10.0
    )


def motions(name: str, options: Options) -> Iterator[Finding]:
    """Row b."""
    one, (fixed, law) = arm(name), laws(name)
    for seed in range(options.motions):
        motion = held_out(one.belief, seed)
        rms, peak = errors(simulated(one.picks_up, law, motion, options.seconds))
        old, _ = errors(simulated(one.picks_up, fixed, motion, options.seconds))
        yield Finding("b", name, f"motion {seed}: RMS error, last quarter", rms, "mrad", 1.0)
        yield Finding("b", name, "  of the fixed law", old, "mrad")
        yield Finding("b", name, f"motion {seed}: largest error, last half", peak, "mrad", 3.0)


def no_load(name: str, options: Options) -> Iterator[Finding]:
    """Row c."""
    one, (fixed, law) = arm(name), laws(name)
    all_motions = [nbs.Sinusoid.for_robot(one.belief), *(held_out(one.belief, seed) for seed in range(options.motions))]
    for k, motion in enumerate(all_motions):
        rms, old = (errors(simulated(one.bare, x, motion, options.seconds))[0] for x in (law, fixed))
        what = "usual motion" if k == 0 else f"motion {k - 1}"
        yield Finding("c", name, f"{what}: RMS error, of the fixed law's", rms / old, "×", 1.1)
        yield Finding("c", name, "  RMS error", rms, "mrad")


def pushes(n: int, seed: int = 0) -> Callable[[float, np.ndarray, np.ndarray], np.ndarray]:
    """Three disturbances, one for every row of a batch: a square wave, a sine, and signs that change at random."""
    frequency = np.linspace(0.5, 2.5, n)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (10_007, n))

    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        sine = np.sin(frequency * t)
        return PUSH * np.stack([np.where(sine >= 0.0, 1.0, -1.0), sine, signs[int(t / 0.2 + 1e-9) % len(signs)]])

    return torque


def hour(name: str, options: Options) -> Iterator[Finding]:
    """Row d: errors minute by minute, and how near to their bounds the estimates come."""
    one, (fixed, law) = arm(name), laws(name)
    motion, n = nbs.Sinusoid.for_robot(one.belief), one.belief.nv
    start = [np.tile(x, (3, 1)) for x in motion(0.0)[:2]]
    settings = {"q0": start[0], "v0": start[1], "disturbance": pushes(n), "check": False, "block": 10_000}
    squares: list[np.ndarray] = []
    cut, size = np.zeros(3), np.zeros(3)
    for run in nbs.stream(one.bare, law, motion, 60.0 * options.minutes, PERIOD, **settings):
        squares.append(np.square(nbs.metrics.error(run)[:-1]).mean(axis=0))
        cut += np.any(np.abs(run.tau_command[:-1]) > run.effort_limit, axis=-1).mean(axis=0)
        size = np.maximum(size, np.abs(run.estimates[..., 10:]).max(axis=(0, -1)))
        mass = run.estimates[-1, :, 0]
    old = simulated(one.bare, fixed, motion, 120.0, q0=start[0], v0=start[1], disturbance=pushes(n))
    of_fixed = np.sqrt(np.square(nbs.metrics.error(old)[20_000:]).mean(axis=0)).max(axis=-1)
    blocks = np.array(squares)
    quarter = max(1, len(blocks) // 4)
    early, late = (np.sqrt(x.mean(axis=0)).max(axis=-1) for x in (blocks[quarter : 2 * quarter], blocks[-quarter:]))
    for k, what in enumerate(("square wave", "sine", "random switching")):
        ratio = late[k] / of_fixed[k]
        yield Finding("d", name, f"{what}, {options.minutes:g} min: error, of the fixed law's", ratio, "×", 1.1)
        yield Finding("d", name, "  RMS error, last quarter", 1e3 * late[k], "mrad")
        yield Finding("d", name, "  drift: last quarter, of the second quarter's", late[k] / early[k], "×", 1.1)
        yield Finding("d", name, "  largest friction or rotor believed", size[k], "N·m")
        yield Finding("d", name, "  mass believed at the end", float(mass[k]), "kg")
        yield Finding("d", name, "  share of instants with a torque cut off", 100.0 * cut[k] / len(blocks), "%")


def with_encoders(one: Arm, law: nbs.Controller, seconds: float, bits: int = 16) -> np.ndarray:
    """z1 of a loop that sees rounded positions, and their differences as velocities (rows, n) [rad]."""
    law, plant = law.compile(), one.picks_up
    h, lead, step, slides = PERIOD, 0.5 * PERIOD, 2.0**-bits, one.belief.prismatic
    t = h * np.arange(round(seconds / h) + 1)
    motion = nbs.Sinusoid.for_robot(one.belief)
    aim, ahead = motion(t), motion(t + lead)
    q, v = aim.q[0], aim.v[0]
    last, memory = quantised(q - h * v, step, slides), law.initial_memory(q)
    found = np.empty(aim.q.shape)
    for k in range(len(t)):
        found[k] = q - aim.q[k]
        reading = quantised(q, step, slides)
        speed, dv = (reading - last) / h, lead * aim.a[k]
        seen, last = reading + lead * (speed + 0.5 * dv), reading
        target = nbs.Reference(ahead.q[k], ahead.v[k], ahead.a[k])
        tau, memory = law.step(memory, seen, speed + dv, target, h)
        tau = np.clip(tau, -one.belief.effort_limit, one.belief.effort_limit)
        q, v = plant.at(float(t[k])).step(q, v, tau, h)
    return found


def encoders(name: str, options: Options) -> Iterator[Finding]:
    """Row e."""
    fixed, own = laws(name)
    for what, law, asked in ("RMS error, last quarter", own, 3.0), ("  of the fixed law", fixed, None):
        found = with_encoders(arm(name), law, options.seconds)
        rms = np.sqrt(np.square(found[len(found) * 3 // 4 :]).mean(axis=0)).max()
        yield Finding("e", name, what, 1e3 * float(rms), "mrad", asked)


def any_update(name: str, options: Options) -> Iterator[Finding]:
    """Row f: a share of the updates for every arm, a fifth of them with all bodies and numbers unknown."""
    count = options.updates // len(ARMS)
    inner = nbs.NeuralBackstepping.for_robot(arm(name).belief)
    every = nbs.AdaptiveLaw(inner, ["load", "links", "friction", "rotors", "offsets"])
    for what, law, share in ("default", laws(name)[1], 0.8), ("all", every, 0.2):
        found: Updates = updates(law, round(share * count), seed=1)
        yield Finding("f", name, f"{what}: bodies that cannot exist, of {found.count} updates", found.outside, "", 0.0)
        yield Finding("f", name, "  numbers beyond their bounds", found.beyond, "", 0.0)
        yield Finding("f", name, "  updates that are not finite", found.not_finite, "", 0.0)
        yield Finding("f", name, "  least eigenvalue below zero, of the trace", found.depth, "")


def step_time(name: str, options: Options) -> Iterator[Finding]:
    """Row g: laws in turn at every instant, so that what else the machine does slows all alike."""
    fixed, law = laws(name)
    inner = nbs.NeuralBackstepping.for_robot(arm(name).belief)
    others = {"load": nbs.AdaptiveLaw(inner), "default": law, "all links": nbs.AdaptiveLaw(inner, ["links"])}
    compiled = [x.compile() for x in (fixed, *others.values())]
    motion = nbs.Sinusoid.for_robot(arm(name).belief)(PERIOD * np.arange(3000))
    memories = [x.initial_memory(motion.q[0]) for x in compiled]
    taken = np.empty((3000, len(compiled)))
    for k in range(3000):
        target = nbs.Reference(motion.q[k], motion.v[k], motion.a[k])
        for i, x in enumerate(compiled):
            begin = time.perf_counter()
            _, memories[i] = x.step(memories[i], motion.q[k], motion.v[k], target, PERIOD)
            taken[k, i] = time.perf_counter() - begin
    medians = np.median(taken, axis=0)
    yield Finding("g", name, "a step of the fixed law", 1e6 * medians[0], "µs")
    for what, value, asked in zip(others, medians[1:] / medians[0], (2.0, None, 4.0), strict=True):
        yield Finding("g", name, f"a step, {what}", value, "×", asked)


def integral_action(name: str, options: Options) -> Iterator[Finding]:
    """Row h; friction, which holds an arm where it stands, is no matter of constant torques."""
    one, push = arm(name), nbs.ConstantTorque(PUSH)
    motion = nbs.Sinusoid.for_robot(one.belief)
    for kind, make in LAWS.items():
        law = nbs.AdaptiveLaw(make.for_robot(one.belief), ["offsets"])
        last, error = 0.0, np.inf
        longest = options.seconds if name == "fr3_like" else options.longest  # dry friction keeps an error of its own
        for run in nbs.stream(one.bare, law, nbs.Hold(motion.offset), longest, PERIOD, disturbance=push, check=False):
            size = np.abs(nbs.metrics.error(run)).max(axis=-1)
            over, error = np.flatnonzero(size > 1e-6), float(size[-1])
            last = float(run.t[over[-1]]) if len(over) else last
            if run.t[-1] > last + 3.0:
                break
        asked = None if name == "fr3_like" else 1e-3
        yield Finding("h", name, f"{kind}: error on Hold, at the end", 1e3 * error, "mrad", asked)
        yield Finding("h", name, "  until it stays below 1e-6 rad", last, "s")
        rms = [errors(simulated(one.bare, x, motion, options.seconds, disturbance=push))[0] for x in (law, law.law)]
        yield Finding("h", name, "  RMS error on the sinusoid, last quarter", rms[0], "mrad")
        yield Finding("h", name, "    of the fixed law", rms[1], "mrad")


ROWS = {
    "a": load, "b": motions, "c": no_load, "d": hour,
    "e": encoders, "f": any_update, "g": step_time, "h": integral_action,
}  # fmt: skip


def table(found: list[Finding]) -> Table:
    """All figures."""
    drawn = Table("row", "arm", "figure", "value", "asked", box=None)
    for x in found:
        asked = "" if x.asked is None else f"≤ {x.asked:g}"
        style = "red" if x.misses else None
        drawn.add_row(x.row, x.arm, x.what, f"{x.value:.3g} {x.unit}", asked, style=style)
    return drawn


def write(found: list[Finding], options: Options, path: Path) -> None:
    """The json file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [x._asdict() | {"value": float(x.value), "misses": x.misses} for x in found]
    path.write_text(json.dumps({"version": nbs.__version__, "options": options._asdict(), "figures": rows}, indent=1))


def main() -> int:
    """Measure what is asked for; returns 1 if a figure misses."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default="".join(ROWS), help="letters of the rows")
    parser.add_argument("--arms", nargs="+", default=ARMS, help="fr3_like, or arms that load_robot knows")
    parser.add_argument("--motions", type=int, default=6, help="held-out motions of rows b and c")
    parser.add_argument("--minutes", type=float, default=10.0, help="simulated time of row d")
    parser.add_argument("--updates", type=int, default=10_000_000, help="random updates of row f, over all arms")
    parser.add_argument("--seconds", type=float, default=20.0, help="simulated time of rows a, b, c, e and h")
    parser.add_argument("--out", type=Path, default=Path("out/adaptive-campaign.json"))
    given = parser.parse_args()
    options = Options(given.motions, given.minutes, given.updates, given.seconds)
    console, found = Console(), []
    tasks = [(row, name) for row in given.rows for name in given.arms]
    with Progress(console=console) as progress:
        bar = progress.add_task("measuring", total=len(tasks))
        try:
            for row, name in tasks:
                progress.update(bar, description=f"row {row}, {name}")
                for finding in ROWS[row](name, options):
                    found.append(finding)
                    write(found, options, given.out)
                progress.advance(bar)
        except KeyboardInterrupt:
            console.print(f"interrupted; {len(found)} figures of the rows so far:")
    console.print(table(found))
    missed = sum(x.misses for x in found)
    console.print(f"{missed} of {sum(x.asked is not None for x in found)} figures miss; all are in {given.out}")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
