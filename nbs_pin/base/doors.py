"""How a message names an option: as an argument in Python, as a flag in the shell.

An error of the library reaches its reader at one of two doors, and its remedy must be one that can be typed there.
"""

import os
import shlex
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

_FLAGS = {"xacro_args": "--arg", "package_dirs": "--package-dir"}
"""Flags that are not called like the argument: they are given once for each value."""
_OFF = {"degrees": "--radians"}
"""Flags that stand for False."""


class _Blank(str):
    """Three dots, without quotation marks wherever they stand."""

    def __repr__(self) -> str:
        return str(self)


class _Shell(NamedTuple):
    """The command that was typed."""

    flags: Mapping[str, str]
    """By the name of each option, how it is typed: --data, or ROBOT of what is given by its place."""
    given: Mapping[str, str]
    """By each text that was typed, the option that it was given to."""
    command: str = ""
    """All of it, as one line of the shell."""


BLANK = _Blank("…")
"""A value that the reader knows."""
_doors: list[_Shell | None] = [None]


def option(name: str, value: Any) -> str:
    """`name` with a value, as the reader types it: lock=['elbow'] in Python, --lock elbow in the shell.

    In the shell, lists are separated by commas, and mappings are written as in name:=value for arguments of xacro and
    as in elbow.effort=50 for limits.
    """
    shell = _doors[-1]
    if shell is None:
        return f"{name}={value!r}"
    if value is False:
        return _OFF[name]
    flag = _FLAGS.get(name, shell.flags.get(name, f"--{name.replace('_', '-')}"))
    if name == "xacro_args":
        values = {"NAME": "VALUE"} if value == BLANK else value
        return " ".join(f"{flag} {_quoted(f'{key}:={item}')}" for key, item in values.items())
    if value is True:
        return flag
    typed = _quoted(_typed(value))
    return f"{flag}={typed}" if typed.startswith("-") else f"{flag} {typed}"


def own_arm() -> str:
    """How the reader gives an arm in place of the one that a file names: robot=load_robot(…), or --robot ROBOT.

    Some commands call it --against.
    """
    shell = _doors[-1]
    if shell is None:
        return "robot=load_robot(…)"
    flag = next((shell.flags[name] for name in ("robot", "against") if name in shell.flags), "--robot")
    return f"{flag} ROBOT" if flag.startswith("-") else flag


def as_loaded(source: str, options: Mapping[str, Any]) -> str:
    """An arm with the options of `load_robot` as the reader gives it: panda --lock finger in the shell."""
    stated = {name: value for name, value in options.items() if value not in (False, None, {})}
    told = [option(name, value) for name, value in stated.items()]
    if _doors[-1] is None:
        return f"load_robot({', '.join([repr(source), *told])})"
    return " ".join([_quoted(source), *told])


def where_printed(*, python: str, shell: str) -> str:
    """The words for the door at which the message is printed, where `option` cannot say it at both."""
    return python if _doors[-1] is None else shell


def in_words(thing: Any, words: str) -> str:
    """What a message calls an object: its repr in Python, the words in the shell."""
    return where_printed(python=repr(thing), shell=words)


def names_of(options: Iterable[str]) -> list[str]:
    """What a message calls arguments: by name in Python; in the shell as they are typed, those that the command has."""
    shell = _doors[-1]
    return list(options) if shell is None else [shell.flags[name] for name in options if name in shell.flags]


def typed_command() -> str:
    """The command that was typed in the shell, empty in Python."""
    return _doors[-1].command if _doors[-1] is not None else ""


def argument(function: str, name: str, value: Any = None) -> str:
    """What a message calls an argument with that value.

    In Python "simulate: duration". In the shell it is the option that the value, or the folder of the file that it
    names, was given to, or the one of that name, or else the plain name.
    """
    shell = _doors[-1]
    if shell is None:
        return f"{function}: {name}"
    if isinstance(value, str | os.PathLike) and isinstance(os.fspath(value), str):
        for text in (os.fspath(value), str(Path(value).parent)):
            if text in shell.given:
                return shell.given[text]
    return _FLAGS.get(name, shell.flags.get(name, name.replace("_", " ")))


@contextmanager
def at_the_shell(
    flags: Mapping[str, str] | None = None, given: Mapping[str, str] | None = None, command: Iterable[str] = ()
) -> Iterator[None]:
    """Within this context, messages name flags of the shell.

    Args:
        flags: By the name of each option of the command, how it is typed.
        given: By each text that was typed, the option that it was given to.
        command: All words that were typed.
    """
    _doors.append(_Shell(flags or {}, given or {}, shlex.join(command)))
    try:
        yield
    finally:
        _doors.pop()


def _quoted(text: str) -> str:
    """The text as one word of the shell; dots that stand for a value are left as they are."""
    plain = text.replace(BLANK, "x").replace("*", "x" if BLANK in text else "*")
    return text if shlex.quote(plain) == plain else shlex.quote(text)


def _typed(value: Any) -> str:
    if isinstance(value, Mapping):
        parts: list[str] = []
        for name, item in value.items():
            if isinstance(item, Mapping):
                parts += [f"{name}.{key}={'inf' if x is None else x}" for key, x in item.items()]
            else:
                parts.append(f"{name}={item}" if item else name)
        return ",".join(parts)
    return ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
