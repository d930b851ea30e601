"""What made a run, in words: the titles and settings of pictures and pages."""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from nbs_pin.base.records import Run
from nbs_pin.base.shown import joints_told

_NAMES = {
    "PD": "PD control",
    "PID": "PID control",
    "SlotineLi": "Slotine–Li",
    "MujocoPlant": "MuJoCo",
    "DynamicsPlant": "Pinocchio",
}
"""Classes whose names are not words run together."""
_ENGINES = {
    "rk4": "RK4",
    "euler": "Euler",
    "semi_implicit_euler": "semi-implicit Euler",
    "implicitfast": "implicitfast",
}


_PHRASES: dict[str, Callable[[Any], str]] = {
    "bandwidth": "ω = {:g} rad/s".format,
    "period": lambda value: f"control every {1e3 * value:g} ms",
    "duration": "{:g} s".format,
    "start_error": "start off by up to {:g} rad".format,
    "torque_noise": "torque noise {:g} N·m".format,
}


def law_in_words(run: Run) -> str:
    """The control law of a run, as in "neural backstepping"."""
    return _words(str(run.info.get("controller") or "unnamed law"))


def arm_in_words(run: Run) -> str:
    """The arm of a run, without the folder of its file."""
    return re.sub(r"\.(urdf|xacro|xml)$", "", run.robot.rsplit("/", 1)[-1]) or joints_told(run.nv)


def settings_in_words(run: Run) -> list[str]:
    """What else determines a run, one phrase each: rate and period of the law, motion, disturbance, plant, seed."""
    given = run.info.get("settings")
    given = given if isinstance(given, Mapping) else {}
    saved = str(given.get("controller", "")).endswith(".nbs")
    phrases = [
        f"ω = {given['bandwidth']:g} rad/s" if given.get("bandwidth") is not None and not saved else "",
        f"control every {1e3 * run.period:g} ms",
        _motion(run, given),
        _start(given),
        "" if given.get("disturbance") in (None, "none") else f"disturbance {given['disturbance']}",
        *_plant(str(run.info.get("plant") or ""), friction_of(run)),
        *(f"{name.replace('_', ' ')} {_told(value)}" for name, value in (given.get("arm") or {}).items()),
        f"seed {given['seed']}" if given.get("seed") is not None else "",
    ]
    return [phrase for phrase in phrases if phrase]


def failing(void: Iterable[str], conditions: Iterable[Mapping[str, Any]]) -> str:
    """The conditions of those names with the numbers on both sides, as a certificate's summary has them."""
    told = {}
    for condition in conditions:
        if not condition["holds"]:
            left, right = (math.inf if condition[side] is None else condition[side] for side in ("left", "right"))
            sides = f"{left:.3g} against {right:.3g} {condition['unit']}".rstrip()
            told[condition["name"]] = f"{condition['name']} ({sides})"
    return "; ".join(told.get(name, name) for name in void)


def chosen(settings: Mapping[str, Any], *names: str) -> list[str]:
    """The settings of those names as phrases, without those that are off; the law's and the period in words."""
    phrases = []
    for name in names:
        value = settings.get(name)
        if value in (None, False, "", "none", {}, 0.0) and name != "seed":
            continue
        known = _PHRASES.get(name)
        phrases.append(known(value) if known else f"{name.replace('_', ' ')} {_told(value)}")
    return phrases


def _motion(run: Run, given: Mapping[str, Any]) -> str:
    motion = str(run.info.get("reference") or "").rsplit("/", 1)[-1]
    return f"{motion} at {given['frequency']:g} rad/s" if motion == "sinusoid" and given.get("frequency") else motion


def _start(given: Mapping[str, Any]) -> str:
    if given.get("start"):
        return f"from {given['start']}"
    return f"start off by {given['start_error']:g} rad" if given.get("start_error") else ""


def _plant(text: str, friction: str) -> list[str]:
    """The plant from its repr, as in MujocoPlant(panda, rk4, joint_friction=drop)."""
    text = re.sub(r"^ChangingPlant\((.*), changes at .* s\)$", r"\1", text)  # the first of them
    name, _, inside = text.rstrip(")").partition("(")
    words = inside.split(", ")
    engine = next((f" ({_ENGINES[word]})" for word in words if word in _ENGINES), "")
    return [
        f"in {_words(name)}{engine}" if name else "",
        {"drop": "no joint friction", "keep": "with joint friction"}.get(friction, ""),
        "joint stops" if "joint_stops=keep" in words else "",
    ]


def friction_of(run: Run) -> str:
    """What a simulation did with the arm's joint friction, "drop" or "keep", by settings or plant; "" if unknown."""
    given = run.info.get("settings")
    stated = given.get("joint_friction") if isinstance(given, Mapping) else ""
    return str(stated or next(iter(re.findall(r"joint_friction=(\w+)", str(run.info.get("plant")))), ""))


def _words(name: str) -> str:
    """A class name, or the repr of an object, as words: NeuralBackstepping(…) is "neural backstepping"."""
    name = name.partition("(")[0]
    if not re.fullmatch(r"\w+", name):
        return name
    return _NAMES.get(name) or re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name).lower()


def _told(value: Any) -> str:
    """A setting in words: a payload as its mass at its link, without the rest."""
    if isinstance(value, Mapping):
        masses = {at: of.get("mass") if isinstance(of, Mapping) else of for at, of in value.items()}
        return ", ".join(
            f"{mass:g} kg at {at or 'the last link'}" if isinstance(mass, int | float) else f"{at} {value[at]}"
            for at, mass in masses.items()
        )
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
