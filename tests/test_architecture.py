"""The house of docs/architecture.md, held to the code: arrows run one way, engines stay in their rooms."""

import ast
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "nbs_pin"
FILES = sorted(PACKAGE.rglob("*.py"))

# From the ground up; a module imports only its own floor and the floors below.
FLOORS = [
    {"exceptions", "arrays", "files", "progress", "versions"},
    {"checks", "npz", "archives", "state", "runtime"},
    {"urdf_source", "urdf_checks", "urdf", "catalogue", "robot", "networks"},
    {"dynamics", "references", "reference_files", "disturbances", "metrics", "meshes", "visuals"},
    {"controllers", "plants"},
    {"loop", "checkpoints", "relative_errors", "error_maps", "free_motion", "mismatch", "model_error"},
    {"simulation"},
    {"learning"},
    {"certificates"},
    {"plotting", "charts", "error_charts", "certificate_charts", "replay_page"},
    {"studies"},
    {"cli"},
]
FLOOR = {room: level for level, rooms in enumerate(FLOORS) for room in rooms}
HOMES = {
    "mujoco": {"plants.mujoco_plant"},
    "matplotlib": {"plotting", "charts", "error_charts", "certificate_charts"},
    "meshcat": {"replay_page"},
    "yourdfpy": {"visuals"},
    "trimesh": {"meshes", "visuals", "replay_page"},
    "scipy": {
        "reference_files",
        "visuals",
        "mismatch",
        "learning.measuring",
        "learning.tree_guess",
        "learning.physical_tree",
        "certificates.multipliers",
    },
    "clarabel": {"certificates.multipliers"},
    "threadpoolctl": {"learning.chain_fit"},
    "xacrodoc": {"urdf_source"},
    "numba": {"studies.bench", "runtime.jit", "runtime.laws", "runtime.tree_laws", "runtime.threads"},
}


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


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


def test_every_module_has_a_floor_and_every_floor_a_module():
    assert {room(m) for m in GRAPH} == set(FLOOR)


@pytest.mark.parametrize("module", GRAPH)
def test_arrows_point_down(module):
    above = [t for t in GRAPH[module] if room(t) != room(module) and FLOOR[room(t)] > FLOOR[room(module)]]
    assert not above


def test_there_is_no_cycle():
    list(TopologicalSorter({m: {t for t in ts if t in GRAPH} for m, ts in GRAPH.items()}).static_order())


def test_truth_and_belief_do_not_meet():
    """Controllers never import plants, plants never controllers, networks no robots."""
    for module, targets in GRAPH.items():
        rooms = {room(t) for t in targets}
        assert not (room(module) == "controllers" and "plants" in rooms)
        assert not (room(module) == "plants" and "controllers" in rooms)
        assert not (room(module) == "networks" and rooms & {"robot", "dynamics", "controllers"})


@pytest.mark.parametrize("library", HOMES)
def test_a_library_stays_in_its_rooms(library):
    users = {module_name(f) for f in FILES if any(m.split(".")[0] == library for m in imports(f))}
    assert users <= HOMES[library]
    assert users


def test_importing_the_package_is_light():
    code = "import nbs_pin, sys; nbs_pin.load_robot; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    heavy = {"torch", "matplotlib", "mujoco", "meshcat", "yourdfpy", "trimesh", "scipy", "numba", "clarabel"}
    assert not heavy & set(loaded)


@pytest.mark.parametrize("path", FILES, ids=module_name)
def test_house_numbers(path):
    text = path.read_text()
    assert len(text.splitlines()) <= 400
    assert not re.search(r"\b(TODO|FIXME|XXX)\b", text)
    for node in public_definitions(ast.parse(text)):
        assert ast.get_docstring(node), f"{node.name} has no docstring"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            body = node.body[-1].end_lineno - node.body[0].lineno + 1
            assert body <= 60, f"{node.name} has {body} lines"


def test_the_architecture_page_names_every_room():
    page = (ROOT / "docs" / "architecture.md").read_text()
    missing = [f.name for f in FILES if not f.name.startswith("__") and not re.search(rf"[`/]{f.name}`", page)]
    assert not missing
