"""A packed law and its model of the arm as one header and one source file of C."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.units import several, units
from nbs_pin.export.networks import damping_c, potential_c
from nbs_pin.export.statements import Precision, literal, statements, table
from nbs_pin.export.symbols import Tape
from nbs_pin.export.templates import filled
from nbs_pin.export.tracing import Hook, as_python
from nbs_pin.kernels import layout as at
from nbs_pin.kernels.laws import law_workspace, torque_of
from nbs_pin.kernels.layout import LawCode, Packed
from nbs_pin.kernels.records import State, Target
from nbs_pin.kernels.tree_layout import BASE, BODY, PLACE
from nbs_pin.kernels.views import damping_in, pid_of, potential_in

_ASCII = {"·": " ", "²": "^2", "τ": "tau", "≤": "<=", "≥": ">=", "‖": "|", "ω": "omega", "Λ": "Lambda", "−": "-", "∞": "oo", "√": "sqrt"}
_SECTIONS = {"errors": "errors", "backstepping": "the law", "linear_law": "the law", "friction": "friction"}
_JOINTS = {"place": "place joint", "sweep": "motion and load of body", "gather": "torque of joint"}
"""What kernels do, as remarks in the C; the latter for each joint."""


@dataclass(frozen=True)
class Exported:
    """A law that becomes C."""

    name: str
    """What its files and functions begin with; an identifier of C."""
    law: Packed
    """As `layout.pack_law` or `layout.pack_pid` packs it."""
    tree: Packed | None
    """Its model (`tree_layout.pack_tree`); None for a PID."""
    effort_limit: JointArray
    """[N·m, N]; inf where there is none."""
    rate_limit: JointArray
    """Largest change of the torque per second [N·m/s, N/s]; inf where there is none."""
    gravity: bool
    """Whether the torque holds the weight of the arm."""
    precision: Precision
    title: str
    joint_names: tuple[str, ...]
    prismatic: Bool[np.ndarray, " n"]
    robot_sha256: str
    known: tuple[str, ...]
    """What a certificate says of the law, line by line."""
    versions: dict[str, str]

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(self.law.layout[at.JOINTS])

    @property
    def code(self) -> LawCode:
        """Which law it is."""
        return LawCode(int(self.law.layout[at.LAW]))

    def unit(self, quantity: str) -> str:
        """The unit of a quantity of all joints, in ASCII."""
        return several(units(quantity, self.prismatic)).replace("·", " ")

    @property
    def words(self) -> dict[str, object]:
        """What the templates need of every law."""
        return {
            "NAME": self.name,
            "PREFIX": self.name.upper(),
            "N": self.nv,
            "TITLE": comment(self.title),
            "VERSION": self.versions["nbs_pin"],
            "VERSIONS": ", ".join(f"{name} {version}" for name, version in self.versions.items() if name != "nbs_pin"),
            "PRECISION": self.precision,
            "SHA256": self.robot_sha256,
        }


def law_files(exported: Exported) -> dict[str, str]:
    """The header and the source file, by name."""
    parts, torque = _pid(exported) if exported.code is LawCode.PID else _with_model(exported)
    tables, limits = _limits(exported)
    words, remembers = exported.words, exported.code is LawCode.PID
    source = words | {
        "PARTS": "\n".join([*parts, *tables]),
        "TORQUE": torque,
        "START": _inner(["state->integral[i] = 0;", "state->derivative[i] = 0;"] if remembers else []),
        "LIMITS": _inner(limits),
    }
    memory = (
        f"    {exported.name}_real integral[{exported.nv}]; /* the integral term [{exported.unit('torque')}] */\n"
        f"    {exported.name}_real derivative[{exported.nv}]; /* the filtered rate of the error [{exported.unit('velocity')}] */\n"
    )
    text = _without_blanks(filled("law.c", source))
    header = words | {
        "ABOUT": "\n".join(f" * {comment(line)}".rstrip() for line in _about(exported)),
        "MEMORY": memory if remembers else "",
        "LIBM": ", ".join(_libm(text)) or "no function",
        "RATE_WORDS": " and its rate" if np.isfinite(exported.rate_limit).any() else "",
        "TORQUE_UNIT": exported.unit("torque"),
        "POSITION_UNIT": exported.unit("position"),
        "VELOCITY_UNIT": exported.unit("velocity"),
    }
    return {f"{exported.name}.h": filled("law.h", header), f"{exported.name}.c": text}


def pid_limit(law: Packed) -> JointArray:
    """Where the torque of a PID saturates [N·m]."""
    return as_python(pid_of, {})(law.weights).limit


def comment(text: str) -> str:
    """A text that may stand in a comment of C, in ASCII."""
    for word, plain in _ASCII.items():
        text = text.replace(word, plain)
    return text.encode("ascii", "replace").decode().replace("*/", "* /").replace("\n", " ")


def _about(exported: Exported) -> list[str]:
    """What the head of the header says of the arm and the law."""
    rows = zip(exported.joint_names, exported.effort_limit, exported.rate_limit, exported.prismatic, strict=True)
    joints = [
        f"  {i}  {name}: |tau| <= {effort:g} {'N' if slides else 'N m'}"
        + (f", |dtau/dt| <= {rate:g} {'N' if slides else 'N m'}/s" if np.isfinite(rate) else "")
        for i, (name, effort, rate, slides) in enumerate(rows)
    ]
    weight = "holds the weight of the arm" if exported.gravity else "leaves the weight of the arm to the arm itself"
    fed = exported.code is not LawCode.PID and bool(exported.law.layout[at.FRICTION])
    friction = "and feeds joint friction forward" if fed else "and feeds no joint friction forward"
    certified = ["", *exported.known] if exported.known else ["", "No certificate was given at the export."]
    return ["Joints:", *joints, "", f"The torque {weight} {friction}.", *certified]


def traced(law: Packed, tree: Packed) -> tuple[Tape, np.ndarray]:
    """The torque of a law on a tree, `kernels.laws.torque_of`, for symbols in place of the state and the reference."""
    tape, n = Tape(), int(law.layout[at.JOINTS])
    q, v, q_ref, v_ref, a_ref = (tape.variables(name, n) for name in ("q", "v", "q_ref", "v_ref", "a_ref"))
    tau, work = np.zeros(n, dtype=object), np.zeros(law_workspace(law, tree), dtype=object)
    as_python(torque_of, _hooks(tape, n))(State(q, v), Target(q_ref, v_ref, a_ref), law, tree, work, tau)
    return tape, tau


def _hooks(tape: Tape, n: int) -> dict[str, Hook]:
    """Networks as calls of C functions, and remarks on what everything else does."""
    section = [""]

    def potential(error: Any, part: Packed, work: Any, out: Any) -> None:
        arrays = {"z1": error.value, "dz1": error.rate}
        out.value[:], out.rate[:] = tape.call("potential", arrays, {"gradient": n, "product": n})

    def damping(z: Any, part: Packed, work: Any, force: Any) -> None:
        (force[:],) = tape.call("damping_force", {"z2": z}, {"force": n})

    def within(words: str, each: bool) -> Hook:
        def hook(plain: Callable[..., Any]) -> Callable[..., Any]:
            def run(*given: Any) -> Any:
                section[0] = words
                if not each:
                    tape.remark(words)
                return plain(*given)

            return run

        return hook

    def joint_of(plain: Callable[..., Any]) -> Callable[..., Any]:
        def run(i: int, *given: Any) -> Any:
            tape.remark(f"{section[0]} {i + 1}")
            return plain(i, *given)

        return run

    sections = {name: within(words, False) for name, words in _SECTIONS.items()}
    joints = {name: within(words, True) for name, words in _JOINTS.items()}
    networks: dict[str, Hook] = {"potential": lambda _: potential, "damping_force": lambda _: damping}
    return {**sections, **joints, **networks, "joint_of": joint_of}


def _with_model(exported: Exported) -> tuple[list[str], str]:
    """Tables and functions, and the body of the torque, of a law with a model."""
    assert exported.tree is not None
    tree, parts = _folded(exported.tree, exported.gravity), []
    if exported.code is LawCode.BACKSTEPPING:
        phi, d = (as_python(view, {})(exported.law) for view in (potential_in, damping_in))
        parts = [potential_c(phi, exported.precision), damping_c(d, exported.precision)]
    tape, tau = traced(exported.law, tree)
    # A law that needs no velocity of the arm or no reference of its own still has all arguments.
    unused = [f"    (void){name};" for name in ("state", "v", "v_ref", "a_ref", "period")]
    return parts, "\n".join([*unused, statements(tape, {"tau": tau}, exported.precision)])


def _folded(tree: Packed, gravity: bool) -> Packed:
    """The tree with rotations that are 0 up to rounding set to 0, so that they cost nothing, and weightless if wanted."""
    weights = tree.weights.copy()
    for rotation in weights[BASE:].reshape(-1, BODY)[:, :PLACE]:
        rotation[np.abs(rotation) <= np.finfo(float).eps] = 0.0
    if not gravity:
        weights[:BASE] = 0.0
    return Packed(tree.layout, weights)


def _pid(exported: Exported) -> tuple[list[str], str]:
    gains, precision = as_python(pid_of, {})(exported.law.weights), exported.precision
    names = {"kp": gains.kp, "ki": gains.ki, "kd": gains.kd, "filter_time": gains.filter_time, "wraps": gains.wraps}
    parts = [table(name, values, precision) for name, values in (names | {"saturated": _finite(gains.limit, precision)}).items()]
    words = {
        "N": exported.nv,
        "PI": literal(np.pi, precision),
        "TURN": literal(2.0 * np.pi, precision),
        "CEIL": "ceil" if precision == "double" else "ceilf",
    }
    return parts, filled("pid.c", words)


def _limits(exported: Exported) -> tuple[list[str], list[str]]:
    """Tables of the limits that there are, and what is done to next.tau[i]."""
    tables, lines = [], []
    if np.isfinite(exported.effort_limit).any():
        tables += [table("effort_limit", _finite(exported.effort_limit, exported.precision), exported.precision)]
        lines += ["next.tau[i] = clamped(next.tau[i], effort_limit[i]);"]
    if np.isfinite(exported.rate_limit).any():
        tables += [table("rate_limit", _finite(exported.rate_limit, exported.precision), exported.precision)]
        lines += ["next.tau[i] = state->tau[i] + clamped(next.tau[i] - state->tau[i], rate_limit[i] * period);"]
    clamped = "static real clamped(real x, real most)\n{\n    return x > most ? most : (x < -most ? -most : x);\n}\n"
    return ([*tables, clamped] if lines else []), lines


def _finite(limits: JointArray, precision: Precision) -> JointArray:
    """C has no constant for infinity: the largest number takes its place."""
    return np.minimum(limits, np.finfo(np.float64 if precision == "double" else np.float32).max)


def _libm(text: str) -> list[str]:
    return sorted(set(re.findall(r"\b((?:sin|cos|sqrt|tanh|ceil)f?)\(", text)))


def _inner(lines: list[str]) -> str:
    return "\n".join(f"            {line}" for line in lines)


def _without_blanks(text: str) -> str:
    """The text without blank lines that follow another or a bracket."""
    lines: list[str] = []
    for line in text.splitlines():
        if line.strip() or not lines or not (lines[-1] == "" or lines[-1].endswith("{")):
            lines.append(line.rstrip())
    return "\n".join(lines) + "\n"
