"""What is built from the repository has every file that its metadata names."""

import email
import re
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

ROOT = Path(__file__).parent.parent
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = SETTINGS["project"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    (built,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("wheel")), versions=["standard"])
    with zipfile.ZipFile(built) as archive:
        yield archive


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """The files of the source distribution by their path in it."""
    (built,) = SdistBuilder(str(ROOT)).build(directory=str(tmp_path_factory.mktemp("sdist")), versions=["standard"])
    with tarfile.open(built) as archive:
        yield {name.partition("/")[2] for name in archive.getnames()}


def metadata(wheel):
    (name,) = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
    return Path(name).parent, email.message_from_bytes(wheel.read(name))


def test_the_wheel_has_its_licence_and_its_readme(wheel):
    folder, stated = metadata(wheel)
    assert stated.get_all("License-File") == PROJECT["license-files"]
    assert PROJECT["license-files"][0] == "LICENSE"
    assert stated["License-Expression"] == PROJECT["license"]
    for name in stated.get_all("License-File"):
        assert wheel.read(f"{folder}/licenses/{name}") == (ROOT / name).read_bytes()
    assert stated.get_payload(decode=True).decode() == (ROOT / PROJECT["readme"]).read_text()


def test_the_wheel_has_every_extra_and_the_command(wheel):
    folder, stated = metadata(wheel)
    assert set(stated.get_all("Provides-Extra")) == set(PROJECT["optional-dependencies"])
    commands = wheel.read(f"{folder}/entry_points.txt").decode()
    for name, target in PROJECT["scripts"].items():
        assert f"{name} = {target}" in commands
        module = target.partition(":")[0].replace(".", "/")
        assert {f"{module}.py", f"{module}/__init__.py"} & set(wheel.namelist())


def test_the_wheel_has_the_arms_and_every_file_of_the_package(wheel):
    names = set(wheel.namelist())
    assert {f"nbs_pin/_urdf/{path.name}" for path in (ROOT / "urdf").glob("*.urdf")} <= names
    ours = {path for path in (ROOT / "nbs_pin").rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert {path.relative_to(ROOT).as_posix() for path in ours} <= names
    assert "nbs_pin/py.typed" in names


def test_the_source_has_what_it_names_and_what_its_pages_link_to(source):
    for name in SETTINGS["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]:
        assert any(file == name or file.startswith(f"{name}/") for file in source), name
    assert {PROJECT["readme"], *PROJECT["license-files"], SETTINGS["tool"]["hatch"]["version"]["path"]} <= source
    for target in re.findall(r"\]\(([^):#]+)\)", (ROOT / "README.md").read_text()):
        assert target in source or any(file.startswith(f"{target}/") for file in source), target


def test_the_citation_is_of_this_version_and_licence():
    text = (ROOT / "CITATION.cff").read_text()
    version = re.search(r'__version__ = "(.*)"', (ROOT / SETTINGS["tool"]["hatch"]["version"]["path"]).read_text())[1]
    assert f"version: {version}\n" in text
    assert f"license: {PROJECT['license']}\n" in text
