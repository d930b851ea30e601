"""Default gains of an arm from its inertia and effort limits."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np
from jaxtyping import Float
from torch import nn

from nbs_pin.base.arguments import a
from nbs_pin.base.arrays import Array, JointArray, is_torch_array
from nbs_pin.base.checks import SMALLEST, floats, is_usual, told
from nbs_pin.base.exceptions import ArgumentError
from nbs_pin.base.known_code import known_code
from nbs_pin.base.storable import Tensors
from nbs_pin.base.units import units
from nbs_pin.controllers.gain import Gain
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.robots.robot import Robot

PerJoint: TypeAlias = float | JointArray
"""One number for all joints, or one per joint (n,)."""


@dataclass(frozen=True)
class Gains:
    """K, Λ and D₀ of the potential Φ = ½zᵀKz + ψ(z) and the total damping ωM + D₀ + TᵀT, with ΛK = ωI."""

    bandwidth: float
    """ω [rad/s]."""
    stiffness: JointArray
    """Diagonal of K [N·m/rad]."""
    damping: JointArray
    """Diagonal of D₀ [N·m·s/rad]."""

    @property
    def rate(self) -> JointArray:
        """Diagonal of Λ = ωK⁻¹ [rad/s per N·m]."""
        return self.bandwidth / self.stiffness


GAINS = a(Gains, "Gains, as of gains_for_robot")
"""The check of an argument that is gains."""


def gains_for_robot(
    robot: Robot,
    dynamics: DynamicsProvider,
    *,
    bandwidth: float,
    period: float,
    stiffness_per_sample: float = 0.1,
    damping_ratio: float = 0.7,
    start_error: float = 0.3,
) -> Gains:
    """K = k M_e, D₀ = 2ζ√(K M_e), with √k·h = `stiffness_per_sample` and K_i·`start_error` within the effort limit.

    M_e is `effective_inertia`, `bandwidth` ω [rad/s], `period` the control period h [s], `damping_ratio` ζ, and
    `start_error` the largest error [rad] at which the stiffness alone saturates no joint. √k·h = 0.03 is soft, 0.1 a
    good default, 0.4 still stable without delay (docs/theory.md §2).

    Raises:
        ArgumentError: If ω or h is out of range, or robot and dynamics differ in their number of joints.
    """
    check_sampling(bandwidth, period)
    if dynamics.nv != robot.nv:
        raise ArgumentError(f"the dynamics has {dynamics.nv} joints and {robot.name} {robot.nv}; give its own model.")
    inertia = effective_inertia(robot, dynamics)
    stiffness = np.minimum((stiffness_per_sample / period) ** 2 * inertia, robot.effort_limit / start_error)
    return Gains(bandwidth, stiffness, 2.0 * damping_ratio * np.sqrt(stiffness * inertia))


def pd_gains(
    robot: Robot, dynamics: DynamicsProvider, *, bandwidth: float, period: float
) -> tuple[JointArray, JointArray]:
    """K_p [N·m/rad] of `gains_for_robot` and K_d [N·m·s/rad], critically damped at the largest inertia of each joint.

    K_d is at most ½M_e/h, a quarter of the gain at which a sampled damper on the inertia M_e chatters (2M_e/h).
    Raises ArgumentError if ω or h is out of range.
    """
    kp = gains_for_robot(robot, dynamics, bandwidth=bandwidth, period=period).stiffness
    critical = 2.0 * np.sqrt(kp * largest_inertia(robot, dynamics))
    return kp, np.minimum(critical, 0.5 * effective_inertia(robot, dynamics) / period)


def effective_inertia(robot: Robot, dynamics: DynamicsProvider) -> JointArray:
    """M_e,i = min_q 1/(M(q)⁻¹)_ii [kg·m²] over sampled q: the inertia at joint i when the others are free to move."""
    inverse = np.linalg.inv(dynamics.mass_matrix(sample_configurations(robot)))
    return (1.0 / np.diagonal(inverse, axis1=-2, axis2=-1)).min(axis=0)


def largest_inertia(robot: Robot, dynamics: DynamicsProvider) -> JointArray:
    """max_q M_ii(q) [kg·m²] over sampled q: the inertia at joint i when the others are held."""
    return np.diagonal(dynamics.mass_matrix(sample_configurations(robot)), axis1=-2, axis2=-1).max(axis=0)


def sample_configurations(robot: Robot, count: int = 1000, seed: int = 0) -> Float[np.ndarray, "count n"]:
    """Configurations drawn uniformly from the position limits, or from a full turn if a joint has none [rad]."""
    return np.random.default_rng(seed).uniform(*robot.sampling_range, (count, robot.nv))


def check_sampling(bandwidth: float, period: float) -> None:
    """Raises ArgumentError unless ω [rad/s] and h [s] are positive and ωh ≤ ½."""
    if not (0.0 < bandwidth < np.inf and 0.0 < period < np.inf):
        raise ArgumentError(f"bandwidth {bandwidth} rad/s and period {period} s must be positive and finite.")
    if bandwidth * period > 0.5:
        raise ArgumentError(
            f"bandwidth {bandwidth} rad/s at a period of {period} s leaves {1 / (bandwidth * period):.2g} samples per"
            f" time constant; give a bandwidth of at most {0.5 / period:.4g} rad/s or a shorter period."
        )


def warn_if_too_fast(robot: Robot, dynamics: DynamicsProvider, bandwidth: float, start_error: float = 0.3) -> None:
    """Warns if ω²M_ii·`start_error` [N·m] exceeds six times the effort limit of a joint.

    No stability proof covers a saturated law, and from about that value some arms no longer converge.
    """
    asked = bandwidth**2 * largest_inertia(robot, dynamics) * start_error / robot.effort_limit
    worst = int(np.argmax(asked))
    if asked[worst] > 6.0:
        unit = units("position", robot.prismatic)[worst]
        warnings.warn(
            f"at a bandwidth of {bandwidth:g} rad/s joint '{robot.joint_names[worst]}' of {robot.name} needs"
            f" {asked[worst]:.1f} times its effort limit from an error of {start_error} {unit} and may not converge;"
            f" take at most {bandwidth * np.sqrt(6.0 / asked[worst]):.3g} rad/s, or start on the reference.",
            stacklevel=4,  # past the law and the check of its arguments
        )


def positive_gains(nv: int, **gains: PerJoint) -> tuple[JointArray, ...]:
    """The gains as float arrays (nv,), single numbers broadcast; raises ArgumentError unless all are positive."""
    arrays = {name: floats(name, gain) for name, gain in gains.items()}
    for name, gain in arrays.items():
        if gain.shape not in ((), (nv,)) or not (gain >= SMALLEST).all() or not is_usual(gain):
            raise ArgumentError(f"{name} is {told(gain)}; give one positive number, or {nv}, one per joint.")
    return tuple(np.full(nv, gain) for gain in arrays.values())


@known_code
class PositiveGains(nn.ModuleDict):
    """Named gains, each one positive number or one per joint (nv,); training keeps them positive (`Gain`, φ = 0)."""

    def __init__(self, nv: int, **gains: PerJoint) -> None:
        arrays = zip(gains, positive_gains(nv, **gains), strict=True)
        super().__init__({name: Gain(array, name=name) for name, array in arrays})

    def value(self, *, numpy: bool) -> tuple[Float[Array, " n"], ...]:
        """All gains in the order given, as numpy arrays or as tensors differentiable in the parameters."""
        return tuple(cast(Gain, gain).value(numpy=numpy) for gain in self.values())

    def like(self, x: Array) -> tuple[Float[Array, " n"], ...]:
        """All gains with the array type of x."""
        return self.value(numpy=not is_torch_array(x))

    def numpy(self, name: str) -> JointArray:
        """The gain of that name as a numpy array."""
        return self.named(name).numpy()

    def named(self, name: str) -> Gain:
        """The gain of that name with its trainable parameter."""
        return cast(Gain, self[name])


def stored_gains(*names: str) -> Callable[[Tensors], Mapping[str, Any]]:
    """Reader of a law's `PositiveGains` from its stored tensors (`base/storable.py`)."""
    return lambda t: {name: t[f"gains.{name}.nominal"].numpy(force=True) for name in names}
