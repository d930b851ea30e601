"""How many small faults the tests find: seeded mutants of laws, kernels, bounds, checks and units, one by one.

    python tools/mutants.py                 # 60 mutants, seed 0, two at a time
    python tools/mutants.py --count 20 --seed 3 --show

Each mutant is one edit of one expression: a sign flipped, a term dropped, arguments swapped, a bound or an index moved.
The tests named for its file run in a copy of the tree until one fails. A mutant that survives is in `EQUIVALENT`, with
the reason why no test can tell it from the original, or it is a gap in the tests; with any gap the exit code is 1.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
TESTS: dict[str, str] = {
    "controllers/neural_backstepping": "controllers closed_loops lyapunov_laws theory old_files",
    "controllers/slotine_li": "controllers closed_loops lyapunov_laws compiled",
    "controllers/sliding_mode": "controllers closed_loops lyapunov_laws",
    "controllers/computed_torque": "controllers closed_loops compiled",
    "controllers/pd": "controllers closed_loops compiled",
    "controllers/pid": "controllers closed_loops compiled gains_training",
    "controllers/gains": "controllers closed_loops gains_training figures design told_numbers",
    "controllers/gain": "gains_training",
    "controllers/potential": "networks compiled lyapunov_laws certificates",
    "controllers/damping": "networks compiled lyapunov_laws certificates",
    "controllers/convex": "networks",
    "controllers/activations": "networks certificates",
    "controllers/lyapunov_law": "lyapunov_laws controllers monitor",
    "controllers/part_claims": "structure_checks certificates lyapunov_laws",
    "controllers/falsification": "structure_checks",
    "kernels/laws": "kernels compiled",
    "kernels/law_adjoints": "kernels adjoints",
    "kernels/convex": "kernels compiled",
    "kernels/convex_adjoint": "kernels adjoints",
    "kernels/damping": "kernels compiled adjoints",
    "kernels/trees": "trees",
    "kernels/tree_bodies": "trees",
    "kernels/tree_layout": "trees",
    "kernels/spatial": "trees",
    "kernels/rollouts": "kernels training",
    "kernels/cholesky": "lagrangian",
    "kernels/tree_parameters": "chain",
    "dynamics/pinocchio": "dynamics closed_loops",
    "dynamics/analytic": "dynamics structure_checks",
    "dynamics/friction": "plants controllers",
    "dynamics/structure": "structure_checks inertia_bounds",
    "dynamics/rigid_tree": "inertia_bounds structure_checks",
    "inertia/bounds": "inertia_bounds",
    "inertia/lever_arms": "inertia_bounds",
    "inertia/pose_grid": "inertia_bounds",
    "inertia/multipliers": "inertia_bounds",
    "certificates/comparison_system": "certificates told_numbers",
    "certificates/one_joint": "certificates lyapunov_laws",
    "certificates/error_bounds": "certificates lyapunov_laws told_numbers",
    "certificates/constants": "certificates lyapunov_laws",
    "certificates/margins": "told_numbers structure_checks certificates",
    "certificates/loads": "loads",
    "certificates/model_error": "certificates structure_checks",
    "certificates/energy_balance": "monitor",
    "certificates/period_watch": "monitor",
    "certificates/window_watch": "encoders",
    "certificates/encoders": "encoders",
    "certificates/loop_model": "encoders monitor",
    "kernels/watching": "encoders",
    "kernels/verdicts": "encoders monitor",
    "kernels/periods": "monitor encoders",
    "base/rounding": "inertia_bounds structure_checks told_numbers",
    "base/intervals": "certificates",
    "base/checks": "references plants told_numbers",
    "base/csv_files": "references datasets",
    "robots/urdf_checks": "urdf urdf_mutations",
    "robots/robot": "robot controllers",
    "motions/references": "references",
    "motions/disturbances": "simulation plants disturbances",
    "simulation/loop": "simulation told_numbers",
    "simulation/simulate": "simulation",
    "simulation/metrics": "metrics",
    "accuracy/mismatch": "model_error",
    "accuracy/relative_errors": "model_error",
}
"""Source files that are mutated, and the tests that answer for each."""
INTERPRETED = ("kernels/laws", "kernels/law_adjoints", "kernels/convex", "kernels/damping")
"""Files whose mutants are tested as plain Python, which starts sooner than a minute of compilation."""
SWAPS = {"minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min", "floor": "ceil", "ceil": "floor",
         "any": "all", "all": "any", "lower": "upper", "upper": "lower"}  # fmt: skip
OPERATORS = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}
COMPARISONS = {ast.Lt: ">", ast.Gt: "<", ast.LtE: ">", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "=="}
EQUIVALENT: dict[tuple[str, str], str] = {
    (
        "accuracy/mismatch",
        "return a, b, c + max(0.0, float((size - bound).max())) + 8.0 * np.finfo(float).eps * float(bound.max())",
    ): "an allowance for rounding, twice as wide, is one too",
    ("certificates/one_joint", "spread = math.sqrt(max(0.0, -square))"): "max has no order",
    ("controllers/part_claims", "below[np.tril_indices(n, -1)] = np.maximum(high, -low)"): "max has no order",
    ("inertia/bounds", "return down(float(np.exp(max(scaled, plain))))"): "max has no order",
    (
        "controllers/sliding_mode",
        "ratio = xp.where(small, 1.0 + 0.0 * x, xp.tanh(x) / xp.where(small, (1.0) - (0.0 * x), x))",
    ): "1 − 0·x is 1 + 0·x",
    (
        "inertia/pose_grid",
        "length = np.linalg.norm(tree.position, axis=1).sum() + (np.linalg.norm(tree.centre, axis=1)).min()",
    ): "sizes an allowance for rounding, which is far wider than rounding with either",
    ("accuracy/mismatch", "chosen = np.union1d(worst, chosen)"): "a union has no order",
    (
        "certificates/constants",
        "return np.asarray(np.diag((1.0 + 8.0 * np.finfo(float).eps) / diagonal))",
    ): "an allowance for rounding, twice as wide, is one too",
    (
        "controllers/part_claims",
        "size, slope, _ = phi.terms((zero) - (1.0), zero)",
    ): "any state other than 0 gives the size of Φ that rounding at 0 is measured by",
    (
        "motions/disturbances",
        "interval = (math).ceil(t / self.period + 1e-9)  # t = k·period may be rounded into the interval before",
    ): "numbers the intervals from one; the random numbers of each are as good",
}
"""(file, mutated line) of mutants that no test can find, and why."""


class Mutant(NamedTuple):
    """One edit of one file."""

    name: str
    start: int
    end: int
    text: str
    """What takes the place of the characters from start to end."""
    kind: str

    def applied(self, source: str) -> str:
        """The mutated source."""
        return source[: self.start] + self.text + source[self.end :]

    def line(self, source: str) -> str:
        """The mutated line."""
        mutated = self.applied(source)
        first = mutated.rfind("\n", 0, self.start) + 1
        return mutated[first : mutated.find("\n", self.start + len(self.text))].strip()


def mutants_of(name: str) -> list[Mutant]:
    """Every mutant of a file."""
    source = (ROOT / "nbs_pin" / f"{name}.py").read_text()
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))

    def place(line: int, column: int) -> int:
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    def span(node: ast.expr) -> tuple[int, int]:
        return place(node.lineno, node.col_offset), place(node.end_lineno or 0, node.end_col_offset or 0)

    def text(node: ast.expr) -> str:
        first, last = span(node)
        return source[first:last]

    found = []
    for node in _expressions(ast.parse(source)):
        found += [Mutant(name, *span(node), new, kind) for kind, new in _edits(node, text)]
    return [m for m in found if m.applied(source) != source and _parses(m.applied(source))]


def _edits(node: ast.expr, read: Callable[[ast.expr], str]) -> Iterator[tuple[str, str]]:
    """The kinds of edit of an expression and what it becomes; read: the source of a node."""
    match node:
        case ast.BinOp(left, op, right) if type(op) in OPERATORS:
            kind = "sign" if isinstance(op, ast.Add | ast.Sub) else "product"
            yield kind, f"({read(left)}) {OPERATORS[type(op)]} ({read(right)})"
            if kind == "sign":
                yield "dropped term", read(left)
        case ast.UnaryOp(ast.USub(), operand) if not isinstance(operand, ast.Constant):
            yield "sign", f"({read(operand)})"
        case ast.Compare(left, [op], [right]) if type(op) in COMPARISONS:
            yield "comparison", f"({read(left)}) {COMPARISONS[type(op)]} ({read(right)})"
        case ast.Call(func, [first, second, *rest], keywords) if not isinstance(first, ast.Starred):
            words = [
                *map(read, rest),
                *(f"{k.arg}={read(k.value)}" if k.arg else f"**{read(k.value)}" for k in keywords),
            ]
            yield "swapped arguments", f"{read(func)}({', '.join([read(second), read(first), *words])})"
        case ast.Attribute(value, attr) if attr in SWAPS:
            yield "swapped name", f"({read(value)}).{SWAPS[attr]}"
        case ast.Name(name) if name in SWAPS:
            yield "swapped name", SWAPS[name]
        case ast.Constant(float(value)) if value not in (0.0, 1.0) and 1e-3 <= value <= 1e3:
            yield "factor", repr(2.0 * value)
        case ast.Subscript(value, ast.Constant(int(index))) if type(index) is int:
            yield "index", f"{read(value)}[{index + 1}]"


def _expressions(tree: ast.AST) -> Iterator[ast.expr]:
    """Expressions inside functions: no annotations, no constants of the module, no decorators."""
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                for node in ast.walk(statement):
                    if isinstance(node, ast.expr) and not isinstance(statement, ast.FunctionDef):
                        yield node


def _parses(source: str) -> bool:
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True


def chosen(count: int, seed: int) -> list[Mutant]:
    """So many mutants: a file at random, a kind of edit that it offers, and one of that kind."""
    rng = random.Random(seed)
    picked: dict[tuple[str, int, int, str], Mutant] = {}
    names = sorted(TESTS)
    while len(picked) < count:
        name = names[len(picked) % len(names)] if len(picked) < len(names) else rng.choice(names)
        offered = mutants_of(name)
        kind = rng.choice(sorted({mutant.kind for mutant in offered}))
        mutant = rng.choice([m for m in offered if m.kind == kind])
        picked[mutant[:4]] = mutant
    return list(picked.values())


def verdict(mutant: Mutant, folder: Path, timeout: float) -> str:
    """What becomes of it: "killed", "survived" or "timeout", in a copy of the tree at the folder."""
    path = folder / "nbs_pin" / f"{mutant.name}.py"
    original = path.read_text()
    path.write_text(mutant.applied(original))
    tests = [f"tests/test_{test}.py" for test in TESTS[mutant.name].split()]
    tests = [test for test in tests if (folder / test).is_file()]
    environment = os.environ | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    if mutant.name in INTERPRETED:
        environment["NUMBA_DISABLE_JIT"] = "1"
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=timeout, check=False)
        return "survived" if done.returncode == 0 else "killed"
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        path.write_text(original)


def main() -> int:
    """Runs the mutants and says what became of each."""
    parser = argparse.ArgumentParser(description="How many seeded faults the tests find.")
    parser.add_argument("--count", type=int, default=60, help="how many mutants")
    parser.add_argument("--seed", type=int, default=0, help="which mutants")
    parser.add_argument("--timeout", type=float, default=600.0, help="of the tests of one mutant [s]")
    parser.add_argument("--only", default="", help="only files whose name contains this")
    parser.add_argument("--show", action="store_true", help="list the mutants, run nothing")
    given = parser.parse_args()
    mutants = [m for m in chosen(given.count, given.seed) if given.only in m.name]
    sources = {m.name: (ROOT / "nbs_pin" / f"{m.name}.py").read_text() for m in mutants}
    if given.show:
        for m in mutants:
            print(f"{m.name:32} {m.kind:18} {m.line(sources[m.name])}")
        return 0
    with tempfile.TemporaryDirectory() as scratch:
        folders = [Path(scratch) / str(k) for k in range(2)]
        for folder in folders:
            for part in ("nbs_pin", "tests", "urdf", "docs", "demos"):
                shutil.copytree(ROOT / part, folder / part)
            for file in ("pyproject.toml", "README.md", "CHANGELOG.md"):
                shutil.copy(ROOT / file, folder / file)

        def tried(k: int) -> list[tuple[Mutant, str]]:
            found = []
            for mutant in mutants[k :: len(folders)]:
                found.append((mutant, verdict(mutant, folders[k], given.timeout)))
                print(
                    f"{found[-1][1]:9} {mutant.name:32} {mutant.kind:18} {mutant.line(sources[mutant.name])}",
                    flush=True,
                )
            return found

        with ThreadPoolExecutor(len(folders)) as pool:
            results = [result for part in pool.map(tried, range(len(folders))) for result in part]
    survivors = [m for m, became in results if became == "survived"]
    gaps = [m for m in survivors if (m.name, m.line(sources[m.name])) not in EQUIVALENT]
    killed = len(results) - len(survivors)
    print(f"{killed} of {len(results)} killed, {len(survivors) - len(gaps)} equivalent, {len(gaps)} found by no test")
    return 1 if gaps else 0


if __name__ == "__main__":
    sys.exit(main())
