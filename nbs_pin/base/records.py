"""Records that are passed between the parts of the package: reference values and recorded runs."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.archives import parse_json
from nbs_pin.base.arguments import PERIOD, a, check_fields, checked, count, mapping, readable, text, writable
from nbs_pin.base.arrays import Array, JointArray
from nbs_pin.base.checks import floats, told
from nbs_pin.base.exceptions import ArgumentError, FileFormatError
from nbs_pin.base.npz import read_npz, require, write_npz
from nbs_pin.base.shown import Cells, Shown, joints_told
from nbs_pin.base.units import JointUnits, counted, measured, units_of

RUN_FORMAT = "nbs_pin run 1"
"""Value of the entry `format` in a run file."""
ROW_ARRAYS = ("q", "v", "tau", "tau_command", "disturbance", "q_ref", "v_ref", "a_ref")
"""Arrays of a run with a number for each instant, start and joint."""
_PER_JOINT = ("effort_limit", "continuous", "joint_names")
_JSON = ("robot_options", "info")
_OPTIONAL = {"prismatic": "b", "estimates": "f"}


class Reference(NamedTuple):
    """Desired configuration q [rad], velocity v [rad/s] and acceleration a [rad/s²], shape (..., nv).

    Example:
        >>> import nbs_pin as nbs
        >>> import numpy as np
        >>> def accelerate(t):  # one joint, for a time or an array of times
        ...     t = np.asarray(t, dtype=float)[..., None]
        ...     return nbs.Reference(q=0.5 * t**2, v=t, a=np.ones_like(t))
        >>> accelerate(2.0)
        Reference(q=array([2.]), v=array([2.]), a=array([1.]))
    """

    q: Array
    v: Array
    a: Array


@dataclass(frozen=True, eq=False, repr=False)
class Run(Shown):
    """A recorded simulation; row k of every array belongs to the control instant t[k].

    The torque in row k acts from t[k] to t[k+1]; the torque in the last row was computed but not applied.
    A batch of initial states adds axes between time and joint: q has shape (steps + 1, ..., nv).

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, plant = nbs.NeuralBackstepping.for_robot(robot), nbs.DynamicsPlant.for_robot(robot)
        >>> run = nbs.simulate(plant, law, nbs.Hold([0.3, 0.2]), 0.1, 0.001)
        >>> run.joint_names, run.t.shape, run.tau.shape
        (('joint1', 'joint2'), (101,), (101, 2))
    """

    t: Float[np.ndarray, " rows"]
    """Time [s]."""
    q: Float[np.ndarray, "rows *batch n"]
    """Configuration [rad]."""
    v: Float[np.ndarray, "rows *batch n"]
    """Velocity [rad/s]."""
    tau: Float[np.ndarray, "rows *batch n"]
    """Applied torque, after the effort limits [N·m]."""
    tau_command: Float[np.ndarray, "rows *batch n"]
    """Commanded torque, before the effort limits [N·m]."""
    disturbance: Float[np.ndarray, "rows *batch n"]
    """Disturbance torque τ_d at the control instants [N·m], 0 in the last row."""
    q_ref: Float[np.ndarray, "rows *batch n"]
    """Desired configuration [rad]."""
    v_ref: Float[np.ndarray, "rows *batch n"]
    """Desired velocity [rad/s]."""
    a_ref: Float[np.ndarray, "rows *batch n"]
    """Desired acceleration [rad/s²]."""
    effort_limit: JointArray
    """Largest |τ| per joint [N·m], inf where there is no limit."""
    continuous: Bool[np.ndarray, " n"]
    """True for joints whose error is wrapped to (−π, π]."""
    joint_names: tuple[str, ...]
    """Names of the joints, in order."""
    period: float
    """Control period [s]."""
    robot: str = ""
    """`Robot.source` of the arm, or empty."""
    robot_sha256: str = ""
    """`Robot.sha256` of that arm, or empty."""
    robot_options: dict[str, Any] = field(default_factory=dict)
    """`Robot.options` of that arm."""
    info: dict[str, Any] = field(default_factory=dict)
    """Further metadata (controller, plant, seed, versions), stored as JSON."""
    prismatic: Bool[np.ndarray, " n"] | None = None
    """True for joints that slide, with q in [m] and a force tau [N]; None, as in older files, is for no joint."""
    estimates: Float[np.ndarray, "rows *batch k"] | None = None
    """What a law that adapts believed in each row, named in `info["estimates"]`; None for other laws."""

    def __post_init__(self) -> None:
        check_fields(self, period=PERIOD, robot=text, robot_sha256=text, robot_options=mapping, info=mapping)
        for name in ("t", *ROW_ARRAYS, "effort_limit"):
            object.__setattr__(self, name, floats(f"Run: {name}", getattr(self, name)))
        wraps = floats("Run: continuous", self.continuous, truths=True).astype(bool)
        object.__setattr__(self, "continuous", wraps)
        if self.prismatic is not None:
            slides = floats("Run: prismatic", self.prismatic, truths=True).astype(bool)
            if slides.shape != wraps.shape:
                raise ArgumentError(
                    f"Run: prismatic has shape {slides.shape}, expected {wraps.shape}, one truth value per joint."
                )
            object.__setattr__(self, "prismatic", slides)
        if self.estimates is not None:
            object.__setattr__(self, "estimates", floats("Run: estimates", self.estimates))
            if self.estimates.shape[:-1] != self.q.shape[:-1]:
                raise ArgumentError(
                    f"Run: estimates has shape {self.estimates.shape} beside q of shape {self.q.shape}; give a row of"
                    " them for each of q."
                )
        names = tuple(self.joint_names) if isinstance(self.joint_names, tuple | list) else ()
        object.__setattr__(self, "joint_names", names)
        shape = self.q.shape
        expected = dict.fromkeys(ROW_ARRAYS, shape) | {"t": shape[:1], "effort_limit": shape[-1:]}
        found = {name: getattr(self, name).shape for name in expected}
        found, expected = found | {"continuous": wraps.shape}, expected | {"continuous": shape[-1:]}
        wrong = [name for name in expected if len(shape) < 2 or 0 in shape or found[name] != expected[name]]
        if wrong:
            raise ArgumentError(
                f"Run: {wrong[0]} has shape {found[wrong[0]]} beside q of shape {shape}, expected"
                f" {expected[wrong[0]]}, where q is (rows, ..., joints); give arrays that fit."
            )
        if len(names) != shape[-1] or not all(isinstance(name, str) for name in names):
            raise ArgumentError(f"Run: joint_names is {told(self.joint_names)}, expected {shape[-1]} texts; give them.")

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(self.q.shape[-1])

    @property
    def signals(self) -> dict[str, Any]:
        """What has a row for each instant besides `t`: `ROW_ARRAYS`, and the estimates if there are any."""
        own: dict[str, Any] = {name: getattr(self, name) for name in ROW_ARRAYS}
        return own if self.estimates is None else own | {"estimates": self.estimates}

    def _facts(self) -> Iterable[str]:
        starts = math.prod(self.q.shape[1:-1])
        several = () if starts == 1 else (counted(starts, "start"),)
        arm = (self.robot.rsplit("/", 1)[-1],) if self.robot else ()
        length = f"{self.t[-1] - self.t[0]:.6g} s at {1e3 * self.period:.6g} ms"
        return *arm, joints_told(self.nv), length, *several

    def _cells(self) -> Cells:
        error = self.q - self.q_ref
        error = np.where(self.continuous, np.arctan2(np.sin(error), np.cos(error)), error)
        worst, torque = (np.abs(x).max(axis=tuple(range(x.ndim - 1))) for x in (error, self.tau))
        each = zip(self.joint_names, worst, torque, self.units, strict=True)
        rows = [(name, measured(e, of.position), measured(tau, of.torque)) for name, e, tau, of in each]
        return Cells(("joint", "largest error", "largest torque"), rows)

    @property
    def slides(self) -> Bool[np.ndarray, " n"]:
        """`prismatic`, or False for every joint if it is not stated."""
        return np.zeros(self.nv, dtype=bool) if self.prismatic is None else self.prismatic

    @property
    def units(self) -> tuple[JointUnits, ...]:
        """The units of every joint."""
        return units_of(self.slides)

    @checked(path=writable)
    def save(self, path: str | Path) -> None:
        """Write the run to an npz file atomically; missing folders are created.

        Raises:
            ArgumentError: If `load` would refuse the file: a number is not finite, times do not increase, a limit is
                not > 0, or `info` or `robot_options` cannot be stored as JSON. `head` gives the rows before a number.
        """
        check_numbers("Run.save", self)
        values = {entry.name: getattr(self, entry.name) for entry in dataclasses.fields(self)}
        values = {name: value for name, value in values.items() if value is not None}
        texts = {name: as_json(name, values[name]) for name in _JSON} | {"format": RUN_FORMAT}
        write_npz(path, {name: np.asarray(value) for name, value in (values | texts).items()})

    @checked(rows=count(1, of="rows"))
    def head(self, rows: int) -> "Run":
        """The first rows of the run, all of them if it has fewer."""
        return dataclasses.replace(self, t=self.t[:rows], **{name: x[:rows] for name, x in self.signals.items()})

    @classmethod
    @checked(path=readable)
    def load(cls, path: str | Path) -> "Run":
        """The run in an npz file written by `save`.

        Raises:
            FileFormatError: If the file is damaged, a key is missing, a shape is wrong or a number is not finite.
        """
        names = {entry.name for entry in dataclasses.fields(cls)} | {"format"}
        data = {"robot_options": np.array("{}"), **read_npz(path, names)}  # absent in the oldest run files
        require(data, path, {"format": "U", "t": "f", **dict.fromkeys(ROW_ARRAYS, "f"), "effort_limit": "f"})
        require(data, path, {"continuous": "b", **dict.fromkeys(("joint_names", "robot", "robot_sha256", *_JSON), "U")})
        require(data, path, {"period": "f", **{name: kind for name, kind in _OPTIONAL.items() if name in data}})
        if str(data["format"]) != RUN_FORMAT:
            raise FileFormatError(f"{path}: format '{data['format']}', expected '{RUN_FORMAT}'; record the run again.")
        _check_shapes(path, data)
        for name, (fault, _) in _number_faults(data).items():
            raise FileFormatError(f"{path}: '{name}' has {fault}; record the run again.")
        return cls(
            **{name: data[name] for name in ("t", *ROW_ARRAYS, "effort_limit", "continuous")},
            joint_names=tuple(str(name) for name in data["joint_names"]),
            period=float(data["period"]),
            robot=str(data["robot"]),
            robot_sha256=str(data["robot_sha256"]),
            robot_options=parse_json(path, "robot_options", str(data["robot_options"])),
            info=parse_json(path, "info", str(data["info"])),
            prismatic=data.get("prismatic"),
            estimates=data.get("estimates"),
        )


RUN = a(Run, "what simulate returned or Run.load read")
"""The check of an argument that is a run."""


def check_numbers(function: str, run: Run) -> None:
    """Raise ArgumentError, naming the function that was to write it, for a run that no file may have."""
    for name, (fault, row) in _number_faults(vars(run)).items():
        kept = f"save the rows before it, head({row})" if row else "correct it"
        raise ArgumentError(f"{function}: {name} has {fault}{f' in row {row}' if row else ''}; {kept}.")


def _check_shapes(path: str | Path, data: dict[str, np.ndarray]) -> None:
    shape = data["q"].shape
    joints = (*_PER_JOINT, *(["prismatic"] if "prismatic" in data else []))
    expected = dict.fromkeys(ROW_ARRAYS, shape) | dict.fromkeys(joints, shape[-1:]) | {"t": shape[:1], "period": ()}
    if "estimates" in data:
        expected["estimates"] = (*shape[:-1], *data["estimates"].shape[-1:])
    for name, wanted in expected.items():
        if len(shape) < 2 or 0 in shape or data[name].shape != wanted:
            raise FileFormatError(
                f"{path}: '{name}' has shape {data[name].shape}, expected {wanted} for q of shape {shape}, "
                "(rows, ..., joints), at least one of each; record the run again."
            )


def _number_faults(arrays: Mapping[str, Any]) -> dict[str, tuple[str, int]]:
    """What no file of a run may have, by array, with the first row that has it, or 0."""
    faults = {}
    for name in ("t", *ROW_ARRAYS, *(["estimates"] if arrays.get("estimates") is not None else [])):
        finite = np.isfinite(arrays[name]).reshape(len(arrays["t"]), -1).all(axis=1)
        if not finite.all():
            faults[name] = "numbers that are not finite", int(np.argmin(finite))
    if not (arrays["effort_limit"] > 0.0).all():
        faults["effort_limit"] = "limits that are not > 0", 0
    if not 0.0 < arrays["period"] < np.inf:
        faults["period"] = "a value that is not finite and > 0", 0
    if not (np.diff(arrays["t"]) > 0.0).all():
        faults.setdefault("t", ("times that do not increase", 0))
    return faults


def as_json(name: str, value: dict[str, Any]) -> str:
    """The text of `info` or `robot_options` in files; raises ArgumentError if JSON cannot store it."""
    try:
        return json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"run.{name} cannot be stored as JSON ({error}); use numbers, text and lists.") from error
