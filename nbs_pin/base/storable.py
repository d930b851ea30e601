"""How controllers, models and their parts are stored: each class says where its constructor's arguments are found.

`storage/descriptions.py` turns an object into settings for JSON and tensors by these recipes, and back.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import numpy as np

from nbs_pin.base.exceptions import ArgumentError

_Class = TypeVar("_Class", bound=type)
Attributes: TypeAlias = Mapping[str, str] | Sequence[str]
"""Arguments and the attributes that hold them, or just the arguments whose attributes have their names."""


class Tensors(dict[str, Any]):
    """Tensors of a `state_dict` by name; asking for one that is not there raises ArgumentError."""

    def __missing__(self, name: str) -> Any:
        raise ArgumentError(f"there is no tensor '{name}'")

    def below(self, prefix: str) -> "Tensors":
        """Those whose names begin with the prefix, named without it."""
        return Tensors({name.removeprefix(prefix): x for name, x in self.items() if name.startswith(prefix)})

    def widths(self, stem: str) -> tuple[int, ...]:
        """Sizes of the hidden layers; the weights of the layers are named stem0, stem1 and so on."""
        count = sum(name.startswith(stem) for name in self)
        return tuple(len(self[f"{stem}{i}"]) for i in range(count))[:-1]


@dataclass(frozen=True)
class Recipe:
    """Where the arguments of a constructor come from."""

    make: Callable[..., Any]
    settings: Mapping[str, str]
    """Arguments stored as they are, and the attributes that hold them."""
    parts: Mapping[str, str]
    """Arguments that are parts or None, and the attributes that hold them."""
    arrays: Callable[[Tensors], Mapping[str, Any]]
    """Arguments that are found among the part's tensors."""
    sequence: Callable[[list[Any]], Any]
    """What a stored list is handed over as."""


RECIPES: dict[str, Recipe] = {}
"""Recipes by the name of the class, for the classes whose modules have been imported."""


def storable(
    settings: Attributes = (),
    parts: Attributes = (),
    arrays: Callable[[Tensors], Mapping[str, Any]] = lambda tensors: {},
    sequence: Callable[[list[Any]], Any] = np.array,
) -> Callable[[_Class], _Class]:
    """Class decorator: objects of exactly this class can be stored in files.

    Args:
        settings: Arguments of the constructor that JSON can hold: numbers, text, lists, mappings, arrays.
        parts: Arguments that are storable objects themselves, or None.
        arrays: Arguments made from the tensors of the object's `state_dict`.
        sequence: What a stored list is handed to the constructor as.
    """

    def register(cls: _Class) -> _Class:
        RECIPES[cls.__name__] = Recipe(cls, _named(settings), _named(parts), arrays, sequence)
        return cls

    return register


def _named(attributes: Attributes) -> Mapping[str, str]:
    return attributes if isinstance(attributes, Mapping) else {name: name for name in attributes}
