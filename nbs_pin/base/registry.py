"""Implementations registered by name and imported on first use."""

import difflib
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from pkgutil import resolve_name
from typing import Any

from nbs_pin.base.exceptions import ArgumentError


@dataclass(frozen=True)
class Entry:
    """Where an implementation is defined, and the settings that its name implies."""

    place: str
    """`package.module:Class`, `package.module:function` or `package.module:Class.method`."""
    settings: Mapping[str, Any] = field(default_factory=dict)

    def load(self) -> Any:
        """Import the module and return the class or function."""
        return resolve_name(self.place)

    def make(self, *arguments: Any, **settings: Any) -> Any:
        """Call it with the settings of the entry and those of `settings` that it accepts."""
        function = self.load()
        known = inspect.signature(function).parameters
        taken = {name: value for name, value in settings.items() if name in known}
        return function(*arguments, **self.settings, **taken)


def entry(kind: str, name: str, table: Mapping[str, Entry], more: str = "") -> Entry:
    """The entry with the given name.

    Args:
        kind: What the table lists, for the error message.
        name: The name to look up.
        table: Entries by name.
        more: Other accepted input, appended to the error message.

    Raises:
        ArgumentError: If the name is not in the table; lists the names and suggests the nearest one.
    """
    if name not in table:
        near = difflib.get_close_matches(name, table, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ArgumentError(f"{kind} '{name}' is unknown; {hint}choose one of {', '.join(table)}{more}.")
    return table[name]
