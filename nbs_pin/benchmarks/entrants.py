"""Entrants by name, and the laws that they make: ours, ours as C, and any callable of a file."""

import hashlib
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from nbs_pin.base.arguments import called
from nbs_pin.base.arrays import JointArray, Vectors
from nbs_pin.base.checks import floats, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.benchmarks.challenge_tasks import DURATION, PERIOD, Task
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.registry import LAWS, build_law
from nbs_pin.robots.robot import Robot

SHIPPED = ("nbs", "adaptive", "slotine-li", "computed-torque", "pd-plus", "pid", "c:nbs")
"""Entrants of every challenge, each with its default settings on every arm."""
PROMISING = ("nbs", "nbs-paper", "adaptive", "slotine-li", "sliding-mode")
"""Laws of ours with a certificate."""
IN_C = "c:"
"""Begins the name of a law of ours that is exported as C."""
_PROMISE = "promise"


class Entrant(NamedTuple):
    """Who takes part."""

    name: str
    """A name in `LAWS`, one after `IN_C`, or FILE.py:FUNCTION."""

    @classmethod
    def read(cls, name: str) -> "Entrant":
        """The entrant of that name; raises ArgumentError if there is none."""
        entrant = cls(name)
        file, function = entrant._places
        if name.removeprefix(IN_C) in LAWS or file is None:
            if name.removeprefix(IN_C) not in LAWS:
                raise ArgumentError(
                    f"no entrant '{name:.200}'; give one of {', '.join(LAWS)}, {IN_C} before one of these, or"
                    " FILE.py:FUNCTION."
                )
            return entrant
        if not file.is_file() or not function.isidentifier():
            raise ArgumentError(f"no file '{file}' with a function '{function:.80}'; give FILE.py:FUNCTION.")
        return entrant

    @property
    def digest(self) -> str:
        """Changes with the file of the entrant; empty for one of ours."""
        file, _ = self._places
        return "" if file is None else hashlib.sha256(file.read_bytes()).hexdigest()[:12]

    @property
    def promises_of(self) -> str:
        """The name under which its promises are known: a law in C promises what it promises in Python."""
        return self.name.removeprefix(IN_C)

    @property
    def may_promise(self) -> bool:
        """Whether it may promise something: a file, or a law with a certificate."""
        return self._places[0] is not None or self.promises_of in PROMISING

    @property
    def is_ours(self) -> bool:
        """Whether it is a law of the package, whose memory is a value outside of it."""
        return self._places[0] is None

    @property
    def shown(self) -> str:
        """Its name in tables."""
        file, function = self._places
        return self.name if file is None else f"{file.name}:{function}"

    def maker(self) -> Callable[[Robot], Controller]:
        """What makes the law for an arm, fresh for every run; raises ArgumentError if the file has no such function."""
        file, function = self._places
        if file is not None:
            make = _of_file(file, function)
            return lambda robot: _controller(self.shown, called(self.shown, make, robot, PERIOD), robot.nv)
        in_c, name = self.name.startswith(IN_C), self.name.removeprefix(IN_C)
        made: dict[str, Controller] = {}  # ours keep their memory outside, so that one serves every run

        def law(robot: Robot) -> Controller:
            if robot.name not in made:
                built = build_law(name, robot, period=PERIOD, seed=0)
                if in_c:
                    from nbs_pin.benchmarks.c_law import CLaw

                    built = CLaw(built)
                made[robot.name] = built
            return made[robot.name]

        return law

    def promise(self) -> Callable[[Task], JointArray | None]:
        """What tells the promise for a task [rad], (n,); for a file without a function `promise`, always None."""
        file, _ = self._places
        if file is None:
            from nbs_pin.benchmarks.promises import promised_by  # slow to load, and runs do not need it

            laws: dict[str, Controller] = {}

            def certified(task: Task) -> JointArray | None:
                name = self.promises_of
                law = laws.setdefault(task.robot.name, build_law(name, task.robot, period=PERIOD, seed=0))
                return promised_by(law, task)

            return certified
        given = getattr(_module(file), _PROMISE, None)
        if given is None:
            return lambda task: None
        return lambda task: _bound(f"{_PROMISE} of {file.name}", called(_PROMISE, given, task), task.robot.nv)

    @property
    def _places(self) -> tuple[Path | None, str]:
        """The file and the function in it, or None."""
        file, mark, function = self.name.rpartition(":")
        return (Path(file), function) if mark and file.endswith(".py") else (None, "")


@dataclass(frozen=True, eq=False)
class Called(Controller):
    """A callable (q, v, q_d, v_d, a_d, t) → τ as a law; what it remembers, it keeps itself."""

    name: str
    function: Callable[..., Any]
    joints: int

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.joints

    def initial_memory(self, q: Vectors) -> int:
        """How many torques it has given."""
        return 0

    def step(self, memory: int, q: Vectors, v: Vectors, reference: Reference, period: float) -> tuple[Vectors, int]:
        """Its torque; t is the time of the reference that it is given."""
        t = min((memory + 0.5) * period, DURATION)
        given = called(f"{self.name} at t = {memory * period:.3f} s", self.function, q, v, *reference, t)
        tau = floats(f"the torque of {self.name}", given)
        if tau.shape != (self.joints,):
            raise ArgumentError(
                f"{self.name} gave a torque of shape {tau.shape} at t = {memory * period:.3f} s, expected"
                f" ({self.joints},); return one torque per joint."
            )
        if not np.isfinite(tau).all():
            raise ArgumentError(f"{self.name} gave the torque {told(tau)} at t = {memory * period:.3f} s; correct it.")
        return tau, memory + 1


def _controller(name: str, made: Any, joints: int) -> Controller:
    if isinstance(made, Controller):
        if made.nv != joints:
            raise ArgumentError(f"{name} made a law for {made.nv} joints, the arm has {joints}; build it for the arm.")
        return made
    if not callable(made):
        raise ArgumentError(f"{name} made {told(made)}; return a callable of q, v, q_d, v_d, a_d, t, or a Controller.")
    return Called(name, made, joints)


def _bound(name: str, given: Any, joints: int) -> JointArray | None:
    """What a promise says of every joint; one number stands for all."""
    if given is None:
        return None
    bound = floats(name, given)
    if bound.shape not in ((), (joints,)) or not (np.isfinite(bound) & (bound > 0.0)).all():
        raise ArgumentError(f"{name} is {told(given)}; give one error > 0 or {joints} of them [rad], or None.")
    return np.full(joints, bound)


def _of_file(file: Path, function: str) -> Callable[..., Any]:
    found = getattr(_module(file), function, None)
    if not callable(found):
        raise ArgumentError(f"{file} has no function '{function}'; name one of it.")
    return found


def _module(file: Path) -> Any:
    """The module of the file, which may import its neighbours."""
    folder = str(file.resolve().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    name = f"entrant_{file.stem}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ArgumentError(f"{file} is no Python file; give FILE.py:FUNCTION.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        called(f"{file}", spec.loader.exec_module, module)
    except ArgumentError:
        del sys.modules[name]
        raise
    return module
