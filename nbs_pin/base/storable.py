"""Recipes for storing controllers, models and their parts: where each class keeps its constructor arguments.

`storage/descriptions.py` uses them to convert an object to JSON settings and tensors, and back.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

import numpy as np

from nbs_pin.base.exceptions import ArgumentError

_Class = TypeVar("_Class", bound=type)
Attributes: TypeAlias = Mapping[str, str] | Sequence[str]
"""Constructor arguments and the attributes that hold them, or only the names where both are equal."""


class Tensors(dict[str, Any]):
    """Tensors of a `state_dict` by name; a missing name raises ArgumentError."""

    def __missing__(self, name: str) -> Any:
        raise ArgumentError(f"there is no tensor '{name}'")

    def below(self, prefix: str) -> "Tensors":
        """The tensors whose names begin with the prefix, under the rest of their names."""
        return Tensors({name.removeprefix(prefix): x for name, x in self.items() if name.startswith(prefix)})

    def widths(self, stem: str) -> tuple[int, ...]:
        """Sizes of the hidden layers of a network whose weights are named stem0, stem1 and so on."""
        count = sum(name.startswith(stem) for name in self)
        return tuple(len(self[f"{stem}{i}"]) for i in range(count))[:-1]


@dataclass(frozen=True)
class Recipe:
    """Where the constructor arguments of a class are found."""

    make: Callable[..., Any]
    settings: Mapping[str, str]
    """Arguments stored in JSON, and the attributes that hold them."""
    parts: Mapping[str, str]
    """Arguments that are storable objects or None, and the attributes that hold them."""
    arrays: Callable[[Tensors], Mapping[str, Any]]
    """Function from the tensors of the object to further arguments."""
    sequence: Callable[[list[Any]], Any]
    """Conversion of a stored list into the argument."""


RECIPES: dict[str, Recipe] = {}
"""Recipes by class name, for the classes whose modules have been imported."""


def storable(
    settings: Attributes = (),
    parts: Attributes = (),
    arrays: Callable[[Tensors], Mapping[str, Any]] = lambda tensors: {},
    sequence: Callable[[list[Any]], Any] = np.array,
) -> Callable[[_Class], _Class]:
    """Class decorator: instances of exactly this class can be stored in files.

    Args:
        settings: Constructor arguments that JSON can hold: numbers, text, lists, mappings, arrays.
        parts: Constructor arguments that are storable objects or None.
        arrays: Function from the tensors of the object's `state_dict` to further constructor arguments.
        sequence: Conversion of a stored list into the constructor argument.
    """

    def register(cls: _Class) -> _Class:
        RECIPES[cls.__name__] = Recipe(cls, _named(settings), _named(parts), arrays, sequence)
        return cls

    return register


def _named(attributes: Attributes) -> Mapping[str, str]:
    return attributes if isinstance(attributes, Mapping) else {name: name for name in attributes}
