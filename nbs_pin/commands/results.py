"""Result folders of commands: the facts that determine their contents, and how they are shown."""

import contextlib
import dataclasses
import hashlib
import inspect
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.files import write_whole
from nbs_pin.base.versions import versions
from nbs_pin.cli.values import OptionError
from nbs_pin.robots.robot import Robot

SUMMARY = "summary.json"
_NO_SETTINGS = ("out", "resume", "force")


@dataclass(frozen=True)
class Results:
    """The folder of a command's results, and the facts that determine them."""

    folder: Path
    facts: dict[str, Any]
    """Settings, versions and the arm's fingerprint, which are equal for identical runs."""

    @classmethod
    def of(cls, options: Any, name: str, robot: Robot | None, /, **resolved: Any) -> "Results":
        """The folder that the options give, or out/COMMAND-NAME.

        Args:
            options: The command's options; all are settings, except for the folder and its treatment.
            name: Name of the results, usually the arm's.
            robot: The arm, or None.
            resolved: Settings that were computed; they replace the options of the same names.
        """
        command = type(options).__name__.lower()
        folder = options.out or Path("out") / f"{command}-{re.sub(r'[^A-Za-z0-9_.-]', '_', name)}"
        sha256 = {} if robot is None else {"robot_sha256": robot.sha256}
        return cls(folder, {"settings": settings_of(options, **resolved), "versions": versions(), **sha256})

    def check(
        self,
        names: Sequence[str],
        force: bool,
        *,
        whole: Mapping[str, Any] | None = None,
        whose: str = "another run",
        remedy: str = "give another --out",
    ) -> None:
        """Raises OptionError if the folder holds results of another run.

        Args:
            names: The files that count as results.
            force: Whether they may be overwritten.
            whole: Entries that summary.json must have besides the facts.
            whose: Name of other results in the error.
            remedy: Advice in the error besides --force.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise OptionError(f"--out '{self.folder}' is a file; give a folder.")
        present = [name for name in names if (self.folder / name).exists()]
        if not present or force:
            return
        summary, same = summary_in(self.folder), self.facts | dict(whole or {})
        if {key: summary.get(key) for key in same} != same:  # results without a readable summary are another run's
            raise OptionError(f"'{self.folder}' holds {present[0]} of {whose}; {remedy}, or --force to replace it.")

    @contextlib.contextmanager
    def made(self) -> Iterator[Path]:
        """The folder, created before any long work so that a bad path fails at once; removed if it stays empty."""
        new = [path for path in (self.folder, *self.folder.parents) if not path.exists()]
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            yield self.folder
        finally:
            for path in new:
                if path.is_dir() and not any(path.iterdir()):
                    path.rmdir()

    def write_summary(self, figures: Mapping[str, Any], **more: Any) -> Path:
        """Write summary.json with the facts, the figures and further entries, all as JSON can store them."""
        return write_whole(self.folder / SUMMARY, summary_text(self.facts | more | {"figures": figures}).encode())

    def show(self, console: Console, names: Iterable[str]) -> None:
        """Print the paths of the results, one per line."""
        for name in names:
            console.print(str(self.folder / name), soft_wrap=True, highlight=False, markup=False)


def settings_of(options: Any, **resolved: Any) -> dict[str, Any]:
    """Everything that determines a command's results, as JSON can store it; files by name and SHA-256."""
    settings = {name: value for name, value in dataclasses.asdict(options).items() if name not in _NO_SETTINGS}
    if "arm" in settings:
        settings["arm"] = options.arm.given()
    for name, value in list(settings.items()):
        if name not in resolved and isinstance(value, str | Path):
            settings[name] = str(value)
            if Path(value).is_file():
                settings[f"{name}_sha256"] = sha256_of(Path(value))
    return settings | resolved


def sha256_of(file: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def summary_text(summary: Mapping[str, Any]) -> str:
    """A summary as the text of summary.json."""
    return json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def summary_in(folder: Path) -> dict[str, Any]:
    """The content of summary.json in the folder, empty if it cannot be read."""
    try:
        summary = json.loads((folder / SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return summary if isinstance(summary, dict) else {}


def keywords(options: Any, function: Callable[..., Any]) -> dict[str, Any]:
    """The options that are keyword arguments of the function."""
    return {
        name: getattr(options, name)
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY and name in vars(options)
    }


def table(title: str, *headings: str, first: str = "joint") -> Table:
    """A table with one column of text, which may wrap, and columns of numbers."""
    made = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")
    made.add_column(first, overflow="fold")
    for heading in headings:
        made.add_column(Text(heading), justify="right", no_wrap=True)
    return made
