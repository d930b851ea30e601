"""The files of an MJCF description before MuJoCo reads them: how large they are, and where its elements are written.

MuJoCo allocates what an attribute asks for, so that one number can take all memory; what is refused here never reaches
it.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from nbs_pin.robots.packages import is_file
from nbs_pin.robots.urdf_source import MAX_DEPTH, Node, Place, parse, read_bytes

MAX_ELEMENTS = 100_000
"""Largest number of elements of all files, those of <replicate> counted as often as they are made."""
MAX_FILES = 200
MAX_SIZE = 4096
"""Largest number that an attribute may ask memory for."""
_SIZES = ("nrow", "ncol", "actdim", "nsample", "size", "params", "octree_maxdepth", "maxhullvert")
_SIZED = ("hfield", "mesh", "numeric", "general", "plugin", "user", "size")
"""Elements whose attributes `_SIZES`, or all of them, ask for memory."""
_SOFT = ("flex", "flexcomp", "composite")
_WHOLE = re.compile(r"\s*\d{1,6}\s*", re.ASCII)


@dataclass
class MjcfFiles:
    """What is found in the files of a description."""

    main: Path
    files: list[Path] = field(default_factory=list)
    attaches: bool = False
    """Whether a model is attached."""
    places: dict[tuple[str, str], Place] = field(default_factory=dict)
    """Where the element of a tag and a name is written."""

    @property
    def folders(self) -> list[Path]:
        """The folders of the files, that of the first one first."""
        return list(dict.fromkeys(file.parent for file in self.files))


def scan(main: Path, root: Node) -> MjcfFiles:
    """Read the files that a description includes or attaches, and check that they are of reasonable size.

    Raises:
        RobotError: If a file is missing, is included twice, has a DTD or is no MJCF, if the description has too many
            elements, asks for too much memory, or has deformable parts.
    """
    found = MjcfFiles(main, [main])
    count = _count(root, found, 1, 0)
    if count > MAX_ELEMENTS:
        problem = f"too large: {count} elements, those that <replicate> makes included (limit {MAX_ELEMENTS})"
        raise root.refuse(problem, "give a smaller arm")
    return found


def _count(node: Node, found: MjcfFiles, times: int, depth: int) -> int:
    """Check an element and what is below it; how many elements it makes in all, `times` times."""
    element, tag = node.element, str(node.element.tag)
    if depth > MAX_DEPTH:
        raise node.refuse(f"too deep: more than {MAX_DEPTH} nested elements", f"flatten <{tag}>")
    if tag in _SOFT:
        raise node.refuse(f"<{tag}> is deformable, and an arm here is of rigid bodies", f"remove <{tag}>")
    name = element.get("name")
    if name:
        found.places.setdefault((_kind(tag), name), node.place)
    _check_sizes(node)
    if tag == "replicate":
        times *= _whole(node, "count", MAX_ELEMENTS)
    count = times
    inner = [(node.at(child), depth + 1) for child in element]
    if tag == "include":
        inner = [(child, depth) for child in _included(node, found)]
    elif tag == "model":
        found.attaches = True
        inner = [(_parsed(node, found, ("mujoco",)), depth + 1)]
    for child, at in inner:
        count += _count(child, found, times, at)
        if count > MAX_ELEMENTS:
            break
    return count


def _included(node: Node, found: MjcfFiles) -> Iterator[Node]:
    root = _parsed(node, found, ())
    yield from (root.at(child) for child in root.element)


def _parsed(node: Node, found: MjcfFiles, roots: tuple[str, ...]) -> Node:
    """The root of the file that an element names."""
    name = node.text("file")
    path = next((path for path in _candidates(name, node, found) if is_file(path)), None)
    if path is None:
        raise node.refuse(
            f"file '{name:.200}' was not found in {found.main.parent}", f"fix <{node.element.tag} file=…>"
        )
    if path in found.files and node.element.tag == "include":
        raise node.refuse(f"file '{name:.200}' is included twice", "include it once")
    if len(found.files) >= MAX_FILES:
        raise node.refuse(f"more than {MAX_FILES} files", "join them")
    found.files.append(path)
    root = parse(read_bytes(path), str(path), expanded=False, roots=roots)
    return root


def _candidates(name: str, node: Node, found: MjcfFiles) -> Iterator[Path]:
    for folder in dict.fromkeys((Path(node.place.file).parent, found.main.parent)):
        yield (folder / name).resolve()


def _check_sizes(node: Node) -> None:
    """Raise RobotError if an attribute asks for a size beyond MAX_SIZE."""
    tag = str(node.element.tag)
    if tag not in _SIZED:
        return
    for key, text in node.element.attrib.items():
        counts = key in _SIZES or key.startswith(("nuser", "nkey"))
        if not counts or (tag, key) == ("hfield", "size"):
            continue
        for word in text.split():
            try:
                large = not abs(float(word)) <= MAX_SIZE
            except ValueError:
                continue  # MuJoCo refuses it in its own words
            if large:
                raise node.refuse(f"{tag} {key} '{text:.60}' is beyond {MAX_SIZE}", f"give a smaller {key}")


def _whole(node: Node, key: str, most: int) -> int:
    text = node.text(key)
    if not _WHOLE.fullmatch(text) or int(text) > most:
        raise node.refuse(f"{key} '{text:.60}' is not a whole number from 1 to {most}", f"fix <replicate {key}=…>")
    return int(text)


def _kind(tag: str) -> str:
    """Joints and actuators have several tags."""
    if tag == "freejoint":
        return "joint"
    return tag if tag in ("body", "joint", "geom", "mesh", "site") else "other"
