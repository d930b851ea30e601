"""The momentum observer: the torque from outside on each joint, found without acceleration (docs/theory.md §9)."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from nbs_pin.base.arguments import PERIOD, a, checked, count, joints, writable
from nbs_pin.base.arrays import Array, JointArray, Vectors, as_vectors, finite_result, is_torch_array, matvec
from nbs_pin.base.checks import PerJoint, floats
from nbs_pin.base.csv_files import write_csv
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.records import RUN, Run
from nbs_pin.base.shown import Cells, Shown, joints_told, spread
from nbs_pin.base.units import JointUnits, counted, measured, units_of
from nbs_pin.dynamics.friction import JointFriction, friction_of_size, has_viscous_and_coulomb_only
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.dynamics.provider import MODEL, DynamicsProvider
from nbs_pin.kernels import momenta as at
from nbs_pin.kernels.jit import NOT_TAKEN
from nbs_pin.kernels.threads import Scratch, over_cores
from nbs_pin.kernels.tree_layout import tree_workspace
from nbs_pin.robots.robot import ARM, Robot

GAIN = 50.0
"""Default K_o [1/s]: after 20 ms the estimate has 63 % of a torque that sets in."""
_BATCH = 4096  # states at which a model that is no rigid tree is evaluated at once


class ExternalTorque(NamedTuple):
    """What a momentum observer knows at an instant; vectors have the shape (..., n).

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> observer, still = nbs.MomentumObserver(nbs.AnalyticDynamics(), gain=50.0), np.zeros(2)
        >>> seen, memory = observer.step(observer.initial(still, still), still, still, [29.4, 7.8], period=0.02)
        >>> seen.torque.round(3)  # 2 N·m less than G at rest: something else holds 63 % of it, as far as one knows yet
        array([0.   , 1.264])
    """

    torque: Vectors
    """r, the estimate of the torque from outside [N·m, N]; positive where it drives the joint."""
    momentum: Vectors
    """p = M(q) v [N·m·s, N·s]."""


class ObserverMemory(NamedTuple):
    """What a momentum observer remembers between two samples."""

    rows: Float[np.ndarray, "3 *batch n"]
    """p, β and r (`kernels/momenta.py`)."""


MEMORY = a(ObserverMemory, "the memory that `initial` or `step` returned")


@dataclass(frozen=True, eq=False, repr=False)
class ObservedTorques(Shown):
    """The torque from outside along a run, as `MomentumObserver.observe` estimates it.

    Example:
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> law, plant = nbs.NeuralBackstepping.for_robot(robot), nbs.DynamicsPlant.for_robot(robot)
        >>> push = nbs.ConstantTorque([2.0, 0.0])
        >>> run = nbs.simulate(plant, law, nbs.Sinusoid.for_robot(robot), 0.5, 0.001, disturbance=push)
        >>> nbs.MomentumObserver.for_robot(robot).observe(run).torque[-1].round(2) + 0.0
        array([2., 0.])
    """

    t: Float[np.ndarray, " rows"]
    """Time [s]."""
    torque: Float[np.ndarray, "rows *batch n"]
    """r, the estimate [N·m, N]; 0 in the first row."""
    disturbance: Float[np.ndarray, "rows *batch n"]
    """τ_d as the run recorded it, which only simulations do [N·m, N]."""
    joint_names: tuple[str, ...]
    """Names of the joints, in order."""
    gain: JointArray
    """K_o of the observer [1/s]."""
    prismatic: Bool[np.ndarray, " n"]
    """True for joints that slide."""

    def _facts(self) -> Iterable[str]:
        return joints_told(len(self.joint_names)), counted(len(self.t), "row"), spread("gain", self.gain, "1/s")

    def _cells(self) -> Cells:
        each = zip(self.joint_names, self.largest, self.units, strict=True)
        return Cells(("joint", "largest torque"), [(name, measured(r, of.torque)) for name, r, of in each])

    @property
    def units(self) -> tuple[JointUnits, ...]:
        """The units of every joint."""
        return units_of(self.prismatic)

    @property
    def largest(self) -> JointArray:
        """Largest |r| of each joint over time and starts [N·m, N]."""
        return np.asarray(np.abs(self.torque).reshape(-1, len(self.joint_names)).max(axis=0))

    @checked(path=writable, start=count(0))
    def save(self, path: str | Path, *, start: int = 0) -> Path:
        """Write one start as a CSV file: `t`, then `external_JOINT` of every joint; returns its path.

        Raises:
            ArgumentError: If there is no such start.
        """
        rows = self.torque.reshape(len(self.t), -1, len(self.joint_names))
        if start >= rows.shape[1]:
            raise ArgumentError(f"start is {start}, but there are starts 0 to {rows.shape[1] - 1}; give one of them.")
        head = ["t", *(f"external_{name}" for name in self.joint_names)]
        return write_csv(Path(path), head, np.column_stack([self.t, rows[:, start]]).tolist())


class MomentumObserver(Shown):
    """The torque from outside on each joint, r → τ_ext with ṙ = K_o(τ_ext − r), from q, v and τ alone.

    The generalised momentum p = M(q) v obeys ṗ = τ + β + τ_ext with β = C(q, v)ᵀv − G(q) − friction(v), hence

        r = K_o (p − p₀ − ∫ (τ + β + r) dt).

    Over a period h in which τ is held, the mean of τ_ext is τ̄ = (p₁ − p₀)/h − τ − ½(β₀ + β₁), up to h²/12·|β̈|, and

        r₁ = r₀ + (1 − e^(−K_o h)) (τ̄ − r₀)

    is the exact step of the filter for that mean, stable at every h. So r is a mean of the past torque, off by at most
    h²/12·|β̈|; noise δv of the velocity appears in it as about K_o M δv. What the model lacks (payload, friction, wrong
    masses) is seen as a torque from outside. A rigid tree is evaluated by a kernel, in microseconds.

    Source: De Luca and Mattone 2005; Haddadin, De Luca and Albu-Schäffer 2017, section V.

    Args:
        dynamics: Model of the arm; rotor inertia is part of its M.
        gain: K_o > 0 [1/s], one number or one per joint.
        friction: Joint friction, which then counts as known, but for what depends on the load; or None.

    Raises:
        ArgumentError: If gain or friction are for another number of joints.

    Example:
        >>> import numpy as np
        >>> import nbs_pin as nbs
        >>> robot = nbs.load_robot("two_link")
        >>> plant, observer = nbs.DynamicsPlant.for_robot(robot), nbs.MomentumObserver.for_robot(robot)
        >>> q, v, tau, push = np.zeros(2), np.zeros(2), np.array([30.0, 10.0]), np.array([0.0, 1.5])
        >>> memory = observer.initial(q, v)
        >>> for _ in range(200):
        ...     q, v = plant.step(q, v, tau + push, 0.001)
        ...     seen, memory = observer.step(memory, q, v, tau, 0.001)
        >>> seen.torque.round(3) + 0.0
        array([0. , 1.5])
    """

    @checked(dynamics=MODEL, gain=joints(above=0.0, unit="1/s"))
    def __init__(
        self, dynamics: DynamicsProvider, gain: PerJoint = GAIN, friction: JointFriction | None = None
    ) -> None:
        n = dynamics.nv
        if np.shape(gain) not in ((), (n,)):
            raise ArgumentError(f"gain has {np.size(gain)} numbers for {n} joints; give one, or one per joint.")
        self.dynamics, self.gain, self.friction = dynamics, np.full(n, gain), friction_of_size(friction, n)
        tree = dynamics.packed_tree()
        self._tree: tuple[np.ndarray, ...] = () if tree is None else tuple(tree)
        at.compile_momenta()
        plain = has_viscous_and_coulomb_only(friction)
        if tree is not None:
            self._scratch = Scratch(tree_workspace(tree))
            self._constants = np.zeros((at.CONSTANTS, n))
            self._constants[at.GAIN], self._constants[at.TRANSITION] = self.gain, 1.0
            if friction is not None:
                self._constants[at.VISCOUS], self._constants[at.COULOMB] = friction.viscous, friction.coulomb
                self._constants[at.TRANSITION] = friction.transition
        self._fast = plain and tree is not None

    @classmethod
    @checked(robot=ARM)
    def for_robot(
        cls, robot: Robot, gain: PerJoint = GAIN, friction: JointFriction | None = None
    ) -> "MomentumObserver":
        """The observer with the model of the arm's description, `PinocchioDynamics(robot)`."""
        return cls(PinocchioDynamics(robot), gain, friction)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return self.dynamics.nv

    def _facts(self) -> Iterable[str]:
        friction = () if self.friction is None else ("with friction",)
        gain = spread("gain", self.gain, "1/s")
        return joints_told(self.nv), f"model {type(self.dynamics).__name__}", gain, *friction

    def initial(self, q: Vectors, v: Vectors) -> ObserverMemory:
        """The memory at the first sample, where the estimate is 0; q [rad, m] and v [rad/s, m/s], (..., nv)."""
        q, v = self._numpy(q=q, v=v)
        momentum, known = self._terms(q, v)
        rows = np.stack([momentum, known, np.zeros_like(q)])
        return ObserverMemory(finite_result("the momentum", rows, q, v))

    def step(
        self, memory: ObserverMemory, q: Vectors, v: Vectors, tau: Vectors, period: float
    ) -> tuple[ExternalTorque, ObserverMemory]:
        """What is known at a sample, and the memory for the next one.

        Fastest for contiguous float64 vectors (nv,). NaN gives NaN from then on: leave such samples out, and let the
        next period be longer.

        Args:
            memory: From `initial` or the step before.
            q: Position now [rad, m], (..., nv).
            v: Velocity now [rad/s, m/s].
            tau: Torque of the motors since the sample before [N·m, N]; of one that is not held, its mean.
            period: Time since the sample before [s].

        Raises:
            ArgumentError: If shapes do not match, or the period is not > 0.
        """
        period, memory = (
            PERIOD("MomentumObserver.step: period", period),
            MEMORY("MomentumObserver.step: memory", memory),
        )
        if self._fast and isinstance(q, np.ndarray) and q.ndim == 1:
            after, work = np.empty((at.MEMORY, self.nv)), self._scratch.take()
            try:
                fits = at.observe(q, v, tau, period, self._constants, *self._tree, work, memory.rows, after)
            except NOT_TAKEN:  # not all contiguous float64 vectors: converted and checked below
                fits = False
            self._scratch.give(work)
            if fits:
                return _told(after)
        q, v, tau = self._numpy(q=q, v=v, tau=tau)
        return self._step(memory.rows, period, q, v, tau)

    def _step(
        self, before: np.ndarray, period: float, q: Vectors, v: Vectors, tau: Vectors
    ) -> tuple[ExternalTorque, ObserverMemory]:
        if before.shape[1:] != q.shape:
            raise ArgumentError(
                f"the memory is for samples of shape {before.shape[1:]}, but this one has {q.shape}; give the memory of"
                " this loop."
            )
        momentum, known = self._terms(q, v)
        mean = (momentum - before[at.MOMENTUM]) / period - tau - 0.5 * (before[at.KNOWN] + known)
        torque = before[at.TORQUE] - np.expm1(-self.gain * period) * (mean - before[at.TORQUE])
        after = finite_result("the external torque", np.stack([momentum, known, torque]), before, q, v, tau)
        return _told(after)

    @checked(run=RUN)
    def observe(self, run: Run) -> ObservedTorques:
        """The estimate along a run, simulated or logged, with the torques that were applied; of every start.

        The first row is 0. The arm of the run may differ from that of the observer, as with an unknown payload.

        Raises:
            ArgumentError: If the run has another number of joints.
        """
        if run.nv != self.nv:
            raise ArgumentError(
                f"the run has {joints_told(run.nv)} and the observer {self.nv}; give one for the same arm."
            )
        torque = self.estimate(run.t, run.q, run.v, run.tau)
        return ObservedTorques(run.t, torque, run.disturbance, run.joint_names, self.gain, run.slides)

    def estimate(self, t: Array, q: Vectors, v: Vectors, tau: Vectors) -> Vectors:
        """r at the instants t [s], (rows,), of samples (rows, ..., nv); tau acts from each row to the next [N·m, N].

        Raises:
            ArgumentError: If shapes do not match, or the times do not increase.
        """
        q, v, tau = self._numpy(q=q, v=v, tau=tau)
        times = floats("t", t)
        if q.ndim < 2 or times.shape != q.shape[:1] or not (np.diff(times) > 0.0).all():
            raise ArgumentError(
                f"t has shape {times.shape} and q {q.shape}, expected increasing times (rows,) and (rows, ..., n)"
                "; give one time for each row."
            )
        momentum, known = self._terms(q, v)
        periods, flat = np.diff(times), (len(times), -1)
        h = periods.reshape(-1, *[1] * (q.ndim - 1))
        mean = np.diff(momentum, axis=0) / h - tau[:-1] - 0.5 * (known[1:] + known[:-1])
        torque = np.zeros(q.shape).reshape(flat)
        gains = np.tile(self.gain, torque.shape[1] // self.nv)
        at.filtered(periods, gains, np.ascontiguousarray(mean.reshape(len(periods), torque.shape[1])), torque)
        return np.asarray(finite_result("the external torque", torque.reshape(q.shape), q, v, tau))

    def _numpy(self, **vectors: Array) -> tuple[np.ndarray, ...]:
        arrays = as_vectors(self.nv, **vectors)
        if is_torch_array(arrays[0]):
            raise ArgumentError(
                "a momentum observer was given torch tensors, expected numpy arrays; give tensor.detach().numpy()."
            )
        return arrays

    def _terms(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """p = M(q) v and β = C(q, v)ᵀv − G(q) − friction(v), both of the shape of q."""
        rows = [np.array(x, order="C").reshape(-1, self.nv) for x in (q, v)]  # copies, since x may be read-only
        momentum, known = self._of_tree(*rows) if self._tree else self._of_model(*rows)
        momentum, known = momentum.reshape(q.shape), known.reshape(q.shape)
        return momentum, known if self.friction is None else known - np.asarray(self.friction.torque(v))

    def _of_tree(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        momentum, known = np.empty_like(q), np.empty_like(q)

        def fill(part: slice) -> None:
            work = self._scratch.take()
            at.tree_momenta(q[part], v[part], *self._tree, work, momentum[part], known[part])
            self._scratch.give(work)

        over_cores(fill, len(q))
        return momentum, known

    def _of_model(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        momentum, known = np.empty_like(q), np.empty_like(q)
        for first in range(0, len(q), _BATCH):
            part = slice(first, first + _BATCH)
            coriolis = np.swapaxes(self.dynamics.coriolis_matrix(q[part], v[part]), -1, -2)
            momentum[part] = matvec(self.dynamics.mass_matrix(q[part]), v[part])
            known[part] = matvec(coriolis, v[part]) - self.dynamics.gravity(q[part])
        return momentum, known


OBSERVER = a(MomentumObserver, "a MomentumObserver, such as MomentumObserver.for_robot(robot)")
"""The check of an argument that is a momentum observer."""
OBSERVED = a(ObservedTorques, "what MomentumObserver.observe returned")
"""The check of an argument that is the torque from outside along a run."""


def _told(after: np.ndarray) -> tuple[ExternalTorque, ObserverMemory]:
    """The record and the memory after a step; the record has numbers of its own."""
    return ExternalTorque(after[at.TORQUE].copy(), after[at.MOMENTUM].copy()), ObserverMemory(after)
