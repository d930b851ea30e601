"""Encoders as a monitor knows them: what readings of a stated resolution can say, and over which window."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nbs_pin.base.arguments import PERIOD, check_fields, checked, count, number
from nbs_pin.base.arrays import JointArray
from nbs_pin.certificates.certificate import CERTIFICATE, Certificate
from nbs_pin.dynamics.provider import DynamicsProvider
from nbs_pin.kernels import verdicts as at

LONGEST = 0.16
"""Longest window [s]: a step is seen within it."""
_OF_BOUND = 0.25  # of the bound of a torque: what quantisation may leave uncertain before a window is lengthened
_POSES = 32


@dataclass(frozen=True)
class Encoders:
    """Positions are rounded to encoder steps. Velocities are taken from them by any filter, which need not be stated.

    The monitor forms its own velocities and accelerations as differences of the positions, and their means over a
    window, whose errors are bounded by the encoder step (docs/certificates.md §12).

    Raises:
        ArgumentError: Unless 0 ≤ step < 0.5.

    Example:
        >>> import nbs_pin as nbs
        >>> nbs.Encoders.of_bits(16).step == 2**-16
        True
    """

    step: float
    """Encoder step as a share of a turn (of 1 m for a prismatic joint), such as 2**-16."""

    def __post_init__(self) -> None:
        check_fields(self, step=number(least=0.0, below=0.5, unit="of a turn"))

    @classmethod
    @checked(bits=count(2, 300))
    def of_bits(cls, bits: int) -> "Encoders":
        """Encoders of that many bits per turn."""
        return cls(2.0**-bits)

    @checked(certificate=CERTIFICATE)
    def resolution(self, certificate: Certificate) -> JointArray:
        """The encoder step of each joint [rad, m]."""
        robot, n = certificate.robot, certificate.controller.nv
        turn = np.full(n, 2.0 * np.pi) if robot is None else np.where(robot.prismatic, 1.0, 2.0 * np.pi)
        return np.asarray(self.step * turn)

    @checked(certificate=CERTIFICATE, period=PERIOD)
    def half_width(self, certificate: Certificate, period: float) -> int:
        """m of the shortest window that tells torques to a quarter of their bound, at most `LONGEST` long [periods].

        The uncertainty of the mean torque is at most 2|M|r/(mh)².
        """
        share = _inertia_rows(certificate.controller.dynamics, self.resolution(certificate))
        with np.errstate(divide="ignore", invalid="ignore"):
            wanted = np.nan_to_num(2.0 * share / (_OF_BOUND * certificate.admissible.largest(len(share))), nan=0.0)
        longest = max(int(0.5 * LONGEST / period), 1)
        return int(np.clip(math.ceil(min(math.sqrt(float(wanted.max())) / period, longest)), 1, longest))


class Limits(NamedTuple):
    """The numbers of a certificate that kernels compare torques with (`kernels/verdicts.py`)."""

    rows: Float[np.ndarray, "rows n"]
    numbers: Float[np.ndarray, " numbers"]

    @classmethod
    def of(cls, certificate: Certificate, resolution: JointArray) -> "Limits":
        """Those of a certificate, for encoders of that resolution [rad], 0 for exact states."""
        law, robot, admissible = certificate.controller, certificate.robot, certificate.admissible
        n, gap, fed = law.nv, certificate.friction.gap, law.friction
        rows, numbers = np.zeros((at.LIMITS, n)), np.zeros(at.NUMBERS)
        rows[at.RESOLUTION], rows[at.BOX] = resolution, np.inf if admissible.box is None else admissible.box
        rows[at.GAP_VISCOUS], rows[at.GAP_COULOMB] = np.abs(gap.viscous), np.abs(gap.coulomb)
        rows[at.LOWER], rows[at.UPPER] = (-np.inf, np.inf) if robot is None else (robot.lower, robot.upper)
        rows[at.WRAPS] = False if law.dynamics.robot is None else law.dynamics.robot.continuous
        if fed is not None:
            rows[at.VISCOUS], rows[at.COULOMB] = fed.viscous, fed.coulomb
        numbers[at.RADIUS] = np.inf if admissible.box is not None else admissible.radius
        numbers[at.TRANSITION] = 1.0 if fed is None else fed.transition
        if certificate.mismatch is not None:
            error = certificate.mismatch
            numbers[[at.OF_Q, at.OF_V, at.CONSTANT]] = error.a, error.b, error.c
        return cls(rows, numbers)


def _inertia_rows(dynamics: DynamicsProvider, resolution: JointArray) -> JointArray:
    """The largest |M|r over some poses [kg·m²·rad]."""
    rng, n = np.random.default_rng(0), dynamics.nv
    lower, upper = (-np.pi, np.pi) if dynamics.robot is None else dynamics.robot.one_turn_range
    poses = rng.uniform(np.broadcast_to(lower, n), np.broadcast_to(upper, n), (_POSES, n))
    return np.asarray((np.abs(dynamics.mass_matrix(poses)) @ resolution).max(axis=0))
