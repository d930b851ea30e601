"""Hostile values: what no argument means, and good values with one thing wrong."""

import copy
import decimal
import fractions
import io
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

NUMBERS: tuple[Any, ...] = (
    0,
    -1,
    1,
    2,
    3.5,
    -0.0,
    float("nan"),
    float("inf"),
    -float("inf"),
    1e-308,
    1e308,
    -1e308,
    1e-12,
    1e12,
    10**9,
    2**31,
    2**63,
    2**70,
    10**400,
    True,
    np.bool_(False),
    np.float32(0.5),
    np.int8(3),
    np.float64("nan"),
    1j,
    complex(1.0, 0.0),
    decimal.Decimal("0.1"),
    fractions.Fraction(1, 10),
)

OTHERS: dict[str, Callable[[], Any]] = {
    "None": lambda: None,
    "empty text": lambda: "",
    "number as text": lambda: "0.1",
    "text": lambda: "nonsense",
    "long text": lambda: "x" * 5000,
    "null character": lambda: "a\0b",
    "lone surrogate": lambda: "\ud800",
    "markup": lambda: "[/red]</script>$x_{$",
    "bytes": lambda: b"\x00\xff",
    "folder": lambda: Path("/"),
    "missing path": lambda: Path("/no/such/folder/file.npz"),
    "device": lambda: "/dev/zero",
    "empty list": list,
    "empty tuple": tuple,
    "empty dict": dict,
    "set": lambda: {1.0, 2.0},
    "ragged list": lambda: [[0.1], [0.1, 0.2]],
    "list with None": lambda: [0.1, None],
    "list with text": lambda: ["0.1", "0.2"],
    "list with NaN": lambda: [0.1, float("nan")],
    "nested list": lambda: [[[[0.1, 0.2]]]],
    "list in itself": lambda: _recursive(),
    "endless iterator": itertools.count,
    "generator": lambda: (x for x in (0.1, 0.2)),
    "range": lambda: range(2),
    "huge range": lambda: range(10**12),
    "object": object,
    "class": lambda: float,
    "module": lambda: np,
    "file": io.BytesIO,
    "function of nothing": lambda: lambda: None,
    "function giving None": lambda: lambda *a, **k: None,
    "function giving text": lambda: lambda *a, **k: "text",
    "function giving NaN": lambda: lambda *a, **k: float("nan"),
    "function giving its first": lambda: lambda *a, **k: a[0] if a else None,
    "function that raises": lambda: _raises,
    "function that writes": lambda: _writes,
    "vector of 2": lambda: np.array([0.1, 0.2]),
    "vector of 3": lambda: np.array([0.1, 0.2, 0.3]),
    "empty vector": lambda: np.zeros(0),
    "no rows": lambda: np.zeros((0, 2)),
    "no joints": lambda: np.zeros((2, 0)),
    "rows": lambda: np.zeros((4, 2)),
    "column": lambda: np.zeros((2, 1)),
    "scalar array": lambda: np.array(0.3),
    "masked": lambda: np.ma.masked_array([0.1, 0.2], mask=[False, True]),
    "masked scalar": lambda: np.ma.masked,
    "complex vector": lambda: np.array([0.1 + 1j, 0.2]),
    "object vector": lambda: np.array([0.1, None], dtype=object),
    "texts": lambda: np.array(["0.1", "0.2"]),
    "dates": lambda: np.array(["2026-01-01", "2026-01-02"], dtype="datetime64[D]"),
    "durations": lambda: np.array([1, 2], dtype="timedelta64[s]"),
    "records": lambda: np.zeros(2, dtype=[("x", float)]),
    "float16": lambda: np.array([0.1, 0.2], dtype=np.float16),
    "float128": lambda: np.array([0.1, 0.2], dtype=np.longdouble),
    "big-endian": lambda: np.array([0.1, 0.2], dtype=">f8"),
    "truth values": lambda: np.array([True, False]),
    "np.matrix": lambda: np.asmatrix([0.1, 0.2]),
    "huge view": lambda: np.broadcast_to(0.1, (10**6, 10**6, 2)),
    "inf vector": lambda: np.array([0.1, np.inf]),
    "1e308 vector": lambda: np.array([1e308, -1e308]),
    "1e160 vector": lambda: np.array([1e160, 0.1]),
    "1e-308 vector": lambda: np.array([1e-308, 1e-308]),
    "read-only": lambda: _read_only(),
    "strided": lambda: np.array([0.1, 9.0, 0.2, 9.0])[::2],
    "tensor": lambda: torch.tensor([0.1, 0.2], dtype=torch.float64),
    "tensor with grad": lambda: torch.tensor([0.1, 0.2], dtype=torch.float64, requires_grad=True),
    "float32 tensor": lambda: torch.tensor([0.1, 0.2]),
    "complex tensor": lambda: torch.tensor([0.1 + 1j, 0.2], dtype=torch.complex128),
    "tensor of 3": lambda: torch.zeros(3, dtype=torch.float64),
    "scalar tensor": lambda: torch.tensor(0.1, dtype=torch.float64, requires_grad=True),
    "sparse tensor": lambda: torch.eye(2, dtype=torch.float64).to_sparse(),
    "meta tensor": lambda: torch.empty(2, dtype=torch.float64, device="meta"),
    "list of tensors": lambda: [torch.tensor(0.1, requires_grad=True), torch.tensor(0.2)],
    "hostile array": lambda: _Hostile(),
}


class _Hostile:
    """An object whose conversions raise."""

    def __array__(self, *arguments: Any, **options: Any) -> np.ndarray:
        raise RuntimeError("no array")

    def __float__(self) -> float:
        raise RuntimeError("no number")

    def __repr__(self) -> str:
        raise RuntimeError("no text")

    __index__ = __len__ = __iter__ = __str__ = __bool__ = __float__  # type: ignore[assignment]


def _recursive() -> list[Any]:
    found: list[Any] = [0.1]
    found.append(found)
    return found


def _read_only() -> np.ndarray:
    x = np.array([0.1, 0.2])
    x.setflags(write=False)
    return x


def _raises(*arguments: Any, **options: Any) -> Any:
    raise ZeroDivisionError("user code")


def _writes(*arguments: Any, **options: Any) -> Any:
    arguments[-1][...] = 1.0
    return 0.0 * arguments[-1]


def broken(good: Any, rng: np.random.Generator) -> tuple[str, Any] | None:
    """A good value with one thing wrong, or None where there is nothing to break."""
    if isinstance(good, bool | str) or good is None:
        return None
    if isinstance(good, int | float):
        factor = float(rng.choice([-1.0, 0.0, 1e-300, 1e300, np.nan]))
        return f"times {factor:g}", good * factor
    try:
        array = np.array(good, dtype=float)
    except Exception:
        return None
    if array.size == 0 or array.ndim == 0:
        return None
    way = _WAYS[int(rng.integers(len(_WAYS)))]
    return way.__name__.strip("_"), way(array, rng)


def _one(x: np.ndarray, rng: np.random.Generator, value: Any, dtype: Any = None) -> np.ndarray:
    y = x.astype(dtype) if dtype is not None else x.copy()
    y.reshape(-1)[int(rng.integers(y.size))] = value
    return y


def _one_nan(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return _one(x, rng, np.nan)


def _one_infinite(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return _one(x, rng, np.inf)


def _one_huge(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return _one(x, rng, float(rng.choice([1e20, 1e80, 1e101, 1e154, 1e200, 1e300])))


def _one_none(x: np.ndarray, rng: np.random.Generator) -> list[Any]:
    return _one(x, rng, None, object).tolist()


def _one_complex(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return _one(x, rng, 1j, complex)


def _negated(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return -x


def _masked(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.ma.masked_array(x, mask=rng.random(x.shape) < 0.5)


def _longer(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([x, x[-1:]])


def _shorter(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return x[:-1]


def _deeper(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return x[None]


def _transposed(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return x[:, None] if x.ndim == 1 else x.T


def _as_text(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return x.astype(str)


def _with_grad(x: np.ndarray, rng: np.random.Generator) -> torch.Tensor:
    return torch.tensor(x, requires_grad=True)


_WAYS = (_one_nan, _one_infinite, _one_huge, _one_none, _one_complex, _negated, _masked, _longer, _shorter, _deeper,
         _transposed, _as_text, _with_grad)  # fmt: skip


def hostile(good: Any, rng: np.random.Generator) -> tuple[str, Any]:
    """A hostile value with its name: a number, another object, or the good value broken."""
    draw = rng.random()
    if draw < 0.35:
        found = broken(good, rng)
        if found is not None:
            return found
    if draw < 0.6:
        value = NUMBERS[int(rng.integers(len(NUMBERS)))]
        return (str(value) if not isinstance(value, int) or abs(value) < 10**20 else "huge int"), copy.copy(value)
    name = list(OTHERS)[int(rng.integers(len(OTHERS)))]
    return name, OTHERS[name]()


def is_finite(value: Any, depth: int = 0) -> bool:
    """Whether every number in the value is finite, as far as it is made of numbers, arrays and containers."""
    if isinstance(value, torch.Tensor):
        return value.is_sparse or value.is_meta or bool(torch.isfinite(torch.abs(value.detach())).all())
    if isinstance(value, np.ndarray):
        return value.dtype.kind not in "fc" or value.size > 10**7 or bool(np.isfinite(np.ma.getdata(value)).all())
    if isinstance(value, float | complex | np.floating):
        return bool(np.isfinite(value))
    if isinstance(value, list | tuple) and depth < 5:
        return all(is_finite(x, depth + 1) for x in value)
    return True
