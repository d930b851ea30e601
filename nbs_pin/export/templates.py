"""The texts of the package, with @NAMES@ in place of what an arm and its law fill in."""

import re
from collections.abc import Mapping
from pathlib import Path

_FOLDER = Path(__file__).parent / "templates"


def filled(template: str, words: Mapping[str, object]) -> str:
    """The text of a template, every @NAME@ of it replaced."""
    text = (_FOLDER / f"{template}.in").read_text(encoding="utf-8")
    return re.sub(r"@([A-Z0-9_]+)@", lambda found: str(words[found[1]]), text)
