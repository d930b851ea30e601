"""Registry of the classes whose code the proofs rely on.

A proof is about the code of one class, and does not apply to a subclass, which may override a method, nor to an object
with a replaced method.
"""

from collections.abc import Iterable
from typing import Any, TypeVar

_Class = TypeVar("_Class", bound=type)
_KNOWN: set[type] = set()
_HOOKS = ("_forward_hooks", "_forward_pre_hooks")


def known_code(cls: _Class) -> _Class:
    """Class decorator: proofs may rely on the code of exactly this class."""
    _KNOWN.add(cls)
    return cls


def defines(part: Any, method: str) -> bool:
    """Whether exactly the class of `part` defines a method or property, as one that packs numbers for a kernel.

    A subclass that inherits it may compute something else, so the kernel is not its own.
    """
    return method in vars(type(part))


def foreign_code(part: Any) -> str:
    """Why the code of `part` may not be the known one (its class, a replaced method or a hook); empty if it is."""
    kind = type(part)
    if kind not in _KNOWN:
        return f"the code of {kind.__name__} is not known"
    own = getattr(part, "__dict__", {})
    replaced = sorted(n for n in own if callable(own[n]) and callable(getattr(kind, n, None)))
    hooks = [name.strip("_") for name in _HOOKS if own.get(name)]
    return f"'{(replaced + hooks)[0]}' of this {kind.__name__} was replaced" if replaced + hooks else ""


def first_foreign(parts: Iterable[Any]) -> str:
    """The first reason that `foreign_code` gives for one of the parts, empty if there is none."""
    return next((why for why in map(foreign_code, parts) if why), "")
