"""What a law in C adapts: the functions, the memory and the words of it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.export.reals import Real
from nbs_pin.export.statements import statements
from nbs_pin.export.templates import filled
from nbs_pin.export.traced_adaptation import traced_adaptation
from nbs_pin.kernels.adaptation import BODIES
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.symmetric4 import CONVERGED, FARTHEST, SWEEPS, TRIANGLE

_CONVERGED = {"double": CONVERGED, "float": 1e-17}
"""In float the squares of what rounding leaves are larger."""


LATE = 1.0 + 1e-6
"""A period longer than this multiple of the law's own is refused."""


class Load(NamedTuple):
    """How a load follows from its matrix X: its first moment and mass are the last column of K X Kᵀ − known."""

    body: int
    """Which of the bodies it is."""
    frame: str
    """The link that carries it."""
    factor: Float[np.ndarray, "4 4"]
    """K, in the frame of that link."""
    known: Float[np.ndarray, " 4"]
    no_mass: float
    """Below this mass [kg] a load has no centre to speak of."""


@dataclass(frozen=True, eq=False)
class Adapting:
    """What a law adapts."""

    unknown: Packed
    """As `kernels/adaptation.py` has it."""
    start: Float[np.ndarray, " m"]
    """The first duals."""
    period: float
    """Longest control period [s]."""
    names: tuple[str, ...]
    """The unknowns, in words."""
    load: Load | None

    @property
    def longest(self) -> float:
        """The period above which a step is refused [s]."""
        return LATE * self.period

    @property
    def words(self) -> dict[str, object]:
        """What the templates need."""
        return {"DUALS": len(self.start), "TRIANGLE": TRIANGLE}


def adaptive_parts(adapting: Adapting, real: Real) -> list[str]:
    """Tables and functions that the torque calls."""
    words = adapting.words | {
        "FARTHEST": real.literal(FARTHEST),
        "SWEEPS": SWEEPS,
        "CONVERGED": real.literal(_CONVERGED[real.precision]),
        "SQRT": real.function("sqrt"),
        "EXP": real.function("exp"),
    }
    parts = [filled("nearest.c", words)]
    if adapting.unknown.layout[BODIES]:
        parts += [filled("logistic.c", words)]
    return [*parts, real.table("first_dual", adapting.start)]


def adaptive_torque(law: Packed, tree: Packed, adapting: Adapting, real: Real, *, gravity: bool, limited: bool) -> str:
    """The body of the torque; without the weight of the model that is believed at first if not `gravity`.

    Args:
        law: The law that adapts.
        tree: The model that is believed at first.
        adapting: What adapts.
        real: The numbers of C.
        gravity: Whether the torque has that weight.
        limited: Whether there is a table of effort limits, beyond which the estimates wait.
    """
    trace = traced_adaptation(law, tree, adapting.unknown)
    arrays = {"kept": trace.kept, "moved": trace.moved.tolist(), "output": trace.output.tolist()}
    whole = "tau" if gravity else "whole"
    if not gravity:
        arrays["whole"] = trace.whole.tolist()
    declared = ", ".join(f"{name}[{len(values)}]" for name, values in arrays.items())
    arrays["tau"] = (trace.whole if gravity else trace.whole - trace.weight).tolist()
    moves = [f"{whole}[i] <= effort_limit[i]", f"{whole}[i] >= -effort_limit[i]"] if limited else []
    ending = {"N": len(trace.output), "MOVES": " && ".join([*moves, "isfinite(state->before[i])"])}
    return "\n".join(
        [f"    real {declared};", statements(trace.tape, arrays, real), filled("adapt.c", adapting.words | ending)]
    )


def load_c(adapting: Adapting, real: Real, words: dict[str, object]) -> str:
    """The function that tells the load; nothing where none adapts."""
    load = adapting.load
    if load is None:
        return ""
    own = {"FIRST_DUAL": f" + {TRIANGLE * load.body}" if load.body else "", "NO_MASS": real.literal(load.no_mass)}
    tables = [real.table("load_factor", load.factor), real.table("load_known", load.known)]
    return "\n".join([*tables, filled("load.c", words | adapting.words | own)])
