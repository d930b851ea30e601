"""Expansion of xacro files, with the line of the user's file kept for every element of the result.

xacro evaluates expressions and reads files and environment variables: expand only files that you trust.
"""

import difflib
import re
import threading
import warnings
import xml.dom.minidom
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element
from xml.parsers import expat

from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.exceptions import MissingExtra, RobotError
from nbs_pin.robots.packages import MISSING, Packages

LINE = "nbs_pin_line"
"""Attribute that carries the number of the file and the line, as in 3:17, through the expansion."""
_USED = re.compile(r"\$\(\s*arg\s+([^()\s]+)\s*\)")
_DECLARED = re.compile(r"""<xacro:arg\b[^>]*?\bname\s*=\s*["']([^"']+)""")
_lock = threading.RLock()
_refusal: ContextVar[str] = ContextVar("refusal", default="")


@contextmanager
def refusing(because: str) -> Iterator[None]:
    """Nothing is expanded in the block: `expand` raises RobotError with these words."""
    before = _refusal.set(because)
    try:
        yield
    finally:
        _refusal.reset(before)


@dataclass
class _Expansion:
    """What is met while a file is expanded."""

    path: Path
    root: Element
    given: Mapping[str, str]
    packages: Packages
    files: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    """Packages that are not found."""

    @property
    def declared(self) -> dict[str, str]:
        """The arguments that the file declares, with their defaults."""
        elements = (element for element in self.root.iter() if str(element.tag).endswith("}arg"))
        return {element.get("name", ""): element.get("default", "") for element in elements}

    @property
    def of_root(self) -> dict[str, str]:
        """Defaults of the arguments in the root element, which xacro evaluates before it reads the declarations."""
        used = _USED.findall(" ".join(self.root.attrib.values()))
        return {name: text for name, text in self.declared.items() if name in used and "$" not in text}

    def check_arguments(self) -> None:
        """Raise RobotError for an argument that no file declares or uses."""
        texts = [Path(file).read_text(errors="replace") for file in self.files]
        known = {name for text in texts for name in (*_USED.findall(text), *_DECLARED.findall(text))}
        for name in self.given:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1) or sorted(known)[:6]
                names = ", ".join(map(repr, near)) or "no argument at all"
                raise RobotError(f"{self.path}: it takes no argument '{name}'; give {names}.")


def expand(path: Path, root: Element, arguments: Mapping[str, str], packages: Packages) -> tuple[bytes, list[str]]:
    """The URDF that a xacro file with this root element expands to, and the files that `LINE` counts.

    Raises:
        RobotError: If it cannot be expanded; names the missing package or argument and how to give it.
        MissingExtra: If the extra `xacro` is not installed.
    """
    if _refusal.get():
        raise RobotError(_refusal.get())
    try:
        import xacro
        import xacro.substitution_args
    except ModuleNotFoundError as error:
        raise MissingExtra(f"{path} needs xacro: pip install 'nbs-pin[xacro]'.") from error
    task = _Expansion(path, root, arguments, packages)
    with _lock, _hooks(xacro, task):
        try:
            document = xacro.process_file(str(path), mappings={**task.of_root, **arguments})
        except Exception as error:  # xacro evaluates Python, which can raise any exception
            where = next((name for name in reversed(xacro.filestack or []) if name), str(path))
            raise RobotError(_sentence(task, where, error)) from error
    task.check_arguments()
    own = packages.assume()
    if task.missing and own is not None and any(Path(file).is_relative_to(own) for file in task.files[1:]):
        text = f"{path}: package {', '.join(map(repr, task.missing))} was not found and is taken to be {own}"
        remedy = f"give another by {option('package_dirs', BLANK)}"
        warnings.warn(f"{text}, which has no package.xml; {remedy}.", stacklevel=2)
    expanded: str = document.documentElement.toxml()
    return expanded.encode(), task.files


@contextmanager
def _hooks(xacro: Any, task: _Expansion) -> Iterator[None]:
    """Let xacro find packages as meshes are found, and mark every element that it parses with its line.

    xacro keeps its state in modules, so that only one file can be expanded at a time.
    """
    substitution = xacro.substitution_args
    parse, find, known = xacro.parse, substitution._eval_find, substitution._eval_dict["find"]

    def marked(source: Any, filename: str | None = None) -> Any:
        document = parse(source, filename)
        if filename is not None:
            task.files.append(str(filename))
            _mark(document, Path(filename).read_bytes(), len(task.files) - 1)
        return document

    def located(package: str) -> str:
        folder = task.packages.find(package)
        if folder is None and package not in task.missing:
            task.missing.append(package)
        return str(folder or task.packages.assume() or MISSING + package)

    xacro.parse, substitution._eval_find, substitution._eval_dict["find"] = marked, located, located
    try:
        yield
    finally:
        xacro.parse, substitution._eval_find, substitution._eval_dict["find"] = parse, find, known


def _mark(document: xml.dom.minidom.Document, data: bytes, file: int) -> None:
    """Give every element but those of xacro the attribute `LINE`."""
    lines: list[int] = []
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda *_: lines.append(parser.CurrentLineNumber)
    parser.Parse(data, True)
    for element, line in zip(document.getElementsByTagName("*"), lines, strict=True):
        if not element.tagName.startswith("xacro:"):
            element.setAttribute(LINE, f"{file}:{line}")


def _sentence(task: _Expansion, where: str, error: BaseException) -> str:
    """What was wrong and what to do, in one sentence."""
    chain = list(_chain(error))
    reason = " ".join(str(chain[-1]).split()) or type(chain[-1]).__name__
    lost = [name for name in task.missing if str(task.packages.assume() or MISSING + name) in f"{error}"]
    if lost:
        packages, near = ", ".join(map(repr, lost)), task.packages.around
        return (
            f"{where}: xacro cannot expand it ({reason}): package {packages} was not found in or beside {near}, nor on "
            f"ROS_PACKAGE_PATH or AMENT_PREFIX_PATH; give the folder it lies in: {option('package_dirs', BLANK)}."
        )
    declared = task.declared
    if any(type(part).__name__ == "ArgException" for part in chain):
        used = _USED.findall(task.path.read_text(errors="replace"))
        first = reason.rsplit(" ", 1)[-1]
        names = [first, *(name for name in dict.fromkeys(used) if name not in {first, *declared, *task.given})]
        plural, listed = "arguments" if len(names) > 1 else "argument", ", ".join(f"'{name}'" for name in names)
        values = dict.fromkeys(names, "VALUE")
        return f"{where}: xacro needs the {plural} {listed}; give a value: {option('xacro_args', values)}."
    words = re.split(r"[/'\s]", reason)
    guilty = ", ".join(f"{name} = '{text}'" for name, text in declared.items() if text in words)
    guilty = f"it has the argument {guilty}: set it by {option('xacro_args', BLANK)}" if guilty else "fix the file"
    return f"{where}: xacro cannot expand it ({reason}); {guilty}."


def _chain(error: BaseException) -> Iterator[BaseException]:
    """The error and those that it wraps, the first cause last."""
    found: BaseException | None = error
    while found is not None:
        yield found
        found = getattr(found, "exc", None) or found.__cause__
