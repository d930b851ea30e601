"""Lets mkdocstrings read our docstrings: Google's style calls the section `Example:`, griffe knows `Examples:`."""

import re
from typing import Any

import griffe


class OneExample(griffe.Extension):
    """Renames the section, so that its lines are shown as code."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for every module, class, function and attribute."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"^Example:$", "Examples:", obj.docstring.value, flags=re.M)
