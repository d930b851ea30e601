"""The interface of all controllers: memory and state in, torque and memory out."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from nbs_pin.base.arguments import PERIOD, a, checked, choice, flag, joints, maybe, path
from nbs_pin.base.arrays import Array, Vectors
from nbs_pin.base.checks import PerJoint, floats, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import Shown, joints_told
from nbs_pin.controllers.exported import Parts, export_law
from nbs_pin.export.reals import Precision
from nbs_pin.kernels.layout import Packed


class Controller(Shown, ABC):
    """A tracking law, evaluated once per control period; its memory is a value that the caller keeps.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, aim = nbs.PID.for_robot(robot), nbs.Hold([0.3, 0.2])(0.0)
        >>> memory = law.initial_memory(aim.q)
        >>> for _ in range(3):  # what `simulate` does, without an arm
        ...     tau, memory = law.step(memory, aim.q, aim.v, aim, period=0.001)
        >>> tau.shape
        (2,)
    """

    @property
    @abstractmethod
    def nv(self) -> int:
        """Number of joints."""

    @property
    def law_name(self) -> str:
        """Class of the law, as runs record it: that of the original for a law as machine code."""
        return type(self).__name__

    def _facts(self) -> Iterable[str]:
        return (joints_told(self.nv),)

    @abstractmethod
    def initial_memory(self, q: Vectors) -> Any:
        """Memory before the first step, for a start at q; None for a law without memory."""

    @abstractmethod
    def step(self, memory: Any, q: Vectors, v: Vectors, reference: Reference, period: float) -> tuple[Vectors, Any]:
        """Torque τ [N·m] to hold for the next period [s], and the memory for the step after it."""

    def recorded(self, memory: Any) -> Array | None:
        """What a run records of the memory, (..., m); None for nothing."""
        return None

    def estimates(self, recorded: np.ndarray) -> tuple[np.ndarray, list[str]]:
        """What was `recorded` (rows, ..., m) in the units of the arm (rows, ..., k), and names of the k numbers."""
        numbers = np.atleast_1d(floats("recorded", recorded))
        return numbers, [f"number {k + 1}" for k in range(numbers.shape[-1])]

    @property
    def packable(self) -> bool:
        """Whether the law has a compiled form (`packed_law`, `compile`)."""
        return False

    @checked(numpy=flag)
    def packed_law(self, *, numpy: bool = True) -> Packed:
        """Constants and weights of the law in the layout of the kernels (`kernels/layout.py`).

        Args:
            numpy: True gives an array, False a tensor of the same numbers, differentiable in the law's parameters.

        Raises:
            ArgumentError: If the law is not `packable`.
        """
        raise ArgumentError(f"{type(self).__name__} has no compiled form; run it uncompiled, or use built-in parts.")

    def compile(self) -> "Controller":
        """The same law as machine code, for numpy: a snapshot that later changes of this controller do not affect.

        The torques agree to a relative 1e-12. A law without a compiled form returns itself: a law from outside the
        package, a subclass, which may compute another torque, or a network with a user-defined activation.
        """
        return self

    def parts_in_c(self) -> Parts:
        """What `export` writes; raises ArgumentError for a law that has no form in C."""
        model: Any = getattr(self, "dynamics", None)
        robot = getattr(self, "robot", None) if model is None else model.robot
        return Parts.of(self.packed_law(), model, robot)

    @checked(
        folder=path,
        precision=choice("double", "float"),
        gravity=flag,
        rate_limit=joints(above=0.0, unit="N·m/s", infinite=True),
        period=maybe(PERIOD),
    )
    def export(
        self,
        folder: str | Path,
        *,
        precision: Precision = "double",
        gravity: bool = True,
        rate_limit: PerJoint = np.inf,
        period: float | None = None,
        certificate: Any = None,
    ) -> Path:
        """Write the law as C99 without heap and globals, with self-test and what middleware needs (docs/export.md).

        Files and functions are called after the folder: panda_law/ gets panda_law.h and panda_law.c with
        `panda_law_step`.

        Args:
            folder: Where to write; created if missing, files of the same names are replaced.
            precision: "double" or "float".
            gravity: False leaves G(q) out, for an arm that adds it itself, as Franka's do.
            rate_limit: Largest change of the torque per second [N·m/s], one number or one per joint; inf for none.
            period: Control period of the self-test [s]; of an `AdaptiveLaw` at most its own. None takes that, or 1 ms.
            certificate: A `Certificate` of this law, whose bounds the header then states, or None.

        Returns:
            The header.

        Raises:
            ArgumentError: For a law without a compiled form, a model that is no rigid tree, or another's certificate.

        Example:
            >>> import tempfile
            >>> import nbs_pin as nbs
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     nbs.PD.for_robot(nbs.load_robot("two_link")).export(f"{folder}/two_link_pd").name
            'two_link_pd.h'
        """
        files = export_law(
            self,
            Path(folder),
            precision=precision,
            gravity=gravity,
            rate_limit=np.asarray(rate_limit),
            period=period,
            certificate=certificate,
        )
        return files[0]


class MemorylessController(Controller):
    """A law whose torque depends only on the present state and reference.

    Example:
        >>> import nbs_pin as nbs
        >>> class Spring(nbs.MemorylessController):
        ...     nv = 1
        ...     def torque(self, q, v, q_ref, v_ref, a_ref):
        ...         return -10.0 * (q - q_ref) - 2.0 * (v - v_ref)
        >>> Spring().step(None, 0.1, 0.0, nbs.Reference(0.0, 0.0, 0.0), 0.001)
        (-1.0, None)
    """

    @abstractmethod
    def torque(self, q: Array, v: Array, q_ref: Array, v_ref: Array, a_ref: Array) -> Vectors:
        """Torque τ [N·m] for the state (q, v) and the reference (q_ref, v_ref, a_ref), all of shape (..., nv)."""

    def initial_memory(self, q: Vectors) -> None:
        """None: the law has no memory."""
        return None

    def step(self, memory: None, q: Vectors, v: Vectors, reference: Reference, period: float) -> tuple[Vectors, None]:
        """`torque` at the present state; memory and period are unused."""
        try:
            aim = reference.q, reference.v, reference.a
        except AttributeError as error:
            raise ArgumentError(f"reference is {told(reference)}, expected a Reference of q, v and a.") from error
        return self.torque(q, v, *aim), None


CONTROLLER = a(Controller, "a control law, such as NeuralBackstepping.for_robot(robot)")
"""The check of an argument that is a controller."""
