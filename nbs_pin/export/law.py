"""A packed law and its model of the arm as one header and one source file of C."""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.units import several, units
from nbs_pin.export.adaptation import Adapting, Load, adaptive_parts, adaptive_torque, load_c
from nbs_pin.export.networks import damping_c, potential_c
from nbs_pin.export.reals import LIBM, Real
from nbs_pin.export.statements import statements
from nbs_pin.export.templates import filled
from nbs_pin.export.traced_law import traced
from nbs_pin.export.tracing import as_python
from nbs_pin.kernels import layout as at
from nbs_pin.kernels.layout import LawCode, Packed
from nbs_pin.kernels.views import damping_in, pid_of, potential_in

_ASCII = {"·": " ", "²": "^2", "τ": "tau", "≤": "<=", "≥": ">=", "‖": "|", "ω": "omega", "Λ": "Lambda", "−": "-"}
_CLAMPED = "static real clamped(real x, real most)\n{\n    return x > most ? most : (x < -most ? -most : x);\n}\n"
_LIBM = re.compile(rf"\b((?:{'|'.join(LIBM)})f?)\(")


@dataclass(frozen=True, eq=False)
class Exported:
    """A law that becomes C."""

    name: str
    """What its files and functions begin with; an identifier of C."""
    law: Packed
    """As `layout.pack_law` or `layout.pack_pid` packs it."""
    tree: Packed | None
    """Its model (`tree_layout.pack_tree`); None for a PID."""
    adapting: Adapting | None
    """What it adapts, beginning with that model; None for nothing."""
    effort_limit: JointArray
    """[N·m, N]; inf where there is none."""
    rate_limit: JointArray
    """Largest change of the torque per second [N·m/s, N/s]; inf where there is none."""
    gravity: bool
    """Whether the torque holds the weight of the arm."""
    real: Real
    title: str
    joint_names: tuple[str, ...]
    prismatic: Bool[np.ndarray, " n"]
    robot_sha256: str
    """Empty for a law whose arm has no description."""
    known: tuple[str, ...]
    """What a certificate says of the law, line by line."""
    versions: dict[str, str]

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(self.law.layout[at.JOINTS])

    @property
    def has_weight(self) -> bool:
        """Whether the torque has the arm's weight in it from the model on; a PID has no model."""
        return self.gravity and self.tree is not None

    @property
    def code(self) -> LawCode:
        """Which law it is."""
        return LawCode(int(self.law.layout[at.LAW]))

    def unit(self, quantity: str) -> str:
        """The unit of a quantity of all joints, for a comment."""
        return comment(several(units(quantity, self.prismatic)))

    @property
    def words(self) -> dict[str, object]:
        """What every template needs."""
        libraries = (f"{name} {version}" for name, version in self.versions.items() if name != "nbs_pin")
        return {
            "NAME": self.name,
            "PREFIX": self.name.upper(),
            "N": self.nv,
            "TITLE": comment(self.title),
            "VERSION": self.versions["nbs_pin"],
            "VERSIONS": ", ".join(libraries),
            "PRECISION": self.real.precision,
            "SHA256": self.robot_sha256,
            "TORQUE_UNIT": self.unit("torque"),
            "POSITION_UNIT": self.unit("position"),
            "VELOCITY_UNIT": self.unit("velocity"),
        }


def law_files(exported: Exported) -> dict[str, str]:
    """The header and the source file, by name."""
    words, adapting = exported.words, exported.adapting
    parts, torque = _pid(exported) if exported.tree is None else _on_tree(exported, exported.tree)
    tables, limits, first = _limits(exported)
    source = words | {
        "PARTS": "\n".join([*parts, *tables]),
        "TORQUE": torque,
        "FIRST": first,
        "START": _inner([f"state->{name}[i] = 0;" for name in _remembered(exported)], 2),
        "ESTIMATES": "" if adapting is None else filled("start.c", adapting.words),
        "LONGER": "" if adapting is None else f" || period > {exported.real.literal(adapting.longest)}",
        "LIMITS": _inner(limits, 3),
        "LOAD": "" if adapting is None else load_c(adapting, exported.real, words),
    }
    text = _without_blanks(filled("law.c", source))
    header = words | {
        "ABOUT": "\n".join(f" * {comment(line)}".rstrip() for line in _about(exported)),
        "MEMORY": _memory(exported),
        "LIBM": ", ".join(sorted(set(_LIBM.findall(text)))) or "nothing",
        "LOAD": "" if adapting is None or adapting.load is None else _load(adapting.load, words),
        "LONGER": "" if adapting is None else f" or above {adapting.period:g} s",
        "BEGIN": "" if adapting is None else " The estimates become the first ones.",
        "LIMITED": "its rate and then its size" if np.isfinite(exported.rate_limit).any() else "its size",
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
    joints = []
    for i, (name, unit) in enumerate(zip(exported.joint_names, units("torque", exported.prismatic), strict=True)):
        effort, rate = exported.effort_limit[i], exported.rate_limit[i]
        rated = f", |dtau/dt| <= {rate:g} {unit}/s" if np.isfinite(rate) else ""
        joints.append(f"  {i}  {name}: |tau| <= {effort:g} {unit}{rated}")
    weight = "holds the weight of the arm" if exported.has_weight else "leaves the weight of the arm to the arm itself"
    if exported.tree is None:
        weight = "holds by its integral what the arm does not hold of its weight"
    fed = exported.tree is not None and bool(exported.law.layout[at.FRICTION])
    friction = "feeds joint friction forward" if fed else "feeds no joint friction forward"
    certified = exported.known or ("No certificate was given at the export.",)
    return ["Joints:", *joints, "", f"The torque {weight} and {friction}.", *_adapts(exported), "", *certified]


def _adapts(exported: Exported) -> list[str]:
    """What the head of the header says of the estimates."""
    if exported.adapting is None:
        return []
    own = "" if exported.has_weight else " Of the weight it holds what the estimates add to that of its model."
    return [
        f"It adapts: {', '.join(exported.adapting.names)}.{own}",
        "The estimates begin as its model has them, and wait while a torque of the law is beyond the effort limit.",
    ]


def _remembered(exported: Exported) -> tuple[str, ...]:
    """What a state remembers of every joint beside the torque, 0 at first."""
    if exported.code is LawCode.PID:
        return "integral", "derivative"
    return () if exported.adapting is None else ("output", "before")


def _memory(exported: Exported) -> str:
    """The same in the declaration of a state, and the estimates."""
    if exported.code is LawCode.PID:
        return filled("pid_memory.h", exported.words)
    return "" if exported.adapting is None else filled("adaptive_memory.h", exported.words | exported.adapting.words)


def _load(load: Load, words: dict[str, object]) -> str:
    return filled("load.h", words | {"FRAME": comment(load.frame)})


def _on_tree(exported: Exported, tree: Packed) -> tuple[list[str], str]:
    """Tables and functions, and the body of the torque, of a law with a model."""
    parts: list[str] = []
    if exported.code is LawCode.BACKSTEPPING:
        phi, d = (as_python(view, {})(exported.law) for view in (potential_in, damping_in))
        parts = [potential_c(phi, exported.real), damping_c(d, exported.real)]
    # All laws have the same arguments, though not each needs them all.
    idle = [f"    (void){name};" for name in ("state", "v", "q_ref", "v_ref", "a_ref", "period")]
    if exported.adapting is None:
        tape, tau = traced(exported.law, tree, exported.gravity)
        return parts, "\n".join([*idle, statements(tape, {"tau": tau.tolist()}, exported.real)])
    limited = bool(np.isfinite(exported.effort_limit).any())
    torque = adaptive_torque(
        exported.law, tree, exported.adapting, exported.real, gravity=exported.gravity, limited=limited
    )
    return [*parts, *adaptive_parts(exported.adapting, exported.real)], "\n".join([*idle, torque])


def _pid(exported: Exported) -> tuple[list[str], str]:
    """Tables, and the body of the torque, of a PID."""
    gains, real = as_python(pid_of, {})(exported.law.weights), exported.real
    tables = gains._asdict() | {"saturated": gains.limit}
    del tables["limit"]
    words = {
        "N": exported.nv,
        "PI": real.literal(np.pi),
        "TURN": real.literal(2.0 * np.pi),
        "CEIL": real.function("ceil"),
    }
    return [real.table(name, values) for name, values in tables.items()], filled("pid.c", words)


def _limits(exported: Exported) -> tuple[list[str], list[str], str]:
    """Tables of the limits that there are, what is done to next.tau[i], and what of tau[i] the first step builds on."""
    tables, lines, first = [], [], "tau[i]"
    if np.isfinite(exported.rate_limit).any():
        tables += [exported.real.table("rate_limit", exported.rate_limit)]
        lines += ["next.tau[i] = state->tau[i] + clamped(next.tau[i] - state->tau[i], rate_limit[i] * period);"]
    if np.isfinite(exported.effort_limit).any():  # last, so that it holds whatever the torque before was
        tables += [exported.real.table("effort_limit", exported.effort_limit)]
        lines += ["next.tau[i] = clamped(next.tau[i], effort_limit[i]);"]
        first = "clamped(tau[i], effort_limit[i])"
    return ([*tables, _CLAMPED] if lines else []), lines, first


def _inner(lines: list[str], depth: int) -> str:
    return "\n".join(f"{'    ' * depth}{line}" for line in lines)


def _without_blanks(text: str) -> str:
    """The text without blank lines that follow another or a bracket."""
    lines: list[str] = []
    for line in text.splitlines():
        if line.strip() or not (lines and (lines[-1] == "" or lines[-1].endswith("{"))):
            lines.append(line.rstrip())
    return "\n".join(lines) + "\n"
