"""Limits of joints: what the file states, what is given in its place, and all that is still wanted."""

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from nbs_pin.base.doors import BLANK, option
from nbs_pin.robots.urdf_checks import LONGEST_WAY, MOST_TURNED, Joint, lock_too
from nbs_pin.robots.urdf_options import LIMITS, UrdfOptions
from nbs_pin.robots.urdf_source import Node

_ENDLESS, _MOST = 1e9, 1e39
"""Position limits between these are read as none: exporters write 1e16, or the largest number of single precision."""


class Limits(NamedTuple):
    """Position [rad, m], effort [N·m, N] and velocity [rad/s, m/s] limits of a joint, inf where none is stated."""

    lower: float
    upper: float
    effort: float
    velocity: float


@dataclass
class _Wanted:
    """What the limits of a file leave open: the first fault, and everything that would settle all of them."""

    first: Node | None = None
    problem: str = ""
    limits: dict[str, dict[str, object]] = field(default_factory=dict)
    lock: dict[str, float] = field(default_factory=dict)
    zeros: list[str] = field(default_factory=list)
    """What `zero_limits` would read as no limit, one entry for each fault that it settles."""
    faults: int = 0

    def add(self, node: Node, problem: str, joint: str, keys: Iterable[str], zero: str = "") -> None:
        """A fault of a joint, the limits that must be given, and what a zero would have to mean."""
        if self.first is None:
            self.first, self.problem = node, problem
        self.faults += 1
        self.limits.setdefault(joint, {}).update(dict.fromkeys(keys, BLANK))
        self.zeros += [zero] if zero else []


def read_limits(joints: list[Joint], options: UrdfOptions) -> dict[str, Limits]:
    """The limits of the moving joints by name: those given in `options.limits`, else those that the file states.

    A continuous joint has no position limits and may omit the others; every other moving joint must state all four.
    `zero_limits`: "refuse" no limits, an effort or velocity ≤ 0 and an empty range at zero, or read these as
    "unlimited". URDF reads a lower or upper limit that is left out as 0.

    Raises:
        RobotError: If limits are missing or wrong; names every joint that needs some.
    """
    wanted = _Wanted()
    limits = {joint.name: _limits(joint, options, wanted) for joint in joints if joint.moves}
    if wanted.first is None:
        return limits
    given = {joint: {**options.limits.get(joint, {}), **keys} for joint, keys in wanted.limits.items()}
    remedies = [f"state them ({option('limits', {**options.limits, **given})})"]
    if wanted.lock:
        remedies.append(f"lock what does not move ({lock_too(options, wanted.lock)})")
    if len(wanted.zeros) == wanted.faults:
        remedies.append(f"{option('zero_limits', 'unlimited')} if {wanted.zeros[0]}")
    raise wanted.first.refuse(wanted.problem, ", or ".join(remedies))


def _limits(joint: Joint, options: UrdfOptions, wanted: _Wanted) -> Limits:
    """The limits of one joint; what is wrong with them is added to `wanted`."""
    given = {key: options.limit(joint.name, key) for key in LIMITS}
    limit, endless = joint.node.child("limit"), joint.kind == "continuous"
    free = endless or options.zero_limits == "unlimited"
    if limit is None and not free and None in given.values():
        keys = [key for key, value in given.items() if value is None]
        wanted.add(joint.node, f"{joint.kind} joint without <limit>", joint.name, keys, "it has none")
        return Limits(-math.inf, math.inf, math.inf, math.inf)
    node = joint.node if limit is None else limit
    effort, velocity = (_strength(node, limit, key, joint, given[key], free, wanted) for key in ("effort", "velocity"))
    stated = [0.0 if limit is None else limit.number(key, 0.0) for key in ("lower", "upper")]
    if endless or limit is None:
        stated = [-math.inf, math.inf]
    ends = [given["lower"], given["upper"]]
    lower, upper = (x if end is None else end for x, end in zip(stated, ends, strict=True))
    if options.zero_limits == "unlimited" and lower == upper == 0.0:
        lower, upper = -math.inf, math.inf
    return Limits(*_range(node, joint, lower, upper, given, wanted), effort, velocity)


def _range(
    node: Node, joint: Joint, lower: float, upper: float, given: dict[str, float | None], wanted: _Wanted
) -> tuple[float, float]:
    """The position limits, none where exporters mean none; adds to `wanted` unless they are a range."""
    most = LONGEST_WAY if joint.kind == "prismatic" else MOST_TURNED
    if -_MOST <= lower <= -_ENDLESS and _ENDLESS <= upper <= _MOST:
        return -math.inf, math.inf
    absent = [key for key in ("lower", "upper") if key not in node.element.attrib and given[key] is None]
    absent = [] if math.isinf(lower) and math.isinf(upper) else absent
    if not lower < upper:
        problem = f"limit lower {lower:g} {'>' if lower > upper else '='} upper {upper:g}"
        problem += f" ({' and '.join(absent)} left out, which URDF reads as 0)" if absent else ""
        nothing = lower == upper == 0.0
        wanted.add(node, problem, joint.name, ("lower", "upper"), "0 means no limit" if nothing else "")
        wanted.lock |= {joint.name: lower} if lower == upper else {}
        return -math.inf, math.inf
    far = [key for key, x in (("lower", lower), ("upper", upper)) if math.isfinite(x) and abs(x) > most]
    if far:
        value = lower if far[0] == "lower" else upper
        wanted.add(node, f"limit {far[0]} {value:g} is beyond ±{most:g}", joint.name, far)
    elif absent:
        text = f"{node.place}: {joint.node.owner}: <limit> states no {absent[0]}, which URDF reads as 0"
        remedy = option("limits", {joint.name: {absent[0]: BLANK}})
        warnings.warn(f"{text}; if it is another, give it: {remedy}.", stacklevel=2)
    return lower, upper


def _strength(
    node: Node, limit: Node | None, key: str, joint: Joint, given: float | None, free: bool, wanted: _Wanted
) -> float:
    """The effort or velocity limit: > 0, or inf if there is none."""
    stated = limit is not None and key in limit.element.attrib
    value = limit.number(key) if limit is not None and stated else math.inf
    if given is not None:
        return given
    if not stated and not free:
        wanted.add(node, f"<limit> states no {key}", joint.name, [key], "it has none")
    elif value <= 0.0:
        if free and joint.kind != "continuous":
            return math.inf
        wanted.add(node, f"limit {key} '{value:g}' is not > 0", joint.name, [key], f"{value:g} means no limit")
    return value
