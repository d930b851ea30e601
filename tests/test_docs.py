"""Documentation is read by tests: citations, links, examples and docstrings."""

import ast
import builtins
import doctest
import inspect
import re
import tomllib
from importlib import import_module
from itertools import pairwise
from pathlib import Path

import pytest

import nbs_pin
from nbs_pin import cli
from nbs_pin.base import exceptions
from tests.pages import blocks, commands, lines, run_page, typed_by_hand
from tools.pictures import CHARTS, RUNS

ROOT = Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")])
WITH_CODE = [page for page in PAGES if {"sh", "python"} & {kind for kind, *_ in blocks(page)}]
SHORT = [ROOT / "README.md", ROOT / "docs" / "index.md"]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
THEORY = ROOT / "docs" / "theory.md"
HOME_OF = {
    alias.name: f"nbs_pin.{node.module}"
    for node in ast.parse((ROOT / "nbs_pin" / "__init__.pyi").read_text()).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
    if alias.name != "metrics"
}
"""The module of every public name."""


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


def made_by(run: str) -> list[str]:
    """The commands behind a picture, in order, as a page has them."""
    folders = {"collect": "out/motions", "learn": "out/learned", "arm": "my_arm.urdf", "loads": "demos/loads.toml"}
    before = [line for name in re.findall(r"{(\w+)}", RUNS[run]) if name in RUNS for line in made_by(name)]
    return [*before, f"nbs-pin {RUNS[run].format(**folders)}"]


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


def test_pictures_are_of_the_commands_beside_them():
    runs = {name: run for name, (run, _) in CHARTS.items()} | {name: name for name in ("swing", "track", "circle")}
    shown = [
        (page.name, command, page.read_text())
        for page in (page for page in PAGES if page not in SHORT)
        for name in re.findall(r"images/([\w-]+)\.webp", page.read_text())
        for command in made_by(runs[name])
    ]
    assert len(shown) > 12
    is_there = [
        bool(re.search(rf"{re.escape(command)}( --out \S+)? *(`|#|$)", text, re.M)) for _, command, text in shown
    ]
    assert [(page, command) for (page, command, _), there in zip(shown, is_there, strict=True) if not there] == []


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


def test_the_python_of_the_readme_and_the_first_page_runs(tmp_path, monkeypatch):
    """Block by block, as a reader would paste them; `make docs-check` runs the commands and the other pages."""
    monkeypatch.chdir(tmp_path)
    for page in SHORT:
        names = {"__name__": "page"}
        for number, (kind, _, text) in enumerate(blocks(page), 1):
            if kind == "python":
                exec(compile(text, f"{page.name}, block {number}", "exec"), names)


@pytest.mark.pages
@pytest.mark.filterwarnings("ignore:log.csv. the torque is noisy")
@pytest.mark.parametrize("page", WITH_CODE, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_a_page_says_can_be_typed_in_order(page, tmp_path):
    run_page(page, tmp_path)


def test_pages_have_no_block_of_another_kind():
    """A kind that nobody runs would hide what does not work."""
    known = {"sh", "python", "shell", "text", "xml", "toml", "c"}
    assert {kind for page in PAGES for kind, *_ in blocks(page)} == known
    assert len(WITH_CODE) > 12


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_that_a_page_shows_has_these_options(page):
    for words in commands(page):
        assert cli.parse(words) is not None


def test_what_no_test_can_type_names_what_exists():
    """Targets of make, extras of pip; else only arms that are not here, and a queue of a cluster."""
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.M))
    extras = set(PROJECT["optional-dependencies"])
    seen = [(page, words) for page in PAGES for words in typed_by_hand(page)]
    assert len(seen) > 3
    for page, words in seen:
        assert words[0] in ("make", "pip", "sbatch", "nbs-pin") or words[0].startswith((".venv/bin/", "python")), (
            page,
            words,
        )
        if words[0] == "nbs-pin":  # with an arm that is not there
            assert cli.parse(words[1:]) is not None
            assert any(word.startswith(("libfranka:", "ur:", "tcp:")) for word in words), (page, words)
        if words[0] == "make" and "-C" not in words:  # of what another command wrote
            assert set(words[1:]) <= targets, (page, words)
        if words[0] == "pip":
            named = re.search(r"\[(.*)\]", words[-1])
            assert named is None or set(named[1].split(",")) <= extras, (page, words)


def test_every_extra_is_in_the_table_of_the_readme():
    told = re.findall(r"^\| `(\w+)` \|", (ROOT / "README.md").read_text(), flags=re.M)
    assert set(told) == set(PROJECT["optional-dependencies"])


def test_every_how_to_is_linked_from_the_first_page_and_the_list():
    pages = {page.name for page in (ROOT / "docs" / "howto").glob("*.md")} - {"index.md"}
    for listing in (ROOT / "docs" / "index.md", ROOT / "docs" / "howto" / "index.md"):
        assert pages <= {Path(target).name for _, target in links(listing)}, listing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_results_that_a_page_uses_again_have_a_folder_that_it_names(page):
    """Without --out they go to another folder if there are results of other settings, and the page reads old ones."""
    named = set()
    for kind, _, text in blocks(page):
        words = [word for line in lines(text) for word in line] if kind == "sh" else re.findall(r'"(out/[^"]+)"', text)
        for before, word in pairwise(["", *words]):
            if before == "--out":
                named.add(word)
            elif word.startswith("out/") and kind in ("sh", "python"):
                assert any(f"{word}/".startswith(f"{folder}/") for folder in named), (page, word)


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


def example_of(name: str) -> bool:
    """Whether its docstring, or that of one of its methods, has an example that runs."""
    thing = getattr(nbs_pin, name)
    members = vars(thing).values() if inspect.isclass(thing) else ()
    texts = [thing.__doc__, *(getattr(getattr(member, "__func__", member), "__doc__", None) for member in members)]
    return any(">>> " in text for text in texts if isinstance(text, str))


def test_every_public_name_has_an_example():
    assert {name for name in HOME_OF if not example_of(name)} == {"Proposal", "ROBOT_NAMES"}
    assert "`propose`" in nbs_pin.Proposal.__doc__
    assert example_of("propose")


def test_every_public_name_is_on_one_page_of_the_reference():
    shown = [name for page in PAGES for name in re.findall(r"^::: nbs_pin\.(\w+)$", page.read_text(), flags=re.M)]
    assert sorted(shown) == sorted([*HOME_OF, "metrics"])


def test_the_page_of_errors_has_every_error_and_what_it_also_is():
    table = re.findall(
        r"^\| `(\w+)` \| `(\w+)` \|", (ROOT / "docs" / "reference" / "errors.md").read_text(), flags=re.M
    )
    errors = {name: error for name, error in vars(exceptions).items() if inspect.isclass(error)}
    assert set(dict(table)) == set(errors) - {"NbsPinError"}
    for name, builtin in table:
        assert issubclass(errors[name], getattr(builtins, builtin)), name


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
