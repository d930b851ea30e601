"""Reading of URDF files: limited in size, parsed without DTDs, with the line number of every element."""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from nbs_pin.base.exceptions import RobotError, RobotNotFound
from nbs_pin.robots.packages import Packages
from nbs_pin.robots.xacro_source import LINE, expand

MAX_BYTES = 5_000_000
"""Largest URDF that is read [bytes]; meshes are separate files."""
MAX_DEPTH = 128
"""Deepest nesting of XML elements."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_LATE = re.compile(rb"(\s+)<\?xml[^>]*\?>")
"""A declaration that is not at the start, which XML does not allow and readers of URDF pass over."""
_ROOTS = {"robot": "a URDF <robot>", "mujoco": "an MJCF <mujoco>"}
_FOREIGN = {"xacro": 'declare xmlns:xacro="http://www.ros.org/wiki/xacro"', "xinclude": "insert the included text"}


class Place(NamedTuple):
    """Where an element is written."""

    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


@dataclass(frozen=True)
class Node:
    """An XML element with its place in the file for messages, and strict access to children and numbers."""

    places: dict[ET.Element, Place]
    element: ET.Element
    owner: str
    """Name of the element in messages, such as "link 'l1'"."""

    def refuse(self, problem: str, remedy: str) -> RobotError:
        """A RobotError that names file, line, element, problem and remedy."""
        return RobotError(f"{self.place}: {self.owner}: {problem}; {remedy}.")

    @property
    def place(self) -> Place:
        """File and line of the element."""
        return self.places[self.element]

    def lines(self, other: ET.Element) -> str:
        """The lines of another element and of this one, with the files if they differ."""
        first, second = self.places[other], self.place
        same = first.file == second.file
        return f"lines {first.line} and {second.line}" if same else f"{first} and {second}"

    def at(self, element: ET.Element, owner: str | None = None) -> "Node":
        """Another element of the same file."""
        return Node(self.places, element, owner or self.owner)

    def named(self, tag: str) -> Iterator["Node"]:
        """The children <tag>, each named in messages by its own name."""
        for element in self.element.findall(tag):
            yield self.at(element, f"{tag} '{shorten(element.get('name', ''))}'")

    def child(self, tag: str) -> "Node | None":
        """The child <tag>, or None; raises RobotError if there are two."""
        found = self.element.findall(tag)
        if len(found) > 1:
            second = self.at(found[1])
            raise second.refuse(f"<{tag}> is stated twice ({second.lines(found[0])})", f"keep one <{tag}>")
        return self.at(found[0]) if found else None

    def need(self, tag: str) -> "Node":
        """The child <tag>; raises RobotError if there is none or there are two."""
        child = self.child(tag)
        if child is None:
            raise self.refuse(f"<{self.element.tag}> has no <{tag}>", f"add <{tag} …/>")
        return child

    def new(self, tag: str, attributes: Mapping[str, str] | None = None, name: str = "") -> "Node":
        """A new child <tag> with these attributes; messages place it at this element, under a name if it has one."""
        element = ET.SubElement(self.element, tag, dict(attributes or {}) | ({"name": name} if name else {}))
        self.places[element] = self.place
        return self.at(element, f"{tag} '{name}'" if name else None)

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
        values = tuple(value for value in map(plain_number, words) if value is not None)
        if not len(values) == len(words) == count:
            raise self._bad_number(key, "a finite number" if count == 1 else f"{count} finite numbers")
        self.element.set(key, " ".join(repr(value) for value in values))
        return values

    def content(self) -> float:
        """The text within the element as one finite number; raises RobotError if it is none."""
        text = (self.element.text or "").strip()
        value = plain_number(text)
        if value is None:
            raise self.refuse(f"<{self.element.tag}> contains '{shorten(text)}'", "write one finite number in it")
        return value

    def _bad_number(self, key: str, expected: str) -> RobotError:
        tag, value = self.element.tag, self.text(key)
        remedy = f"fix <{tag} {key}=…>"
        if "${" in value:
            remedy = "expand the file with xacro first, or give it with the ending .xacro"
        return self.refuse(f"{tag} {key} '{shorten(value)}' is not {expected}", remedy)


def plain_number(text: str) -> float | None:
    """The finite number that the text is in decimal digits, as every engine reads it; None if it is none."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    return value if math.isfinite(value) else None


def shorten(text: str) -> str:
    """The text for use in messages: printable and at most 60 characters."""
    safe = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text)
    return safe if len(safe) <= 60 else safe[:57] + "..."


def read_source(path: Path, xacro_args: Mapping[str, str], packages: Packages) -> Node:
    """The <robot> element of a file, expanded by xacro if it is a `.xacro` file or has elements of xacro.

    That of an MJCF file is <mujoco>. Raises RobotNotFound if the file does not exist, RobotError if it cannot be read,
    parsed or expanded, and MissingExtra where it must be expanded and the extra `xacro` is not installed.
    """
    label, data = str(path), read_bytes(path)
    source = parse(data, label, expanded=False, roots=("robot", "mujoco"))
    is_mjcf = source.element.tag == "mujoco"
    foreign = path.suffix == ".xacro" or any(_foreign(element) == "xacro" for element in source.element.iter())
    if is_mjcf or not foreign:
        if xacro_args:
            raise RobotError(f"{label}: it has nothing of xacro, which could take {', '.join(xacro_args)}; omit that.")
        return source if is_mjcf else parse(data, label)
    expanded, files = expand(path, source.element, xacro_args, packages)
    robot = parse(expanded, label, files)
    robot.element.set("name", robot.element.get("name") or source.element.get("name") or path.stem)
    return robot


def parse(
    data: bytes,
    label: str,
    files: list[str] | None = None,
    *,
    expanded: bool = True,
    roots: tuple[str, ...] = ("robot",),
) -> Node:
    """The <robot> element in the bytes of a URDF; `label` names them in messages, or the `files` that they came from.

    `roots` are the elements that the root may be, any if there are none. The bytes must be UTF-8 without DTD, entity or
    (if `expanded`) xacro and XInclude, within MAX_BYTES and MAX_DEPTH.
    """
    _check_text(data, label)
    late = _LATE.match(data)
    data = late[1] + data[late.end() :] if late else data
    builder = _Builder(label, files)
    parser = DefusedXMLParser(target=builder, encoding="utf-8", forbid_dtd=True)
    builder.expat = parser.parser
    try:
        parser.feed(data)
        root = parser.close()
    except ET.ParseError as error:
        raise RobotError(
            f"{label}:{error.position[0]}: not well-formed XML: {error}; give a URDF or MJCF file."
        ) from error
    except DefusedXmlException as error:
        line = parser.parser.CurrentLineNumber
        raise RobotError(f"{label}:{line}: DTD and entities are not allowed; remove <!DOCTYPE …>.") from error
    _drop_default_namespace(root)
    name = root.get("name", root.get("model", ""))
    node = Node(builder.places, root, f"{'model' if root.tag == 'mujoco' else 'robot'} '{shorten(name)}'")
    if roots and root.tag not in roots:
        needed = " or ".join(_ROOTS[tag] for tag in roots)
        raise node.refuse(f"the root element is <{shorten(root.tag)}>", f"{needed} is needed")
    for element in root.iter() if expanded else ():
        kind = _foreign(element)
        if kind:
            tag = str(element.tag).rpartition("}")[2]
            raise node.at(element).refuse(f"<{kind}:{shorten(tag)}> is not expanded", _FOREIGN[kind])
    return node


class _Builder(ET.TreeBuilder):
    """Tree builder that records the place of every element and limits the depth to MAX_DEPTH."""

    expat: Any = None

    def __init__(self, label: str, files: list[str] | None) -> None:
        super().__init__()
        self.label = label
        self.files = files
        self.places: dict[ET.Element, Place] = {}
        self.depth = 0

    def start(self, tag: Any, attrs: Any, /) -> ET.Element:
        self.depth += 1
        line = self.expat.CurrentLineNumber
        if self.depth > MAX_DEPTH:
            raise RobotError(f"{self.label}:{line}: too deep: more than {MAX_DEPTH} nested elements; flatten <{tag}>.")
        strange = next((name for name in (tag, *attrs) if not name.isascii()), None)
        if strange is not None:
            raise RobotError(f"{self.label}:{line}: '{shorten(strange)}' is no name of URDF; correct it.")
        place = Place(self.label, line)
        if self.files is not None:
            file, _, there = attrs.pop(LINE, "").partition(":")
            marked = file.isdecimal() and there.isdecimal() and int(file) < len(self.files)
            place = Place(self.files[int(file)], int(there)) if marked else Place(self.label, 1)
        element = super().start(tag, attrs)
        self.places[element] = place
        return element

    def end(self, tag: Any, /) -> ET.Element:
        self.depth -= 1
        return super().end(tag)


def _drop_default_namespace(root: ET.Element) -> None:
    """Remove the default namespace of <robot xmlns="…"> from all tags, as every URDF reader does."""
    namespace = root.tag.removesuffix("robot")
    for element in root.iter() if namespace.endswith("}") else ():
        element.tag = element.tag.removeprefix(namespace)


def _foreign(element: ET.Element) -> str | None:
    """Whose element it is, xacro or xinclude, which URDF readers silently skip; None for one of URDF."""
    namespace = str(element.tag).rpartition("}")[0].lower()
    return next((kind for kind in _FOREIGN if kind in namespace), None)


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


def read_bytes(path: Path) -> bytes:
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
