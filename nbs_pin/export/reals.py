"""The numbers of C: what they are called, how they are written, and the functions that take them."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

Precision: TypeAlias = Literal["double", "float"]
LIBM = ("sin", "cos", "sqrt", "tanh", "exp", "ceil", "fabs")
"""All functions of libm that a law may call."""


@dataclass(frozen=True)
class Real:
    """`double` or `float`."""

    precision: Precision

    @property
    def suffix(self) -> str:
        """What its literals and the functions of libm that take it end with."""
        return "f" if self.precision == "float" else ""

    @property
    def largest(self) -> float:
        """The largest finite number."""
        return float(np.finfo(np.float32 if self.precision == "float" else np.float64).max)

    def literal(self, x: float) -> str:
        """The shortest number of C that reads back as x; inf, for which C has none, as the largest."""
        x = min(float(x), self.largest)
        return f"{np.float32(x)}f" if self.precision == "float" else repr(x)

    def function(self, name: str) -> str:
        """A function of libm."""
        return name + self.suffix

    def table(self, name: str, values: np.ndarray) -> str:
        """A constant array."""
        words = [self.literal(x) for x in np.ravel(values).tolist()]
        rows = [", ".join(words[k : k + 8]) for k in range(0, len(words), 8)]
        return f"static const real {name}[{len(words)}] = {{\n    " + ",\n    ".join(rows) + "};\n"
