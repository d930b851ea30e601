"""What a campaign may fix, vary on a grid or draw: each variable's kind, unit and usual value."""

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from nbs_pin.base.arguments import BANDWIDTH, DURATION, PERIOD, SEED, Check, choice, maybe, number, text
from nbs_pin.base.checks import told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.registry import entry
from nbs_pin.cli.values import SAVED, OptionError, parse_disturbance
from nbs_pin.controllers.registry import LAWS
from nbs_pin.simulation.registry import INTEGRATOR_NAMES, PLANTS


class Span(NamedTuple):
    """Numbers between two others, drawn uniformly; whole ones, with both ends, for a variable that counts."""

    least: float
    most: float


class Variable(NamedTuple):
    """Something that a trial is made of."""

    check: Check
    """Takes one value."""
    usual: Any
    """Its value where a campaign does not name it."""
    unit: str = ""
    is_number: bool = False
    is_whole: bool = False

    def drawn(self, span: Span, share: float) -> float | int:
        """The number at that share of a span, in [0, 1)."""
        if self.is_whole:
            return int(span.least) + math.floor(share * (int(span.most) - int(span.least) + 1))
        return span.least + share * (span.most - span.least)


def _law(name: str, value: Any) -> str:
    given = text(name, value)
    if not given.endswith(SAVED):
        try:
            entry("law", given, LAWS, f" or a {SAVED} file")
        except ArgumentError as error:
            raise ArgumentError(f"{name}: {error}") from error
    return given


def _disturbance(name: str, value: Any) -> str:
    try:
        return parse_disturbance(text(name, value), name).text
    except OptionError as error:
        raise ArgumentError(str(error)) from error


def _measure(*, usual: float | None, unit: str, check: Check) -> Variable:
    return Variable(check if usual is not None else maybe(check), usual, unit, is_number=True)


_AMOUNT, _SHARE = number(least=0.0, most=1e6), number(least=0.0, below=100.0)
VARIABLES: dict[str, Variable] = {
    "robot": Variable(text, None),
    "law": Variable(_law, "nbs"),
    "bandwidth": _measure(usual=8.0, unit="rad/s", check=BANDWIDTH),
    "law_seed": Variable(SEED, 0, is_number=True, is_whole=True),
    "reference": Variable(text, "sinusoid"),
    "frequency": _measure(usual=1.0, unit="rad/s", check=number(above=0.0, most=1000.0, unit="rad/s")),
    "duration": _measure(usual=None, unit="s", check=DURATION),
    "period": _measure(usual=0.001, unit="s", check=PERIOD),
    "start_error": _measure(usual=0.0, unit="rad", check=number(least=0.0, most=math.pi, unit="rad")),
    "start_spread": _measure(usual=0.0, unit="rad", check=number(least=0.0, most=math.pi, unit="rad")),
    "disturbance": Variable(_disturbance, "none"),
    "payload": _measure(usual=0.0, unit="kg", check=_AMOUNT),
    "inertia_error": _measure(usual=0.0, unit="%", check=_SHARE),
    "friction": Variable(choice("drop", "keep"), "drop"),
    "unknown_viscous": _measure(usual=0.0, unit="N·m·s/rad", check=_AMOUNT),
    "unknown_coulomb": _measure(usual=0.0, unit="N·m", check=_AMOUNT),
    "effort_share": _measure(usual=1.0, unit="", check=number(above=0.0, most=1e6)),
    "plant": Variable(choice(*PLANTS), "pinocchio"),
    "integrator": Variable(choice(*INTEGRATOR_NAMES), None),
    "plant_step": _measure(usual=None, unit="s", check=PERIOD),
}
"""Every variable by name, in the order of the columns of a table."""


def check_names(where: str, names: Iterable[str], known: Sequence[str]) -> None:
    """Raise ArgumentError for a name that is not known, with the nearest one."""
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, n=1)
            hint = f"did you mean {near[0]}? " if near else ""
            raise ArgumentError(f"{where} has '{name!s:.80}'; {hint}give some of {', '.join(known)}.")


def values_of(where: str, name: str, given: Any) -> tuple[Any, ...]:
    """The values that a variable takes on a grid."""
    if isinstance(given, str) or not isinstance(given, list | tuple) or not given:
        raise ArgumentError(f"{where}.{name} is {told(given)}; give a list of values, such as {_example(name)}.")
    values = tuple(VARIABLES[name].check(f"{where}.{name}[{k}]", value) for k, value in enumerate(given))
    if len(set(values)) < len(values):
        raise ArgumentError(f"{where}.{name} is {told(given)}, with one value twice; give different ones.")
    return values


def drawn_from(where: str, name: str, given: Any) -> tuple[Any, ...] | Span:
    """What a variable is drawn from: a list, or a span of numbers."""
    if isinstance(given, Span):
        given = {"from": given.least, "to": given.most}
    if not isinstance(given, Mapping):
        return values_of(where, name, given)
    variable = VARIABLES[name]
    check_names(f"{where}.{name}", given, ("from", "to"))
    if not variable.is_number or len(given) < 2:
        wanted = "both from and to" if variable.is_number else "a list, as it is no number"
        raise ArgumentError(f"{where}.{name} is {told(dict(given))}; give {wanted}.")
    least, most = (variable.check(f"{where}.{name}.{end}", given[end]) for end in ("from", "to"))
    if not least <= most:
        raise ArgumentError(f"{where}.{name} goes from {least:g} to {most:g}; give the smaller one first.")
    return Span(least, most)


def _example(name: str) -> str:
    usual = VARIABLES[name].usual
    known = {"robot": '["panda", "ur5"]', "law": '["nbs", "pid"]'}
    return known.get(name, f"[{usual!r}]".replace("'", '"') if usual is not None else "[0.001]")
