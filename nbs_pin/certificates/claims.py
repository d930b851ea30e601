"""Assumptions of certificates, and the conditions of their theorems."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from nbs_pin.base.claims import Label
from nbs_pin.base.doors import BLANK, option
from nbs_pin.robots.robot import Robot


class Assumption(StrEnum):
    """The assumptions of the bounds, in the words that certificates and monitors print."""

    MODEL = "the model is exact"
    FRICTION = "joint friction is as stated"
    MEASUREMENT = "position and velocity are measured as stated"
    DISTURBANCE = "the disturbance is within its bound"
    REFERENCE = "the reference is twice differentiable"
    STOPS = "no joint reaches its stop"
    VELOCITY = "no joint is held back by its velocity limit"
    EFFORT = "torques stay within the effort limits"
    TIME = "continuous time, no delay"
    WRAP = "errors of continuous joints stay within ±π"


class Role(StrEnum):
    """What a condition is to the bounds."""

    SUFFICIENT = "sufficient"
    """If it holds, so does the assumption or the premise of the theorem; if it fails, the bounds are void."""
    NECESSARY = "necessary"
    """If it fails, the assumption is false and the bounds are void; if it holds, the assumption is still one."""
    COMPARISON = "comparison"
    """Nothing rests on it."""


@dataclass(frozen=True)
class Condition:
    """A condition left > right of a theorem, with the numbers on both sides."""

    name: str
    left: float
    right: float
    unit: str
    label: Label
    because: str
    role: Role = Role.SUFFICIENT
    checks: Assumption | None = None
    """The assumption that it checks; None for a premise of the theorem itself."""

    @property
    def holds(self) -> bool:
        """Whether left > right."""
        return self.left > self.right

    @property
    def voids(self) -> bool:
        """Whether the bounds rest on it and it fails."""
        return self.role is not Role.COMPARISON and not self.holds

    def plain(self) -> dict[str, Any]:
        """The condition as JSON can store it, None for infinity."""
        sides = {key: x if math.isfinite(x) else None for key, x in (("left", self.left), ("right", self.right))}
        return {
            "name": self.name,
            **sides,
            "holds": self.holds,
            "unit": self.unit,
            "label": str(self.label),
            "because": self.because,
            "role": str(self.role),
            "checks": None if self.checks is None else str(self.checks),
        }


class Assumed(NamedTuple):
    """An assumption of a certificate, and how far it is checked."""

    text: str
    checked: str
    """"checked", "checked in part" (necessary conditions hold), "FAILS", or "not checked"."""


def assumed(assumption: Assumption, conditions: Iterable[Condition], text: str = "") -> Assumed:
    """The assumption with what its conditions say of it; `text` states it in other words."""
    own = [condition for condition in conditions if condition.checks is assumption]
    if any(condition.voids for condition in own):
        checked = "FAILS"
    elif any(condition.role is Role.SUFFICIENT for condition in own):
        checked = "checked"
    else:
        checked = "checked in part" if own else "not checked"
    return Assumed(text or str(assumption), checked)


def if_without_rotors(robot: Robot) -> str:
    """What to add where nothing is proved for want of inertia, if the arm's description states no rotors."""
    if robot.armature.any():
        return ""
    return f"; {robot.name} states no rotor inertia: if its motors have any, {option('armature', BLANK)} may allow more"
