"""PID without a model, as an industrial joint controller has it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.arrays import Array, as_vectors, is_torch_array
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.gains import PerJoint, pd_gains, positive_gains
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.exceptions import ArgumentError
from nbs_pin.robot import Robot, configuration_difference
from nbs_pin.runtime.laws import compile_laws, pid
from nbs_pin.state import Reference


class PIDMemory(NamedTuple):
    """What a PID remembers between two samples, each (..., nv)."""

    integral: Array
    """Integral torque [N·m]."""
    derivative: Array
    """Filtered ż1 [rad/s]."""


class PID(Controller):
    """τ = −K_p z1 − I − K_d y,  İ = K_i z1,  T_f ẏ = ż1 − y, per joint, with clamping anti-windup.

    The integral rests while the torque is saturated and the error would drive it further (Åström and Hägglund 2006,
    section 3.5). kp [N·m/rad], ki [N·m/(rad·s)], kd [N·m·s/rad]: (n,), positive. filter_time: T_f ≥ 0 [s].
    effort_limit: where saturation begins [N·m], (n,). continuous: joints whose error wraps, (n,) or None.
    Raises ArgumentError for gains, limits or a filter time out of range.
    """

    def __init__(
        self,
        *,
        kp: Float[np.ndarray, " n"],
        ki: PerJoint,
        kd: PerJoint,
        effort_limit: PerJoint,
        filter_time: float = 0.0,
        continuous: np.ndarray | None = None,
    ) -> None:
        nv = np.size(kp)
        self.kp, self.ki, self.kd, self.effort_limit = positive_gains(
            nv, kp=kp, ki=ki, kd=kd, effort_limit=effort_limit
        )
        if not 0.0 <= filter_time < np.inf:
            raise ArgumentError(f"filter_time is {filter_time} s; give a time ≥ 0.")
        self.filter_time = filter_time
        self.continuous = np.zeros(nv, dtype=bool) if continuous is None else np.asarray(continuous, dtype=bool)
        if self.continuous.shape != (nv,):
            raise ArgumentError(f"continuous has {self.continuous.size} entries, expected {nv}: one per joint.")

    @classmethod
    def for_robot(cls, robot: Robot, *, bandwidth: float = 8.0, period: float = 0.001) -> "PID":
        """PD gains from the arm's inertia (`pd_gains`), integral time 4/ω, derivative filter two samples long."""
        kp, kd = pd_gains(robot, PinocchioDynamics(robot), bandwidth=bandwidth, period=period)
        return cls(
            kp=kp,
            ki=0.25 * bandwidth * kp,
            kd=kd,
            effort_limit=robot.effort_limit,
            filter_time=2.0 * period,
            continuous=robot.continuous,
        )

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self.kp)

    def initial_memory(self, q: Float[np.ndarray, "*batch n"]) -> PIDMemory:
        """No integral, derivative at rest."""
        return PIDMemory(np.zeros_like(q), np.zeros_like(q))

    def step(
        self,
        memory: PIDMemory,
        q: Float[np.ndarray, "*batch n"],
        v: Float[np.ndarray, "*batch n"],
        reference: Reference,
        period: float,
    ) -> tuple[Float[np.ndarray, "*batch n"], PIDMemory]:
        """τ [N·m] for the next period [s], and the memory after it."""
        z1 = configuration_difference(q, reference.q, self.continuous)
        blend = period / (self.filter_time + period)  # backward Euler of the filter
        derivative = memory.derivative + blend * (v - reference.v - memory.derivative)
        tau = -self.kp * z1 - memory.integral - self.kd * derivative
        winding = (np.abs(tau) > self.effort_limit) & (tau * z1 < 0.0)
        integral = memory.integral + np.where(winding, 0.0, self.ki * period * z1)
        return tau, PIDMemory(integral, derivative)

    def compile(self) -> Controller:
        """The law as machine code (`Controller.compile`)."""
        if type(self) is not PID:
            return self
        filter_time = np.full(self.nv, self.filter_time)
        return CompiledPID(np.array([self.kp, self.ki, self.kd, self.effort_limit, filter_time, self.continuous]))


class CompiledPID(Controller):
    """`PID.step` as machine code, memory in, memory out; numpy only.

    gains: rows k_p, k_i, k_d, effort limit, T_f, continuous (6, n).
    """

    def __init__(self, gains: Float[np.ndarray, "6 n"]) -> None:
        compile_laws()
        self.gains = gains

    @property
    def nv(self) -> int:
        """Number of joints."""
        return int(self.gains.shape[1])

    def initial_memory(self, q: Float[np.ndarray, "*batch n"]) -> PIDMemory:
        """No integral, derivative at rest."""
        return PIDMemory(np.zeros_like(q), np.zeros_like(q))

    def step(
        self, memory: PIDMemory, q: Array, v: Array, reference: Reference, period: float
    ) -> tuple[Float[np.ndarray, "*batch n"], PIDMemory]:
        """τ [N·m] for the next period [s], and the memory after it.

        Raises ArgumentError when shapes do not fit, or for tensors.
        """
        if isinstance(q, np.ndarray) and q.ndim == 1:
            out = np.empty((3, self.nv))
            try:
                fits = pid(*memory, q, v, reference.q, reference.v, float(period), self.gains, out)
            except TypeError:  # not all contiguous float64 vectors: converted and checked below
                fits = False
            if fits:
                return out[0], PIDMemory(out[1], out[2])
        return self._steps(memory, q, v, reference, period)

    def _steps(
        self, memory: PIDMemory, q: Array, v: Array, reference: Reference, period: float
    ) -> tuple[Float[np.ndarray, "*batch n"], PIDMemory]:
        given = as_vectors(
            self.nv,
            integral=memory.integral,
            derivative=memory.derivative,
            q=q,
            v=v,
            q_ref=reference.q,
            v_ref=reference.v,
        )
        if is_torch_array(given[0]):
            raise ArgumentError("a compiled PID was given torch tensors, expected numpy arrays; convert them.")
        out = np.empty((3, given[0].size))
        pid(*(np.array(x, dtype=float).ravel() for x in given), float(period), self.gains, out)
        tau, integral, derivative = out.reshape(3, *given[0].shape)
        return tau, PIDMemory(integral, derivative)
