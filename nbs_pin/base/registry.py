"""Implementations known by name, imported when they are asked for."""

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
        """The class or function, its module imported."""
        return resolve_name(self.place)

    def make(self, *arguments: Any, **settings: Any) -> Any:
        """Calls it with the settings of the name and with those given here that it takes."""
        function = self.load()
        known = inspect.signature(function).parameters
        taken = {name: value for name, value in settings.items() if name in known}
        return function(*arguments, **self.settings, **taken)


def entry(kind: str, name: str, table: Mapping[str, Entry], more: str = "") -> Entry:
    """The entry of that name.

    Args:
        kind: What the table lists, as the error names it.
        name: The name asked for.
        table: Entries by name.
        more: What else the caller accepts, appended to the error.

    Raises:
        ArgumentError: For a name that is not in the table; it lists the names and the nearest one.
    """
    if name not in table:
        near = difflib.get_close_matches(name, table, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ArgumentError(f"{kind} '{name}' is unknown; {hint}choose one of {', '.join(table)}{more}.")
    return table[name]
