"""Reading of URDF files: limited in size, parsed without DTDs, with the line number of every element."""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from nbs_pin.base.exceptions import MissingExtra, RobotError, RobotNotFound

MAX_BYTES = 5_000_000
"""Largest URDF that is read [bytes]; meshes are separate files."""
MAX_DEPTH = 128
"""Deepest nesting of XML elements."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_QUOTE = {'"': "&quot;"}
_FOREIGN = {"xacro": "expand it with xacro first or give the .xacro file", "xinclude": "insert the included text"}


@dataclass(frozen=True)
class Node:
    """An XML element with its place in the file for messages, and strict access to children and numbers."""

    label: str
    """Name of the file in messages."""
    lines: Mapping[ET.Element, int]
    element: ET.Element
    owner: str
    """Name of the element in messages, such as "link 'l1'"."""

    def refuse(self, problem: str, remedy: str) -> RobotError:
        """A RobotError that names file, line, element, problem and remedy."""
        line = self.lines.get(self.element, 1)
        return RobotError(f"{self.label}:{line}: {self.owner}: {problem}; {remedy}.")

    def at(self, element: ET.Element, owner: str | None = None) -> "Node":
        """Another element of the same file."""
        return Node(self.label, self.lines, element, owner or self.owner)

    def named(self, tag: str) -> Iterator["Node"]:
        """The children <tag>, each named in messages by its own name."""
        for element in self.element.findall(tag):
            yield self.at(element, f"{tag} '{shorten(element.get('name', ''))}'")

    def child(self, tag: str) -> "Node | None":
        """The child <tag>, or None; raises RobotError if there are two."""
        found = self.element.findall(tag)
        if len(found) > 1:
            lines = " and ".join(str(self.lines[element]) for element in found[:2])
            raise self.at(found[1]).refuse(f"<{tag}> is stated twice (lines {lines})", f"keep one <{tag}>")
        return self.at(found[0]) if found else None

    def need(self, tag: str) -> "Node":
        """The child <tag>; raises RobotError if there is none or there are two."""
        child = self.child(tag)
        if child is None:
            raise self.refuse(f"<{self.element.tag}> has no <{tag}>", f"add <{tag} …/>")
        return child

    def text(self, key: str) -> str:
        """The attribute `key`; raises RobotError if it is missing."""
        value = self.element.get(key)
        if value is None:
            raise self.refuse(f"<{self.element.tag}> states no {key}", f'add {key}="…" to <{self.element.tag}>')
        return value

    def number(self, key: str, default: float | None = None, least: float = -math.inf) -> float:
        """The attribute `key` as one finite number ≥ least; see `numbers`."""
        (value,) = self.numbers(key, 1, None if default is None else (default,))
        if value < least:
            raise self._bad_number(key, f"a finite number >= {least:g}")
        return value

    def numbers(self, key: str, count: int, default: tuple[float, ...] | None = None) -> tuple[float, ...]:
        """The attribute `key` as `count` finite numbers, or `default` if it is missing (None: it is required).

        The attribute is rewritten in its shortest exact form, so that every engine reads the same number: Pinocchio
        ignores a body whose mass is written " 1 ". Raises RobotError for anything but `count` finite numbers.
        """
        if default is not None and key not in self.element.attrib:
            return default
        words = self.text(key).split()
        values = tuple(float(word) if _NUMBER.fullmatch(word) else math.nan for word in words)
        if len(values) != count or not all(math.isfinite(value) for value in values):
            raise self._bad_number(key, "a finite number" if count == 1 else f"{count} finite numbers")
        self.element.set(key, " ".join(repr(value) for value in values))
        return values

    def _bad_number(self, key: str, expected: str) -> RobotError:
        tag, value = self.element.tag, self.text(key)
        remedy = _FOREIGN["xacro"] if "${" in value else f"fix <{tag} {key}=…>"
        return self.refuse(f"{tag} {key} '{shorten(value)}' is not {expected}", remedy)


def shorten(text: str) -> str:
    """The text for use in messages: printable and at most 60 characters."""
    safe = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
    return safe if len(safe) <= 60 else safe[:57] + "..."


def read_source(path: Path) -> Node:
    """The <robot> element of a `.urdf` or `.xacro` file.

    Raises RobotNotFound if the file does not exist, RobotError if it cannot be read or parsed, and MissingExtra for a
    `.xacro` file if the extra `xacro` is not installed.
    """
    data = _read_bytes(path)
    if path.suffix != ".xacro":
        return parse(data, str(path))
    name = parse(data, str(path), expanded=False).element.get("name", path.stem)
    return parse(_expand(path, name), f"{path} (expanded)")


def parse(data: bytes, label: str, *, expanded: bool = True) -> Node:
    """The <robot> element in the bytes of a URDF; `label` names them in messages.

    They must be UTF-8 without DTD, entity or (if `expanded`) xacro and XInclude, within MAX_BYTES and MAX_DEPTH.
    """
    _check_text(data, label)
    builder = _Builder(label)
    parser = DefusedXMLParser(target=builder, encoding="utf-8", forbid_dtd=True)
    builder.expat = parser.parser
    try:
        parser.feed(data)
        root = parser.close()
    except ET.ParseError as error:
        raise RobotError(f"{label}:{error.position[0]}: not well-formed XML: {error}; give a URDF file.") from error
    except DefusedXmlException as error:
        line = parser.parser.CurrentLineNumber
        raise RobotError(f"{label}:{line}: DTD and entities are not allowed; remove <!DOCTYPE …>.") from error
    _drop_default_namespace(root)
    node = Node(label, builder.lines, root, f"robot '{shorten(root.get('name', ''))}'")
    if root.tag != "robot":
        raise node.refuse(f"the root element is <{shorten(root.tag)}>", "a URDF <robot> is needed")
    for element in root.iter() if expanded else ():
        _refuse_foreign(node.at(element))
    return node


class _Builder(ET.TreeBuilder):
    """Tree builder that records the line of every element and limits the depth to MAX_DEPTH."""

    expat: Any = None

    def __init__(self, label: str) -> None:
        super().__init__()
        self.label = label
        self.lines: dict[ET.Element, int] = {}
        self.depth = 0

    def start(self, tag: Any, attrs: Any, /) -> ET.Element:
        self.depth += 1
        line = self.expat.CurrentLineNumber
        if self.depth > MAX_DEPTH:
            raise RobotError(f"{self.label}:{line}: too deep: more than {MAX_DEPTH} nested elements; flatten <{tag}>.")
        element = super().start(tag, attrs)
        self.lines[element] = line
        return element

    def end(self, tag: Any, /) -> ET.Element:
        self.depth -= 1
        return super().end(tag)


def _drop_default_namespace(root: ET.Element) -> None:
    """Remove the default namespace of <robot xmlns="…"> from all tags, as every URDF reader does."""
    namespace = root.tag.removesuffix("robot")
    for element in root.iter() if namespace.endswith("}") else ():
        element.tag = element.tag.removeprefix(namespace)


def _refuse_foreign(node: Node) -> None:
    """Raise RobotError for an element of xacro or XInclude, which URDF readers silently skip."""
    namespace, _, tag = str(node.element.tag).rpartition("}")
    for kind, remedy in _FOREIGN.items():
        if kind in namespace.lower():
            raise node.refuse(f"<{kind}:{shorten(tag)}> is not expanded", remedy)


def _check_text(data: bytes, label: str) -> None:
    """Raise RobotError unless the bytes are UTF-8 text of at most MAX_BYTES."""
    if len(data) > MAX_BYTES:
        raise RobotError(f"{label}: too large: {len(data)} bytes (limit {MAX_BYTES}); keep meshes in their own files.")
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise RobotError(f"{label}: not UTF-8 at byte {error.start}; save the file as UTF-8.") from error
    if b"\0" in data:
        raise RobotError(f"{label}: not UTF-8 text: NUL at byte {data.index(0)}; save the file as UTF-8.")


def _read_bytes(path: Path) -> bytes:
    """The first MAX_BYTES + 1 bytes of the file."""
    try:
        with path.open("rb") as file:
            return file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise RobotNotFound(f"cannot read {path}: no such file; check the path.") from error
    except IsADirectoryError as error:
        raise RobotNotFound(f"cannot read {path}: it is a directory; give the .urdf file inside it.") from error
    except OSError as error:
        raise RobotError(f"cannot read {path}: {error.strerror}; check its permissions.") from error


def _expand(path: Path, name: str) -> bytes:
    """The URDF of the robot `name` that a xacro file expands to, with includes relative to the file.

    xacro evaluates Python expressions: expand only files that you trust.
    """
    try:
        from xacrodoc import XacroDoc, packages
    except ModuleNotFoundError as error:
        raise MissingExtra(f"{path} needs xacro: pip install 'nbs-pin[xacro]'.") from error
    packages.walk_up_from(path)
    include = escape(str(path.resolve()), _QUOTE)
    try:
        document = XacroDoc.from_includes([include], name=escape(name, _QUOTE), resolve_packages=False)
    except Exception as error:  # xacro evaluates Python, which can raise any exception
        raise RobotError(f"{path}: xacro cannot expand it ({type(error).__name__}: {error}); fix the file.") from error
    expanded: str = document.dom.toxml()
    return expanded.encode()
