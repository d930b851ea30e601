"""Expansion of xacro files, with the line of the user's file kept for every element of the result.

xacro evaluates expressions and reads files and environment variables: expand only files that you trust.
"""

import re
import threading
import warnings
import xml.dom.minidom
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from nbs_pin.base.doors import BLANK, option
from nbs_pin.base.exceptions import MissingExtra, RobotError
from nbs_pin.robots.packages import Packages

LINE = "nbs_pin_line"
"""Attribute that carries the number of the file and the line, as in 3:17, through the expansion."""
_MISSING = "/package-not-found/"
"""Where the files of a package lie that is not found: meshes may be missing, included files may not."""
_USED = re.compile(r"\$\(arg ([^()]+)\)")
_lock = threading.RLock()


def expand(path: Path, arguments: Mapping[str, str], packages: Packages) -> tuple[bytes, list[str]]:
    """The URDF that a xacro file expands to, and the files that `LINE` counts.

    Raises:
        RobotError: If it cannot be expanded; names the missing package or argument and how to give it.
        MissingExtra: If the extra `xacro` is not installed.
    """
    try:
        import xacro
        import xacro.substitution_args
    except ModuleNotFoundError as error:
        raise MissingExtra(f"{path} needs xacro: pip install 'nbs-pin[xacro]'.") from error
    files: list[str] = []
    missing: list[str] = []
    with _lock, _hooks(xacro, files, missing, packages):
        try:
            document = xacro.process_file(str(path), mappings={**_of_root(path), **arguments})
        except Exception as error:  # xacro evaluates Python, which can raise any exception
            raise RobotError(_sentence(path, error, missing, packages, arguments)) from error
    own = packages.assume()
    if missing and own is not None and any(Path(file).is_relative_to(own) for file in files[1:]):
        text = f"{path}: package {', '.join(map(repr, missing))} was not found and is taken to be {own}"
        warnings.warn(
            f"{text}, which has no package.xml; give another by {option('package_dirs', BLANK)}.", stacklevel=2
        )
    expanded: str = document.documentElement.toxml()
    return expanded.encode(), files


@contextmanager
def _hooks(xacro: Any, files: list[str], missing: list[str], packages: Packages) -> Iterator[None]:
    """Let xacro find packages as meshes are found, and mark every element that it parses with its line.

    xacro keeps its state in modules, so that only one file can be expanded at a time.
    """
    substitution = xacro.substitution_args
    parse, find, known = xacro.parse, substitution._eval_find, substitution._eval_dict["find"]

    def marked(source: Any, filename: str | None = None) -> Any:
        document = parse(source, filename)
        if filename is not None:
            files.append(str(filename))
            _mark(document, Path(filename).read_bytes(), len(files) - 1)
        return document

    def located(package: str) -> str:
        folder = packages.find(package)
        if folder is None and package not in missing:
            missing.append(package)
        own = packages.assume()
        return str(folder or own or _MISSING + package)

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


def _sentence(
    path: Path, error: BaseException, missing: list[str], packages: Packages, given: Mapping[str, str]
) -> str:
    """What was wrong and what to do, in one sentence."""
    chain = list(_chain(error))
    reason = " ".join(str(chain[-1]).split()) or type(chain[-1]).__name__
    lost = [name for name in missing if str(packages.assume() or _MISSING + name) in f"{error}"]
    if lost:
        return (
            f"{path}: xacro cannot expand it: package '{lost[0]}' was not found in or beside {packages.around}, nor on "
            f"ROS_PACKAGE_PATH or AMENT_PREFIX_PATH; give the folder it lies in: {option('package_dirs', BLANK)}."
        )
    stated = _arguments(path)
    if any(type(part).__name__ == "ArgException" for part in chain):
        used = _USED.findall(path.read_text(errors="replace"))
        first = reason.rsplit(" ", 1)[-1]
        names = [first, *(name for name in dict.fromkeys(used) if name not in {first, *stated, *given})]
        plural, listed = "arguments" if len(names) > 1 else "argument", ", ".join(f"'{name}'" for name in names)
        values = dict.fromkeys(names, "VALUE")
        return f"{path}: xacro needs the {plural} {listed}; give a value: {option('xacro_args', values)}."
    guilty = {name: text for name, text in stated.items() if text in re.split(r"[/'\s]", reason)} or stated
    settable = ", ".join(f"{name} = '{text}'" for name, text in list(guilty.items())[:6])
    remedy = (
        f"; it has arguments, {settable}: set them by {option('xacro_args', BLANK)}" if stated else "; fix the file"
    )
    return f"{path}: xacro cannot expand it ({reason}){remedy}."


def _chain(error: BaseException) -> Iterator[BaseException]:
    """The error and those that it wraps, the first cause last."""
    found: BaseException | None = error
    while found is not None:
        yield found
        found = getattr(found, "exc", None) or found.__cause__


def _of_root(path: Path) -> dict[str, str]:
    """Defaults of the arguments that the root element uses: xacro evaluates it before it reads their declarations."""
    used = _USED.findall(" ".join(ElementTree.fromstring(path.read_bytes()).attrib.values()))
    return {name: text for name, text in _arguments(path).items() if name in used and text is not None}


def _arguments(path: Path) -> dict[str, str | None]:
    """The arguments that a file declares, with their defaults."""
    root = ElementTree.fromstring(path.read_bytes())
    declared = (element for element in root.iter() if str(element.tag).endswith("}arg"))
    return {element.get("name", ""): element.get("default") for element in declared}
