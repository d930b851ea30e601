"""A run of an adaptive law beside the bounds of its errors, and what it assumes that was not so."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.arguments import checked, writable
from nbs_pin.base.arrays import JointArray
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import Run
from nbs_pin.base.shown import Shown
from nbs_pin.base.units import counted, measured
from nbs_pin.certificates.admissible import Admissible
from nbs_pin.certificates.assumptions import LARGEST
from nbs_pin.certificates.sampled_motion import unexplained_steps
from nbs_pin.controllers.adaptive_law import AdaptiveLaw
from nbs_pin.controllers.lyapunov_law import LyapunovLaw

_ROUNDING = 1.0 + 1e-9


@dataclass(frozen=True, eq=False, repr=False)
class TransientCheck(Shown):
    """|z1_i| along one run of an adaptive law, the bounds, and the assumptions that failed.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law = nbs.AdaptiveLaw(nbs.NeuralBackstepping.for_robot(robot), load_mass=0.5)
        >>> plant = nbs.DynamicsPlant.for_robot(robot.with_payload("tip", 0.5))
        >>> run = nbs.simulate(plant, law, nbs.Sinusoid.for_robot(robot), 1.0, 0.001)
        >>> seen = nbs.transient_bound(law, 0.5).check(run)
        >>> seen.is_kept, seen.ratio < 1.0, seen.failures
        (True, True, {})
    """

    t: Float[np.ndarray, " rows"]
    """Time from the first row [s]."""
    joint_errors: Float[np.ndarray, "rows n"]
    """|z1_i| [rad, m]."""
    joint_bounds: Float[np.ndarray, "rows n"]
    """Bound of each |z1_i| at that time [rad, m]; inf where none is known."""
    joint_names: tuple[str, ...]
    joint_units: tuple[str, ...]
    failures: dict[str, float]
    """What was not as the bound assumes, and the first time that it was not [s]."""

    @property
    def ratio(self) -> float:
        """The largest |z1_i| as a share of its bound; NaN where a number is not finite."""
        return float((self.joint_errors / self.joint_bounds).max())

    @property
    def exceeded(self) -> Bool[np.ndarray, "rows n"]:
        """Where an error is beyond its bound, or no number."""
        return np.asarray(~(self.joint_errors <= self.joint_bounds * _ROUNDING))

    @property
    def is_kept(self) -> bool:
        """Whether every error stayed within its bound."""
        return not self.exceeded.any()

    @property
    def verdict(self) -> str:
        """One sentence: whether the bounds were kept, and which assumptions failed."""
        over = self.exceeded
        row, joint = np.unravel_index(int((over if over.any() else self._shares).argmax()), over.shape)
        error, bound = (
            measured(float(x[row, joint]), self.joint_units[joint]) for x in (self.joint_errors, self.joint_bounds)
        )
        until = self.t[row] if over.any() else np.inf  # what failed later explains nothing
        failed = ", ".join(f"{name} (t = {t:.4g} s)" for name, t in self.failures.items() if t <= until)
        if not over.any():
            said = f"promise kept: {self.joint_names[joint]} came nearest, {error} of {bound}"
            unknown = ~np.isfinite(self.joint_bounds).all(axis=1)
            said += f" (none is known after t = {self.t[~unknown].max(initial=0.0):.4g} s)" if unknown.any() else ""
            return f"{said}, though {failed}" if failed else said
        said = f"promise broken at t = {self.t[row]:.4g} s: {self.joint_names[joint]} was {error} off, beyond {bound}"
        return f"{said}, as {failed or 'the load, the model or a torque from outside is not as stated'}"

    @property
    def _shares(self) -> Float[np.ndarray, "rows n"]:
        return np.asarray(self.joint_errors / self.joint_bounds)

    @checked(path=writable)
    def save(self, path: str | Path) -> Path:
        """Write times and each joint's |z1| with its bound as a CSV file; returns its path."""
        joints = [f"{kind}_{name}" for kind in ("error", "bound") for name in self.joint_names]
        rows = np.column_stack([self.t, self.joint_errors, self.joint_bounds])
        return write_csv(Path(path), ["t", *joints], rows.tolist())

    def _facts(self) -> Iterable[str]:
        return f"{len(self.t)} rows", self.verdict


@dataclass(frozen=True, eq=False)
class Assumed:
    """What the bounds of an adaptive law assume of a run."""

    law: AdaptiveLaw
    start: float
    """V(0) [J]."""
    admissible: Admissible
    duration: float
    """How long the first bounds hold [s]."""
    joint_errors: JointArray
    joint_errors_always: JointArray

    def check(self, run: Run, start: int, joint_units: tuple[str, ...]) -> TransientCheck:
        """The check of one start of a run; raises ArgumentError for a run of another arm or law."""
        self._refuse(run, start)
        names = ("q", "v", "q_ref", "v_ref", "a_ref", "tau", "tau_command", "disturbance")
        rows = {name: getattr(run, name).reshape(len(run.t), -1, run.nv)[:, start] for name in names}
        t = run.t - run.t[0]
        z1 = self.law.law.dynamics.difference(rows["q"], rows["q_ref"])
        bounds = np.where((t <= self.duration * _ROUNDING)[:, None], self.joint_errors, self.joint_errors_always)
        assert run.estimates is not None
        failed = self._failed(t, rows, run.estimates.reshape(len(t), -1, run.estimates.shape[-1])[0, start])
        return TransientCheck(t, np.abs(z1), bounds, self.law.robot.joint_names, joint_units, failed)

    def _failed(
        self, t: Float[np.ndarray, " rows"], rows: dict[str, np.ndarray], began: Float[np.ndarray, " k"]
    ) -> dict[str, float]:
        """What was not so, and since when."""
        known = self.law.estimate().values
        lost = ~(np.abs(np.stack(list(rows.values()))) <= LARGEST).all(axis=(0, 2))
        begin = self._storage(rows)
        outside = np.array([not self.admissible.contains(x) for x in rows["disturbance"]])
        jumped, continuous = np.zeros(len(t), dtype=bool), self.law.robot.continuous
        for rest, allowed in unexplained_steps(t, rows["q_ref"], rows["v_ref"], rows["a_ref"], continuous):
            jumped[1:] |= (rest > allowed).any(axis=1)
        found = {
            "a number is not finite": lost,
            "a torque was cut off": (rows["tau"] != rows["tau_command"]).any(axis=1),
            "the recorded disturbance was larger than stated": outside & ~lost,
            "the reference contradicts its own derivatives": jumped,
            "the estimates did not begin as those of the law": np.array([not np.allclose(began, known)]),
            "a period was longer than the law's": np.diff(t, prepend=t[0]) > self.law.period * (1.0 + 1e-6),
            f"the start has V = {begin:.3g} J or more, above the stated {self.start:.3g} J": np.array(
                [not begin <= self.start * _ROUNDING + 1e-12]
            ),
        }
        return {name: float(t[when.argmax()]) for name, when in found.items() if when.any()}

    def _storage(self, rows: dict[str, np.ndarray]) -> float:
        """V(0) of the arm as the model has it [J], which a load only adds to."""
        state = tuple(rows[name][0] for name in ("q", "v", "q_ref", "v_ref"))
        law = self.law.law
        assert isinstance(law, LyapunovLaw)  # as no other law adapts a load
        return float(law.storage(*state)) if np.isfinite(state).all() else np.nan

    def _refuse(self, run: Run, start: int) -> None:
        robot = self.law.robot
        starts, count = int(np.prod(run.q.shape[1:-1], dtype=int)), self.law.estimate().values.size
        found = 0 if run.estimates is None else run.estimates.shape[-1]
        if tuple(run.joint_names) != robot.joint_names or found != count:
            raise ArgumentError(
                f"the run is of the joints {', '.join(run.joint_names)} and has {found} estimates, expected "
                f"{', '.join(robot.joint_names)} and {count}; give a run of the law that was bounded."
            )
        if len(run.t) < 2 or not 0 <= start < starts:
            raise ArgumentError(
                f"the run has {counted(len(run.t), 'row')} and {counted(starts, 'start')}, expected at least two rows "
                f"and the start {start}; give a longer run or another start."
            )
