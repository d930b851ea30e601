"""One way to check the arguments of public functions: a kind for each argument, applied before the function runs.

A kind takes the argument's name for the message and its value, and returns the value to use, converted where that
loses nothing (`np.float64(0.001)` or a whole number for a time). Whatever does not fit raises ArgumentError with one
sentence: what was given, what was expected, what to do. Work that grows with a number is limited, and the message names
the limit.
"""

import functools
import inspect
import math
import os
import stat
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np

from nbs_pin.base.checks import LARGEST, SMALLEST, floats, integral, is_usual, real, told
from nbs_pin.base.doors import argument
from nbs_pin.base.exceptions import ArgumentError, NbsPinError, NoSuchFile

Check: TypeAlias = Callable[[str, Any], Any]
"""check(name, value) -> the value to use; raises ArgumentError."""
_Function = TypeVar("_Function", bound=Callable[..., Any])

MOST_PERIODS = 10_000_000
"""Most control periods of one recorded run or motion."""
MOST_STEPS = 100_000
"""Most plant steps of one control period."""
MOST_JOINTS = 1000
_LONGEST_NAME = 200
"""Longest name of a file to write; its draft has a longer one."""


def checked(**checks: Check) -> Callable[[_Function], _Function]:
    """Decorator: check these arguments of a function whenever they are given; defaults are taken as they are."""

    def decorate(function: _Function) -> _Function:
        names = list(inspect.signature(function).parameters)
        places = [(name, names.index(name), check) for name, check in checks.items()]
        where = function.__qualname__.removesuffix(".__init__")

        @functools.wraps(function)
        def door(*args: Any, **kwargs: Any) -> Any:
            given = list(args)
            for name, at, check in places:
                if at < len(given):
                    given[at] = check(argument(where, name, given[at]), given[at])
                elif name in kwargs:
                    kwargs[name] = check(argument(where, name, kwargs[name]), kwargs[name])
            return function(*given, **kwargs)

        return door  # type: ignore[return-value]

    return decorate


def check_fields(record: Any, **checks: Check) -> None:
    """Check the fields of a frozen record in its `__post_init__`, and store what the checks return."""
    for name, check in checks.items():
        object.__setattr__(record, name, check(argument(type(record).__name__, name), getattr(record, name)))


def maybe(check: Check) -> Check:
    """None, or what the check takes."""
    return lambda name, value: None if value is None else check(name, value)


def either(*checks: Check) -> Check:
    """What any of the checks takes; the message is that of the last."""

    def check(name: str, value: Any) -> Any:
        for attempt in checks[:-1]:
            try:
                return attempt(name, value)
            except ArgumentError:  # another check may take it
                continue
        return checks[-1](name, value)

    return check


def number(
    *, above: float = -math.inf, least: float = -LARGEST, most: float = LARGEST, below: float = math.inf, unit: str = ""
) -> Check:
    """A finite number in (above, most] or [least, most], or smaller than `below`; above=0 takes `SMALLEST` on."""
    lowest = max(least, SMALLEST) if above == 0.0 else least

    def check(name: str, value: Any) -> float:
        given = real(value)
        if given is None or not (given > above and lowest <= given <= most and (given < below or below == math.inf)):
            raise ArgumentError(f"{name} is {told(value)}; give {_range(above, least, most, below, unit)}.")
        return given

    return check


def _range(above: float, least: float, most: float, below: float, unit: str) -> str:
    low = f"> {above:g}" if above > -math.inf else f"≥ {least:g}" if least > -LARGEST else ""
    high = f"< {below:g}" if below < math.inf else f"at most {most:g}" if most < LARGEST else ""
    bounds = " and ".join(text for text in (low, high) if text)
    return f"a finite number{f' {bounds}' if bounds else ''}{f' [{unit}]' if unit else ''}"


def count(least: int = 0, most: int = 2**31 - 1, of: str = "") -> Check:
    """A whole number from `least` to `most`, as an int."""

    def check(name: str, value: Any) -> int:
        given = integral(value)
        if given is None or not least <= given <= most:
            what = f" of {of}" if of else ""
            raise ArgumentError(f"{name} is {told(value)}; give a whole number{what} from {least} to {most}.")
        return given

    return check


def flag(name: str, value: Any) -> bool:
    """True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ArgumentError(f"{name} is {told(value)}; give True or False.")
    return bool(value)


def text(name: str, value: Any) -> str:
    """A text."""
    if not isinstance(value, str):
        raise ArgumentError(f"{name} is {told(value)}; give a text.")
    return value


def choice(*known: str) -> Check:
    """One of the texts."""

    def check(name: str, value: Any) -> str:
        if not isinstance(value, str) or value not in known:
            quoted = f"'{value:.80}' is unknown" if isinstance(value, str) else f"is {told(value)}"
            raise ArgumentError(f"{name} {quoted}; give one of {', '.join(known)}.")
        return value

    return check


def path(name: str, value: Any) -> Any:
    """The path of a file: a text or a `Path`, without a null character; `~` at its beginning is the home folder."""
    if not isinstance(value, str | os.PathLike) or not isinstance(os.fspath(value), str):
        raise ArgumentError(f"{name} is {told(value)}; give the path of a file.")
    if "\0" in os.fspath(value):
        raise ArgumentError(f"{name} is {os.fspath(value)!r:.80}; give the path of a file, without a null character.")
    home = os.path.expanduser(value)
    return value if home == os.fspath(value) else home


def readable(name: str, value: Any) -> Any:
    """The path of a file that exists and may be read; raises NoSuchFile if it does not exist."""
    given, fault = path(name, value), ""
    try:
        mode = os.stat(given).st_mode
        if not stat.S_ISREG(mode):
            fault = "it is a directory" if stat.S_ISDIR(mode) else "it is no regular file"
        elif not os.access(given, os.R_OK):
            fault = "it may not be read"
    except FileNotFoundError as error:
        raise NoSuchFile(f"{name}: no such file {os.fspath(given)!r:.200}; correct the path.") from error
    except (OSError, ValueError) as error:  # too long, too many links, characters that the system does not take
        fault = getattr(error, "strerror", None) or str(error)
    if fault:
        raise ArgumentError(f"{name}: cannot read {os.fspath(given)!r:.200}: {fault}; give the path of a file.")
    return given


def writable(name: str, value: Any) -> Any:
    """The path of a file to write: no directory, in a folder that exists or can be made, with names of usual length."""
    given, fault = Path(path(name, value)), ""
    try:
        folder = next((p for p in given.absolute().parents if p.exists()), None)
        if given.is_dir():
            fault = "it is a directory"
        elif given.exists() and not given.is_file():
            fault = "it is no regular file"
        elif folder is None or not folder.is_dir() or not os.access(folder, os.W_OK):
            fault = f"{folder} is no folder that may be written to"
        elif any(len(os.fsencode(part)) > _LONGEST_NAME for part in given.parts):
            fault = f"a name in it is longer than {_LONGEST_NAME} bytes"
    except (OSError, ValueError) as error:
        fault = getattr(error, "strerror", None) or str(error)
    if fault:
        raise ArgumentError(f"{name}: cannot write {os.fspath(given)!r:.200}: {fault}; give the path of a file.")
    return given


def a(kind: type | tuple[type, ...], remedy: str) -> Check:
    """An instance of the class or of one of the classes; the remedy says what to give: "an arm, as of load_robot"."""

    def check(name: str, value: Any) -> Any:
        if not isinstance(value, kind):
            raise ArgumentError(f"{name} is {told(value)}; give {remedy}.")
        return value

    return check


def function(takes: int, remedy: str) -> Check:
    """A callable that takes so many positional arguments, as far as it says what it takes."""

    def check(name: str, value: Any) -> Any:
        if not callable(value) or isinstance(value, type):
            raise ArgumentError(f"{name} is {told(value)}; give {remedy}.")
        try:
            inspect.signature(value).bind(*range(takes))
        except TypeError as error:
            raise ArgumentError(f"{name} cannot be called with {takes} arguments ({error}); give {remedy}.") from error
        except ValueError:  # a builtin that does not say what it takes
            return value
        return value

    return check


def many(check: Check, least: int = 0, most: int = 1_000_000, of: str = "") -> Check:
    """A list or tuple of so many entries, each of which the check takes, as a tuple."""

    def check_all(name: str, value: Any) -> tuple[Any, ...]:
        if isinstance(value, np.ndarray) and value.ndim == 1 and type(value) is np.ndarray:
            value = value.tolist()
        if isinstance(value, str | bytes) or not isinstance(value, Sequence) or not least <= len(value) <= most:
            raise ArgumentError(f"{name} is {told(value)}; give a list of {least} to {most} {of or 'entries'}.")
        return tuple(check(f"{name}[{k}]", entry) for k, entry in enumerate(value))

    return check_all


def numbers(
    *shape: int | None, unit: str = "", least: float = -LARGEST, above: float = -math.inf, infinite: bool = False
) -> Check:
    """A float array of that shape, None for an axis of any length, without NaN; inf only if `infinite`."""

    def check(name: str, value: Any) -> np.ndarray:
        array = floats(name, value)
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits or not _within(array, least, above, infinite):
            sizes = ", ".join("…" if n is None else str(n) for n in shape)
            raise ArgumentError(
                f"{name} is {told(value)}; give an array of shape ({sizes}) of"
                f" {_range(above, least, LARGEST, math.inf, unit).replace('a finite number', 'finite numbers')}."
            )
        return array

    return check


def numbers_or_one(least: float = -LARGEST, above: float = -math.inf, unit: str = "") -> Check:
    """A number or an array of numbers of any shape, as a float array."""

    def check(name: str, value: Any) -> np.ndarray:
        array = floats(name, value)
        if not _within(array, least, above, False):
            what = _range(above, least, LARGEST, math.inf, unit)
            raise ArgumentError(f"{name} is {told(value)}; give {what}, or an array of such numbers.")
        return array

    return check


def joints(least: float = -LARGEST, above: float = -math.inf, unit: str = "", infinite: bool = False) -> Check:
    """One number or one per joint, as a float array of shape () or (n,); inf only if `infinite`."""

    def check(name: str, value: Any) -> np.ndarray:
        array = floats(name, value)
        if array.ndim > 1 or array.size == 0 or not _within(array, least, above, infinite):
            what = _range(above, least, LARGEST, math.inf, unit).replace("a finite number", "one finite number")
            raise ArgumentError(f"{name} is {told(value)}; give {what}, or one per joint{', inf for none' * infinite}.")
        return array

    return check


def _within(array: np.ndarray, least: float, above: float, infinite: bool) -> bool:
    lowest = max(least, SMALLEST) if above == 0.0 else least
    inside = bool(((array > above) & (array >= lowest)).all())
    return inside and (is_usual(array) or (infinite and bool(((array <= LARGEST) | (array == np.inf)).all())))


def called(what: str, callback: Callable[..., Any], *arguments: Any) -> Any:
    """What the callback returns for these arguments, arrays among them read-only.

    Raises ArgumentError from whatever it raises, a write into an argument included; errors of the package pass.
    """
    try:
        return callback(*(read_only(x) if isinstance(x, np.ndarray) else x for x in arguments))
    except NbsPinError:
        raise
    except Exception as error:
        raise ArgumentError(f"{what} raised {type(error).__name__} ({error!s:.200}); correct it.") from error


def read_only(x: np.ndarray) -> np.ndarray:
    """A view of the array through which it cannot be written."""
    view = x.view()
    view.setflags(write=False)
    return view


def mapping(name: str, value: Any) -> Mapping[str, Any]:
    """A mapping whose keys are texts."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise ArgumentError(f"{name} is {told(value)}; give a dictionary with texts as keys.")
    return value


def texts(name: str, value: Any) -> list[str]:
    """One text, or an iterable of at most 10,000 texts, as a list."""
    if isinstance(value, str):
        return [value]
    try:
        found: list[Any] = list(islice(value, 10_001)) if isinstance(value, Iterable) else [None]
    except Exception as error:  # an iterable may raise anything
        raise ArgumentError(f"{name} is {told(value)}, which cannot be iterated over; give texts.") from error
    if len(found) > 10_000 or not all(isinstance(entry, str) for entry in found):
        raise ArgumentError(f"{name} is {told(value)}; give texts, at most 10000.")
    return found


def paths(name: str, value: Any) -> list[Path]:
    """Paths of folders, as a list."""
    if isinstance(value, str | os.PathLike) or not isinstance(value, Sequence):
        raise ArgumentError(f"{name} is {told(value)}; give a list of folders.")
    return [Path(path(f"{name}[{k}]", entry)) for k, entry in enumerate(value)]


WIDTHS = many(count(1, 4096, "units"), 0, 64, "layers")
SEED = count(0, 2**63 - 1)
PERIOD = number(above=0.0, most=1000.0, unit="s")
DURATION = number(above=0.0, most=1e7, unit="s")
BANDWIDTH = number(above=0.0, most=10_000.0, unit="rad/s")
SHARE = number(least=0.0, below=1.0)
