"""A law that adapts as operations: the kernel `adaptation.adaptive_step` run on symbols, its logistic as calls."""

from typing import Any, NamedTuple

import numpy as np

from nbs_pin.export.symbols import Number, Tape
from nbs_pin.export.traced_law import after, folded, law_hooks
from nbs_pin.export.tracing import Hook, as_python
from nbs_pin.kernels import layout as at
from nbs_pin.kernels.adaptation import BODIES, NUMBERS, adaptive_step, adaptive_workspace
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import Motion, State, Target
from nbs_pin.kernels.symmetric4 import TRIANGLE
from nbs_pin.kernels.trees import tree_torque


class AdaptiveTrace(NamedTuple):
    """The operations of one step, of symbols q, v, q_ref, v_ref, a_ref, period and those of the state."""

    tape: Tape
    whole: np.ndarray
    """The law's torque (n,)."""
    weight: np.ndarray
    """G(q) of the model that is believed at first (n,), which an arm may hold itself."""
    kept: list[Number]
    """The duals (m,) within their bounds, as they stay where the estimates wait."""
    moved: np.ndarray
    """The duals after the step (m,)."""
    output: np.ndarray
    """What drives adaptation two steps later (n,)."""


def duals_of(unknown: Packed) -> int:
    """How many duals the state holds."""
    return TRIANGLE * int(unknown.layout[BODIES]) + int(unknown.layout[NUMBERS])


def traced_adaptation(law: Packed, tree: Packed, unknown: Packed) -> AdaptiveTrace:
    """One step of a law that adapts, in which the duals move whatever the torque is."""
    tape, n, model = Tape(), int(law.layout[at.JOINTS]), folded(tree, gravity=True)
    q, v, q_ref, v_ref, a_ref = (tape.variables(name, n) for name in ("q", "v", "q_ref", "v_ref", "a_ref"))
    before, duals = tape.variables("state->before", n), tape.variables("state->dual", duals_of(unknown))
    tau, output, weight = np.zeros((3, n), dtype=object)
    work = np.zeros(adaptive_workspace(law, tree), dtype=object)
    kept: list[Number] = []
    hooks = law_hooks(tape, n) | _hooks(tape, kept)
    state, target, limit = State(q, v), Target(q_ref, v_ref, a_ref), np.full(n, np.inf)
    step = as_python(adaptive_step, hooks)
    step(before, state, target, tape.variable("period"), limit, law, model, unknown, work, tau, duals, output)
    still = np.zeros(n)
    as_python(tree_torque, {})(Motion(q, still, still, still), model, work, weight)
    return AdaptiveTrace(tape, tau, weight, kept, duals, output)


def _hooks(tape: Tape, kept: list[Number]) -> dict[str, Hook]:
    """The logistic function and cuts as calls; the duals before they move go into `kept`."""
    bodies = [0]

    def logistic(dual: Any, work: Any, x: Any) -> None:
        bodies[0] += 1
        given, made = {f"dual{bodies[0]}": dual}, {f"x{bodies[0]}": 16, f"kept{bodies[0]}": TRIANGLE}
        x[:], dual[:] = tape.call("logistic", given, made)

    return {
        "logistic": lambda _: logistic,
        "nearest": lambda _: lambda dual: tape.function("nearest", dual),
        "within": lambda _: lambda *_: True,
        "is_finite": lambda _: lambda *_: True,
        "move_duals": lambda plain: after(lambda *given: kept.extend(given[-1]), plain),
    }
