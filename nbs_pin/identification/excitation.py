"""Exciting motions for identification, within joint ranges, velocity limits and torque limits."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arrays import JointArray
from nbs_pin.base.records import Reference
from nbs_pin.controllers.gains import effective_inertia, largest_inertia, sample_configurations
from nbs_pin.controllers.pd import PD
from nbs_pin.dynamics.friction import JointFriction
from nbs_pin.dynamics.pinocchio import PinocchioDynamics
from nbs_pin.motions.references import Sinusoid
from nbs_pin.robots.robot import Robot

_BAND = (0.2, 1.5)  # [Hz]; passes the differentiation window of a quantised record unattenuated
_TONES = 6
_LOOP = 6.0  # [rad/s]; low, so that the exciting torques move the arm
_DAMPING = 1.4  # 2ζ
_HEADROOM = 20.0  # [rad/s²]


@dataclass(frozen=True, eq=False)
class Multisine:
    """q = offset + Σ_k amplitude_k sin(frequency_k t + phase_k), per joint; arrays of shape (tones, n)."""

    amplitude: Float[np.ndarray, "tones n"]
    """Amplitudes [rad]."""
    frequency: Float[np.ndarray, "tones n"]
    """Angular frequencies [rad/s]."""
    phase: Float[np.ndarray, "tones n"]
    """Phases [rad]."""
    offset: JointArray
    """Mean configuration [rad]."""

    def __call__(self, t: Any) -> Reference:
        """Reference at t [s]."""
        A, w = self.amplitude, self.frequency
        angle = w * np.asarray(t, dtype=float)[..., None, None] + self.phase
        sine, cosine = np.sin(angle), np.cos(angle)
        q, v, a = (term.sum(axis=-2) for term in (A * sine, A * w * cosine, -A * w**2 * sine))
        return Reference(self.offset + q, v, a)


def soft_pd(robot: Robot, friction: JointFriction | None = None, *, period: float) -> PD:
    """The PD with gravity compensation about which the arm is excited, of 6 rad/s, its damping limited by the period.

    The reference x adds the torque K_p x + K_d ẋ to a PD that holds the arm, so sines in x are sines in torque.
    Friction is fed forward at ẋ; period [s].
    """
    model = PinocchioDynamics(robot)
    # Accelerations of its neighbours disturb a light joint, so its gains follow the sum over its row of |M|.
    inertia = np.abs(model.mass_matrix(sample_configurations(robot))).sum(axis=-1).max(axis=0)
    kd = np.minimum(_DAMPING * _LOOP * inertia, 0.25 * effective_inertia(robot, model) / period)
    return PD(model, feedforward="gravity", kp=_LOOP * kd / _DAMPING, kd=kd, friction=friction)


def excitation(robot: Robot, generator: np.random.Generator, speed: float) -> Multisine:
    """A random reference of `soft_pd`: sines of 0.2 to 1.5 Hz with about equal speeds, within the joint ranges.

    The RMS speed is 0.6·`speed` [rad/s], at most 0.35 of the velocity limit, so that peaks stay near it; the sum of the
    amplitudes keeps the reference within the ranges.
    """
    n, (lower, upper), band = robot.nv, configuration_box(robot), np.log(_BAND)
    frequency = 2.0 * np.pi * np.exp(generator.uniform(band[0], band[1], (_TONES, n)))
    amplitude = generator.uniform(0.3, 1.0, (_TONES, n)) / frequency
    rms = np.sqrt(0.5 * ((amplitude * frequency) ** 2).sum(axis=0))
    amplitude *= np.minimum(0.6 * speed, 0.35 * robot.velocity_limit) / rms
    amplitude *= np.minimum(1.0, 0.35 * (upper - lower) / amplitude.sum(axis=0))
    swing = amplitude.sum(axis=0)
    offset = generator.uniform(lower + swing, upper - swing)
    return Multisine(amplitude, frequency, generator.uniform(-np.pi, np.pi, (_TONES, n)), offset)


def work(robot: Robot, generator: np.random.Generator) -> Sinusoid:
    """A typical motion in use: `Sinusoid.for_robot` with random frequency from 0.5 to 4 rad/s and random phase."""
    frequency = float(np.exp(generator.uniform(np.log(0.5), np.log(4.0))))
    usual = Sinusoid.for_robot(robot, frequency)
    return Sinusoid(usual.amplitude, usual.frequency, generator.uniform(-np.pi, np.pi, robot.nv), usual.offset)


def configuration_box(robot: Robot) -> tuple[JointArray, JointArray]:
    """(lower, upper) of the sampled configurations [rad, m]: the joint ranges, at most one turn of a revolute joint."""
    return robot.one_turn_range


def torque_limits(robot: Robot) -> JointArray:
    """Torque limits of an experiment [N·m]: the arm's own, else the largest gravity torque plus that of 20 rad/s²."""
    if np.isfinite(robot.effort_limit).all():
        return robot.effort_limit
    model = PinocchioDynamics(robot)
    heaviest = np.abs(model.gravity(sample_configurations(robot))).max(axis=0)
    usable = heaviest + _HEADROOM * largest_inertia(robot, model)
    return np.where(np.isfinite(robot.effort_limit), robot.effort_limit, usable)
