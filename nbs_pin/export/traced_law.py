"""A law on a rigid tree as operations: the kernel `laws.torque_of` run on symbols, its networks as calls."""

from collections.abc import Callable
from typing import Any

import numpy as np

from nbs_pin.export.symbols import Tape
from nbs_pin.export.tracing import Hook, as_python
from nbs_pin.kernels import layout as at
from nbs_pin.kernels.laws import law_workspace, torque_of
from nbs_pin.kernels.layout import Packed
from nbs_pin.kernels.records import State, Target
from nbs_pin.kernels.tree_layout import BASE, BODY, PLACE

_LAW = {
    "errors": "errors",
    "backstepping": "the law",
    "linear_law": "the law",
    "friction": "friction",
    "put_estimates": "estimates",
    "inertia_bars": "how the power depends on the body, and its next dual",
    "output_of": "what drives adaptation",
}
_TREE = {
    "place": "place joint",
    "sweep": "motion and load of body",
    "gather": "torque of joint",
    "spread": "motion at what drives adaptation, of body",
}
"""What kernels do, as remarks in the C; the latter for each joint."""


def traced(law: Packed, tree: Packed, gravity: bool) -> tuple[Tape, np.ndarray]:
    """The operations of τ, and τ (n,), of symbols q, v, q_ref, v_ref and a_ref; without G(q) if not `gravity`."""
    tape, n = Tape(), int(law.layout[at.JOINTS])
    q, v, q_ref, v_ref, a_ref = (tape.variables(name, n) for name in ("q", "v", "q_ref", "v_ref", "a_ref"))
    tau, work = np.zeros(n, dtype=object), np.zeros(law_workspace(law, tree), dtype=object)
    model = folded(tree, gravity)
    as_python(torque_of, law_hooks(tape, n))(State(q, v), Target(q_ref, v_ref, a_ref), law, model, work, tau)
    return tape, tau


def folded(tree: Packed, gravity: bool) -> Packed:
    """The tree with rotations that are 0 up to rounding set to 0, so that they cost nothing; weightless if asked."""
    weights = tree.weights.copy()
    for rotation in weights[BASE:].reshape(-1, BODY)[:, :PLACE]:
        rotation[np.abs(rotation) <= np.finfo(float).eps] = 0.0
    if not gravity:
        weights[:BASE] = 0.0
    return Packed(tree.layout, weights)


def law_hooks(tape: Tape, n: int) -> dict[str, Hook]:
    """Networks as calls of C functions, and remarks on what everything else does."""
    section = [""]

    def potential(error: Any, part: Packed, work: Any, out: Any) -> None:
        arrays = {"z1": error.value, "dz1": error.rate}
        out.value[:], out.rate[:] = tape.call("potential", arrays, {"gradient": n, "product": n})

    def damping_force(z: Any, part: Packed, work: Any, force: Any) -> None:
        (force[:],) = tape.call("damping_force", {"z2": z}, {"force": n})

    def of_law(words: str) -> Hook:
        return lambda plain: after(lambda *_: tape.remark(words), plain)

    def of_tree(words: str) -> Hook:
        return lambda plain: after(lambda *_: section.__setitem__(0, words), plain)

    def of_joint(plain: Callable[..., Any]) -> Callable[..., Any]:
        return after(lambda i, *_: tape.remark(f"{section[0]} {i + 1}"), plain)

    return {
        "potential": lambda _: potential,
        "damping_force": lambda _: damping_force,
        "joint_of": of_joint,
        **{name: of_law(words) for name, words in _LAW.items()},
        **{name: of_tree(words) for name, words in _TREE.items()},
    }


def after(before: Callable[..., Any], kernel: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel that runs after something else, which is given the same."""

    def run(*given: Any) -> Any:
        before(*given)
        return kernel(*given)

    return run
