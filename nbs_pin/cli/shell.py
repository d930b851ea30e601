"""The shell behind `nbs-pin`: one module per command, whose heavy imports wait until it runs."""

import contextlib
import difflib
import io
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Union, cast

import tyro
from rich.console import Console

from nbs_pin import __version__
from nbs_pin.base.doors import at_the_shell
from nbs_pin.base.exceptions import CertificateRefused, NbsPinError
from nbs_pin.base.picture_kinds import svg_too
from nbs_pin.cli.bench import Bench
from nbs_pin.cli.campaign import Campaign
from nbs_pin.cli.certify import Certify
from nbs_pin.cli.challenge import Challenge
from nbs_pin.cli.collect import Collect
from nbs_pin.cli.compare import Compare
from nbs_pin.cli.excite import Excite
from nbs_pin.cli.exit_codes import BAD_INPUT, NO_PROMISE, SIGNALLED
from nbs_pin.cli.export import Export
from nbs_pin.cli.export_run import ExportRun
from nbs_pin.cli.faults import Faults
from nbs_pin.cli.learn import Learn
from nbs_pin.cli.log import Log
from nbs_pin.cli.replay import Replay
from nbs_pin.cli.report import Report
from nbs_pin.cli.reported import Reported
from nbs_pin.cli.reproduce import Reproduce
from nbs_pin.cli.robots import Robots
from nbs_pin.cli.run import Run
from nbs_pin.cli.track import Track
from nbs_pin.cli.train import Train
from nbs_pin.cli.typed import flags, given, with_home
from nbs_pin.cli.values import OptionError
from nbs_pin.cli.verify import Verify

COMMANDS: dict[str, type] = {
    "track": Track,
    "campaign": Campaign,
    "train": Train,
    "excite": Excite,
    "collect": Collect,
    "log": Log,
    "learn": Learn,
    "compare": Compare,
    "certify": Certify,
    "verify": Verify,
    "export": Export,
    "replay": Replay,
    "export-run": ExportRun,
    "report": Report,
    "reproduce": Reproduce,
    "run": Run,
    "faults": Faults,
    "challenge": Challenge,
    "bench": Bench,
    "robots": Robots,
}
"""The options class of every command. The module of its name in `nbs_pin.commands`, _ for -, does the work in `run`."""
_DESCRIPTION = (
    "Tracking control for any URDF arm. `nbs-pin COMMAND --help` lists the options of a command, "
    "`nbs-pin --version` prints the version, `nbs-pin --tyro-print-completion bash` (or zsh) a script for completion. "
    "Commands print their verdict first and the tables behind it with -v. "
    "Exit codes: 0 success, 2 bad input, 3 no promise from certify or verify, "
    "4 stopped by the guard or a row of faults not passed, 130 or 143 interrupted."
)


class Output(Console):
    """Standard output, whose reader may close it early."""

    def on_broken_pipe(self) -> None:
        """Let `main` end quietly; rich would exit with code 1."""
        raise BrokenPipeError


def run(arguments: list[str], stops: list[int], begin: Callable[[], Any]) -> int:
    """Run `nbs-pin` with these arguments and return the exit code (`exit_codes.py`).

    After `begin`, which is called when all is imported, Ctrl-C and SIGTERM raise KeyboardInterrupt, so that drafts are
    removed, and add their exit codes to `stops`.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without Greek letters shows ? for them
    notes = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)
    with _warnings_to(notes), at_the_shell():
        try:
            return _run(arguments, notes, stops, begin)
        except BaseException as error:
            # A signal during the import of an extension surfaces as an ImportError, so signals are checked first.
            if stops or isinstance(error, KeyboardInterrupt):
                notes.print("nbs-pin: interrupted.")
                return stops[0] if stops else SIGNALLED + signal.SIGINT
            return _failed(error, notes)


def _failed(error: BaseException, notes: Console) -> int:
    """Print one sentence for an error that the user can correct and return the exit code; re-raise any other."""
    if isinstance(error, NbsPinError):
        notes.print(f"nbs-pin: error: {_one_line(str(error))}")
    elif isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader has closed the pipe
        return 0
    elif isinstance(error, OSError):
        where = f"'{error.filename}': " if error.filename is not None else ""
        reason = (error.strerror or str(error)).lower()
        notes.print(f"nbs-pin: error: {where}{reason}; check the path, its permissions and the free space.")
    else:
        raise error
    return NO_PROMISE if isinstance(error, CertificateRefused) else BAD_INPUT


def _run(arguments: list[str], notes: Console, stops: list[int], begin: Callable[[], Any]) -> int:
    console = Output()
    if arguments == ["--version"]:
        console.print(f"nbs-pin {__version__}", highlight=False)
        return 0
    command = parse(arguments)
    _check_surroundings()
    os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is rendered by MuJoCo, which would look for a window system
    if command is not None:
        with notes.status("loading"):
            body = import_module(f"nbs_pin.commands.{arguments[0].replace('-', '_')}")
        begin()
        if stops:  # a library that is being imported may swallow the interrupt
            raise KeyboardInterrupt
        wanted = isinstance(command, Reported) and command.svg
        with at_the_shell(flags(command), given(command), ["nbs-pin", *arguments]), svg_too(wanted):
            return body.run(command, console, notes) or 0
    return 0


def _check_surroundings() -> None:
    """Raises OptionError for what would make a library print its own words, or end the process."""
    try:
        Path.cwd()
    except OSError as error:
        raise OptionError("the current folder no longer exists; change to one that does.") from error
    threads = os.environ.get("NUMBA_NUM_THREADS", "1")
    if not threads.isdecimal() or not int(threads[:9]) >= 1:
        raise OptionError(
            f"NUMBA_NUM_THREADS is '{threads:.40}' in the environment; give a whole number of at least 1."
        )


def parse(arguments: list[str]) -> Any:
    """The options of the command, None if help was printed; raises OptionError for anything else."""
    if arguments and not arguments[0].startswith("-") and arguments[0] not in COMMANDS:
        raise OptionError(f"no command '{arguments[0]}'; {_near(arguments[0], COMMANDS)}give {', '.join(COMMANDS)}.")
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            command, unknown = tyro.cli(
                cast(Any, Union[tuple(_subcommand(name) for name in COMMANDS)]),  # noqa: UP007
                prog="nbs-pin",
                description=_DESCRIPTION,
                args=arguments,
                config=(tyro.conf.FlagCreatePairsOff,),
                return_unknown_args=True,
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            return None
        raise OptionError(_complained(arguments, _first_paragraph(complaint.getvalue()))) from None
    if unknown:
        groups = [command, *(group for group in vars(command).values() if is_dataclass(group))]
        known = [f"--{name.replace('_', '-')}" for group in groups for name in vars(group)]
        what = "has no option" if unknown[0].startswith("-") else "takes no argument"
        remedy = f"{_near(unknown[0], known)}see nbs-pin {arguments[0]} --help."
        raise OptionError(f"nbs-pin {arguments[0]} {what} '{unknown[0]}'; {remedy}")
    return with_home(command)


def _subcommand(name: str) -> Any:
    return Annotated[COMMANDS[name], tyro.conf.subcommand(name)]


def _near(word: str, words: Iterable[str]) -> str:
    near = difflib.get_close_matches(word.partition("=")[0], words, n=1)
    return f"did you mean {near[0]}? " if near else ""


def _complained(arguments: list[str], said: str) -> str:
    """What tyro complains of, in a sentence that names the page of help to read."""
    if not arguments or arguments[0] not in COMMANDS:
        given = f"no command is called '{arguments[0]}'" if arguments else "no command was given"
        hint = _near(arguments[0], ("--help", "--version")) if arguments else ""
        return f"{given}; {hint}give one of {', '.join(COMMANDS)}, or see nbs-pin --help."
    bare = re.fullmatch(r"Missing value for argument '(.*?)'\. Expected .* values", said)
    return f"{f'{bare[1]} was given no value' if bare else said}; see nbs-pin {arguments[0]} --help."


def _first_paragraph(box: str) -> str:
    """The text in tyro's error box before its first rule, as one line; where it draws no box, its title is left out."""
    inside = [line.strip("│ ") for line in box.splitlines() if not line.startswith(("╭", "╰"))]
    parts = re.split(r"\n(?:─+|-{3,})\n", "\n".join(inside))
    titled = len(parts) > 1 and not box.lstrip().startswith("╭")
    return _one_line(parts[1 if titled else 0]).rstrip(".")


def _one_line(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()


@contextlib.contextmanager
def _warnings_to(notes: Console) -> Iterator[None]:
    """Print warnings as one line each, without deprecations, which address the authors of a library."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        warnings.showwarning = lambda message, *_, **__: notes.print(f"nbs-pin: warning: {_one_line(str(message))}")
        yield
