"""The options of a command as they were typed: what messages call them, and `~` in the paths among them."""

import dataclasses
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_type_hints

import tyro


def with_home(options: Any) -> Any:
    """The options with `~` at the beginning of every text and path replaced by the home folder.

    A shell does so only where the word begins with it, without quotation marks: not in --out=~/x nor in "~/x".
    """
    changed = {
        entry.name: _with_home(getattr(options, entry.name)) for entry in dataclasses.fields(options) if entry.init
    }
    return dataclasses.replace(options, **changed)


def _with_home(value: Any) -> Any:
    if isinstance(value, str):
        return os.path.expanduser(value)
    if isinstance(value, Path):
        return Path(os.path.expanduser(value))
    if isinstance(value, tuple):
        return tuple(map(_with_home, value))
    return with_home(value) if dataclasses.is_dataclass(value) else value


def flags(options: Any) -> dict[str, str]:
    """How each option is typed, by its name: --data, or ROBOT for one that is given by its place.

    Those of the arm are left out: a setting of the work may have the name of one.
    """
    own = {entry.name for entry in dataclasses.fields(options)}
    return {name: flag for name, flag in _named(options) if name in own}


def given(options: Any) -> dict[str, str]:
    """The option that each text or path was given to; a text that was given to several stands for the first."""
    named, found = dict(_named(options)), dict[str, str]()
    for name, value in _values(options).items():
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, str | Path) and str(text) != ".":
                found.setdefault(str(text), named[name])
    return found


def _named(options: Any) -> Iterator[tuple[str, str]]:
    hints = get_type_hints(type(options), include_extras=True)
    for entry in dataclasses.fields(options):
        inner = getattr(options, entry.name)
        if dataclasses.is_dataclass(inner):  # its options have no prefix
            yield from _named(inner)
            continue
        told = getattr(hints[entry.name], "__metadata__", ())
        metavar = next((x.metavar for x in told if getattr(x, "metavar", None)), entry.name.upper())
        yield entry.name, metavar if tyro.conf.Positional in told else f"--{entry.name.replace('_', '-')}"


def _values(options: Any) -> Mapping[str, Any]:
    values = {entry.name: getattr(options, entry.name) for entry in dataclasses.fields(options)}
    inner = [value for value in values.values() if dataclasses.is_dataclass(value)]
    plain = {name: value for name, value in values.items() if not dataclasses.is_dataclass(value)}
    return plain | {name: value for part in inner for name, value in _values(part).items()}
