"""How a message names an option: as an argument in Python, as a flag in the shell.

An error of the library reaches its reader at one of two doors, and its remedy must be one that can be typed there.
"""

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

_FLAGS = {"xacro_args": "--arg", "package_dirs": "--package-dir"}
"""Flags that are not called like the argument: they are given once for each value."""
_OFF = {"degrees": "--radians"}
"""Flags that stand for False."""


class _Blank(str):
    """Three dots, without quotation marks wherever they stand."""

    def __repr__(self) -> str:
        return str(self)


BLANK = _Blank("…")
"""A value that the reader knows."""
_doors = ["python"]


def option(name: str, value: Any) -> str:
    """`name` with a value, as the reader types it: lock=['elbow'] in Python, --lock elbow in the shell.

    In the shell, lists are separated by commas, and mappings are written as in name:=value for arguments of xacro and
    as in elbow.effort=50 for limits.
    """
    if _doors[-1] == "python":
        return f"{name}={value!r}"
    if value is False:
        return _OFF[name]
    flag = _FLAGS.get(name, f"--{name.replace('_', '-')}")
    if name == "xacro_args":
        values = {"NAME": "VALUE"} if value == BLANK else value
        return " ".join(f"{flag} {_quoted(f'{key}:={item}')}" for key, item in values.items())
    if value is True:
        return flag
    typed = _quoted(_typed(value))
    return f"{flag}={typed}" if typed.startswith("-") else f"{flag} {typed}"


def argument(function: str, name: str) -> str:
    """What a message calls an argument: "simulate: duration" in Python, "duration" in the shell."""
    return f"{function}: {name}" if _doors[-1] == "python" else name.replace("_", " ")


@contextmanager
def at_the_shell() -> Iterator[None]:
    """Within this context, messages name flags of the shell."""
    _doors.append("shell")
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
                parts += [f"{name}.{key}={x}" for key, x in item.items()]
            else:
                parts.append(f"{name}={item}" if item else name)
        return ",".join(parts)
    return ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
