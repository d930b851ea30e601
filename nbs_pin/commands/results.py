"""Result folders of commands: the facts that determine their contents, and how they are shown."""

import contextlib
import dataclasses
import hashlib
import inspect
import os
import re
import shlex
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from nbs_pin.base.doors import typed_command
from nbs_pin.base.files import replaced_together
from nbs_pin.base.picture_kinds import svg_beside
from nbs_pin.base.summaries import REPORT, SUMMARY, summary_in, summary_text
from nbs_pin.base.versions import versions
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.values import OptionError
from nbs_pin.robots.robot import Robot

_MOST_FOLDERS = 1000
_NO_SETTINGS = ("out", "resume", "force", "verbose", "report", "svg")


@dataclass(frozen=True)
class Results:
    """The folder of a command's results, and the facts that determine them."""

    folder: Path
    facts: dict[str, Any]
    """Settings, versions and the arm's fingerprint, which are equal for identical runs."""
    is_default: bool = False
    """Whether the folder was not given, so that another may be taken."""
    report: bool = False
    """Whether `show` is to write the page of `nbs_pin.reports.report` too."""
    inputs: frozenset[Path] = frozenset()
    """The files that the command reads; none of them is removed, and `check` refuses to replace one."""
    forced: bool = False
    """Whether results of other commands may be replaced."""

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
        facts = {"settings": settings_of(options, **resolved), "versions": versions(), **sha256}
        report = isinstance(options, Reported) and options.report
        return cls(folder, facts, options.out is None, report, frozenset(_files_in(dataclasses.asdict(options))))

    def check(
        self,
        names: Sequence[str],
        force: bool,
        *,
        whole: Mapping[str, Any] | None = None,
        whose: str = "another run",
        remedy: str = "give another --out",
        unfinished: str = "",
    ) -> "Results":
        """These results if the folder is free for them, or else, unless it was given, in the next of NAME-2, NAME-3, ….

        Args:
            names: The files that count as results.
            force: Whether they may be overwritten.
            whole: Entries that summary.json must have besides the facts.
            whose: Name of other results in the error.
            remedy: Advice in the error besides --force.
            unfinished: File of work that could be continued; no other folder is taken in its place.

        Raises:
            OptionError: If the folder that was given is a file, holds results of another run or, even with --force, a
                result of the same name that the command reads.
        """
        same = self.facts | dict(whole or {})
        for k in range(1, _MOST_FOLDERS):
            folder = self.folder if k == 1 else self.folder.with_name(f"{self.folder.name}-{k}")
            if folder.exists() and not folder.is_dir():
                raise OptionError(f"--out '{folder}' is a file; give a folder.")
            read = [folder / name for name in names if (folder / name).resolve() in self.inputs]
            if read and self.is_default:
                continue
            if read:
                raise OptionError(f"'{read[0]}' is read here and would be replaced; give another --out.")
            present = [name for name in names if (folder / name).exists()]
            summary = summary_in(folder)
            if not present or force or {key: summary.get(key) for key in same} == same:
                return replace(self, folder=folder, forced=force)
            # Results without a readable summary are another run's, or those of one that was stopped.
            stopped = unfinished in present and {key: summary.get(key, self.facts[key]) for key in self.facts}
            if not self.is_default or stopped == self.facts:
                break
        raise OptionError(f"'{folder}' holds {present[0]} of {whose}; {remedy}, or --force to replace it.")

    def held(self, name: str) -> "Results":
        """These results in the folder, of those that `check` may have taken, that holds the file and these facts."""
        for k in range(2, _MOST_FOLDERS) if self.is_default else ():
            folder = self.folder.with_name(f"{self.folder.name}-{k}")
            if not folder.exists():
                break
            if (folder / name).exists() and {key: summary_in(folder).get(key) for key in self.facts} == self.facts:
                return replace(self, folder=folder)
        return self

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

    @contextlib.contextmanager
    def replaced(self, names: Sequence[str], figures: Mapping[str, Any], **more: Any) -> Iterator[Path]:
        """A folder for the new results that are data, which take the place of all those in `names` when the block ends.

        summary.json is added with the facts, the figures and further entries. Whenever the process ends, the files of
        those names in the folder, and with --force those that a summary.json before named, belong to one run, but for
        files that the command reads. Pictures are drawn afterwards, within `drawing`.
        """
        files = [*names, *(str(svg_beside(name)) for name in names if name.endswith(".png"))]
        old = [SUMMARY, REPORT, *files, *self._files_before(files)]
        old = [name for name in old if (self.folder / name).resolve() not in self.inputs]
        with replaced_together(self.folder, old) as draft:
            yield draft
            typed = {"command": typed_command()} if typed_command() else {}
            summary = summary_text(self.facts | typed | more | {"files": files, "figures": figures})
            (draft / SUMMARY).write_text(summary, encoding="utf-8")
            old += [name for name in files if name not in old and (draft / name).exists()]  # `check` allowed it

    def _files_before(self, files: Sequence[str]) -> list[str]:
        """What else the summary.json in the folder names as results, of another command perhaps."""
        named = summary_in(self.folder).get("files") if self.forced else None
        plain = [x for x in named if isinstance(x, str) and x == Path(x).name] if isinstance(named, list) else []
        return [x for x in plain if x not in (SUMMARY, REPORT, *files) and (self.folder / x).is_file()]

    def show(self, console: Console, names: Sequence[str], *following: str | Path) -> None:
        """Print the paths of the results that exist, one per line, and the arguments of a command to go on with.

        The report is written before, if it is wanted, within `drawing`.
        """
        if self.report:
            from nbs_pin.reports.report import report  # which loads the drawing of arms

            with drawing(self.folder / REPORT) as path:
                report([self.folder], path)
        drawn = (str(svg_beside(name)) for name in names if name.endswith(".png"))
        for name in (*names, *drawn, REPORT):
            if (self.folder / name).exists():
                console.print(str(self.folder / name), soft_wrap=True, highlight=False, markup=False)
        if following:
            console.print(next_step(*following), soft_wrap=True, highlight=False, markup=False)


def page_file(out: Path | None, usual: Path, *, force: bool, is_own: bool = True) -> Path:
    """The page to write, `usual` without --out; is_own: whether the usual one may be replaced.

    Raises OptionError for a folder, a name that browsers do not take for a page, and a file without --force.
    """
    page = out or usual
    if page.is_dir():
        raise OptionError(f"--out '{page}' is a folder; give a file such as '{page / usual.name}'.")
    if page.suffix.lower() not in (".html", ".htm"):
        raise OptionError(f"--out '{page}' is no name of a page; give one that ends in .html.")
    if not (out is None and is_own) and page.exists() and not force:
        raise OptionError(f"'{page}' exists; give another --out, or --force to replace it.")
    return page


def next_step(*arguments: str | Path) -> str:
    """The line that names the next command, as it can be typed."""
    return f"next: nbs-pin {shlex.join(map(str, arguments))}"


def tell(
    console: Console, verdict: str, lines: Iterable[str] = (), tables: Iterable[Table] = (), *, verbose: bool
) -> None:
    """Print the verdict, the tables if the user wants them, and the lines that qualify the verdict."""
    console.print(Text(verdict, style="bold"), soft_wrap=True)
    for shown in tables if verbose else ():
        console.print(shown)
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


@contextlib.contextmanager
def drawing(path: Path) -> Iterator[Path]:
    """Around the drawing of a picture of results that are already written: they outlive whatever goes wrong in it.

    A fault of the drawing is told in a warning; an OSError, as for a full disk, goes on.
    """
    try:
        yield path
    except OSError:
        raise
    except Exception as error:  # drawing libraries may raise any exception
        message = f"'{path}' was not drawn ({type(error).__name__}: {error!s:.500}); the other results are whole."
        warnings.warn(message, stacklevel=3)


def _files_in(values: Any) -> Iterator[Path]:
    """The files that values name, at any depth."""
    if isinstance(values, Mapping):
        values = values.values()
    if isinstance(values, str | Path):
        if os.path.isfile(values):  # which takes names of any length
            yield Path(values).resolve()
    elif isinstance(values, Iterable):
        for value in values:
            yield from _files_in(value)


def settings_of(options: Any, **resolved: Any) -> dict[str, Any]:
    """Everything that determines a command's results, as JSON can store it; files by name and SHA-256."""
    settings = {name: value for name, value in dataclasses.asdict(options).items() if name not in _NO_SETTINGS}
    for group in (name for name in settings if dataclasses.is_dataclass(getattr(options, name))):
        settings[group] = getattr(options, group).given()
    for name, value in list(settings.items()):
        if name not in resolved and isinstance(value, str | Path):
            settings[name] = str(value)
            if Path(value).is_file():
                settings[f"{name}_sha256"] = sha256_of(Path(value))
    return settings | resolved


def sha256_of(file: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def keywords(options: Any, function: Callable[..., Any]) -> dict[str, Any]:
    """The options that are keyword arguments of the function."""
    return {
        name: getattr(options, name)
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.kind is parameter.KEYWORD_ONLY and name in vars(options)
    }


def titled(title: str, *, heads: bool = True) -> Table:
    """A table without columns, in the style of all tables."""
    return Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", title_style="bold", show_header=heads)


def table(title: str, *headings: str, first: str = "joint") -> Table:
    """A table with one column of text, which may wrap, and columns of numbers."""
    made = titled(title)
    made.add_column(first, overflow="fold")
    for heading in headings:
        made.add_column(Text(heading), justify="right", no_wrap=True)
    return made
