"""The house of docs/architecture.md, held to the code: arrows run one way, engines stay in their rooms."""

import ast
import builtins
import dis
import functools
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path
from types import CodeType

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "nbs_pin"
FILES = sorted(PACKAGE.rglob("*.py"))

# From the ground up; a module imports its own room and rooms of lower floors.
FLOORS = [
    {"base"},
    {"kernels", "robots"},
    {"dynamics", "export", "motions"},
    {"controllers", "inertia"},
    {"simulation", "storage"},
    {"accuracy", "identification", "training"},
    {"certificates", "cli", "verification"},
    {"campaigns"},
    {"reports", "runtime"},
    {"benchmarks", "reproduction"},
    {"commands"},
]
FLOOR = {room: level for level, rooms in enumerate(FLOORS) for room in rooms}
HOMES = {
    "mujoco": {
        "simulation.mujoco_plant",
        "simulation.massless",
        "robots.mjcf_checks",
        "robots.mjcf_joints",
        "robots.mjcf_model",
        "robots.mjcf_shapes",
        "robots.mjcf_tree",
    },
    "matplotlib": {"reports"},
    "meshcat": {"reports.live", "reports.live_server", "reports.scene"},
    "yourdfpy": {"robots.visuals"},
    "trimesh": {"robots.meshes", "robots.shape_inertia", "robots.visuals"},
    "pink": {"motions.inverse_kinematics"},
    "toppra": {"motions.least_time"},
    "scipy": {
        "motions",
        "robots.mass_matrix",
        "inertia",
        "accuracy",
        "identification",
        "certificates",
        "benchmarks.fair_tuning",
    },
    "clarabel": {"inertia.multipliers"},
    "coal": {"robots.collisions"},
    "flint": {"verification.balls"},
    "jsonschema": {"verification.document"},
    "threadpoolctl": {"identification.chain_fit", "identification.coupling", "identification.explain"},
    "xacro": {"robots.xacro_source"},
    "distributed": {"campaigns.runner"},
    "pyarrow": {"campaigns.table"},
    "rosbags": {"identification.log_bags", "reports.run_bags"},
    "numba": {"kernels", "benchmarks.bench"},
    "tyro": {"cli"},
    "rich": {"base.progress", "cli", "commands"},
}
"""The modules or rooms that may import a library."""


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


@functools.cache
def imports(path: Path) -> set[str]:
    """Every module a file imports, wherever in the file."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{a.name}" if node.module == "nbs_pin" else str(node.module) for a in node.names}
    return found


def public_definitions(node: ast.AST) -> list[ast.FunctionDef | ast.ClassDef]:
    """Public classes and functions of a module, and the public methods of those classes."""
    named = [n for n in ast.iter_child_nodes(node) if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    public = [n for n in named if not n.name.startswith("_")]
    return public + [m for n in public if isinstance(n, ast.ClassDef) for m in public_definitions(n)]


def room(module: str) -> str:
    return module.removeprefix("nbs_pin.").split(".")[0]


GRAPH = {module_name(f): {m.removeprefix("nbs_pin.") for m in imports(f) if m.startswith("nbs_pin.")} for f in FILES}
GRAPH.pop("__init__")
for targets in GRAPH.values():
    targets.discard("__version__")


def test_the_root_holds_the_door_alone_and_every_room_has_a_floor():
    assert {path.name for path in PACKAGE.iterdir() if path.is_file()} <= {"__init__.py", "__init__.pyi", "py.typed"}
    assert {room(m) for m in GRAPH} == set(FLOOR)
    assert len(FLOOR) <= 22
    assert len(FLOORS) <= 12


def test_arrows_point_down():
    up = [(m, t) for m, ts in GRAPH.items() for t in ts if room(t) != room(m) and FLOOR[room(t)] >= FLOOR[room(m)]]
    assert not up


def test_there_is_no_cycle():
    list(TopologicalSorter({m: {t for t in ts if t in GRAPH} for m, ts in GRAPH.items()}).static_order())


def test_truth_and_belief_do_not_meet():
    """Controllers never import plants, and no plant imports a controller."""
    plants = {"simulation.plant", "simulation.integrators", "simulation.dynamics_plant", "simulation.mujoco_plant"}
    plants |= {"simulation.changing_plant"}
    for module, targets in GRAPH.items():
        rooms = {room(t) for t in targets}
        assert not (room(module) == "controllers" and "simulation" in rooms)
        assert not (module in plants and "controllers" in rooms)


def test_the_library_never_imports_what_re_makes_a_paper_or_measures_speed():
    for module, targets in GRAPH.items():
        if room(module) not in ("reproduction", "benchmarks", "commands"):
            assert not {room(t) for t in targets} & {"reproduction", "benchmarks", "commands"}, module


def test_the_checker_of_certificates_shares_no_code_with_what_makes_them():
    known = {"nbs_pin.base.exceptions"}
    for path in (PACKAGE / "verification").glob("*.py"):
        ours = {m for m in imports(path) if m.startswith("nbs_pin")}
        assert all(m in known or m.startswith("nbs_pin.verification.") for m in ours), path
    assert len((PACKAGE / "verification" / "verify.py").read_text().splitlines()) <= 300


@pytest.mark.parametrize("library", HOMES)
def test_a_library_stays_in_its_rooms(library):
    users = {module_name(f) for f in FILES if any(m.split(".")[0] == library for m in imports(f))}
    assert users
    assert all(user in HOMES[library] or room(user) in HOMES[library] for user in users)


def test_importing_the_package_is_light():
    code = "import nbs_pin, sys; nbs_pin.load_robot; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    heavy = {
        "torch",
        "matplotlib",
        "mujoco",
        "meshcat",
        "yourdfpy",
        "trimesh",
        "scipy",
        "numba",
        "clarabel",
        "flint",
        "jsonschema",
        "pink",
        "toppra",
    }
    assert not heavy & set(loaded)


def test_house_numbers():
    faults = []
    for path in FILES:
        text = path.read_text()
        tree, name = ast.parse(text), module_name(path)
        if len(text.splitlines()) > 400 or re.search(r"\b(TODO|FIXME|XXX)\b", text):
            faults.append(f"{name} is over 400 lines, or not done")
        faults += [f"{name}.{n.name} has no docstring" for n in public_definitions(tree) if not ast.get_docstring(n)]
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and node.body[-1].end_lineno - node.body[0].lineno >= 60:
                faults.append(f"{name}.{node.name} is longer than 60 lines")
    assert not faults


def undefined(code: CodeType, known: set[str]) -> set[str]:
    """Global names that a module or what is in it reads and nothing assigns."""
    steps = list(dis.get_instructions(code))
    own = {str(step.argval) for step in steps if step.opname in ("STORE_NAME", "DELETE_NAME")}
    read = {str(step.argval) for step in steps if step.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    inner = (undefined(x, known) for x in code.co_consts if isinstance(x, CodeType))
    return (read - own - known).union(*inner)


def assigned(code: CodeType) -> set[str]:
    """What a module assigns at its level, and what its functions declare `global`."""
    stores = {str(x.argval) for x in dis.get_instructions(code) if x.opname in ("STORE_NAME", "STORE_GLOBAL")}
    inner = (assigned(x) for x in code.co_consts if isinstance(x, CodeType) and "STORE_GLOBAL" in dis.Bytecode(x).dis())
    return stores.union(*inner)


@pytest.mark.parametrize("folder", ["nbs_pin", "tests", "tools", "demos"])
def test_every_name_is_defined(folder):
    """What F821 and name-defined would say, which are off as they take jaxtyping's shapes for names."""
    given = set(dir(builtins)) | {"__file__", "__doc__", "__name__", "__path__", "__package__", "__annotations__"}
    faults = {}
    for path in sorted((ROOT / folder).rglob("*.py")):
        code = compile(path.read_text(), str(path), "exec")
        if lacking := undefined(code, given | assigned(code)):
            faults[str(path.relative_to(ROOT))] = lacking
    assert not faults


def test_a_name_that_nothing_defines_is_found():
    code = compile("import os\nx = 1\ndef f(y):\n    z = x + y\n    return [os, z, lost]\n", "a", "exec")
    assert undefined(code, assigned(code)) == {"lost"}


def test_the_architecture_page_names_every_room():
    page = (ROOT / "docs" / "architecture.md").read_text()
    assert not [room for room in FLOOR if f"{room}/" not in page]
