"""Kernels as plain Python functions, which run on symbols as on numbers."""

import inspect
import math
from collections.abc import Callable, Mapping
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

from nbs_pin.export.symbols import Symbol

Hook = Callable[[Callable[..., Any]], Callable[..., Any]]
"""What takes the place of a kernel, made from the kernel as plain Python."""
_KERNELS = "nbs_pin.kernels."


def as_python(kernel: Callable[..., Any], hooks: Mapping[str, Hook]) -> Callable[..., Any]:
    """A kernel, and all kernels that it calls, as the Python in which they are written.

    Args:
        kernel: A function of `kernels/`.
        hooks: By the name of a kernel, what makes its replacement.
    """
    made: dict[Any, Callable[..., Any]] = {}

    def plain(kernel: Callable[..., Any]) -> Callable[..., Any]:
        function: Any = inspect.unwrap(kernel)
        if function not in made:
            world = dict(function.__globals__)
            made[function] = copy = FunctionType(function.__code__, world, function.__name__)
            if function.__name__ in hooks:
                made[function] = hooks[function.__name__](copy)
            world |= {name: replaced(world[name]) for name in function.__code__.co_names if name in world}
        return made[function]

    def replaced(thing: Any) -> Any:
        if thing is math:
            return SimpleNamespace(**vars(math) | {"tanh": _tanh, "exp": _exp, "expm1": _expm1})
        if isinstance(thing, ModuleType) and thing.__name__.startswith(_KERNELS):
            return SimpleNamespace(**{name: replaced(x) for name, x in vars(thing).items() if not name.startswith("_")})
        is_kernel = hasattr(thing, "__wrapped__") and thing.__module__.startswith(_KERNELS)
        return plain(thing) if is_kernel else thing

    return plain(kernel)


def _tanh(x: Any) -> Any:
    return x.tape.function("tanh", x) if isinstance(x, Symbol) else math.tanh(x)


def _exp(x: Any) -> Any:
    return x.tape.function("exp", x) if isinstance(x, Symbol) else math.exp(x)


def _expm1(x: Any) -> Any:
    """eˣ − 1 for x ≤ 0 by tanh, which loses no digits near 0 either, so that C needs no further function of libm."""
    t = _tanh(0.5 * x)
    return 2.0 * t / (1.0 - t)
