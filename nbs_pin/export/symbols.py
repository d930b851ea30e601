"""Numbers that are not known yet: every operation on them is written down, and what is known is computed at once.

A `Symbol` is the result of one operation. Sums with 0, products with 0, 1 and −1 and operations on plain numbers
disappear, signs move outwards, and the same operation on the same numbers is one symbol. None of this changes a
rounding, so that compiled C gives the kernels' numbers as far as sums stay in order.
"""

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np


class Call(NamedTuple):
    """A call of a C function between the operations: arrays in, arrays out."""

    function: str
    inputs: dict[str, "list[Number]"]
    outputs: dict[str, int]
    """How long they are."""


class Remark(NamedTuple):
    """What the operations after it do, for readers of the C."""

    text: str


class Symbol:
    """A number as the result of an operation; `leaf` names a variable of C."""

    __slots__ = ("arguments", "operation", "place", "tape")

    def __init__(self, tape: "Tape", operation: str, arguments: tuple[Any, ...]) -> None:
        self.tape, self.operation, self.arguments = tape, operation, arguments
        self.place = len(tape.entries)

    def __array_ufunc__(self, function: Any, method: str, *given: Any, **options: Any) -> Any:
        """What numpy's functions and numpy's numbers do with a symbol."""
        if method != "__call__" or options or function not in _UFUNCS:
            return NotImplemented
        return _UFUNCS[function](*map(_plain, given))

    def __add__(self, other: Any) -> "Number":
        return self.tape.sum(self, other)

    def __radd__(self, other: Any) -> "Number":
        return self.tape.sum(other, self)

    def __sub__(self, other: Any) -> "Number":
        return self.tape.difference(self, other)

    def __rsub__(self, other: Any) -> "Number":
        return self.tape.difference(other, self)

    def __mul__(self, other: Any) -> "Number":
        return self.tape.product(self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> "Number":
        return self.tape.quotient(self, other)

    def __rtruediv__(self, other: Any) -> "Number":
        return self.tape.quotient(other, self)

    def __neg__(self) -> "Number":
        return self.tape.negative(self)


Number: TypeAlias = "float | Symbol"


class Tape:
    """All operations in their order, each once, with the calls and remarks between them."""

    def __init__(self) -> None:
        self.entries: list[Symbol | Call | Remark] = []
        self._known: dict[tuple[Any, ...], Symbol] = {}

    def variable(self, name: str) -> Symbol:
        """A number of C."""
        return self._once("leaf", name)

    def variables(self, name: str, count: int) -> np.ndarray:
        """An array of C."""
        return np.array([self.variable(f"{name}[{i}]") for i in range(count)], dtype=object)

    def call(self, function: str, inputs: dict[str, Sequence[Number]], outputs: dict[str, int]) -> list[np.ndarray]:
        """The arrays that a function of C writes."""
        self.entries.append(Call(function, {name: list(x) for name, x in inputs.items()}, outputs))
        return [self.variables(name, count) for name, count in outputs.items()]

    def remark(self, text: str) -> None:
        """Say what follows."""
        self.entries.append(Remark(text))

    def function(self, name: str, x: Number) -> Number:
        """A function of libm, or of a symbol one of the C around it."""
        return self._once(name, x) if isinstance(x, Symbol) else float(getattr(math, name)(x))

    def sum(self, x: Number, y: Number) -> Number:
        """X + y."""
        x, y = _plain(x), _plain(y)
        if not isinstance(x, Symbol):
            x, y = y, x
        if not isinstance(x, Symbol):
            return x + y
        if y == 0.0:
            return x
        if _is_negative(y):
            return self.difference(x, self.negative(y))
        return self.difference(y, self.negative(x)) if _is_negative(x) else self._once("+", *_sorted(x, y))

    def difference(self, x: Number, y: Number) -> Number:
        """X − y."""
        x, y = _plain(x), _plain(y)
        if not isinstance(x, Symbol) and not isinstance(y, Symbol):
            return x - y
        if y == 0.0:
            return x
        if x == 0.0:
            return self.negative(y)
        if _is_negative(y):
            return self.sum(x, self.negative(y))
        return self.negative(self.sum(self.negative(x), y)) if _is_negative(x) else self._once("-", x, y)

    def product(self, x: Number, y: Number) -> Number:
        """X y."""
        x, y = _plain(x), _plain(y)
        if not isinstance(x, Symbol):
            x, y = y, x
        if not isinstance(x, Symbol):
            return x * y
        if y == 0.0:
            return 0.0
        if y == 1.0:
            return x
        if _is_negative(x):
            return self.negative(self.product(self.negative(x), y))
        return self.negative(self.product(x, self.negative(y))) if _is_negative(y) else self._once("*", *_sorted(x, y))

    def quotient(self, x: Number, y: Number) -> Number:
        """X / y."""
        x, y = _plain(x), _plain(y)
        if not isinstance(x, Symbol) and not isinstance(y, Symbol):
            return x / y
        return 0.0 if x == 0.0 else self._once("/", x, y)

    def negative(self, x: Number) -> Number:
        """−x."""
        if not isinstance(x, Symbol):
            return -x
        return x.arguments[0] if x.operation == "negative" else self._once("negative", x)

    def _once(self, operation: str, *arguments: Any) -> Symbol:
        key = (operation, *(x.place if isinstance(x, Symbol) else (x,) for x in arguments))
        if key not in self._known:
            self._known[key] = Symbol(self, operation, arguments)
            self.entries.append(self._known[key])
        return self._known[key]


def _plain(x: Any) -> Number:
    return x if isinstance(x, Symbol) else float(x)


def _is_negative(x: Number) -> bool:
    return x.operation == "negative" if isinstance(x, Symbol) else x < 0.0


def _sorted(x: Symbol, y: Number) -> tuple[Number, Number]:
    """The operands of a commutative operation: numbers first, then the older symbol."""
    return (x, y) if isinstance(y, Symbol) and x.place < y.place else (y, x)


def _of_libm(name: str) -> Callable[[Symbol], Number]:
    return lambda x: x.tape.function(name, x)


_UFUNCS: dict[Any, Callable[..., Any]] = {
    np.add: operator.add,
    np.subtract: operator.sub,
    np.multiply: operator.mul,
    np.true_divide: operator.truediv,
    np.sin: _of_libm("sin"),
    np.cos: _of_libm("cos"),
    np.ceil: _of_libm("ceil"),
}
