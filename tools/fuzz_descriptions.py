"""Files of arms broken at random.

    python tools/fuzz_descriptions.py --count 20000                  # URDF and xacro
    python tools/fuzz_descriptions.py --format mjcf --count 5000
    python tools/fuzz_descriptions.py --format mjcf --case 17        # one again, here

Mutants of the arms of the catalogue and of a xacro file, or of those in tests/data/mjcf (bytes, numbers, attributes,
elements, encodings). What `load_robot` accepts must have M(q) ≻ 0 in every pose that a search finds, and MuJoCo must
build the same M, from the same bytes or, for MJCF, from the file itself, with C v + G and friction, to 1e-9 of the
largest entry. Prints the counts and ends with 1 if an error was not the package's own, a process died, hung, took more
than 1 GB, printed something or left a file, or an accepted arm was not sound.
"""

import argparse
import collections
import faulthandler
import os
import random
import re
import shutil
import sys
import tempfile
import warnings
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from fuzz.guarded import guarded, peak
from fuzz.original import deviations, followers, original_model
from rich.progress import track
from scipy.optimize import minimize

from nbs_pin.base.exceptions import NbsPinError
from nbs_pin.robots.catalogue import ROBOT_NAMES, find
from nbs_pin.robots.robot import Robot, load_robot
from nbs_pin.simulation.mujoco_plant import MujocoPlant

MJCF = Path(__file__).parent.parent / "tests" / "data" / "mjcf"
PATIENCE, MEMORY = 30.0, 1 << 20
"""Longest time [s] and largest growth of memory [kB] of one case."""
NASTY = [
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "-0.0",
    "1e-320",
    "1e-30",
    "1e-16",
    "1e-12",
    "1e-6",
    "1e-3",
    "0.5",
    "2",
    "7",
    "100",
    "1e6",
    "1e9",
    "1e16",
    "1e20",
    "1e200",
    "1e308",
    "1e400",
    "1_0",
    "0x10",
    "1,5",
    "٣",
    "''",
    "x",
    "${1/0}",
    "${x}",
    "$(arg",
    "y)",
    "$(find",
    "z)",
    "1.5707963267948966",
]
PIECES = [
    "<link/>",
    "<joint/>",
    "&x;",
    "<!--",
    "]]>",
    "<xacro:if value='1'>",
    "<limit/>",
    "<inertial/>",
    "\x00",
    "é",
    "\ufeff",
]
XACRO = """<?xml version="1.0"?>
<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="mass" default="2.0"/>
  <xacro:property name="length" value="0.4"/>
  <xacro:macro name="arm" params="name parent m:=1.0 *origin">
    <link name="${name}"><inertial><origin xyz="0 0 ${length / 2}"/><mass value="${m}"/>
      <inertia ixx="${m * length ** 2 / 12}" ixy="0" ixz="0" iyy="${m * length ** 2 / 12}" iyz="0" izz="0.001"/>
    </inertial></link>
    <joint name="${name}_joint" type="revolute"><xacro:insert_block name="origin"/>
      <parent link="${parent}"/><child link="${name}"/><axis xyz="0 1 0"/>
      <limit lower="-2" upper="2" effort="50" velocity="3"/><dynamics damping="0.1" friction="0.2"/></joint>
  </xacro:macro>
  <link name="base"/>
  <xacro:arm name="a" parent="base" m="$(arg mass)"><origin xyz="0 0 0.1"/></xacro:arm>
  <xacro:arm name="b" parent="a"><origin xyz="0 0 ${length}" rpy="0 0 ${pi / 2}"/></xacro:arm>
</robot>
"""


class Outcome(NamedTuple):
    """What became of a case."""

    case: int
    told: str


def mutant(seed: int, case: int, texts: list[tuple[str, str]]) -> tuple[str, bytes]:
    """The mutant of a case: the name of its file and its bytes."""
    rng = random.Random(f"{seed} {case}")
    name, text = rng.choice(texts)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        text = mutated(text, rng)
    data = text.encode("utf-8", "replace")
    if rng.random() < 0.1:
        spot = rng.randrange(len(data) + 1)
        data = data[:spot] + rng.randbytes(rng.randrange(4)) + data[spot + rng.randrange(20) :]
    if rng.random() < 0.01:
        data = text.encode(rng.choice(("utf-16", "latin-1", "utf-32")), "replace")
    return name, data


def mutated(text: str, rng: random.Random) -> str:
    """One change of a text."""
    kind = rng.random()
    if kind < 0.55:
        return _number(text, rng)
    if kind < 0.7:
        return _element(text, rng)
    attributes = list(re.finditer(r'\s[\w:]+="[^"]*"', text))
    if kind < 0.85 and attributes:
        found, other = rng.choice(attributes), rng.choice(attributes)
        new = "" if rng.random() < 0.5 else other.group()
        return text[: found.start()] + new + text[found.end() :]
    spot = rng.randrange(len(text) + 1)
    return text[:spot] + rng.choice(PIECES) + text[spot + rng.randrange(30) :]


def _number(text: str, rng: random.Random) -> str:
    spots = list(re.finditer(r'(?<==")[-+\d.e ]+(?=")', text))
    if not spots:
        return text
    spot = rng.choice(spots)
    words = spot.group().split() or [""]
    place = rng.randrange(len(words))
    factor = rng.choice((-1.0, 0.0, 1e-9, 1e-3, 0.1, 0.99, 1.01, 10.0, 1e3, 1e9))
    try:
        words[place] = repr(float(words[place]) * factor) if rng.random() < 0.4 else rng.choice(NASTY)
    except ValueError:
        words[place] = rng.choice(NASTY)
    return text[: spot.start()] + " ".join(words) + text[spot.end() :]


def _element(text: str, rng: random.Random) -> str:
    """An element dropped, doubled or moved."""
    elements = list(re.finditer(r"<(\w+)\b[^<>]*?(/>|>.*?</\1>)", text, re.S))
    if not elements:
        return text
    found, kind = rng.choice(elements), rng.random()
    rest = text[: found.start()] + text[found.end() :]
    if kind < 0.4:
        return rest
    spot = found.start() if kind < 0.7 else rng.randrange(len(rest) + 1)
    return rest[:spot] + found.group() * (2 if kind < 0.7 else 1) + rest[spot:]


def verdict(path: Path) -> str:
    """What became of one file: refused, accepted, or what is wrong."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            robot = load_robot(path)
        except NbsPinError as error:
            return "refused" if "\n" not in str(error) else "BAD refusal of several lines"
        except Exception as error:
            return f"BAD untyped {type(error).__name__}: {error}"[:200]
        found = fault(robot)
        return fault_of_mjcf(path) if found.startswith("accepted") and path.suffix == ".xml" else found


def fault_of_mjcf(path: Path) -> str:
    """Whether the arm is that of MuJoCo; joints that follow another are locked where it does not matter."""
    try:
        model = original_model(path)
    except ValueError as error:
        return f"accepted, refused by MuJoCo ({' '.join(str(error).split())[:60]})"
    held = dict.fromkeys(followers(model), 0.013)
    try:
        robot = load_robot(path, lock=held)
    except NbsPinError:
        return "accepted, refused with its followers locked"
    found = {name: x for name, x in deviations(robot, model, held).items() if not x <= 1e-9}
    return f"BAD differs from MuJoCo: {found}" if found else "accepted"


def fault(robot: Robot) -> str:
    """Why the arm is not sound, or that it is accepted."""
    low, high = robot.one_turn_range
    rng = np.random.default_rng(0)
    data = robot.model.createData()
    poses = rng.uniform(low, high, (12, robot.nv))
    masses = [np.array(pin.crba(robot.model, data, q)) for q in poses]
    if not np.isfinite(masses).all():
        return "BAD M is not finite"
    scale = np.sqrt(np.max([np.diag(mass) for mass in masses], axis=0))

    def least(q: Any) -> float:
        return float(np.linalg.eigvalsh(pin.crba(robot.model, data, np.clip(q, low, high)) / scale / scale[:, None])[0])

    start = min(poses, key=least)
    if robot.nv <= 8:
        start = np.clip(minimize(least, start, method="Nelder-Mead", options={"maxfev": 60 * robot.nv}).x, low, high)
    if not least(start) > 1e-12:
        return f"BAD M is singular at {start.tolist()}"
    try:
        plant = MujocoPlant(robot)
    except NbsPinError as error:
        return f"accepted, refused by MuJoCo ({str(error).partition('(')[2][:60]})"
    plant.model.body_sameframe[:] = 0  # else MuJoCo takes frames that differ by less than 1e-6 for one
    for q, mass in zip(poses, masses, strict=True):
        if np.abs(plant.mass_matrix(q) - mass).max() > 1e-9 * np.abs(mass).max():
            return "BAD M differs from MuJoCo's"
    return "accepted"


def attempt(place: Path, texts: list[tuple[str, str]], seed: int, case: int) -> Outcome:
    """Write the mutant of a case into a copy of the folder of its sample, and read it there."""
    name, data = mutant(seed, case, texts)
    folder, heard = place / f"cwd-{os.getpid()}", place / f"heard-{os.getpid()}"
    if not folder.exists():
        shutil.copytree(MJCF, folder)
        os.chdir(folder)
    before = sorted(folder.rglob("*"))
    path = folder / f"mutant-{name}"
    path.write_bytes(data)
    memory, streams = peak(reset=True), [os.dup(1), os.dup(2)]
    with heard.open("wb") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    faulthandler.dump_traceback_later(0.8 * PATIENCE, file=streams[1])  # says where it hangs before it is killed
    told = verdict(path)
    faulthandler.cancel_dump_traceback_later()
    for stream, kept in zip((1, 2), streams, strict=True):
        os.dup2(kept, stream)
        os.close(kept)
    path.unlink()
    if sorted(folder.rglob("*")) != before:
        told = "BAD it left a file"
    elif heard.stat().st_size and path.suffix == ".xml":
        told = f"BAD it printed {heard.read_bytes()[:80]!r}"
    elif peak() - memory > MEMORY:
        told = "BAD more than 1 GB"
    return Outcome(case, told)


def lost(case: int, kind: str, told: str) -> Outcome:
    """The outcome of a case whose process hung or died."""
    return Outcome(case, f"BAD {kind} {told}".rstrip())


def main() -> int:
    """Run and print; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=20000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--format", choices=("urdf", "mjcf"), default="urdf")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--case", type=int, help="repeat this case alone, here")
    parser.add_argument("--keep", type=Path, help="folder for the bad files")
    options = parser.parse_args()
    if options.format == "urdf":
        texts = [(f"{name}.urdf", find(name).path.read_text()) for name in ROBOT_NAMES] + [("arm.xacro", XACRO)] * 4
    else:
        texts = [
            (path.name, path.read_text()) for path in sorted(MJCF.glob("*.xml")) if "<worldbody>" in path.read_text()
        ]
    counts: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory() as folder:
        one = partial(attempt, Path(folder), texts, options.seed)
        if options.case is not None:
            print(one(options.case).told)
            return 0
        outcomes = guarded(one, options.count, options.workers, PATIENCE, lost)
        for outcome in track(outcomes, "mutants", total=options.count):
            counts[outcome.told] += 1
            if outcome.told.startswith("BAD"):
                print(f"case {outcome.case}: {outcome.told}")
                if options.keep:
                    options.keep.mkdir(parents=True, exist_ok=True)
                    name, data = mutant(options.seed, outcome.case, texts)
                    (options.keep / f"bad-{outcome.case}-{name}").write_bytes(data)
    for text, number in counts.most_common():
        print(f"{number:8d}  {text}")
    return int(any(text.startswith("BAD") for text in counts))


if __name__ == "__main__":
    sys.exit(main())
