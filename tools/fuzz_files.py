"""Damaged files at every reader: seeded mutations, each under guard of time and memory.

    python tools/fuzz_files.py                        # 10,000 files, seed 0, two processes; about five minutes
    python tools/fuzz_files.py --count 500 --seed 3
    python tools/fuzz_files.py --only run.npz --case 17   # one again, here, with its traceback

A mutation changes bytes, numbers in text, or the arrays, settings and weights inside, sealed again. The outcome is
typed (an `NbsPinError`), accepted, untyped (any other exception), non-finite (accepted, but a number read or computed
from it is NaN or inf), memory (more than 1 GB), hang (more than 20 s) or crash (the process died). Any of the last five
is a fault: the exit code is 1 and the cases are listed.
"""

import argparse
import gzip
import io
import json
import os
import random
import sys
import tempfile
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import safetensors.torch
import scipy.io
import torch
from fuzz.guarded import guarded, peak

import nbs_pin as nbs
from nbs_pin.base.archives import read_archive, write_archive
from nbs_pin.base.exceptions import NbsPinError
from nbs_pin.campaigns import journal as journals
from nbs_pin.motions.by_name import motion_of
from nbs_pin.reports.replay import replay
from nbs_pin.robots.meshes import read_mesh
from nbs_pin.storage.checkpoints import FORMAT

PATIENCE, MEMORY = 20.0, 1 << 20
"""Longest time [s] and largest growth of memory [kB] of one case."""
FAULTS = ("untyped", "non-finite", "memory", "hang", "crash")
NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "1e308",
    "-1e308",
    "1e999",
    "1e-320",
    "0",
    "-1",
    "1e20",
    "9" * 400,
    "x",
    "",
    "1_0",
    "٣",
)
TEXTS = ("", "\0", "</script>", "a" * 300, "[" * 5000, "../../etc/passwd", "evil.xacro", "/dev/zero", "{}", "null")


class Outcome(NamedTuple):
    """What became of a mutated file."""

    case: int
    target: str
    kind: str
    told: str


def main() -> int:
    """Try the cases and print how many ended how."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", default="", help="one of " + ", ".join(READERS))
    parser.add_argument("--case", type=int, help="repeat this case alone, here")
    options = parser.parse_args()
    targets = [name for name in READERS if options.only in ("", name)]
    with tempfile.TemporaryDirectory() as folder:
        samples(Path(folder))
        if options.case is not None:
            print(attempt(Path(folder), targets, options.seed, options.case, trace=True))
            return 0
        found = list(attempts(Path(folder), targets, options))
    counts = {name: Counter(outcome.kind for outcome in found if outcome.target == name) for name in targets}
    kinds = ("typed", "accepted", *FAULTS)
    print(f"{'file':16}" + "".join(f"{kind:>12}" for kind in kinds))
    for name, counted in counts.items():
        print(f"{name:16}" + "".join(f"{counted[kind]:12}" for kind in kinds))
    bad = [outcome for outcome in found if outcome.kind in FAULTS]
    for outcome in bad[:40]:
        print(f"case {outcome.case} of {outcome.target}: {outcome.kind}: {outcome.told:.200}")
    print(f"{len(found)} files, {len(bad)} faults, seed {options.seed}")
    return 1 if bad else 0


# Files, and how they are read.


def samples(folder: Path) -> None:
    """One sound file for every reader."""
    robot = nbs.load_robot("two_link")
    t = np.linspace(0.0, 1.0, 40)
    q = np.column_stack([1.0 - np.cos(np.pi * t), 0.5 * np.cos(np.pi * t)])  # from rest to rest
    v, a = np.gradient(q, t, axis=0), np.gradient(np.gradient(q, t, axis=0), t, axis=0)
    zero = np.zeros_like(q)
    run = nbs.Run(
        t=t, q=q, v=v, tau=zero, tau_command=zero, disturbance=zero, q_ref=q, v_ref=v, a_ref=a,
        effort_limit=robot.effort_limit, continuous=robot.continuous, joint_names=robot.joint_names, period=t[1],
        robot=robot.source, robot_sha256=robot.sha256, robot_options=robot.options, info={"seed": 1},
        prismatic=robot.prismatic,
    )  # fmt: skip
    run.save(folder / "run.npz")
    for kind in ("mcap", "csv"):
        nbs.export_run(run, folder / f"exported.{kind}")
    trajectory = np.arange(40) // 20
    about = {"robot": {"source": robot.source, "options": {}}}
    nbs.Dataset(q, v, a, a + q, t, trajectory, robot.parents, robot.prismatic, "two_link", about).save(
        folder / "data.npz"
    )
    np.savez(folder / "log.npz", t=t, q=q, tau=a, v=v, trajectory=trajectory, joint_names=np.array(robot.joint_names))
    np.savez(folder / "motion.npz", t=t, q=q)
    table = np.column_stack([t, q, a])
    np.savetxt(folder / "log.csv", table, delimiter=",", header="t,q1,q2,tau1,tau2", comments="")
    (folder / "log.csv.gz").write_bytes(gzip.compress((folder / "log.csv").read_bytes()))
    scipy.io.savemat(folder / "log.mat", {"log": {"t": t, "q": q, "tau": a, "v": v}, "about": "a log"})
    np.savetxt(folder / "motion.csv", table[:, :3], delimiter=",", header="t,q1,q2", comments="")
    (folder / "campaign.toml").write_text(CAMPAIGN)
    with journals.Journal.opened(folder, {"seed": 1}) as journal:
        for k in range(9):
            journal.add(
                journals.Outcome(str(k), {"error": 0.1 * k} if k % 3 else None, "it diverged." * (k % 3 == 0), 0.1 * k)
            )
    nbs.save(nbs.NeuralBackstepping.for_robot(robot, seed=1), folder / "law.nbs")
    nbs.save(nbs.PID.for_robot(robot), folder / "pid.nbs")
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    points = [" ".join(map(str, corner)) for corner in corners]
    facets = "".join(
        "facet normal 0 0 1\nouter loop\n" + "".join(f"vertex {points[i]}\n" for i in face) + "endloop\nendfacet\n"
        for face in faces
    )
    (folder / "mesh.stl").write_text(f"solid a\n{facets}endsolid a\n")
    triangles = np.array(corners, dtype="<f4")[faces]
    rows = b"".join(bytes(12) + triangle.tobytes() + bytes(2) for triangle in triangles)
    (folder / "binary.stl").write_bytes(bytes(80) + len(faces).to_bytes(4, "little") + rows)
    lines = [f"v {point}" for point in points] + ["g one", "usemtl red"]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in faces]
    (folder / "mesh.obj").write_text("\n".join(lines))
    flat = " ".join(points), " ".join(str(i) for face in faces for i in face)
    (folder / "mesh.dae").write_text(DAE.format(*flat))


CAMPAIGN = """robot = "two_link"
duration = 0.2
samples = 3
[grid]
law = [ "nbs" , "pid" ]
payload = [ 0.0 , 1.0 ]
[random]
bandwidth = { from = 4.0 , to = 8.0 }
[arm]
lock = {}
"""
DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>
<up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh><source id="p"><float_array id="pa"
count="12">{0}</float_array><technique_common><accessor source="#pa" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source><vertices id="v">
<input semantic="POSITION" source="#p"/></vertices><triangles count="4"><input semantic="VERTEX" source="#v"
offset="0"/>
<p>{1}</p></triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s"><node id="n">
<matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def _run(path: Path) -> Iterator[Any]:
    run = nbs.Run.load(path) if path.suffix == ".npz" else nbs.import_run(path, nbs.load_robot("two_link"))
    yield from (run.t, run.q, run.v, run.tau, run.q_ref, run.period)
    replay(run, path.with_name("page.html"))


def _controller(path: Path) -> Iterator[Any]:
    law = nbs.load(path)
    for size in (0.01, 0.3):
        state = [np.full(law.nv, size), np.full(law.nv, -size)]
        reference = nbs.Reference(*(np.zeros(law.nv) for _ in range(3)))
        yield law.step(law.initial_memory(state[0]), *state, reference, 1e-3)[0]


def _reference(path: Path) -> Iterator[Any]:
    motion, _ = motion_of(str(path), nbs.load_robot("two_link"), frequency=1.0, period=0.001)
    yield from motion(np.linspace(-1.0, 2.0, 50))


def _data(read: Callable[[Path], Any]) -> Callable[[Path], Iterator[Any]]:
    def read_all(path: Path) -> Iterator[Any]:
        data = read(path)
        yield from (data.q, data.v, data.a, data.tau, data.t)

    return read_all


def _campaign(path: Path) -> Iterator[Any]:
    for trial in nbs.Campaign.load(path).trials[:20]:
        yield [x for x in trial.values.values() if isinstance(x, int | float)]


def _journal(path: Path) -> Iterator[Any]:
    with journals.Journal.opened(path.parent, {"seed": 1}) as journal:
        yield [outcome.seconds for outcome in journal.outcomes.values()]


def _mesh(path: Path) -> Iterator[Any]:
    yield from (part.vertices for part in read_mesh(path, np.ones(3)))


READERS: dict[str, Callable[[Path], Iterator[Any]]] = {
    "run.npz": _run,
    "exported.mcap": _run,
    "exported.csv": _run,
    "data.npz": _data(nbs.load_dataset),
    "log.npz": _data(nbs.load_log),
    "log.csv": _data(nbs.load_log),
    "log.csv.gz": _data(nbs.load_log),
    "log.mat": _data(nbs.load_log),
    "motion.npz": _reference,
    "motion.csv": _reference,
    "campaign.toml": _campaign,
    "results.jsonl": _journal,
    "law.nbs": _controller,
    "pid.nbs": _controller,
    "mesh.stl": _mesh,
    "binary.stl": _mesh,
    "mesh.obj": _mesh,
    "mesh.dae": _mesh,
}
"""Readers by the sample that they read; each yields numbers that must be finite."""


# Mutations.


def mutated(path: Path, draw: random.Random) -> bytes:
    """The content of a sound file, changed in one to three ways."""
    content = path.read_bytes()
    inside = {".npz": _inside_npz, ".nbs": _inside_archive}.get(path.suffix)
    if inside is not None and draw.random() < 0.6:
        content = inside(path, draw)
    else:
        for _ in range(draw.choice((1, 1, 2, 3))):
            text = path.suffix in (".csv", ".obj", ".dae", ".toml") or path.name == "mesh.stl"
            content = draw.choice((_numbers, _numbers, _bytes) if text else (_bytes,))(content, draw)
    return content


def _bytes(content: bytes, draw: random.Random) -> bytes:
    """Flipped, cut, inserted, doubled or moved bytes."""
    if not content:
        return draw.randbytes(draw.randrange(50))
    begin = draw.randrange(len(content))
    end = min(len(content), begin + draw.choice((1, 1, 4, 30, 400)))
    part = content[begin:end]
    flipped = bytes(byte ^ (1 << draw.randrange(8)) for byte in part)
    new = draw.choice(
        (flipped, b"", part * 2, draw.randbytes(len(part)), part + draw.randbytes(4), b"\xff" * len(part))
    )
    return draw.choice((content[:begin] + new + content[end:],) * 4 + (content[:begin], content[begin:]))


def _numbers(content: bytes, draw: random.Random) -> bytes:
    """A word of the text replaced by a hostile number or text."""
    words = content.decode(errors="replace").replace(",", " , ").split(" ")
    words[draw.randrange(len(words))] = draw.choice((*NUMBERS, *TEXTS))
    return " ".join(words).replace(" , ", ",").encode()


def _hostile(array: np.ndarray, draw: random.Random) -> np.ndarray:
    """An array with one hostile number, or of another shape or type."""
    if array.dtype.kind == "U":
        text = draw.choice((*TEXTS, json.dumps({"a": 1e300}), '{"a": NaN}', '{"gravity": "x"}', '{"lock": [[1]]}'))
        return np.array(text) if array.ndim == 0 else np.array([text] * draw.randrange(4))
    changed = array.astype(draw.choice((array.dtype, np.float32, ">f8", np.int64, np.complex128, bool, "U8")))
    if draw.random() < 0.3:
        shapes = ((), (0,), (1,), (3, 3), (0, 2), (2, 0), (*array.shape, 1), array.shape[::-1])
        return np.resize(changed, draw.choice(shapes))
    if changed.size and changed.dtype.kind in "fc":
        spoilt = np.array(changed)
        value = draw.choice((np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 1e20, 0.0, -1.0))
        with np.errstate(over="ignore"):
            spoilt.reshape(-1)[draw.randrange(spoilt.size) :: draw.choice((1, 3, 10**6))] = value
        return spoilt
    return changed


def _inside_npz(path: Path, draw: random.Random) -> bytes:
    with np.load(path) as stored:
        arrays = dict(stored)
    name = draw.choice(sorted(arrays))
    change = draw.randrange(6)
    if change == 0:
        arrays.pop(name)
    elif change == 1:
        arrays[draw.choice(TEXTS[2:6])] = arrays[name]
    else:
        arrays[name] = _hostile(arrays[name], draw)
    buffer = io.BytesIO()
    draw.choice((np.savez, np.savez_compressed))(buffer, **arrays)
    if change == 1:  # two entries of one name
        with warnings.catch_warnings(), zipfile.ZipFile(buffer, "a") as archive:
            warnings.simplefilter("ignore")
            archive.writestr(f"{name}.npy", draw.randbytes(200))
    return buffer.getvalue()


def _inside_archive(path: Path, draw: random.Random) -> bytes:
    """Settings or weights changed and the archive sealed again."""
    entries = dict(read_archive(path, FORMAT))
    if draw.random() < 0.5:
        tensors = safetensors.torch.load(entries["controller.safetensors"])
        name = draw.choice(sorted(tensors))
        spoilt = _hostile(tensors[name].numpy(), draw)
        if spoilt.dtype.kind in "fib" and spoilt.dtype.isnative:
            tensors[name] = torch.from_numpy(np.ascontiguousarray(spoilt))
        entries["controller.safetensors"] = safetensors.torch.save(tensors)
    else:
        document = json.loads(entries["controller.json"])
        place: Any = document
        while isinstance(place, dict | list) and place:
            key = draw.choice(sorted(place)) if isinstance(place, dict) else draw.randrange(len(place))
            if not isinstance(place[key], dict | list) or not place[key] or draw.random() < 0.15:
                place[key] = draw.choice((None, -1, 0, 1e308, 1e-300, 10**9, True, [], {}, "x", [1e20], *TEXTS))
                break
            place = place[key]
        entries["controller.json"] = json.dumps(document).encode()
    target = path.with_name(f"sealed-{os.getpid()}")
    write_archive(target, FORMAT, entries)
    return target.read_bytes()


# Attempts.


def attempt(folder: Path, targets: list[str], seed: int, case: int, *, trace: bool = False) -> Outcome:
    """Mutate the sample of a case and read it."""
    draw = random.Random(f"{seed} {case}")
    name = targets[case % len(targets)]
    sample = folder / name
    with tempfile.TemporaryDirectory(dir=folder) as place:
        path = Path(place) / name
        path.write_bytes(mutated(sample, draw))
        before = peak(reset=True)
        try:
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                finite = all(np.isfinite(np.asarray(numbers)).all() for numbers in READERS[name](path))
            kind, told = ("accepted", "") if finite else ("non-finite", "a number is not finite")
        except NbsPinError as error:
            kind, told = "typed", str(error)
        except Exception as error:
            kind, told = "untyped", f"{type(error).__name__}: {error}"
            if trace:
                traceback.print_exc()
    if peak() - before > MEMORY:
        kind, told = "memory", f"{(peak() - before) // 1024} MB"
    return Outcome(case, name, kind, told)


def attempts(folder: Path, targets: list[str], options: argparse.Namespace) -> Iterator[Outcome]:
    """The outcomes of all cases."""

    def lost(case: int, kind: str, told: str) -> Outcome:
        return Outcome(case, targets[case % len(targets)], kind, told)

    attempt_one = partial(attempt, folder, targets, options.seed)
    return guarded(attempt_one, options.count, options.workers, PATIENCE, lost)


if __name__ == "__main__":
    sys.exit(main())
