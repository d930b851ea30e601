"""Where ROS packages lie: the same look-up for `$(find …)` of xacro files and for `package://` of meshes."""

import os
import re
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path

from nbs_pin.robots.catalogue import example_robot_share

MISSING = "/package-not-found/"
"""Where the files of a package lie that is not found: meshes may be missing, included files may not."""
_NAME = re.compile(r"<!--.*?-->|<name>\s*([^<]*?)\s*</name>", re.S)
_INNER = ("urdf", "urdfs", "xacro")
"""Folders of a package that usually hold descriptions."""
_PARTS = (*_INNER, "meshes", "robots", "config", "CMakeLists.txt")
"""One of these is in a folder that may be a package although it has no package.xml."""
_MOST_FOLDERS = 2000
"""Folders that are looked into on one level of the search."""
_ABOVE = 3
"""Folders above the package of the file whose contents are searched, as in src/repository/package."""
_DEEP = 3
"""How far below such a folder packages are searched."""


class Packages:
    """The ROS packages that a description file can refer to, found by name.

    Searched in this order: `package_dirs` and what they contain; the folders around the file, by the name in their
    package.xml; packages beside and near the file; ROS_PACKAGE_PATH; AMENT_PREFIX_PATH; folders near the file that
    have the name but no package.xml. Links to folders are followed only where the user names them. Nothing is
    remembered between two instances, so that one file gives one answer.
    """

    def __init__(self, file: Path, package_dirs: Iterable[str | Path] = ()) -> None:
        self.file = file.resolve()
        self.given = tuple(Path(folder).expanduser().resolve() for folder in package_dirs)
        self._found: dict[str, Path | None] = {}
        self._inside: dict[Path, list[tuple[str, Path]]] = {}

    @cached_property
    def around(self) -> Path:
        """The nearest folder above the file that is a package; else the file's own, or the one above `urdf`."""
        own = self.file.parent
        package = next((folder for folder in self.file.parents if is_file(folder / "package.xml")), None)
        return package or (own.parent if own.name.lower() in _INNER and not _is_top(own.parent) else own)

    def find(self, name: str) -> Path | None:
        """The folder of the package, None if there is none."""
        if name not in self._found:
            self._found[name] = next(self._candidates(name), None)
        return self._found[name]

    def assume(self) -> Path | None:
        """The folder of a package that is not found but may be the file's own: `around`, unless that has a name."""
        return None if is_file(self.around / "package.xml") else self.around

    def holds(self, path: Path) -> bool:
        """Whether a file lies in a package that `find` gives by its name."""
        folder = next((folder for folder in path.parents if is_file(folder / "package.xml")), None)
        name = None if folder is None else _package_name(folder)
        found = None if name is None else self.find(name)
        return found is not None and found.resolve() == folder

    def _candidates(self, name: str) -> Iterator[Path]:
        if not 0 < len(name) < 256 or {"/", "\\", "\0"} & set(name) or name in (".", ".."):
            return
        for folder in self.given:
            own = [folder] if folder.name == name else []
            yield from (*own, *self._named(name, folder, links=True), *_folder(folder / name))
        yield from (folder for folder in self.file.parents if _package_name(folder) == name)
        # Descriptions of example-robot-data call their package by its folder, not by the name in its package.xml.
        yield from (folder for folder in _folder(example_robot_share() / name) if folder.resolve() in self.file.parents)
        for above in self._near:
            yield from self._named(name, above)
        for variable, inner in (("ROS_PACKAGE_PATH", ""), ("AMENT_PREFIX_PATH", "share")):
            for text in filter(None, os.environ.get(variable, "").split(os.pathsep)):
                folder = Path(text) / inner
                yield from (folder / name for _ in range(is_file(folder / name / "package.xml")))
                yield from self._named(name, folder, links=True)
        yield from (folder for folder in (self.around, *self._near) if folder.name == name)
        beside = [folder / name for folder in self._near[:1] if not (folder / name).is_symlink()]
        yield from (folder for folder in beside if any((folder / part).exists() for part in _PARTS))
        yield from _folder(example_robot_share() / name)

    @cached_property
    def _near(self) -> list[Path]:
        """Folders above the package, up to the user's home, a mount point or the root of the file system."""
        near: list[Path] = []
        for folder in self.around.parents[:_ABOVE]:
            if _is_top(folder):
                break
            near.append(folder)
        return near

    def _named(self, name: str, root: Path, *, links: bool = False) -> Iterator[Path]:
        """The packages of that name at most `_DEEP` levels below a folder."""
        if root not in self._inside:
            self._inside[root] = list(_packages_in(root, links))
        return (folder for known, folder in self._inside[root] if known == name)


def is_file(path: Path) -> bool:
    """Whether there is such a file; names that are too long or hold a NUL are none, nor is what may not be read."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _folder(path: Path) -> list[Path]:
    try:
        return [path] if path.is_dir() else []
    except (OSError, ValueError):
        return []


def _is_top(folder: Path) -> bool:
    """Whether a folder is the user's home, the root of the file system, or right below it."""
    home = Path(os.path.expanduser("~"))  # Path.home() raises for a user without one
    return folder == home or folder.parent == Path(folder.anchor)


def _package_name(folder: Path) -> str | None:
    """The name in the folder's package.xml, None if it has none."""
    try:
        with (folder / "package.xml").open(errors="replace") as file:
            names = [found[1] for found in _NAME.finditer(file.read(100_000)) if found[1]]
    except OSError:
        return None
    return names[0] if names else None


def _packages_in(root: Path, links: bool) -> Iterator[tuple[str, Path]]:
    """The packages in a folder by name, level by level; a package contains no other."""
    level = [root]
    for _ in range(_DEEP + 1):
        below: list[Path] = []
        for folder in level:
            name = _package_name(folder)
            if name is not None:
                yield name, folder
            elif len(below) < _MOST_FOLDERS:
                below += _folders(folder, links)
        level = below


def _folders(folder: Path, links: bool) -> list[Path]:
    """The folders in a folder that may be read, without hidden ones."""
    found: list[Path] = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name[0] != "." and (links or not entry.is_symlink()):
                    found += _folder(Path(entry.path))
    except OSError:
        return sorted(found)
    return sorted(found)
