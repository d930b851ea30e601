"""Documentation is read by tests: citations, links, examples and docstrings."""

import ast
import doctest
import inspect
import re
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import pytest

import nbs_pin

ROOT = Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
THEORY = ROOT / "docs" / "theory.md"
HOME_OF = {
    alias.name: f"nbs_pin.{node.module}"
    for node in ast.parse((ROOT / "nbs_pin" / "__init__.pyi").read_text()).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
    if alias.name != "metrics"
}
"""The module of every public name."""
LONGEST_RUN = 2.0
"""What a simulation of the README is cut to [s]."""


def cited_sections() -> list[tuple[str, str]]:
    """(section, file) of every `docs/theory.md §n` in the package and its tests."""
    files = sorted([*ROOT.glob("nbs_pin/**/*.py"), *ROOT.glob("tests/*.py"), *ROOT.glob("demos/*.py")])
    pattern = re.compile(r"docs/theory\.md\s+§(\d+)")
    return [(n, file.relative_to(ROOT).as_posix()) for file in files for n in pattern.findall(file.read_text())]


def prose(page: Path) -> str:
    """A page without its code, fenced or quoted."""
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S))


def links(page: Path) -> list[tuple[str, str]]:
    """(text, target) of every Markdown link and image."""
    return re.findall(r"\[([^\]]*)\]\(\s*([^)\s]+)[^)]*\)", prose(page))


def anchors(page: Path) -> set[str]:
    """The anchors that GitHub makes of the page's headings."""
    headings = re.findall(r"^#+ +(.*?) *$", page.read_text(), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def functions(file: Path) -> set[str]:
    return {node.name for node in ast.parse(file.read_text()).body if isinstance(node, ast.FunctionDef)}


def test_every_cited_section_of_the_theory_is_a_heading():
    sections = re.findall(r"^## §(\d+) \S", THEORY.read_text(), flags=re.M)
    assert sections == [str(n) for n in range(1, len(sections) + 1)]
    cited = cited_sections()
    assert len(cited) > 10
    assert [(n, file) for n, file in cited if n not in sections] == []


def test_sections_that_the_theory_cites_of_itself_exist():
    text = THEORY.read_text()
    sections = set(re.findall(r"^## §(\d+)", text, flags=re.M))
    assert set(re.findall(r"§(\d+)", text)) <= sections


def test_every_test_that_the_pages_name_exists():
    named = [(text, target, page) for page in PAGES for text, target in links(page) if text.startswith("test_")]
    assert sum(page == THEORY for *_, page in named) > 10
    for name, target, page in named:
        if name.endswith(".py"):
            continue
        assert name in functions((page.parent / target).resolve()), f"{page.name} names {name}, not in {target}"


def test_every_row_of_the_theorys_table_names_a_test():
    table = THEORY.read_text().split("|---|---|---|\n")[1].split("\n\n")[0].splitlines()
    assert len(table) > 8
    for row in table:
        assert "](../tests/test_" in row.split("|")[3], row


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_relative_links_lead_somewhere(page):
    for text, target in links(page):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name}: [{text}]({target})"
        assert file == ROOT or ROOT in file.parents, f"{page.name}: [{text}]({target}) leaves the repository"
        if anchor and file.suffix == ".md":
            assert anchor in anchors(file), f"{page.name}: [{text}]({target})"


def test_the_readmes_python_runs(tmp_path, monkeypatch):
    """The blocks of the README one after another, as a reader would paste them; long simulations are cut short."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), flags=re.M | re.S)
    assert blocks
    simulate = nbs_pin.simulate

    def short(plant, controller, reference, duration, period, **options):
        steps = round(min(duration, LONGEST_RUN) / period)
        return simulate(plant, controller, reference, steps * period, period, **options)

    monkeypatch.setattr(nbs_pin, "simulate", short, raising=False)
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "readme"}
    for number, block in enumerate(blocks, 1):
        exec(compile(block, f"README.md, block {number}", "exec"), namespace)


EXAMPLES = sorted(file for file in ROOT.glob("nbs_pin/**/*.py") if ">>> " in file.read_text())


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: file.stem)
def test_the_example_of_a_docstring_runs_and_prints_what_it_says(file, tmp_path, monkeypatch):
    """Docstring by docstring, each in a namespace of its own."""
    monkeypatch.chdir(tmp_path)
    module = import_module(".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"))
    found = [test for test in doctest.DocTestFinder().find(module, globs={}) if test.examples]
    assert found
    for test in found:
        outcome = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test)
        assert outcome.failed == 0, f"{test.name}: see the output above"


def assigned_docstrings(module: str) -> set[str]:
    """Names of the module's constants that are followed by a docstring."""
    body = ast.parse(inspect.getsource(import_module(module))).body
    named = set()
    for node, after in pairwise(body):
        documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        if documented and isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            named |= {target.id for target in targets if isinstance(target, ast.Name)}
    return named


@pytest.mark.parametrize("name", [name for name in nbs_pin.__all__ if not name.startswith("__")])
def test_every_public_name_has_a_docstring(name):
    thing = getattr(nbs_pin, name)
    if not (inspect.ismodule(thing) or inspect.isclass(thing) or inspect.isfunction(thing)):
        assert name in assigned_docstrings(HOME_OF[name])
        return
    text = vars(thing).get("__doc__") if inspect.isclass(thing) else thing.__doc__  # inherited words do not count
    assert text
    assert not text.startswith(f"{name}(")  # what dataclasses and named tuples write of themselves
    assert len(text.split()) >= 3


def test_the_package_and_the_theory_write_the_same_symbols():
    package, theory = ("".join(text.split()) for text in (nbs_pin.__doc__, THEORY.read_text()))
    for symbols in ("M(q)v̇+C(q,v)v+G(q)=τ+τ_d", "G=+∂V/∂q", "z1", "φ=v_d−Λ∇Φ(z1)", "z2"):
        assert symbols in package
        assert symbols in theory


def test_every_public_name_is_the_thing_and_not_its_module():
    """A function named like its module would be shadowed by it after the first import."""
    for module in set(HOME_OF.values()):
        import_module(module)
    for name in HOME_OF:
        assert not inspect.ismodule(getattr(nbs_pin, name)), name
