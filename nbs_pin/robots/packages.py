"""Where ROS packages lie: the same look-up for `$(find …)` of xacro files and for `package://` of meshes."""

import os
import re
from collections.abc import Iterable, Iterator
from functools import cached_property
from itertools import islice
from pathlib import Path

from nbs_pin.robots.catalogue import example_robot_share

_NAME = re.compile(r"<name>\s*([^<]*?)\s*</name>")
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
    have the name but no package.xml. Nothing is remembered between two instances, so that one file gives one answer.
    """

    def __init__(self, file: Path, package_dirs: Iterable[str | Path] = ()) -> None:
        self.file = file.resolve()
        self.given = tuple(Path(folder).expanduser().resolve() for folder in package_dirs)
        self._found: dict[str, Path | None] = {}

    @cached_property
    def around(self) -> Path:
        """The nearest folder above the file that is a package; else the file's own, or the one above `urdf`."""
        own = self.file.parent
        package = next((folder for folder in self.file.parents if (folder / "package.xml").is_file()), None)
        return package or (own.parent if own.name.lower() in _INNER else own)

    def find(self, name: str) -> Path | None:
        """The folder of the package, None if there is none."""
        if name not in self._found:
            self._found[name] = next(self._candidates(name), None)
        return self._found[name]

    def assume(self) -> Path | None:
        """The folder of a package that is not found but may be the file's own: `around`, unless that has a name."""
        return None if (self.around / "package.xml").is_file() else self.around

    def _candidates(self, name: str) -> Iterator[Path]:
        if not name or "/" in name or "\\" in name or name in (".", ".."):
            return
        for folder in self.given:
            yield from (folder for _ in range(folder.name == name))
            yield from _named(name, _packages_in([folder]))
            yield from (folder / name for _ in range((folder / name).is_dir()))
        yield from (folder for folder in self.file.parents if _package_name(folder) == name)
        for above in self._near():
            yield from _named(name, _packages_in([above]))
        for variable, inner in (("ROS_PACKAGE_PATH", ""), ("AMENT_PREFIX_PATH", "share")):
            folders = [Path(text) / inner for text in os.environ.get(variable, "").split(os.pathsep) if text]
            yield from (folder / name for folder in folders if (folder / name / "package.xml").is_file())
            yield from _named(name, _packages_in(folders))
        for folder in (*self.file.parents[:_ABOVE], self.around.parent, example_robot_share()):
            yield from (folder for _ in range(folder.name == name))
            yield from (folder / name for _ in range((folder / name).is_dir()))

    def _near(self) -> list[Path]:
        """Folders above the package, up to the user's home, a mount point or the root of the file system."""
        near: list[Path] = []
        for folder in self.around.parents[:_ABOVE]:
            if folder == Path.home() or folder == Path(folder.anchor) or folder.parent == Path(folder.anchor):
                break
            near.append(folder)
        return near


_INNER = ("urdf", "urdfs", "xacro")
"""Folders of a package that usually hold descriptions."""


def _named(name: str, packages: Iterable[Path]) -> Iterator[Path]:
    return (folder for folder in packages if _package_name(folder) == name)


def _package_name(folder: Path) -> str | None:
    """The name in the folder's package.xml, None if it has none."""
    try:
        found = _NAME.search((folder / "package.xml").read_text(errors="replace")[:100_000])
    except OSError:
        return None
    return found[1] if found else None


def _packages_in(roots: Iterable[Path]) -> Iterator[Path]:
    """The packages at most `_DEEP` levels below the roots, level by level; a package contains no other."""
    level = list(roots)
    for _ in range(_DEEP + 1):
        below: list[Path] = []
        for folder in level:
            if (folder / "package.xml").is_file():
                yield folder
            else:
                below += islice(_folders(folder), _MOST_FOLDERS - len(below))
        level = below


def _folders(folder: Path) -> Iterator[Path]:
    try:
        inside = sorted(entry.path for entry in os.scandir(folder) if entry.is_dir() and entry.name[0] != ".")
    except OSError:
        return iter(())
    return map(Path, inside)
