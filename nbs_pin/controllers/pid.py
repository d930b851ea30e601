"""PID control of each joint without a model, as in industrial controllers."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from torch import nn

from nbs_pin.base.arguments import BANDWIDTH, PERIOD, checked, flag, joints, maybe, number
from nbs_pin.base.arrays import (
    Array,
    JointArray,
    Vectors,
    array_namespace,
    as_vectors,
    constant_like,
    finite_result,
    is_torch_array,
)
from nbs_pin.base.checks import floats, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import defines, known_code
from nbs_pin.base.records import Reference
from nbs_pin.base.shown import joints_told, spread
from nbs_pin.base.storable import storable
from nbs_pin.controllers.controller import Controller
from nbs_pin.controllers.gains import PerJoint, PositiveGains, pd_gains, stored_gains
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.kernels.jit import NOT_TAKEN
from nbs_pin.kernels.laws import compile_laws, pid
from nbs_pin.kernels.layout import Packed, pack_pid
from nbs_pin.robots.robot import ARM, Robot, configuration_difference


class PIDMemory(NamedTuple):
    """State of a PID between two samples, each (..., nv)."""

    integral: Array
    """Integral torque [N·m]."""
    derivative: Array
    """Filtered ż1 [rad/s]."""


@known_code
@storable(("effort_limit", "filter_time", "continuous"), parts=("robot",), arrays=stored_gains("kp", "ki", "kd"))
class PID(Controller, nn.Module):
    """τ = −K_p z1 − I − K_d y,  İ = K_i z1,  T_f ẏ = ż1 − y, per joint, with clamping anti-windup.

    I is held while τ is saturated and z1 would saturate it further (Åström and Hägglund 2006, section 3.5).

    Args:
        kp: K_p [N·m/rad], (n,).
        ki: K_i [N·m/(rad·s)], (n,) or one number.
        kd: K_d [N·m·s/rad], (n,) or one number.
        effort_limit: Largest |τ| before saturation [N·m], (n,) or one number.
        filter_time: T_f ≥ 0 [s].
        continuous: True for joints whose error is wrapped, (n,); None for no joint.
        robot: The arm, stored with the controller by `save`, or None.

    Raises:
        ArgumentError: If a number is out of range, or the numbers of joints differ.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.PID.for_robot(nbs.load_robot("two_link"), bandwidth=8.0).ki.round(1)
        array([666.7, 666.7])
    """

    @checked(filter_time=number(least=0.0, unit="s"), robot=maybe(ARM))
    def __init__(
        self,
        *,
        kp: JointArray,
        ki: PerJoint,
        kd: PerJoint,
        effort_limit: PerJoint,
        filter_time: float = 0.0,
        continuous: np.ndarray | None = None,
        robot: Robot | None = None,
    ) -> None:
        super().__init__()
        nv = floats("kp", kp).size
        self.gains = PositiveGains(nv, kp=kp, ki=ki, kd=kd)
        limit = joints(above=0.0, unit="N·m", infinite=True)("PID: effort_limit", effort_limit)
        if limit.shape not in ((), (nv,)):
            raise ArgumentError(f"effort_limit has {limit.size} numbers, expected {nv}; give one per joint.")
        self.effort_limit = np.full(nv, limit)
        self.filter_time = filter_time
        wraps = np.zeros(nv) if continuous is None else floats("continuous", continuous, truths=True)
        self.continuous = wraps.astype(bool)
        if self.continuous.shape != (nv,):
            raise ArgumentError(f"continuous has {self.continuous.size} entries, expected {nv}: one per joint.")
        if robot is not None and robot.nv != nv:
            raise ArgumentError(f"the gains are for {nv} joints and {robot.name} has {robot.nv}; give one per joint.")
        self.robot = robot

    @classmethod
    @checked(robot=ARM, bandwidth=BANDWIDTH, period=PERIOD)
    def for_robot(cls, robot: Robot, *, bandwidth: float = 8.0, period: float = 0.001) -> "PID":
        """Gains of `pd_gains`, integral time 4/ω, and a derivative filter of two periods."""
        kp, kd = pd_gains(robot, PinocchioDynamics(robot), bandwidth=bandwidth, period=period)
        gains = {"kp": kp, "ki": 0.25 * bandwidth * kp, "kd": kd, "effort_limit": robot.effort_limit}
        return cls(**gains, filter_time=2.0 * period, continuous=robot.continuous, robot=robot)

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self.effort_limit)

    def _facts(self) -> Iterable[str]:
        arm = () if self.robot is None else (self.robot.name,)
        gains = (
            spread("K_p", self.kp, "N·m/rad"),
            spread("K_i", self.ki, "N·m/(rad·s)"),
            spread("K_d", self.kd, "N·m·s/rad"),
        )
        return *arm, joints_told(self.nv), *gains

    @property
    def kp(self) -> JointArray:
        """K_p [N·m/rad]."""
        return self.gains.numpy("kp")

    @property
    def ki(self) -> JointArray:
        """K_i [N·m/(rad·s)]."""
        return self.gains.numpy("ki")

    @property
    def kd(self) -> JointArray:
        """K_d [N·m·s/rad]."""
        return self.gains.numpy("kd")

    def initial_memory(self, q: Vectors) -> PIDMemory:
        """Zero integral and derivative with the array type of q."""
        (q,) = as_vectors(self.nv, q=q)
        xp = array_namespace(q)
        return PIDMemory(xp.zeros_like(q), xp.zeros_like(q))

    def step(
        self, memory: PIDMemory, q: Vectors, v: Vectors, reference: Reference, period: float
    ) -> tuple[Vectors, PIDMemory]:
        """τ [N·m] for the next period [s], and the memory after it; differentiable for tensors."""
        period, given = PERIOD("period", period), _signals(self.nv, memory, q, v, reference)
        integral, derivative, q, v, q_ref, v_ref = given
        xp, (kp, ki, kd) = array_namespace(q), self.gains.like(q)
        z1 = configuration_difference(q, q_ref, self.continuous)
        blend = period / (self.filter_time + period)  # backward Euler for the filter
        derivative = derivative + blend * (v - v_ref - derivative)
        tau = finite_result("the torque", -kp * z1 - integral - kd * derivative, *given)
        winding = (abs(tau) > constant_like(q, self.effort_limit)) & (tau * z1 < 0.0)
        integral = integral + xp.where(winding, 0.0 * z1, ki * period * z1)
        return tau, PIDMemory(integral, derivative)

    @property
    def packable(self) -> bool:
        """Whether the kernel implements this law: True unless it is a subclass."""
        return defines(self, "packed_law")

    @checked(numpy=flag)
    def packed_law(self, *, numpy: bool = True) -> Packed:
        """Gains, limits, T_f and wrapped joints for the kernel (`Controller.packed_law`)."""
        if not self.packable:
            return super().packed_law(numpy=numpy)
        kp, ki, kd = self.gains.value(numpy=numpy)
        return pack_pid((kp, ki, kd), self.effort_limit, self.filter_time, self.continuous)

    def compile(self) -> Controller:  # type: ignore[override]  # torch.nn.Module has another compile
        """The law as machine code (`Controller.compile`)."""
        return CompiledPID(self.packed_law()) if self.packable else self


def _signals(nv: int, memory: PIDMemory, q: Array, v: Array, reference: Reference) -> tuple[Array, ...]:
    """Integral, derivative, q, v and the reference's q and v as arrays of one type and shape (..., nv)."""
    if not isinstance(memory, PIDMemory):
        raise ArgumentError(f"memory is {told(memory)}, expected what initial_memory or step returned; give that.")
    try:
        aim = {"q_ref": reference.q, "v_ref": reference.v}
    except AttributeError as error:
        raise ArgumentError(f"reference is {told(reference)}, expected a Reference of q, v and a.") from error
    return as_vectors(nv, **memory._asdict(), q=q, v=v, **aim)


class CompiledPID(Controller):
    """`PID.step` as machine code, for numpy arrays.

    Args:
        law: Rows K_p, K_i, K_d, effort limit, T_f, continuous, (6n,), as a numpy array (`Controller.packed_law`).
    """

    def __init__(self, law: Packed) -> None:
        compile_laws()
        self.law, self.weights = law, law.weights

    @property
    def nv(self) -> int:
        """Number of joints."""
        return len(self.weights) // 6

    @property
    def law_name(self) -> str:
        """PID."""
        return PID.__name__

    def packed_law(self, *, numpy: bool = True) -> Packed:
        """The gains and limits that it was made of, as arrays."""
        return self.law

    def initial_memory(self, q: Vectors) -> PIDMemory:
        """Zero integral and derivative."""
        (q,) = as_vectors(self.nv, q=q)
        if is_torch_array(q):
            raise ArgumentError("a compiled PID was given torch tensors, expected numpy arrays; call `PID`'s method.")
        return PIDMemory(np.zeros_like(q), np.zeros_like(q))

    def step(
        self, memory: PIDMemory, q: Array, v: Array, reference: Reference, period: float
    ) -> tuple[Vectors, PIDMemory]:
        """τ [N·m] for the next period [s], and the memory after it; ArgumentError for tensors or wrong shapes."""
        if type(period) is not float or not 0.0 < period <= 1000.0:
            period = PERIOD("period", period)
        if isinstance(q, np.ndarray) and q.ndim == 1:
            out = np.empty((3, self.nv))
            try:
                fits = pid(*memory, q, v, reference.q, reference.v, period, self.weights, out)
            except (AttributeError, *NOT_TAKEN):  # not all contiguous float64 vectors: converted and checked below
                fits = False
            if fits:
                return out[0], PIDMemory(out[1], out[2])
        return self._steps(memory, q, v, reference, period)

    def _steps(
        self, memory: PIDMemory, q: Array, v: Array, reference: Reference, period: float
    ) -> tuple[Vectors, PIDMemory]:
        given = _signals(self.nv, memory, q, v, reference)
        if is_torch_array(given[0]):
            raise ArgumentError("a compiled PID was given torch tensors, expected numpy arrays; call `PID.step`.")
        out = np.empty((3, given[0].size))
        pid(*(np.array(x, dtype=float).ravel() for x in given), period, self.weights, out)
        tau, integral, derivative = finite_result("the torque", out, *given).reshape(3, *given[0].shape)
        return tau, PIDMemory(integral, derivative)
